"""Photos: reading them and their EXIF data (CIPA DC-008, JEITA CP-3451), and writing pictures as PNG.

Decoders of HEIC turn a photo as its properties ``irot`` and ``imir`` say (ISO/IEC 23008-12; libheif/box.cc of
https://github.com/strukturag/libheif), whatever its EXIF data say.
"""

import base64
import contextlib
import io
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from PIL import Image

from dsr.io.images import Size, read_colours
from dsr.notes import Assumption
from dsr.utils.files import replacing
from dsr.utils.guards import MOST_FILE, expect_pixels, opened, read_limited, refusing
from dsr.utils.versions import how_to_install

HEIC_SUFFIXES = (".heic", ".heif")
AS_STORED = Assumption("the photo's EXIF orientation is ignored: the depth map is assumed to fit it as stored")
_MODEL, _ORIENTATION, _EXIF_IFD, _EXIF_FOCAL_35 = 0x0110, 0x0112, 0x8769, 0xA405
_ASPECT_TOLERANCE = 0.02
# What turns a photo upright, by EXIF orientation: whether its axes are exchanged, then the steps of rows and columns.
_TURNS = {
    1: (False, 1, 1), 2: (False, 1, -1), 3: (False, -1, -1), 4: (False, -1, 1),
    5: (True, 1, 1), 6: (True, 1, -1), 7: (True, -1, -1), 8: (True, -1, 1),
}  # fmt: skip
_BACK = {6: 8, 8: 6}  # orientations whose operation undoes that of another one; the others undo themselves
_IN_HEIC = {turn: orientation for orientation, turn in _TURNS.items()}
_LEVEL = 6  # of the compression of PNG files
# What pillow-heif raises of damaged files.
_DAMAGED = (ValueError, RuntimeError, SyntaxError, EOFError, OSError, IndexError, MemoryError)


def _turn(pixels: np.ndarray, orientation: int) -> np.ndarray:
    exchange, rows, columns = _TURNS[orientation]
    return (pixels.transpose(1, 0, 2) if exchange else pixels)[::rows, ::columns]


