"""Recordings of ROS 1 and ROS 2, opened by the package rosbags, and the pixels of their messages of images.

https://github.com/ros-perception/image_transport_plugins: ``compressed_depth_image_transport`` has the header of
``compressedDepth`` (compression_common.h), the quantisation of floats (codec.cpp) and RVL (rvl_codec.cpp).
"""

import atexit
import contextlib
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from dsr.io.captures.archive import decode_photo
from dsr.io.frames import Part
from dsr.utils.decoding import decode_pixels
from dsr.utils.guards import expect_pixels, path_within, pixels_of_file, refusing
from dsr.utils.versions import how_to_install

IMAGE, COMPRESSED = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage"))
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


class Message(NamedTuple):
    """A message of an image: where its pixels are, its bytes, its type, and when it was recorded in nanoseconds."""

    source: Part
    raw: bytes
    kind: str
    time: int


def images_of(reader: Any, path: Path, topic: str) -> Iterator[Message]:
    """Yield the messages of images of a topic."""
    last, order = None, 0
    for connection, time, raw in reader.messages(connections_of(reader, topic)):
        last, order = time, order + 1 if time == last else 0
        fetch, decode = partial(_fetch, path, topic, time, order), partial(_decode, path, connection.msgtype)
        yield Message(Part(path, topic.removeprefix("/"), fetch, decode), raw, connection.msgtype, time)


def _fetch(path: Path, topic: str, time: int, order: int) -> bytes:
    with naming_recording(path):
        reader = open_recording(path)
        return bytes(list(reader.messages(connections_of(reader, topic), start=time, stop=time + 1))[order][2])


def _decode(path: Path, kind: str, content: bytes) -> np.ndarray:
    """Return (H, W, 3) uint8 RGB of a photo, (h, w) of a depth map as it is stored."""
    with refusing("expected a message of an image, got a damaged one", Exception):
        message = deserialize(open_recording(path), content, kind)
    return decode_message(message)


def connections_of(reader: Any, topic: str) -> list[Any]:
    """Return the connections of a topic."""
    return [each for each in reader.connections if each.topic == topic]


def messages_of(reader: Any, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield the messages of a topic with the times when they were recorded."""
    if connections := connections_of(reader, topic):
        for connection, time, raw in reader.messages(connections):
            yield time, deserialize(reader, raw, connection.msgtype)


def first_message(reader: Any, topic: str) -> Any:
    """Return the first message of a topic; None if there is none."""
    return next((message for _, message in messages_of(reader, topic)), None)


def deserialize(reader: Any, raw: bytes, kind: str) -> Any:
    """Return a message; behind an Image in a ``.bag`` RealSense's SDK puts four bytes that its definition lacks."""
    if not reader.is2 and kind == IMAGE:
        place = 12  # behind number and time
        for behind in (8, 5):  # the header's text before height and width, the encoding before the rows' size
            place += 4 + int.from_bytes(raw[place : place + 4], "little") + behind
        raw = raw[: place + 4 + int.from_bytes(raw[place : place + 4], "little")]
    return reader.deserialize(raw, kind)


@contextlib.contextmanager
def naming_recording(path: Path) -> Iterator[None]:
    """Within this context rosbags' errors become one that names the recording."""
    try:
        yield
    except Exception as error:
        if isinstance(error, ValueError) and str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: expected a recording of ROS, got a damaged one ({error!s:.120})") from error


_OPEN: dict[tuple[Any, ...], Any] = {}  # the open recording by its path and the sizes and times of its files


def open_recording(path: Path) -> Any:
    """Return the open recording; the one before it is closed."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    key = (path, *((file.stat().st_size, file.stat().st_mtime_ns) for file in files))
    if key in _OPEN:
        return _OPEN[key]
    _close()
    with refusing(f"{path}: recordings of ROS need the package rosbags: {how_to_install('captures')}", ImportError):
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    if path.is_dir():
        for file in path.iterdir():  # of which rosbags takes those that metadata.yaml names
            path_within(path, file.name, f"{path / 'metadata.yaml'}: relative_file_paths")
    reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    reader.open()
    _OPEN[key] = reader
    return reader


@atexit.register
def _close() -> None:
    """Close the open recording, as its unpacked files are deleted then."""
    while _OPEN:
        _OPEN.popitem()[1].close()


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
        raise ValueError(f"expected an image of {width} x {height} in rows of {step} bytes, got {data.size} bytes")
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
