"""Pixels of the image messages of ROS.

``compressedDepth`` is that of https://github.com/ros-perception/image_transport_plugins.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from dsr.data.formats.decoding import decode_pixels
from dsr.io.captures.archive import PHOTO_LIMIT, decode_photo

COLOURS = {
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
}
"""Channels of encodings of colour, and OpenCV's conversion to BGR."""
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_CONFIG = struct.Struct("<iff")
"""Header of compressedDepth: format, and two numbers of the quantisation of floats."""


def decode_message(place: str, message: Any) -> np.ndarray:
    """Return the pixels of an Image or a CompressedImage: (H, W, 3) uint8 RGB, or (h, w) of depth as it is stored.

    Raises:
        ValueError: its size does not fit its data, or they are damaged; the message begins with ``place``.

    """
    data = np.asarray(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        if "compresseddepth" in message.format.lower():
            return _decode_compressed_depth(place, message.format, data)
        if data.size > PHOTO_LIMIT:
            raise ValueError(f"{place}: expected a photo of at most {PHOTO_LIMIT} bytes, got {data.size}")
        try:
            return decode_photo(data.tobytes())
        except ValueError as error:
            raise ValueError(f"{place}: {error}") from error
    channels, code = COLOURS.get(message.encoding, (1, None))
    dtype = np.dtype(DEPTHS.get(message.encoding, "u1")).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = message.height, message.width, message.step
    if min(height, width) < 1 or step < width * channels * dtype.itemsize or data.size != height * step:
        raise ValueError(
            f"{place}: expected an image of {width} x {height} pixels in rows of {step} bytes, got {data.size} bytes"
        )
    rows = data.reshape(height, step)[:, : width * channels * dtype.itemsize]
    values = np.ascontiguousarray(rows).view(dtype).reshape(height, width, *([channels] if channels > 1 else []))
    if message.encoding in DEPTHS:
        return values.astype(dtype.newbyteorder("="))
    return cv2.cvtColor(values if code is None else cv2.cvtColor(values, code), cv2.COLOR_BGR2RGB)


def _decode_compressed_depth(place: str, encoding: str, data: np.ndarray) -> np.ndarray:
    """Return the map of a message of compressedDepth: a PNG of whole numbers, or of quantised inverse metres."""
    pixels = None
    if _CONFIG.size < data.size <= PHOTO_LIMIT:
        pixels = decode_pixels(place, data[_CONFIG.size :].tobytes(), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.ndim != 2 or pixels.dtype != np.uint16:
        raise ValueError(
            f"{place}: expected depth as a 16-bit PNG (compressedDepth), got {data.size} bytes of another kind"
        )
    if "32fc1" not in encoding.lower():
        return pixels
    _, a, b = _CONFIG.unpack(data[: _CONFIG.size].tobytes())
    with np.errstate(divide="ignore"):
        return np.where(pixels > 0, a / (pixels - np.float32(b)), np.nan).astype(np.float32)
