"""The input of a result as one file beside it: the depth map as it was read, and the photo.

The input itself may be moved, and what was read of it (its unit, holes, registration) is not in the file alone. With a
copy, a result can be looked at anywhere.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.data.formats.decoding import decode_pixels
from dsr.sample import expect_distances
from dsr.utils.files import array_headers, read_arrays, replacing

INPUT = "input.npz"
LONGEST = 2048
"""Longest side of the stored photo in pixels."""
_QUALITY = 90
_MOST_BYTES = 64 << 20
"""Largest photo that is decoded."""
_MOST_PIXELS = 1 << 28


def write_input(path: Path, rgb: Tensor, depth_lr: Tensor) -> None:
    """Write the input atomically: ``depth_lr`` (h, w) float32 in metres, NaN in holes, and ``photo``, a JPEG's bytes.

    Args:
        path: an ``.npz`` file.
        rgb: (3, H, W) in [0, 1]; stored with its longer side at most :data:`LONGEST` pixels.
        depth_lr: (1, h, w) orthogonal depth in metres, NaN in holes.

    """
    pixels = (255 * rgb).round().clamp(0, 255).byte().permute(1, 2, 0).cpu().numpy()
    photo = np.frombuffer(to_jpeg(pixels, LONGEST, _QUALITY), np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, depth_lr=depth_lr[0].float().cpu().numpy(), photo=photo)


def read_input(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the photo, (H, W, 3) uint8, and the depth map, (h, w) float32 in metres, NaN in holes.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, or something else, or a depth is out of range.

    """
    headers = array_headers(path)
    dimensions = {name: len(shape) for name, (shape, _) in headers.items()}
    types = {name: str(dtype) for name, (_, dtype) in headers.items()}
    if dimensions != {"depth_lr": 2, "photo": 1} or types != {"depth_lr": "float32", "photo": "uint8"}:
        raise ValueError(f"{path}: expected depth_lr (h, w) float32 and photo (n,) uint8, got {headers}")
    (height, width), (length,) = headers["depth_lr"][0], headers["photo"][0]
    if min(height, width) < 2 or height * width > _MOST_PIXELS or length > _MOST_BYTES:
        raise ValueError(f"{path}: expected a depth map of 2 x 2 pixels or more and a photo, got {headers}")
    arrays = read_arrays(path)
    depth = arrays["depth_lr"]
    expect_distances(str(path), torch.from_numpy(depth[np.isfinite(depth)]))
    return _decode(path, arrays["photo"]), np.where(np.isfinite(depth), depth, np.float32(np.nan))


def to_jpeg(pixels: np.ndarray, longest: int, quality: int) -> bytes:
    """Encode a picture, (H, W, 3) uint8, as a JPEG, reduced if its longer side has more than ``longest`` pixels."""
    height, width = pixels.shape[:2]
    shrink = min(1.0, longest / max(height, width))
    if shrink < 1:
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    done, content = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), options)
    if not done:
        raise OSError(f"the picture of {pixels.shape} could not be encoded")
    return content.tobytes()


def _decode(path: Path, content: np.ndarray) -> np.ndarray:
    """Decode the photo."""
    picture = decode_pixels(path, content.tobytes(), cv2.IMREAD_COLOR, LONGEST**2)
    if picture is None:
        raise ValueError(f"{path}: expected the bytes of a JPEG as photo, got something else")
    return picture[..., ::-1]
