"""Recordings of ROS 1 and ROS 2, opened by the package rosbags, and their messages of images."""

from __future__ import annotations

import atexit
import bz2
import contextlib
import functools
import hashlib
import importlib
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np

from dsr.io.captures.ros_images import decode_message
from dsr.io.frames import Record
from dsr.utils.files import FullDiskError, expect_space, space_for
from dsr.utils.guards import MOST_TEXT, bytes_of_archive, expect_bytes, opened, path_within, refusing
from dsr.utils.versions import how_to_install

IMAGE, COMPRESSED = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage"))


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
        kind, raw = self._raw()
        with naming_recording(self.file):
            message = deserialize(open_recording(self.file), raw, kind)
        return decode_message(f"{self.file}{self.topic}", message)

    def record(self) -> Record:
        """Return the topic and a hash of the message."""
        _, raw = self._raw()
        return {"file": f"{self.file.name}{self.topic}", "sha256": hashlib.sha256(raw).hexdigest()}

    def _raw(self) -> tuple[str, bytes]:
        """Return the message's type and bytes."""
        with naming_recording(self.file):
            reader = open_recording(self.file)
            found = list(reader.messages(connections_of(reader, self.topic), start=self.time, stop=self.time + 1))
            connection, _, raw = found[self.order]
            return connection.msgtype, bytes(raw)


def connections_of(reader: Any, topic: str) -> list[Any]:
    """Return the connections of a topic."""
    return [each for each in reader.connections if each.topic == topic]


def first_message(reader: Any, topic: str) -> Any:
    """Return the first message of a topic; None if there is none."""
    connections = connections_of(reader, topic)
    for connection, _, raw in reader.messages(connections) if connections else ():
        return deserialize(reader, raw, connection.msgtype)
    return None


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
    except FullDiskError:
        raise
    except Exception as error:
        if isinstance(error, ValueError) and str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: expected a recording of ROS, got a damaged one ({error!s:.120})") from error


def state_of(path: Path) -> tuple[int, ...]:
    """Return sizes and modification times of the files of a recording, which change if it is replaced."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        if file.exists() and not file.is_file() and not file.is_dir():  # a pipe would be waited for
            raise ValueError(f"{file}: expected a file of the recording, got something else")
    return tuple(number for file in files for number in (file.stat().st_size, file.stat().st_mtime_ns))


def open_recording(path: Path) -> Any:
    """Return the open recording; the one before it is closed.

    Raises:
        ValueError: it is missing, was interrupted, or the package rosbags is missing.

    """
    key = (path, state_of(path))
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
    with refusing(f"{path}: recordings of ROS need the package rosbags: {how_to_install('captures')}", ImportError):
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    _limit_chunks()
    _expect_finished(path)
    description = path / "metadata.yaml"
    if path.is_dir() and description.is_file():
        expect_bytes(description, description.stat().st_size, MOST_TEXT)
        for file in path.iterdir():  # of which rosbags takes those that the description names
            path_within(path, file.name, f"{description}: relative_file_paths")
    reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    packed = path.is_dir() and any(path.glob("*.zstd"))  # files that are packed whole are unpacked into TMPDIR
    with space_for(Path(tempfile.gettempdir()) / path.name) if packed else contextlib.nullcontext():
        reader.open()
    sizes = [chunk.datasize for each in reader.readers for chunk in getattr(each, "chunks", {}).values()]
    if max(sizes, default=0) > _CHUNK:  # a damaged number, which rosbags would read all the same
        reader.close()
        raise ValueError(f"{path}: expected chunks of at most {_CHUNK} bytes, got one of {max(sizes)}")
    return reader


_MAGIC = b"#ROSBAG V2.0\n"


def _expect_finished(path: Path) -> None:
    """Check that a ``.bag`` file is a ROS recording with an index, whose position is in the first record.

    http://wiki.ros.org/Bags/Format/2.0
    """
    if path.suffix.lower() != ".bag":
        return
    with opened(path) as file:
        head = file.read(1 << 12)
    if not head.startswith(_MAGIC):  # which rosbags looks for up to the first line's end, wherever that is
        raise ValueError(f"{path}: expected a recording of ROS, got another file")
    place = head.find(b"index_pos=")
    if place > 0 and head[place + 10 : place + 18] == bytes(8):
        raise ValueError(
            f"{path}: expected a finished recording, this one was interrupted and has no index; rosbag reindex adds it"
        )


_CHUNK = 1 << 28
"""Largest number of bytes of a chunk or a packed message of a recording; writers make chunks of a few MB."""
_ZSTD_HEAD = 18
"""Largest number of bytes of the header of a frame of Zstandard, which may declare its size (RFC 8878, 3.1.1.1)."""


def _limit_chunks() -> None:
    """Make rosbags unpack nothing to more than :data:`_CHUNK`: a bzip2 chunk of 700 bytes may stand for 1 GB.

    Messages may be packed one by one. Files that are packed whole, which rosbags unpacks into a temporary folder, are
    together unpacked to what :func:`~dsr.utils.guards.bytes_of_archive` explains, from this call on.
    """
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

    zstd: Any = storage_mcap.zstd
    of_messages: Any = importlib.import_module("rosbags.rosbag2.reader")
    allowance = _Allowance(zstd)
    of_messages.zstd = SimpleNamespace(decompress=functools.partial(bounded, kinds["zstd"]), open=allowance.opened)


class _Allowance:
    """Opens the files of one recording that are packed whole, and counts what all of them unpack to.

    Args:
        zstd: the module that unpacks.

    """

    def __init__(self, zstd: Any) -> None:
        self._zstd = zstd
        self._names: set[str] = set()
        self._packed = self._count = 0

    @contextlib.contextmanager
    def opened(self, file: BinaryIO, mode: str) -> Iterator[_Bounded]:
        """Yield the content of the next file; ValueError if it was opened before."""
        name = Path(file.name).name
        if name in self._names:
            raise ValueError(f"relative_file_paths names {name} twice")
        self._names.add(name)
        self._packed += os.fstat(file.fileno()).st_size
        head = file.read(_ZSTD_HEAD)
        file.seek(0)
        declared = self._zstd.get_frame_info(head).decompressed_size or 0
        self.expect(self._count + declared)
        expect_space(Path(tempfile.gettempdir()) / name, declared)
        with self._zstd.open(file, mode) as content:
            yield _Bounded(content, self)

    def take(self, count: int) -> None:
        """Count bytes that were unpacked; ValueError if these are too many."""
        self._count += count
        self.expect(self._count)

    def expect(self, count: int) -> None:
        """Raise ValueError unless the files that were opened may unpack to so many bytes."""
        most = bytes_of_archive(self._packed)
        if count > most:
            raise ValueError(f"packed files of more than {most} bytes")


@dataclass
class _Bounded:
    """A file of a recording that counts what is read of it."""

    file: BinaryIO
    allowance: _Allowance

    def read(self, size: int) -> bytes:
        """Return the next bytes, at most ``size``."""
        content = self.file.read(size)
        self.allowance.take(len(content))
        return content
