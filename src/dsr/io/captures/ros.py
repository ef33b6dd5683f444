"""Recordings of ROS 1 (``.bag``) and ROS 2 (a folder with ``metadata.yaml``), read by the package rosbags.

Messages of sensor_msgs: Image, CompressedImage and CameraInfo,
http://docs.ros.org/en/api/sensor_msgs/html/index-msg.html; depth is in millimetres as whole numbers and in metres as
floats, https://ros.org/reps/rep-0118.html.

Of the topics of depth one named *aligned* or *registered* is taken before others, then one with more messages, then the
first by name; of those of colour one named *color*, *colour* or *rgb*, then the same. The photo's camera is that of the
topic ``camera_info`` beside it. Photo and depth map are paired by the times in their headers, within 20 ms. Poses are
not read.

``compressedDepth`` is that of https://github.com/ros-perception/image_transport_plugins.
"""

from __future__ import annotations

import atexit
import bz2
import functools
import hashlib
import importlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import cv2
import numpy as np

from dsr.geometry.lens import Lens
from dsr.io.captures.archive import PHOTO_LIMIT, decode_photo
from dsr.io.frames import CaptureFrame, Geometry, Record
from dsr.io.pairs import Pair, PairingResult, match_times
from dsr.io.trajectories import intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.decoding import decode_pixels
from dsr.utils.guards import MOST_TEXT, expect_bytes, naming, natural_key, path_within, refusing

_IMAGE, _COMPRESSED, _INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_UNITS = {"u": 1e-3, "f": 1.0}
_PREFERRED = {"depth": ("aligned", "registered"), "rgb": ("color", "colour", "rgb")}

_LENSES = {
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "kannala_brandt",
}
"""Distortion models of CameraInfo, see sensor_msgs/distortion_models.h."""
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


@dataclass(frozen=True)
class Message:
    """A :class:`~dsr.io.frames.Source` of an image in a recording.

    Args:
        file: the recording.
        topic: its topic.
        time: when it was recorded, in nanoseconds.
        order: number among the topic's messages of this time.

    """

    file: Path
    topic: str
    time: int
    order: int = 0

    def read(self) -> np.ndarray:
        """Return (H, W, 3) uint8 RGB of a photo, (h, w) of a depth map as it is stored."""
        return decode_message(f"{self.file}{self.topic}", self._message())

    def record(self) -> Record:
        """Return the topic and a hash of the message."""
        _, raw = self._raw()
        return {"file": f"{self.file.name}{self.topic}", "sha256": hashlib.sha256(raw).hexdigest()}

    def _message(self) -> Any:
        """Return the message."""
        kind, raw = self._raw()
        with _NamedErrors(self.file):
            return _reader(self.file, _state(self.file)).deserialize(raw, kind)

    def _raw(self) -> tuple[str, bytes]:
        """Return the message's type and bytes."""
        with _NamedErrors(self.file):
            reader = _reader(self.file, _state(self.file))
            connections = [each for each in reader.connections if each.topic == self.topic]
            found = list(reader.messages(connections, start=self.time, stop=self.time + 1))
            connection, _, raw = found[self.order]
            return connection.msgtype, bytes(raw)


def find_ros(folder: Path) -> PairingResult | None:
    """Return the frames of a recording, or of those in a folder; None if there is none.

    Raises:
        ValueError: a recording is damaged, or has no topic of photos or of depth; or rosbags is missing.

    """
    if folder.is_file():
        return _read(folder) if folder.suffix.lower() == ".bag" else None
    if (folder / "metadata.yaml").is_file() and any((*folder.glob("*.db3"), *folder.glob("*.mcap"))):
        return _read(folder)
    bags = [path for path in folder.iterdir() if path.suffix.lower() == ".bag" and path.is_file()]
    if not bags:
        return None
    parts = [_read(path, f"{path.stem}/") for path in sorted(bags, key=natural_key)]
    notes = tuple(dict.fromkeys(note for part in parts for note in part.assumptions))
    pairs = tuple(pair for part in parts for pair in part.pairs)
    return PairingResult(pairs, notes, tuple(path for part in parts for path in part.unpaired))


