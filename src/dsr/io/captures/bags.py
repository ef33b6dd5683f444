"""Recordings of ROS 1 and ROS 2, opened by the package rosbags, and their messages of images."""

from __future__ import annotations

import atexit
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsr.io.captures.ros_images import decode_message
from dsr.io.frames import Source
from dsr.utils.guards import path_within, refusing
from dsr.utils.versions import how_to_install

IMAGE, COMPRESSED = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage"))


@dataclass(frozen=True)
class Message(Source):
    """An image in a recording.

    Args:
        file: the recording.
        name: its topic, without the slash that it begins with.
        kind: type of the message.
        time: when it was recorded, in nanoseconds.
        order: number among the topic's messages of this time.

    """

    file: Path
    name: str
    kind: str
    time: int
    order: int

    def content(self) -> bytes:
        """Return the message as it is stored."""
        with naming_recording(self.file):
            reader = open_recording(self.file)
            connections = connections_of(reader, f"/{self.name}")
            return bytes(list(reader.messages(connections, start=self.time, stop=self.time + 1))[self.order][2])

    def decode(self, content: bytes) -> np.ndarray:
        """Return (H, W, 3) uint8 RGB of a photo, (h, w) of a depth map as it is stored."""
        with refusing("expected a message of an image, got a damaged one", Exception):
            message = deserialize(open_recording(self.file), content, self.kind)
        return decode_message(message)


def images_of(reader: Any, path: Path, topic: str) -> Iterator[tuple[Message, bytes]]:
    """Yield the messages of images of a topic, each with its bytes."""
    last, order = None, 0
    for connection, time, raw in reader.messages(connections_of(reader, topic)):
        last, order = time, order + 1 if time == last else 0
        yield Message(path, topic.removeprefix("/"), connection.msgtype, time, order), raw


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
    if key not in _OPEN:
        _close()
        _OPEN[key] = _open(path)
    return _OPEN[key]


@atexit.register
def _close() -> None:
    """Close the open recording."""
    while _OPEN:
        _OPEN.popitem()[1].close()


def _open(path: Path) -> Any:
    """Open a recording."""
    with refusing(f"{path}: recordings of ROS need the package rosbags: {how_to_install('captures')}", ImportError):
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    if path.is_dir():
        for file in path.iterdir():  # of which rosbags takes those that metadata.yaml names
            path_within(path, file.name, f"{path / 'metadata.yaml'}: relative_file_paths")
    reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    reader.open()
    return reader
