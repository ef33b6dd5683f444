"""JPEG photos with depth maps of their own, as Android phones write: GDepth, and Dynamic Depth 1.0.

GDepth (https://developers.google.com/depthmap-metadata) keeps the map, its confidence and the photo before effects as
base64 in XMP, mostly in its extension (Adobe, XMP specification part 3, 1.1.3). Dynamic Depth
(https://developer.android.com/training/camera2/Dynamic-depth-v1.0.pdf) keeps them as files behind the photo, in the
order and with the lengths of a directory in XMP. In both a grey picture says where depth lies between near (black) and
far. XMP is searched for properties and not parsed: Google's own example is no valid XML.
"""

import base64
import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from pathlib import Path

import cv2
import numpy as np

from dsr.io.captures.archive import decode_photo
from dsr.io.frames import CaptureFrame, ConfidenceMap, Geometry, Source, accuracy_notes, stated
from dsr.io.pairs import Pair, PairingResult
from dsr.io.photos import AS_STORED, read_exif
from dsr.io.trajectories import intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.decoding import decode_pixels, picture_size
from dsr.utils.guards import MOST_FILE, expect_bytes, expect_one_of, naming, numbers_in, opened, refusing

_START, _APP1, _SCAN, _END = b"\xff\xd8", 0xE1, 0xDA, b"\xff\xd9"  # markers of JPEG (ITU-T T.81, B.1)
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # in and behind entropy-coded data
_XMP, _EXTENDED = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_MOST_XMP = 1 << 26  # bytes
_NAMESPACE = re.compile(rb"http://ns\.google\.com/photos/(dd/)?1\.0/depthmap/")
# an attribute or an element with text; Google Photos writes Item_1_ for Item in a file with two directories
_PROPERTY = re.compile(
    r"""\b(GDepth|GImage|Item|Image|DepthMap|ImagingModel)(?:_\d_)?:(\w+)\s*(?:=\s*"([^"]*)"|=\s*'([^']*)'|>([^<>]*)<)"""
)
_MODEL = {f"ImagingModel:{name}": default for name, default in (
    ("FocalLengthX", ""), ("FocalLengthY", ""), ("ImageWidth", ""), ("ImageHeight", ""),
    ("PrincipalPointX", "0.5"), ("PrincipalPointY", "0.5"),
)}  # fmt: skip
_METRES = {"m": 1.0, "meters": 1.0, "mm": 1e-3, "diopters": 1.0}
_NO_CONFIDENCE = 0.02  # a JPEG does not keep zeros
_Values = dict[str, str]  # properties by their names


