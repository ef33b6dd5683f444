"""Archives, folders with the same members, parts of files, and LZFSE data; sizes are checked before unpacking.

LZFSE: https://github.com/lzfse/lzfse, of which lzfse_internal.h describes the blocks.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import lzma
import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from dsr.io.frames import Record, file_state
from dsr.utils.decoding import decode_pixels
from dsr.utils.files import expect_space, space_for
from dsr.utils.guards import (
    bytes_of_archive,
    expect_bytes,
    files_in,
    naming,
    opened,
    read_limited,
    read_member,
    refusing,
)
from dsr.utils.versions import how_to_install

_CHUNK = 1 << 20
_MOST_FILES, _MOST_FOLDERS = 200_000, 1000
"""Of a ZIP file that is unpacked."""
PHOTO_LIMIT = 1 << 26
"""Largest size in bytes of an encoded photo."""
_DAMAGED = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError, struct.error)
"""What reading a damaged or encrypted archive raises."""


@dataclass(frozen=True)
class Archive:
    """The members of a ZIP file, or the files of a folder with the same ones.

    Args:
        path: the file or folder.

    """

    path: Path

    def names(self) -> list[str]:
        """Return the names of the members.

        Raises:
            ValueError: the file is damaged or no archive.

        """
        if self.path.is_dir():
            paths = sorted(path for path in self.path.rglob("*") if path.is_file())
            return [path.relative_to(self.path).as_posix() for path in paths]
        return _open(self.path, file_state(self.path, "an archive")).namelist()

    def read(self, name: str, limit: int) -> bytes:
        """Return a member's content.

        Args:
            limit: largest number of bytes that it may have.

        Raises:
            ValueError: there is none, it is larger by what the archive declares, or damaged.

        """
        place = self.path / name
        size = self._declared(name)
        if size is None:
            raise ValueError(f"{place}: expected it in the capture, there is none")
        if size > limit:
            raise ValueError(f"{place}: expected at most {limit} bytes, the archive declares {size}")
        with refusing(f"{place}: expected a member of the archive, got a damaged one", *_DAMAGED):
            if self.path.is_dir():
                return read_limited(place, limit)
            return read_member(_open(self.path, file_state(self.path, "an archive")), name)

    def _declared(self, name: str) -> int | None:
        """Return the size of a member, which an archive declares; None if there is no such member."""
        if self.path.is_dir():
            return (self.path / name).stat().st_size if (self.path / name).is_file() else None
        try:
            return _open(self.path, file_state(self.path, "an archive")).getinfo(name).file_size
        except KeyError:
            return None


@dataclass(frozen=True)
class Member:
    """A :class:`~dsr.io.frames.Source` of a member of an archive.

    Args:
        archive: the archive.
        name: the member's name.
        limit: largest number of bytes.
        decode: returns the pixels of the content, or raises a ValueError without the file's name.

    """

    archive: Archive
    name: str
    limit: int
    decode: Callable[[bytes], np.ndarray]

    @property
    def file(self) -> Path:
        """The archive, or the file in the folder."""
        return self.archive.path / self.name if self.archive.path.is_dir() else self.archive.path

    def read(self) -> np.ndarray:
        """Return the pixels."""
        try:
            return self.decode(self.archive.read(self.name, self.limit))
        except ValueError as error:
            text, place = str(error), str(self.archive.path / self.name)
            raise ValueError(text if text.startswith(place) else f"{place}: {text}") from error

    def record(self) -> Record:
        """Return the member's name and hash."""
        content = self.archive.read(self.name, self.limit)
        name = f"{self.archive.path.name}/{self.name}"
        return {"file": name, "sha256": hashlib.sha256(content).hexdigest()}


@dataclass(frozen=True)
class Section:
    """A :class:`~dsr.io.frames.Source` of a part of a file.

    Args:
        file: the file.
        name: of the part, for messages.
        start, length: place in the file, in bytes.
        decode: returns the pixels of the content, or raises a ValueError without the file's name.

    """

    file: Path
    name: str
    start: int
    length: int
    decode: Callable[[bytes], np.ndarray]

    def read(self) -> np.ndarray:
        """Return the pixels."""
        with naming(self.file / self.name):
            return self.decode(self._content())

    def record(self) -> Record:
        """Return the part's name and hash."""
        return {"file": f"{self.file.name}/{self.name}", "sha256": hashlib.sha256(self._content()).hexdigest()}

    def _content(self) -> bytes:
        """Return the bytes of the part."""
        with opened(self.file) as file:
            file.seek(self.start)
            return file.read(self.length)


def unpack(path: Path) -> Path:
    """Return a temporary folder with the files of a ZIP file, which is deleted when the program ends.

    Those that killed programs left are deleted first.

    Raises:
        ValueError: it is damaged or encrypted, a member is a link or leads outside the folder, or they are larger than
            the size of the archive explains.
        FullDiskError: the disk is too small.

    """
    return _unpack(path, file_state(path, "an archive"))