def read_photo(path: Path, size_lr: Size) -> tuple[np.ndarray, list[Assumption]]:
    """Return the photo, (H, W, 3) uint8 RGB, turned upright only if the depth map fits so, and the assumptions."""
    orientation, found = read_exif(path).orientation, list[Assumption]()
    if path.suffix.lower() in HEIC_SUFFIXES:
        turned = 1 if orientation == 1 else turned_in_heic(path)
        pixels = _turn(read_heic(path), _BACK.get(turned, turned))
    else:
        pixels, found = read_colours(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if orientation == 1:
        return pixels, found
    size: Size = (pixels.shape[0], pixels.shape[1])
    if orientation >= 5 and not same_aspect(size, size_lr) and same_aspect(size[::-1], size_lr):
        found.append(Assumption("the photo is turned by its EXIF data, as the depth map is"))
        return _turn(pixels, orientation), found
    return pixels, [*found, AS_STORED]


def read_heic(path: Path) -> np.ndarray:
    """Return the photo of a HEIC file, (H, W, 3) uint8 RGB, turned as :func:`turned_in_heic` says."""
    image = open_heic(path)
    pixels = decode_heic(path, image)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise ValueError(f"{path}: expected a colour photo, got {image.mode}")
    return pixels[..., :3]


def turned_in_heic(path: Path) -> int:
    """Return the EXIF orientation that says how the decoder turns the photo of a HEIC file, 1 (not at all) to 8."""
    exchange, rows, columns = _TURNS[1]
    for kind, value in _properties(read_limited(path, MOST_FILE)):
        if kind == b"irot":
            for _ in range(value & 3):  # a quarter to the left
                exchange, rows, columns = not exchange, -columns, rows
        elif kind == b"imir":
            rows, columns = (rows, -columns) if value & 1 else (-rows, columns)
    return _IN_HEIC[exchange, rows, columns]


def _properties(content: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield kind and first byte of each property of the photo of a HEIC file, in order; ends where it is damaged."""
    with contextlib.suppress(struct.error, KeyError, IndexError):  # which the decoder refuses
        meta = dict(_boxes(dict(_boxes(memoryview(content)))[b"meta"][4:]))
        parts = list(_boxes(meta[b"iprp"]))
        kinds = [each for kind, part in parts if kind == b"ipco" for each in _boxes(part)]
        (photo,) = struct.unpack_from(">I" if meta[b"pitm"][0] else ">H", meta[b"pitm"], 4)
        for table in (part for kind, part in parts if kind == b"ipma"):
            head, wide, place = ">IB" if table[0] else ">HB", 1 + (table[3] & 1), 8
            for _ in range(struct.unpack_from(">I", table, 4)[0]):
                item, count = struct.unpack_from(head, table, place)
                place += struct.calcsize(head)
                for start in range(place, place + wide * count, wide) if item == photo else ():
                    number = int.from_bytes(table[start : start + wide], "big") & (0x7FFF if wide == 2 else 0x7F)
                    yield kinds[number - 1][0], kinds[number - 1][1][0]
                place += wide * count


def _boxes(content: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and content of the boxes of a file (ISO/IEC 14496-12), or of those in a box."""
    while len(content) >= 8:
        size, kind = struct.unpack_from(">I4s", content)
        head = 8 if size != 1 else 16
        size = len(content) if size == 0 else size if size != 1 else struct.unpack_from(">Q", content, 8)[0]
        if size < head:
            return
        yield kind, content[head:size]
        content = content[size:]


def open_heic(path: Path) -> Any:
    """Return the photo of a HEIC file, pillow-heif's image, whose pixels are not decoded yet; ValueError if damaged."""
    with refusing(f"{path}: HEIC photos need the package pillow-heif: {how_to_install('captures')}", ImportError):
        import pillow_heif  # noqa: PLC0415 - an extra
    content = read_limited(path, MOST_FILE)
    with refusing(f"{path}: expected a HEIC photo, got a damaged one", *_DAMAGED):
        file = pillow_heif.open_heif(content)
        return file[file.primary_index]


def decode_heic(path: Path, image: Any) -> np.ndarray:
    """Return the decoded pixels of an image of a HEIC file; ValueError if it is damaged or too large."""
    width, height = image.size
    expect_pixels(path, height, width)
    with refusing(f"{path}: expected a HEIC photo, got a damaged one", *_DAMAGED):
        return np.array(image)


def same_aspect(first: Size, second: Size) -> bool:
    """Return whether the aspects of two sizes differ by at most 2 %."""
    return abs(first[0] * second[1] / (first[1] * second[0]) - 1) <= _ASPECT_TOLERANCE


class Exif(NamedTuple):
    """The EXIF data of a photo, as far as they make sense."""

    focal: float | None  # the equivalent focal length for 35 mm film in millimetres
    model: str  # the name of the device; empty if there is none
    orientation: int  # 1 (as it is) to 8; 1 if there is none


def read_exif(photo: Path) -> Exif:
    """Return the EXIF data of a photo; those that are missing or damaged are ignored."""
    found: dict[int, Any] = {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of data that are damaged
            if photo.suffix.lower() in HEIC_SUFFIXES:
                exif = Image.Exif()
                exif.load(open_heic(photo).info["exif"])
            else:
                with opened(photo) as file, Image.open(file) as image:
                    exif = image.getexif()
            found = {**dict(exif), **exif.get_ifd(_EXIF_IFD)}
    except Exception:  # of any kind, by Pillow
        found = {}
    focal, model, orientation = (found.get(tag) for tag in (_EXIF_FOCAL_35, _MODEL, _ORIENTATION))
    return Exif(
        float(focal) if isinstance(focal, (int, float)) and 1 < focal < 10_000 else None,
        model if isinstance(model, str) else "",
        orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1,
    )


def write_png(path: Path, picture: np.ndarray, known: np.ndarray | None = None) -> None:
    """Write a picture, grey (H, W) or blue-green-red (H, W, 3), uint8 or uint16, transparent if not ``known``."""
    if known is not None and not known.all():
        picture = np.dstack((picture, np.where(known, 255, 0).astype(np.uint8)))
    with replacing(path) as temporary:
        temporary.write_bytes(encode_png(picture))


def encode_png(picture: np.ndarray) -> bytes:
    """Return a picture, (H, W) or (H, W, 2, 3 or 4) blue first, uint8 or uint16, as a PNG; 2: grey and opacity."""
    if picture.ndim == 3 and picture.shape[2] == 2:  # which OpenCV would write as four
        content = io.BytesIO()
        Image.fromarray(picture).save(content, "PNG", compress_level=_LEVEL)
        return content.getvalue()
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, _LEVEL])
    return encoded.tobytes()


def to_jpeg(pixels: np.ndarray, longest: int, quality: int) -> bytes:
    """Encode a picture, (H, W, 3) uint8, as a JPEG, reduced if its longer side has more than ``longest`` pixels."""
    height, width = pixels.shape[:2]
    shrink = min(1.0, longest / max(height, width))
    if shrink < 1:
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    _, content = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), options)
    return content.tobytes()


def data_url(content: bytes, kind: str = "jpeg") -> str:
    """Return the bytes of a picture as the address of itself, for pages."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