@dataclass(frozen=True)
class _JpegImage(Source):
    """The ``photo``, the ``depth`` map or its ``confidence`` in a JPEG file."""

    def read(self) -> np.ndarray:
        """Return (H, W, 3) uint8 RGB, (h, w) float32 depth in metres, NaN in holes, or confidence from 0 to 1."""
        pictures, values = _read(self.file)
        if self.name == "photo":
            with naming(self.file):
                return decode_photo(pictures["photo"])
        share = self._grey(pictures[self.name])
        if self.name == "confidence":
            return share
        near, far = (next(iter(numbers_in([values.get(name, "")])), 0.0) for name in ("Near", "Far"))
        if not (0 < near < np.inf and 0 < far < np.inf):
            got = f"{values.get('Near')!r:.40}, {values.get('Far')!r:.40}"
            raise ValueError(f"{self.file}: Near, Far: expected positive numbers, got {got}")
        kind, unit = values.get("Format", "RangeInverse").lower(), values.get("Units", "").lower()
        expect_one_of(f"{self.file}: Format", kind, ("rangeinverse", "rangelinear"))
        with np.errstate(all="ignore"):  # of ranges that are no distances
            inverse = 1 / near + share * (1 / far - 1 / near)
            depth = 1 / inverse if kind == "rangeinverse" else near + share * (far - near)
            depth = (1 / depth if unit == "diopters" else depth * _METRES.get(unit, 1.0)).astype(np.float32)
        sure = self._grey(pictures["confidence"]) if pictures["confidence"] else np.ones_like(depth)
        if sure.shape == depth.shape:  # another size is refused when confidence is read
            depth[sure < _NO_CONFIDENCE] = np.nan  # where Android writes near
        return depth

    def _grey(self, content: bytes) -> np.ndarray:
        """Return a grey picture, (h, w) float64 from 0 to 1."""
        pixels = decode_pixels(self.file / self.name, content, cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.dtype.kind != "u" or (pixels.ndim > 2 and np.ptp(pixels[..., :3], axis=-1).any()):
            got = "a damaged one or none" if pixels is None else f"{pixels.dtype} of shape {pixels.shape} in colours"
            raise ValueError(f"{self.file / self.name}: expected a grey JPEG or PNG, got {got}")
        return (pixels if pixels.ndim == 2 else pixels[..., 0]) / np.iinfo(pixels.dtype).max


def read(path: Path) -> PairingResult:
    """Return the pair of a JPEG with a depth map."""
    pictures, values = _read(path)
    unit, ray = values.get("Units", "").lower(), values.get("MeasureType", "").lower() == "opticray"
    notes = accuracy_notes(absolute=unit in _METRES, stated=bool(unit))
    notes += [AS_STORED] if read_exif(path).orientation != 1 else []
    model = {name: values[name] for name in _MODEL if name in values}
    geometry = stated(_geometry, path, model, tuple(notes))
    photo, depth, confidence = (_JpegImage(path, name) for name in pictures)
    frame = CaptureFrame("JPEG", geometry, path, repr(model).encode(), photo, depth)
    sure = ConfidenceMap(path, 1.0, confidence) if pictures["confidence"] else None
    pair = Pair(path.stem, path, path / "depth", unit=1.0, capture=frame, confidence=sure, along_ray=ray)
    return PairingResult((pair,), (Assumption("JPEG photos with depth maps of their own"),))


def has_depth(path: Path) -> bool:
    """Return whether the XMP of a JPEG is about a depth map; nothing from the pixels on is read."""
    with opened(path) as file:
        return any(_NAMESPACE.search(segment) for segment in _segments(file))


def _segments(file: BufferedReader) -> Iterator[bytes]:
    """Yield the APP1 segments of a JPEG; at the end the file is four bytes behind the beginning of its first scan."""
    head = b"\xff" if file.read(2) == _START else b""
    while head[:1] == b"\xff" and len(head := file.read(4)) == 4 and head[1] != _SCAN:
        size = max(int.from_bytes(head[2:]) - 2, 0)
        if head[1] == _APP1:
            yield file.read(size)
        else:
            file.seek(size, 1)


def _read(path: Path) -> tuple[dict[str, bytes], _Values]:
    """Return the encoded photo, depth map and confidence, and the properties of map and camera."""
    with opened(path) as file:
        expect_bytes(path, path.stat().st_size, MOST_FILE)
        segments, place = list(_segments(file)), max(file.tell() - 4, 0)
        file.seek(0)
        content = file.read()
    expect_bytes(f"{path}: XMP", sum(map(len, segments)), _MOST_XMP)
    xmp = b"".join(each.removeprefix(_XMP) for each in segments if each.startswith(_XMP))
    parts = [each.removeprefix(_EXTENDED) for each in segments if each.startswith(_EXTENDED)]
    parts = sorted((each for each in parts if each[:32] in xmp), key=lambda each: each[36:40])  # GUID, length, offset
    extended = b"".join(each[40:] for each in parts)
    if parts and len(extended) != int.from_bytes(parts[0][32:36]):
        raise ValueError(f"{path}: expected {int.from_bytes(parts[0][32:36])} bytes of XMP, got {len(extended)}")
    lists = (xmp + extended).decode("latin-1").split("<rdf:li")
    groups = [{f"{m[1]}:{m[2]}": m[3] or m[4] or m[5] or "" for m in _PROPERTY.finditer(each)} for each in lists]
    found = {name: value for group in groups for name, value in group.items()}
    camera = next((group for group in groups if "DepthMap:DepthURI" in group), {})
    if "GDepth:Data" in found:
        camera, names = found, ("GImage:Data", "GDepth:Data", "GDepth:Confidence")
        original, depth, confidence = (_decoded(path, name, found.get(name, "")) for name in names)
    elif camera:
        names = "Image:ItemURI", "DepthMap:DepthURI", "DepthMap:ConfidenceURI"
        files = _files(path, content, place, groups)
        original, depth, confidence = (files.get(camera.get(name, ""), b"") for name in names)
    else:
        raise ValueError(f"{path}: expected GDepth:Data or DepthMap:DepthURI in the XMP, there is neither")
    if original and picture_size(BytesIO(original)) == picture_size(BytesIO(content)):  # the photo before effects
        content = original
    values = {re.sub("^(GDepth|DepthMap):", "", name): value for name, value in camera.items()}
    return {"photo": content, "depth": depth, "confidence": confidence}, values


def _files(path: Path, content: bytes, place: int, groups: list[_Values]) -> dict[str, bytes]:
    """Return the files behind a JPEG, of which a scan begins at a place, by their addresses in its directory."""
    end = len(content)
    while marker := _MARKER.search(content, place):
        place = end = marker.end()
        if marker[0] == _END:
            break
        place += int.from_bytes(content[place : place + 2])
    files = dict[str, bytes]()
    for number, item in enumerate(each for each in groups if "Item:Mime" in each):
        sizes = [item.get(name) or "0" for name in ("Item:Length", "Item:Padding")]
        if not all(re.fullmatch(r"\d{1,12}", each, re.ASCII) for each in sizes):
            raise ValueError(f"{path}: Item:Length, Item:Padding: expected bytes, got {', '.join(sizes)!r:.60}")
        length = int(sizes[0]) if number else 0  # the first one is the photo
        files[item.get("Item:DataURI", "")] = content[end : end + length]
        end += length + int(sizes[1])
    return files


def _decoded(path: Path, name: str, text: str) -> bytes:
    """Return what base64 stands for, of which XML may escape the ends of lines, and which may lack its padding."""
    with refusing(f"{path}: {name}: expected base64, got something else", ValueError):
        return base64.b64decode(re.sub(r"&#\w+;|\s", "", text) + "==")


def _geometry(path: Path, model: _Values, notes: tuple[Assumption, ...]) -> Geometry:
    """Return the camera of an imaging model, in pixels, but for the principal point, a share of the photo or pixels."""
    if not model:
        return Geometry(None, None, notes)
    numbers = numbers_in((_MODEL | model).values())
    if len(numbers) != len(_MODEL) or not all(1 <= each <= MOST_FILE for each in numbers[2:4]):
        raise ValueError(f"{path}: ImagingModel: expected focal lengths and the size of the photo, got {model!s:.200}")
    fx, fy, width, height, cx, cy = numbers
    if max(cx, cy) <= 1:
        cx, cy = cx * width - 0.5, cy * height - 0.5
    size = round(height), round(width)
    return Geometry(intrinsics_camera(f"{path}: ImagingModel", size, (fx, fy, cx, cy)), None, notes)
