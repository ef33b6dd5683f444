"""Pixels of the messages sensor_msgs/Image and CompressedImage, and of ``compressedDepth`` as PNG and RVL.

https://github.com/ros-perception/image_transport_plugins: ``compressed_depth_image_transport`` has the header
(compression_common.h), the quantisation of floats (codec.cpp) and RVL (rvl_codec.cpp).
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from dsr.io.captures.archive import decode_photo
from dsr.utils.decoding import decode_pixels
from dsr.utils.guards import expect_pixels, pixels_of_file

# Channels of encodings of colour, and OpenCV's conversion to BGR.
COLOURS = {
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
    "YUYV": (2, cv2.COLOR_YUV2BGR_YUY2),
}
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_LONGEST = 10  # parts of a number in RVL data beyond the first: more than 32 bits
_CONFIG = struct.Struct("<iff")  # header of compressedDepth: format, and two numbers of the quantisation of floats


def decode_message(message: Any) -> np.ndarray:
    """Return the pixels of an Image or a CompressedImage: (H, W, 3) uint8 RGB, or (h, w) of depth as it is stored."""
    data = np.asarray(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        if "compresseddepth" in message.format.lower():
            return _decode_compressed_depth(message.format, data)
        return decode_photo(data.tobytes())
    channels, code = COLOURS.get(message.encoding, (1, None))
    dtype = np.dtype(DEPTHS.get(message.encoding, "u1")).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = message.height, message.width, message.step
    if min(height, width) < 1 or step < width * channels * dtype.itemsize or data.size != height * step:
        raise ValueError(
            f"expected an image of {width} x {height} pixels in rows of {step} bytes, got {data.size} bytes"
        )
    rows = data.reshape(height, step)[:, : width * channels * dtype.itemsize]
    values = np.ascontiguousarray(rows).view(dtype).reshape(height, width, *([channels] if channels > 1 else []))
    if message.encoding in DEPTHS:
        return values.astype(dtype.newbyteorder("="))
    return cv2.cvtColor(values if code is None else cv2.cvtColor(values, code), cv2.COLOR_BGR2RGB)


def _decode_compressed_depth(encoding: str, data: np.ndarray) -> np.ndarray:
    """Return the map of a message of compressedDepth: of whole numbers, or of quantised inverse metres."""
    pixels = None
    kind = "RVL" if "compresseddepth rvl" in encoding.lower() else "a 16-bit PNG"
    if data.size > _CONFIG.size:
        content = data[_CONFIG.size :].tobytes()
        pixels = decode_rvl(content) if kind == "RVL" else decode_pixels("depth", content, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.ndim != 2 or pixels.dtype != np.uint16:
        raise ValueError(f"expected depth as {kind} (compressedDepth), got {data.size} bytes of another kind")
    if "32fc1" not in encoding.lower():
        return pixels
    _, a, b = _CONFIG.unpack(data[: _CONFIG.size].tobytes())
    with np.errstate(divide="ignore"):
        return np.where(pixels > 0, a / (pixels - np.float32(b)), np.nan).astype(np.float32)


def decode_rvl(content: bytes) -> np.ndarray:
    """Return the map, (h, w) uint16, that RVL data hold behind their width and height.

    The data are 4-bit parts of numbers, the most significant of a 32-bit word first: three bits of the number, the
    lowest first, and one that says that more follow. The numbers are counts of zeros and of other values in turn, and
    behind the latter count the differences of the values, with the sign in the lowest bit.
    """
    damaged = f"expected depth as RVL (compressedDepth), got {len(content)} bytes that are damaged"
    if len(content) < 12 or len(content) % 4:
        raise ValueError(damaged)
    width, height = struct.unpack_from("<II", content)
    expect_pixels("depth as RVL", height, width, pixels_of_file(len(content)))
    if min(width, height) < 1:
        raise ValueError(damaged)
    words = np.frombuffer(content, "<u4", offset=8)
    parts = (words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32) & 15).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(parts < 8)
    starts = np.concatenate(([0], ends[:-1] + 1))
    if not len(ends) or (ends - starts).max() > _LONGEST:
        raise ValueError(damaged)
    order = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    numbers = np.add.reduceat((parts[: ends[-1] + 1] & 7) << 3 * order, starts)
    found, known, place, first = np.zeros(height * width, np.int64), np.zeros(height * width, bool), 0, 0
    while place < len(found):
        if first + 2 > len(numbers):
            raise ValueError(damaged)
        zeros, count = int(numbers[first]), int(numbers[first + 1])
        place, values = place + zeros, numbers[first + 2 : first + 2 + count]
        if len(values) != count or place + count > len(found) or not zeros + count:
            raise ValueError(damaged)
        found[place : place + count], known[place : place + count] = values >> 1 ^ -(values & 1), True
        place, first = place + count, first + 2 + count
    return np.where(known, np.cumsum(found), 0).astype(np.uint16).reshape(height, width)