def _read(path: Path, prefix: str = "") -> PairingResult:
    """Return the frames of a recording."""
    with _NamedErrors(path):
        reader = _reader(path, _state(path))
        topics = _topics(reader)
        photo_topic, depth_topic = _choose(path, topics, "rgb"), _choose(path, topics, "depth")
        photos, depths = _times(reader, path, photo_topic), _times(reader, path, depth_topic)
        info = _camera_info(reader, photo_topic)
        kind = depths[0][0].read().dtype.kind
    named = {kind: {Path(f"{i:09}"): stamp for i, (_, stamp) in enumerate(each)} for kind, each in
             (("rgb", photos), ("depth", depths))}  # fmt: skip
    partner = match_times(named["rgb"], named["depth"])
    if not partner:
        raise ValueError(f"{path}: expected photos and depth maps within 20 ms of each other, found none")
    told = repr(info).encode()
    geometry = functools.partial(_geometry, f"{path}{PurePosixPath(photo_topic).parent / 'camera_info'}", info)
    pairs = []
    for first, second in sorted(partner.items()):
        photo, depth = photos[int(first.name)][0], depths[int(second.name)][0]
        frame = CaptureFrame("ROS", geometry, path, told, photo, depth)
        name = f"{prefix}{int(first.name):06}"
        pairs.append(
            Pair(name, Path(f"{path}{photo_topic}"), Path(f"{path}{depth_topic}"), unit=_UNITS[kind], capture=frame)
        )
    unit = "millimetres" if kind == "u" else "metres"
    notes = [Assumption(f"a recording of ROS: photos of {photo_topic}, depth in {unit} of {depth_topic}")]
    others = sorted(topic for topic, kind in topics.items() if kind[0] and topic not in (photo_topic, depth_topic))
    if others:
        notes.append(Assumption(f"topics that are not looked at: {', '.join(others)}"))
    lone = [Path(f"{path}{photo_topic}")] * (len(photos) - len(pairs))
    lone += [Path(f"{path}{depth_topic}")] * (len(depths) - len(pairs))
    return PairingResult(tuple(pairs), tuple(notes), tuple(lone))


def _topics(reader: Any) -> dict[str, tuple[str, int]]:
    """Return, for each topic of images, its role (``rgb``, ``depth`` or empty) by its first message, and the count."""
    topics: dict[str, tuple[str, int]] = {}
    for topic in sorted({each.topic for each in reader.connections if each.msgtype in (_IMAGE, _COMPRESSED)}):
        connections = [each for each in reader.connections if each.topic == topic]
        first = next(iter(reader.messages(connections)), None)
        if first is not None:
            message = reader.deserialize(first[2], first[0].msgtype)
            topics[topic] = _role(message), sum(each.msgcount for each in connections)
    return topics


def _role(message: Any) -> str:
    """Return whether a message is a photo or a depth map; an empty text if it is neither, such as an infrared image."""
    if hasattr(message, "encoding"):
        return "depth" if message.encoding in DEPTHS else "rgb" if message.encoding in COLOURS else ""
    words = message.format.lower()
    if "compresseddepth" in words:
        return "depth"
    encoding = words.partition(";")[0].strip()
    return "" if encoding in ("mono8", "8uc1", "16uc1", "mono16") else "rgb"


def _choose(path: Path, topics: dict[str, tuple[str, int]], role: str) -> str:
    """Return the topic of a role, see the module's text."""
    found = [topic for topic, (kind, _) in topics.items() if kind == role]
    if not found:
        what = "photos (sensor_msgs/Image of colour, or CompressedImage)" if role == "rgb" else \
            "depth (sensor_msgs/Image of 16UC1 or 32FC1)"  # fmt: skip
        raise ValueError(f"{path}: expected a topic of {what}, got {', '.join(sorted(topics)) or 'no images'}")
    return min(found, key=lambda topic: (not any(word in topic for word in _PREFERRED[role]), -topics[topic][1], topic))


def _times(reader: Any, path: Path, topic: str) -> list[tuple[Message, float]]:
    """Return the messages of a topic with the times in their headers, in seconds."""
    found: list[tuple[Message, float]] = []
    for connection, time, raw in reader.messages([each for each in reader.connections if each.topic == topic]):
        same = found[-1][0].order + 1 if found and found[-1][0].time == time else 0
        seconds, nanoseconds = struct.unpack_from("<II", raw, 4)  # after a sequence number, or CDR's header
        stamp = seconds + 1e-9 * nanoseconds if seconds else 1e-9 * time
        found.append((Message(path, connection.topic, time, same), stamp))
    return found


class _Info(NamedTuple):
    """What is read of a CameraInfo: fx, fy, cx, cy, and the model and coefficients of the distortion."""

    height: int
    width: int
    numbers: tuple[float, ...]
    model: str
    distortion: tuple[float, ...]


