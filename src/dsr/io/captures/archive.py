"""Archives, folders with the same members, parts of files, and compressed data; sizes are checked before unpacking."""

import atexit
import contextlib
import functools
import lzma
import math
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np

from dsr.io.frames import file_state
from dsr.utils.decoding import decode_pixels
from dsr.utils.files import expect_space, space_for
from dsr.utils.guards import bytes_of_archive, expect_bytes, files_in, opened, read_limited, read_member, refusing

PHOTO_LIMIT = 1 << 26  # bytes of an encoded photo
# What reading a damaged or encrypted archive raises.
_DAMAGED = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError, struct.error)


def members(path: Path) -> list[str]:
    """Return the names of the members of a ZIP file, or of the files in a folder."""
    if path.is_dir():
        return [each.relative_to(path).as_posix() for each in sorted(path.rglob("*")) if each.is_file()]
    return _open(path, file_state(path, "an archive")).namelist()


def read_part(path: Path, name: str, most: int) -> bytes:
    """Return the content of a member of a ZIP file or of a file in a folder, of at most so many bytes."""
    place = path / name
    missing = f"{place}: expected it in the capture, there is none"
    if path.is_dir():
        if not place.is_file():
            raise ValueError(missing)
        return read_limited(place, most)
    packed = _open(path, file_state(path, "an archive"))
    with refusing(missing, KeyError):
        size = packed.getinfo(name).file_size
    expect_bytes(place, size, most)
    with refusing(f"{place}: expected a member of the archive, got a damaged one", *_DAMAGED):
        return read_member(packed, name)


def read_section(path: Path, start: int, length: int) -> bytes:
    """Return ``length`` bytes of a file from ``start`` on."""
    with opened(path) as file:
        file.seek(start)
        return file.read(length)


def inflate(content: bytes, size: int, bits: int = zlib.MAX_WBITS) -> bytes:
    """Return compressed data unpacked, which are ``size`` bytes; ``bits`` are negative for data without a header."""
    with refusing(f"expected compressed data of {size} bytes, got damaged ones", zlib.error):
        values = zlib.decompressobj(bits).decompress(content, size + 1)
    if len(values) != size:
        raise ValueError(
            f"expected compressed data of {size} bytes, got {'more' if len(values) > size else len(values)}"
        )
    return values


def as_pixels(content: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return values of a type that are stored one after another as an array of a shape."""
    if len(content) != math.prod(shape) * np.dtype(dtype).itemsize:
        sides = " x ".join(map(str, shape))
        raise ValueError(f"expected {sides} values (height x width) of {np.dtype(dtype)}, got {len(content)} bytes")
    return np.frombuffer(content, dtype).reshape(shape)


def decode_photo(content: bytes) -> np.ndarray:
    """Return the pixels of an encoded photo, (H, W, 3) uint8 RGB."""
    pixels = decode_pixels("photo", content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise ValueError(f"expected a photo, got {len(content)} bytes that are none")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


@functools.lru_cache(maxsize=1)
def _open(path: Path, _state: tuple[int, int]) -> zipfile.ZipFile:
    with refusing(f"{path}: expected a ZIP archive, got a damaged, truncated or foreign file", *_DAMAGED):
        return zipfile.ZipFile(path)


@functools.cache
def unpack(path: Path, state: tuple[int, int]) -> Path:
    """Return a folder with the files of a ZIP file in a :func:`file_state`, which the end of the program deletes."""
    packed = _open(path, state)
    inside = [each for each in files_in(packed, path) if not each.filename.startswith("__MACOSX/")]
    total = sum(each.file_size for each in inside)
    expect_bytes(f"{path}: the members declare", total, bytes_of_archive(path.stat().st_size))
    with contextlib.ExitStack() as stack:
        target = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=".dsr-"))) / path.name
        target.mkdir()
        expect_space(target, total)
        for each in inside:
            each.filename = each.filename.replace("\\", "/")  # as Windows may write it
            text = f"{path}: {each.filename}: expected a member, got a damaged one"
            with refusing(text, *_DAMAGED), space_for(target):
                packed.extract(each, target)
        atexit.register(stack.pop_all().close)
    return target
