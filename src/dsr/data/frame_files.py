"""Functions that several readers use: numbers and pictures from files, and checks whose errors name the file."""

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import ASSUMED_FOV, Camera
from dsr.io.images import read_pixels
from dsr.sample import Scene
from dsr.utils.guards import natural_key

# Note of scenes whose camera is that of Camera.from_fov
NO_CAMERA = f"no camera is published: {ASSUMED_FOV:g} degrees of horizontal view are assumed"
Found = TypeVar("Found")


def read_picture(path: Path, size: Sequence[int] | None = None) -> Tensor:
    """Return a picture of 8 or 16 bits a channel, (3, H, W) float32 in [0, 1], perhaps of a given size."""
    pixels = read_pixels(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: expected a picture of 8 or 16 bits a channel, got {pixels.dtype}")
    scaled = pixels[..., ::-1].astype(np.float32) / np.iinfo(pixels.dtype).max
    if size is not None:
        expect_size(path, scaled[..., 0], size)
    return torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))


def read_16bit(path: Path) -> np.ndarray:
    """Return the values of a grey picture of 16 bits, (H, W) uint16."""
    pixels = read_pixels(path, cv2.IMREAD_UNCHANGED)
    if pixels.ndim != 2 or pixels.dtype != np.uint16:
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        raise ValueError(f"{path}: expected one channel of 16 bits, got {channels} of {pixels.dtype}")
    return pixels


def read_millimetres(path: Path) -> Tensor:
    """Return a depth picture of 16 bits in millimetres, 0 for a hole, as (1, H, W) float64 in metres, NaN there."""
    return to_depth(path, read_16bit(path) / 1000)


def to_depth(path: Path, values: np.ndarray, farthest: float = math.inf) -> Tensor:
    """Return depth, (1, H, W) float64 in metres, NaN where values, (H, W), are 0 or beyond ``farthest``, the sky."""
    with np.errstate(invalid="ignore"):  # damaged bytes may be signalling NaN, which a cast warns of
        values = values.astype(np.float64)
    if not (values >= 0).all():
        came = "NaN" if np.isnan(values).any() else f"{values.min():g}"
        raise ValueError(f"{path}: expected positive depth, and 0 where a pixel is a hole; got {came}")
    known = (values > 0) & (values <= farthest) & np.isfinite(values)
    if not known.any():
        limit = "" if math.isinf(farthest) else f" within {farthest:g} m"
        raise ValueError(f"{path}: expected at least one known pixel{limit}, all are holes")
    return torch.from_numpy(np.where(known, values, np.nan))[None]


def expect_size(path: Path, image: Tensor | np.ndarray, expected: Sequence[int], source: str = "") -> None:
    """Refuse an image, (..., H, W), that is not ``expected`` = (height, width), perhaps of another file."""
    height, width = image.shape[-2:]
    if (height, width) != tuple(expected):
        raise ValueError(
            f"{path}: expected {expected[0]} x {expected[1]} pixels (height x width{source}), got {height} x {width}"
        )


def to_camera(source: Path | str, matrix: np.ndarray, size: Sequence[int]) -> Camera:
    """Return the camera of an intrinsic matrix [fx 0 cx; 0 fy cy; 0 0 1], pixel centres at integers.

    A focal length beyond 0.1 to 100 picture widths, or a principal point outside of the picture of ``size`` = (height,
    width), is refused; ``source`` is the file or argument that the message names.
    """
    height, width = size
    (fx, skew, cx), (lower, fy, cy), last = matrix.tolist()
    shape = (skew, lower, *last) == (0, 0, 0, 0, 1)
    focal = all(0.1 * width <= value <= 100 * width for value in (fx, fy))
    if not (shape and focal and 0 <= cx < width and 0 <= cy < height):
        came = " ".join(f"{value:g}" for value in matrix.ravel())
        raise ValueError(f"{source}: expected fx 0 cx 0 fy cy 0 0 1 of a {height} x {width} picture, got {came}")
    return Camera(width, height, fx, fy, cx, cy)


def given_camera(intrinsics: Sequence[float], size: Sequence[int], source: Path | str = "intrinsics") -> Camera:
    """Return the camera of (fx, fy, cx, cy) for pictures of ``size``; see :func:`to_camera`."""
    fx, fy, cx, cy = intrinsics
    return to_camera(source, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), size)


def read_frame(rgb_path: Path, *depth_paths: Path, size: tuple[int, int] | None = None) -> list[Tensor]:
    """Return a photo and depth pictures in millimetres, all of ``size`` = (height, width), or the photo's."""
    rgb, maps = read_picture(rgb_path), [read_millimetres(path) for path in depth_paths]
    for path, image in zip((rgb_path, *depth_paths), (rgb, *maps), strict=True):
        expect_size(path, image, size or rgb.shape[1:])
    return [rgb, *maps]


def load_pair(rgb_path: Path, depth_path: Path, dataset: str, name: str) -> Scene:
    """Return a photo and its depth in millimetres, for which no camera is published, as a scene."""
    rgb, depth = read_frame(rgb_path, depth_path)
    height, width = rgb.shape[1:]
    return Scene(dataset, name, rgb, Camera.from_fov(ASSUMED_FOV, width, height), depth)


def walk(root: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Yield every folder of a directory in order, with the names of its folders and of its files; of none, nothing.

    A name that the caller takes off the list of folders is not entered; hidden folders are not either. Links are,
    unless they lead back.
    """
    entered = set()
    for folder, below, files in os.walk(root, followlinks=True):
        entered.add(os.path.realpath(folder))
        fresh = [name for name in below if os.path.realpath(os.path.join(folder, name)) not in entered]  # noqa: PTH118
        below[:] = sorted((name for name in fresh if not name.startswith(".")), key=natural_key)
        yield Path(folder), below, sorted(files, key=natural_key)


def in_natural_order(found: Mapping[str, Found]) -> dict[str, Found]:
    """Return a mapping sorted by its names, with numbers in them by value."""
    return {name: found[name] for name in sorted(found, key=natural_key)}


def name_of(root: Path, folder: Path, frame: str = "") -> str:
    """Return the name of a frame of a folder, "a/b/0001", from ``root`` on; of ``root`` itself the directory's name."""
    path = folder.relative_to(root) / frame
    return path.as_posix() if path.parts else root.resolve().name


def find_beside(
    root: Path, photos: str, pattern: str, others: Sequence[str]
) -> Iterator[tuple[Path, str, tuple[Path, ...]]]:
    """Yield the frames of a data set that has its photos in one folder and their maps in folders beside it.

    These are the folder that ``photos`` lies in, at any depth, the frame, which is the first group of ``pattern`` in
    the photo's name, and its files: the photo, then the ``others`` from that folder on, with ``{}`` for the frame. A
    frame that lacks one of them is left out.
    """
    for place, below, _ in walk(root):
        if photos in below:
            for photo in sorted((place / photos).iterdir(), key=natural_key):
                if match := re.fullmatch(pattern, photo.name):
                    files = (photo, *(place / other.format(match[1]) for other in others))
                    if all(path.is_file() for path in files):
                        yield place, match[1], files