def _camera_info(reader: Any, photo_topic: str) -> _Info | None:
    """Return the content of the topic beside the photo's; None if there is none."""
    for place in PurePosixPath(photo_topic).parents:
        connections = [each for each in reader.connections if each.topic == str(place / "camera_info")]
        for connection, _, raw in reader.messages(connections) if connections else ():
            info = reader.deserialize(raw, connection.msgtype)
            K = info.K if hasattr(info, "K") else info.k
            distortion = info.D if hasattr(info, "D") else info.d
            numbers = (float(K[0]), float(K[4]), float(K[2]), float(K[5]))
            return _Info(info.height, info.width, numbers, info.distortion_model, tuple(map(float, distortion)))
        if connections or len(place.parts) < 3:
            return None
    return None


def _geometry(place: str, info: _Info | None, _: tuple[int, int]) -> Geometry:
    """Return the camera of a recording."""
    if info is None:
        return Geometry(None, None, (Assumption("the recording has no camera_info beside the photo's topic"),))
    if min(info.height, info.width) < 1:
        raise ValueError(f"{place}: expected a positive width and height, got {info.width} x {info.height}")
    camera = intrinsics_camera(place, (info.height, info.width), info.numbers)
    if not any(info.distortion):
        return Geometry(camera)
    if info.model not in _LENSES:
        text = f"the photo's lens distortion of the model {info.model!r:.40} is not undone: a rectified topic (image_rect) has none"
        return Geometry(camera, None, (Assumption(text),))
    with naming(place):
        return Geometry(camera, lens=Lens(_LENSES[info.model], info.distortion))


class _NamedErrors:
    """A context in which rosbags' errors become one that names the recording."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if error is None or not isinstance(error, Exception):
            return
        if isinstance(error, ValueError) and str(error).startswith(str(self._path)):
            return
        raise ValueError(f"{self._path}: expected a recording of ROS, got a damaged one ({error!s:.120})") from error


def _state(path: Path) -> tuple[int, ...]:
    """Return sizes and times of the files of a recording, which tell whether it was replaced."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        if file.exists() and not file.is_file() and not file.is_dir():  # a pipe would be waited for
            raise ValueError(f"{file}: expected a file of the recording, got something else")
    return tuple(number for file in files for number in (file.stat().st_size, file.stat().st_mtime_ns))


def _reader(path: Path, state: tuple[int, ...]) -> Any:
    """Return the open recording; the one before it is closed."""
    key = (path, state)
    if _OPEN.get("key") != key:
        _close()
        _OPEN.update(reader=_open(path), key=key)
    return _OPEN["reader"]


_OPEN: dict[str, Any] = {}
"""The open recording with its path and state; empty if there is none."""


@atexit.register
def _close() -> None:
    """Close the open recording."""
    reader = _OPEN.get("reader")
    _OPEN.clear()
    if reader is not None:
        reader.close()


def _open(path: Path) -> Any:
    """Open a recording."""
    with refusing(f"{path}: recordings of ROS need the package rosbags: pip install 'dsr[captures]'", ImportError):
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    _limit_chunks()
    description = path / "metadata.yaml"
    if path.is_dir() and description.is_file():
        expect_bytes(description, description.stat().st_size, MOST_TEXT)
        for file in path.iterdir():  # of which rosbags takes those that the description names
            path_within(path, file.name, f"{description}: relative_file_paths")
    reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    reader.open()
    return reader


_CHUNK = 1 << 28
"""Largest number of bytes that a compressed chunk of a recording may unpack to; writers make chunks of a few MB."""


def _limit_chunks() -> None:
    """Make rosbags unpack no chunk to more than :data:`_CHUNK`: a bzip2 chunk of 700 bytes may stand for 1 GB."""
    lz4: Any = importlib.import_module("lz4.frame")  # with the extra alone
    from rosbags.rosbag1 import reader  # noqa: PLC0415
    from rosbags.rosbag2 import storage_mcap  # noqa: PLC0415

    def bounded(make: Callable[[], Any], data: bytes, *_: int) -> bytes:
        unpacking = make()
        content: bytes = unpacking.decompress(data, _CHUNK)
        if not unpacking.eof:
            raise ValueError(f"a chunk without end, or of more than {_CHUNK} bytes")
        return content

    kinds: dict[str, Callable[[], Any]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": lz4.LZ4FrameDecompressor,
        "zstd": storage_mcap.zstd.ZstdDecompressor,
    }
    for table in (reader.decompressors, storage_mcap.DECOMPRESSORS):
        for name in kinds.keys() & table.keys():
            table[name] = functools.partial(bounded, kinds[name])


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
        with naming(place):
            return decode_photo(data.tobytes())
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