def inflate(content: bytes, size: int, bits: int = zlib.MAX_WBITS) -> bytes:
    """Return compressed data unpacked.

    Args:
        size: number of bytes that is expected.
        bits: zlib's window size: negative for data without a header.

    Raises:
        ValueError: they are damaged, or unpack to another number of bytes.

    """
    with refusing(f"expected compressed data of {size} bytes, got damaged ones", zlib.error):
        values = zlib.decompressobj(bits).decompress(content, size + 1)
    if len(values) != size:
        raise ValueError(
            f"expected compressed data of {size} bytes, got {'more' if len(values) > size else len(values)}"
        )
    return values


def decode_photo(content: bytes) -> np.ndarray:
    """Return the pixels of an encoded photo, (H, W, 3) uint8 RGB.

    Raises:
        ValueError: it is damaged, or larger than a photo is.

    """
    pixels = decode_pixels("photo", content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise ValueError(f"expected a photo, got {len(content)} bytes that are none")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def decode_lzfse(content: bytes, size: tuple[int, int], dtype: str) -> np.ndarray:
    """Return the map (h, w) that LZFSE data hold.

    Args:
        content: compressed data.
        size: (h, w) of the map.
        dtype: type of its values.

    Raises:
        ValueError: they are damaged, or of another size; or the package that reads them is missing.

    """
    expected = size[0] * size[1] * np.dtype(dtype).itemsize
    declared = _declared_size(content)
    if declared != expected:
        raise ValueError(
            f"expected {size[1]} x {size[0]} values of {np.dtype(dtype)} ({expected} bytes), "
            f"got LZFSE data of {declared}"
        )
    with refusing(f"LZFSE data need the package lzfse: {how_to_install('captures')}", ImportError):
        import lzfse  # noqa: PLC0415 - an extra
    with refusing("expected LZFSE data, got damaged ones", lzfse.error, MemoryError):
        values = lzfse.decompress(content)
    if len(values) != expected:
        raise ValueError(f"expected LZFSE data of {expected} bytes, got {len(values)}")
    return np.frombuffer(values, dtype).reshape(size)


def _declared_size(content: bytes) -> int:
    """Return the number of bytes that the headers of LZFSE blocks declare."""
    place, total = 0, 0
    while content[place : place + 4] != b"bvx$":
        magic, (raw,) = content[place : place + 4], struct.unpack_from("<I", content.ljust(place + 8, b"\0"), place + 4)
        if magic == b"bvx-":
            length = 8 + raw
        elif magic == b"bvxn" and len(content) >= place + 12:
            length = 12 + int(struct.unpack_from("<I", content, place + 8)[0])
        elif magic == b"bvx2" and len(content) >= place + 32:
            literals, matches, header = struct.unpack_from("<3Q", content, place + 8)
            length = (header & 0xFFFFFFFF) + (literals >> 20 & 0xFFFFF) + (matches >> 40 & 0xFFFFF)
        else:
            raise ValueError(f"expected LZFSE data, got {len(content)} bytes that are damaged or none")
        total, place = total + raw, place + max(length, 8)
        if place > len(content):
            raise ValueError(f"expected LZFSE data, they end early, after {len(content)} bytes")
    return total


@functools.lru_cache(maxsize=1)
def _open(path: Path, _: tuple[int, int]) -> zipfile.ZipFile:
    """Return the open archive."""
    with refusing(f"{path}: expected a ZIP archive, got a damaged, truncated or foreign file", *_DAMAGED):
        return zipfile.ZipFile(path)


@functools.cache
def _unpack(path: Path, _: tuple[int, int]) -> Path:
    """Return the folder with the files of an archive."""
    with _open(path, file_state(path, "an archive")) as packed:
        members = [each for each in files_in(packed, path) if not each.filename.startswith("__MACOSX/")]
        total = sum(each.file_size for each in members)
        folders = {folder for each in members for folder in PurePosixPath(each.filename.replace("\\", "/")).parents}
        if len(members) > _MOST_FILES or len(folders) > _MOST_FOLDERS:
            raise ValueError(
                f"{path}: expected at most {_MOST_FILES} files in {_MOST_FOLDERS} folders, got {len(members)} in "
                f"{len(folders)}"
            )
        expect_bytes(f"{path}: the members declare", total, bytes_of_archive(path.stat().st_size))
        with contextlib.ExitStack() as stack:
            work = tempfile.mkdtemp(prefix=".dsr-")
            stack.callback(shutil.rmtree, work, ignore_errors=True)
            target = Path(work) / path.name
            target.mkdir()
            expect_space(target, total)
            for each in members:
                text = f"{path}: {each.filename}: expected a member, got a damaged one"
                with refusing(text, *_DAMAGED), space_for(target):
                    _unpack_member(packed, each, target / each.filename.replace("\\", "/"))
            stack.pop_all()
    atexit.register(_remove, work, os.getpid())
    return target


def _unpack_member(packed: zipfile.ZipFile, member: zipfile.ZipInfo, path: Path) -> None:
    """Write a member of an archive to a file that does not exist yet; it may have no more bytes than it declares."""
    path.parent.mkdir(parents=True, exist_ok=True)
    left = member.file_size
    with packed.open(member) as source, path.open("xb") as sink:
        while part := source.read(_CHUNK):
            left -= len(part)
            if left < 0:
                break
            sink.write(part)
    if left:
        raise zipfile.BadZipFile(f"{member.filename}: another size than {member.file_size} bytes")


def _remove(folder: str, process: int) -> None:
    """Delete a folder that a process made, in that process."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
