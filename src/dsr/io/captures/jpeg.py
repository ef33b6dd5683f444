"""JPEG photos with depth maps of their own, as Android phones write: GDepth, and Dynamic Depth 1.0.

GDepth (https://developers.google.com/depthmap-metadata) keeps the map, its confidence and the photo before effects as
base64 in XMP, mostly in its extension (Adobe, XMP specification part 3, 1.1.3). Dynamic Depth
(https://developer.android.com/training/camera2/Dynamic-depth-v1.0.pdf) keeps them as files behind the photo, in the
order and with the lengths of a directory in XMP. In both a grey picture says where depth lies between near (black) and
far. XMP is searched for properties and not parsed: Google's own example is no valid XML.
"""

import base64
import contextlib
import re
from collections.abc import Iterator
from functools import lru_cache, partial
from io import BufferedReader, BytesIO
from pathlib import Path

import cv2
import numpy as np

from dsr.io.captures.archive import decode_photo
from dsr.io.frames import CaptureFrame, ConfidenceMap, Geometry, Part, accuracy_notes, file_state, stated
from dsr.io.pairs import Pair, PairingResult
from dsr.io.photos import AS_STORED, read_exif
from dsr.io.trajectories import intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.decoding import decode_pixels, picture_size
from dsr.utils.guards import MOST_FILE, expect_bytes, expect_one_of, numbers_in, opened, refusing

_START, _APP1, _SCAN, _END = b"\xff\xd8", 0xE1, 0xDA, b"\xff\xd9"  # markers of JPEG (ITU-T T.81, B.1)
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # in and behind entropy-coded data
_XMP, _EXTENDED = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_MOST_XMP = 1 << 26  # bytes
_NAMESPACE = re.compile(rb"http://ns\.google\.com/photos/(dd/)?1\.0/depthmap/")
# an attribute or an element with text; Google Photos writes Item_1_ for Item in a file with two directories
_PROPERTY = re.compile(
    r"""\b(GDepth|GImage|Item|Image|DepthMap|ImagingModel)(?:_\d_)?:(\w+)\s*(?:=\s*"([^"]*)"|=\s*'([^']*)'|>([^<>]*)<)"""
)
_OF_GDEPTH = "GImage:Data", "GDepth:Data", "GDepth:Confidence"
_OF_DYNAMIC = "Image:ItemURI", "DepthMap:DepthURI", "DepthMap:ConfidenceURI"
_MODEL = {"FocalLengthX": "", "FocalLengthY": "", "ImageWidth": "", "ImageHeight": "",
          "PrincipalPointX": "0.5", "PrincipalPointY": "0.5"}  # fmt: skip
_METRES = {"m": 1.0, "meters": 1.0, "mm": 1e-3, "diopters": 1.0}
_NO_CONFIDENCE = 0.02  # a JPEG does not keep zeros
_Values = dict[str, str]  # properties by their names


def read(path: Path) -> PairingResult:
    """Return the pair of a JPEG with a depth map."""
    confidence, found = b"", _Values()
    with contextlib.suppress(ValueError):  # which is reported with the frame
        (_, _, confidence), found = _read(path, file_state(path, "a photo"))
    model = {name: found[f"ImagingModel:{name}"] for name in _MODEL if f"ImagingModel:{name}" in found}
    names = ("Near", "Far", "Format", "Units", "MeasureType")
    values = {name: found.get(f"GDepth:{name}", found.get(f"DepthMap:{name}", "")).lower() for name in names}
    notes = accuracy_notes(absolute=values["Units"] in _METRES, stated=bool(values["Units"]))
    notes += [AS_STORED] if read_exif(path).orientation != 1 else []
    fetch = [partial(_fetch, path, place) for place in range(3)]
    photo = Part(path, "photo", fetch[0], decode_photo)
    depth = Part(path, "depth", fetch[1], partial(_depth, path, values))
    geometry = stated(_geometry, path, model, tuple(notes))
    frame = CaptureFrame("JPEG", geometry, path, repr((values, model)).encode(), photo, depth)
    sure = Part(path, "confidence", fetch[2], _grey)
    known = ConfidenceMap(path / "confidence", 1.0, sure) if confidence else None
    ray = values["MeasureType"] == "opticray"
    pair = Pair(path.stem, path, path / "depth", unit=1.0, capture=frame, confidence=known, along_ray=ray)
    return PairingResult((pair,), (Assumption("JPEG photos with depth maps of their own"),))


def has_depth(path: Path) -> bool:
    """Return whether the XMP of a JPEG is about a depth map; nothing from the pixels on is read."""
    with opened(path) as file:
        return any(_NAMESPACE.search(segment) for segment in _segments(file))


def _fetch(path: Path, place: int) -> bytes:
    return _read(path, file_state(path, "a photo"))[0][place]


