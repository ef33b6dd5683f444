"""Archives, folders with the same members, parts of files, and compressed data; sizes are checked before unpacking."""

from __future__ import annotations

import atexit
import contextlib
import functools
import lzma
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from dsr.io.frames import Size, Source, file_state
from dsr.utils.decoding import decode_pixels
from dsr.utils.files import expect_space, space_for
from dsr.utils.guards import bytes_of_archive, expect_bytes, files_in, opened, read_limited, read_member, refusing
from dsr.utils.versions import how_to_install

_MOST_FILES, _MOST_FOLDERS = 200_000, 1000  # of a ZIP file that is unpacked
PHOTO_LIMIT = 1 << 26  # bytes of an encoded photo
# What reading a damaged or encrypted archive raises.
_DAMAGED = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError, struct.error)


@dataclass(frozen=True)
class Archive:
    """The members of a ZIP file, or the files of a folder with the same ones."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of the members."""
        if self.path.is_dir():
            paths = sorted(path for path in self.path.rglob("*") if path.is_file())
            return [path.relative_to(self.path).as_posix() for path in paths]
        return self._packed().namelist()

    def read(self, name: str, most: int) -> bytes:
        """Return a member's content, of at most so many bytes."""
        place, missing = self.path / name, f"{self.path / name}: expected it in the capture, there is none"
        if self.path.is_dir():
            if not place.is_file():
                raise ValueError(missing)
            return read_limited(place, most)
        packed = self._packed()
        with refusing(missing, KeyError):
            size = packed.getinfo(name).file_size
        expect_bytes(place, size, most)
        with refusing(f"{place}: expected a member of the archive, got a damaged one", *_DAMAGED):
            return read_member(packed, name)

    def _packed(self) -> zipfile.ZipFile:
        return _open(self.path, file_state(self.path, "an archive"))


@dataclass(frozen=True)
class Member(Source):
    """A member of an archive of at most ``most`` bytes; ``decoder`` returns the pixels of its content."""

    archive: Archive
    name: str
    most: int
    decoder: Callable[[bytes], np.ndarray]

    @property
    def file(self) -> Path:  # type: ignore[override]
        """The archive."""
        return self.archive.path

    def content(self) -> bytes:
        """Return the member."""
        return self.archive.read(self.name, self.most)

    def decode(self, content: bytes) -> np.ndarray:
        """Return the pixels."""
        return self.decoder(content)


@dataclass(frozen=True)
class Section(Source):
    """``length`` bytes from ``start`` on of a file; ``decoder`` returns the pixels that they stand for."""

    file: Path
    name: str
    start: int
    length: int
    decoder: Callable[[bytes], np.ndarray]

    def content(self) -> bytes:
        """Return the bytes."""
        with opened(self.file) as file:
            file.seek(self.start)
            return file.read(self.length)

    def decode(self, content: bytes) -> np.ndarray:
        """Return the pixels."""
        return self.decoder(content)


def unpack(path: Path) -> Path:
    """Return a temporary folder with the files of a ZIP file, which is deleted when the program ends.

    A ValueError if it is damaged or encrypted, a member is a link or leads outside the folder, or they are larger than
    the size of the archive explains.
    """
    return _unpack(path, file_state(path, "an archive"))


def inflate(content: bytes, size: int, bits: int = zlib.MAX_WBITS) -> bytes:
    """Return compressed data unpacked, which are ``size`` bytes; ``bits`` are negative for data without a header."""
    with refusing(f"expected compressed data of {size} bytes, got damaged ones", zlib.error):
        values = zlib.decompressobj(bits).decompress(content, size + 1)
    if len(values) != size:
        raise ValueError(
            f"expected compressed data of {size} bytes, got {'more' if len(values) > size else len(values)}"
        )
    return values


def decode_photo(content: bytes) -> np.ndarray:
    """Return the pixels of an encoded photo, (H, W, 3) uint8 RGB."""
    pixels = decode_pixels("photo", content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise ValueError(f"expected a photo, got {len(content)} bytes that are none")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def decode_lzfse(content: bytes, size: Size, dtype: str) -> np.ndarray:
    """Return the map (h, w) of some type of values that LZFSE data hold; https://github.com/lzfse/lzfse."""
    with refusing(f"LZFSE data need the package lzfse: {how_to_install('captures')}", ImportError):
        import lzfse  # noqa: PLC0415 - an extra
    with refusing(f"expected LZFSE data, got {len(content)} damaged bytes", lzfse.error, MemoryError):
        values = lzfse.decompress(content)
    expected = size[0] * size[1] * np.dtype(dtype).itemsize
    if len(values) != expected:
        raise ValueError(
            f"expected {size[1]} x {size[0]} values of {np.dtype(dtype)} ({expected} bytes), "
            f"got LZFSE data of {len(values)}"
        )
    return np.frombuffer(values, dtype).reshape(size)


@functools.lru_cache(maxsize=1)
def _open(path: Path, _state: tuple[int, int]) -> zipfile.ZipFile:
    """Return the open archive."""
    with refusing(f"{path}: expected a ZIP archive, got a damaged, truncated or foreign file", *_DAMAGED):
        return zipfile.ZipFile(path)


@functools.cache
def _unpack(path: Path, state: tuple[int, int]) -> Path:
    """Return the folder with the files of an archive."""
    packed = _open(path, state)
    members = [each for each in files_in(packed, path) if not each.filename.startswith("__MACOSX/")]
    for each in members:
        each.filename = each.filename.replace("\\", "/")  # as Windows may write it
    total = sum(each.file_size for each in members)
    folders = {folder for each in members for folder in PurePosixPath(each.filename).parents}
    if len(members) > _MOST_FILES or len(folders) > _MOST_FOLDERS:
        raise ValueError(
            f"{path}: expected at most {_MOST_FILES} files in {_MOST_FOLDERS} folders, got {len(members)} in "
            f"{len(folders)}"
        )
    expect_bytes(f"{path}: the members declare", total, bytes_of_archive(path.stat().st_size))
    with contextlib.ExitStack() as stack:
        target = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=".dsr-"))) / path.name
        target.mkdir()
        expect_space(target, total)
        for each in members:
            text = f"{path}: {each.filename}: expected a member, got a damaged one"
            with refusing(text, *_DAMAGED), space_for(target):
                packed.extract(each, target)
        atexit.register(stack.pop_all().close)
    return target