def _grey(content: bytes) -> np.ndarray:
    """Return a grey picture, (h, w) float64 from 0 to 1."""
    pixels = decode_pixels("map", content, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype.kind != "u" or (pixels.ndim > 2 and np.ptp(pixels[..., :3], axis=-1).any()):
        got = "a damaged one or none" if pixels is None else f"{pixels.dtype} of shape {pixels.shape} in colours"
        raise ValueError(f"expected a grey JPEG or PNG, got {got}")
    return (pixels if pixels.ndim == 2 else pixels[..., 0]) / np.iinfo(pixels.dtype).max


def _depth(path: Path, values: _Values, content: bytes) -> np.ndarray:
    """Return depth, (h, w) float32 in metres, NaN in holes; in a unit of its own if that is not stated."""
    near, far = numbers_in((values["Near"], values["Far"])) or (0.0, 0.0)
    if not (0 < near < np.inf and 0 < far < np.inf):
        raise ValueError(f"Near, Far: expected positive numbers, got {values['Near']!r:.40}, {values['Far']!r:.40}")
    kind, share = values["Format"] or "rangeinverse", _grey(content)
    expect_one_of("Format", kind, ("rangeinverse", "rangelinear"))
    with np.errstate(all="ignore"):  # of ranges that are no distances
        linear = kind == "rangelinear"
        depth = near + share * (far - near) if linear else 1 / (1 / near + share * (1 / far - 1 / near))
        depth = 1 / depth if values["Units"] == "diopters" else depth * _METRES.get(values["Units"], 1.0)
    confidence = _fetch(path, 2)
    if confidence and (sure := _grey(confidence)).shape == depth.shape:  # others are refused when confidence is read
        depth[sure < _NO_CONFIDENCE] = np.nan  # where Android writes near
    return depth.astype(np.float32)


def _segments(file: BufferedReader) -> Iterator[bytes]:
    """Yield the APP1 segments of a JPEG; at the end the file is four bytes behind the beginning of its first scan."""
    head = b"\xff" if file.read(2) == _START else b""
    while head[:1] == b"\xff" and len(head := file.read(4)) == 4 and head[1] != _SCAN:
        size = max(int.from_bytes(head[2:]) - 2, 0)
        if head[1] == _APP1:
            yield file.read(size)
        else:
            file.seek(size, 1)


@lru_cache(maxsize=1)
def _read(path: Path, _state: tuple[int, int]) -> tuple[tuple[bytes, bytes, bytes], _Values]:
    """Return the encoded photo, depth map and confidence, and the properties of map and camera."""
    with opened(path) as file:
        expect_bytes(path, path.stat().st_size, MOST_FILE)
        segments, scan = list(_segments(file)), max(file.tell() - 4, 0)
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
    camera = next((group for group in groups if "DepthMap:DepthURI" in group), None)
    if "GDepth:Data" in found:  # XML may escape the ends of lines of base64, which may lack its padding
        camera, texts = found, (re.sub(r"&#\w+;|\s", "", found.get(name, "")) for name in _OF_GDEPTH)
        with refusing(f"{path}: {', '.join(_OF_GDEPTH)}: expected base64, got something else", ValueError):
            original, depth, confidence = (base64.b64decode(text + "==") for text in texts)
    elif camera is not None:
        files = _files(path, content, scan, groups)
        original, depth, confidence = (files.get(camera.get(name, ""), b"") for name in _OF_DYNAMIC)
    else:
        raise ValueError(f"{path}: expected GDepth:Data or DepthMap:DepthURI in the XMP, there is neither")
    same = original and picture_size(BytesIO(original)) == picture_size(BytesIO(content))
    return (original if same else content, depth, confidence), camera


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
        with refusing(f"{path}: Item:Length, Item:Padding: expected whole numbers, got others", ValueError):
            length, padding = (max(int(item.get(name) or 0), 0) for name in ("Item:Length", "Item:Padding"))
        length = length if number else 0  # the first one is the photo
        files[item.get("Item:DataURI", "")] = content[end : end + length]
        end += length + padding
    return files


def _geometry(path: Path, model: _Values, notes: tuple[Assumption, ...]) -> Geometry:
    """Return the camera of an imaging model, in pixels, but for the principal point, a share of the photo or pixels."""
    if not model:
        return Geometry(None, None, notes)
    numbers = numbers_in((_MODEL | model).values())
    if not numbers or not all(1 <= each <= MOST_FILE for each in numbers[2:4]):
        raise ValueError(f"{path}: ImagingModel: expected focal lengths and the size of the photo, got {model!s:.200}")
    fx, fy, width, height, cx, cy = numbers
    if max(cx, cy) <= 1:
        cx, cy = cx * width - 0.5, cy * height - 0.5
    camera = intrinsics_camera(f"{path}: ImagingModel", (round(height), round(width)), (fx, fy, cx, cy))
    return Geometry(camera, None, notes)
