"""ScanNet's recordings (.sens) and their exports with SensReader, and the iPhone's recordings in ScanNet++.

ScanNet; https://github.com/ScanNet/ScanNet, SensReader/python/SensorData.py. Depth is registered to colour. A ``.sens``
is little-endian:

    uint32 4, uint64 length, the sensor's name
    4 x 16 float32           intrinsics and extrinsics of colour, then of depth, row by row
    2 int32                  compression of colour: 0 raw, 1 PNG, 2 JPEG; of depth: 0 raw, 1 zlib, of uint16
    4 uint32                 width and height of colour, then of depth
    float32, uint64          values per metre (1000), and the number of frames; of each:
        16 float32           pose from camera (x right, y down, z forward) to world, -inf where there is none
        4 uint64             times of colour and depth in microseconds, 0 for none; bytes of both; then those bytes

ScanNet++; https://github.com/scannetpp/scannetpp, iphone/prepare_iphone_data.py and common/scene_release.py.
``depth.bin`` has for each frame a uint32 of its bytes, and 256 x 192 values: LZ4 of uint16 in millimetres, or raw
deflate of float32 in metres.
"""

import contextlib
import struct
import zlib
from dataclasses import replace
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import BaseModel, Field, RootModel

from dsr.geometry.camera import Camera
from dsr.geometry.poses import as_rigid
from dsr.io.captures.archive import PHOTO_LIMIT, as_pixels, decode_photo, inflate, read_section
from dsr.io.captures.stray import VideoFrame, frames_of_video
from dsr.io.frames import CaptureFrame, Geometry, Part, Size, stated
from dsr.io.images import read_numbers
from dsr.io.pairs import PHOTO_SUFFIXES, Pair, PairingResult, numbered_files, paired
from dsr.io.trajectories import NO_POSE, USUAL_SIZE, describe_capture, fitting_camera, intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import MOST_TEXT, opened, read_limited, read_text, refusing
from dsr.utils.validation import parse_model
from dsr.utils.versions import how_to_install

_BEGINNING, _HEADER, _FRAME = struct.Struct("<IQ"), struct.Struct("<64f2i4IfQ"), struct.Struct("<16f4Q")
_VERSION = 4
_LONGEST_NAME, _LARGEST_SIDE, _MOST_FRAMES = 1 << 12, 1 << 14, 1 << 16
_SIZE = (968, 1296)  # height and width of photos as they are recorded

_JSON, _LARGEST_JSON = "pose_intrinsic_imu.json", 1 << 28
_VIDEOS = ("rgb.mkv", "rgb.mp4")
_MAP = (192, 256)
_LARGEST_MAP = 4 * _MAP[0] * _MAP[1] + (1 << 12)  # bytes of a compressed one


class _Sens(NamedTuple):
    """The description in a ``.sens`` file; sizes are (height, width)."""

    intrinsics: list[float]
    compression: tuple[int, int]
    photo: tuple[int, int]
    depth: tuple[int, int]
    scale: float
    frames: int


def read_sens(path: Path) -> PairingResult:
    """Return the frames of a ``.sens`` file."""
    size, pairs = path.stat().st_size, list[Pair]()
    with opened(path) as file:
        header = _read_header(path, file)
        place = file.tell()
        if header.frames > min(size // _FRAME.size, _MOST_FRAMES):
            raise ValueError(f"{path}: expected at most {_MOST_FRAMES} frames, got {header.frames} in {size} bytes")
        for number in range(header.frames):
            file.seek(place)
            content = file.read(_FRAME.size)
            values = _FRAME.unpack(content.ljust(_FRAME.size, b"\0"))
            lengths, start = values[18:], place + _FRAME.size
            place = start + sum(lengths)
            if len(content) < _FRAME.size or place > size or max(lengths) > PHOTO_LIMIT or not min(lengths):
                raise ValueError(f"{path}: expected {header.frames} frames, it is damaged or ends in frame {number}")
            read_photo = partial(read_section, path, start, lengths[0])
            read_depth = partial(read_section, path, start + lengths[0], lengths[1])
            photo = Part(path, f"color/{number}", read_photo, partial(_photo, header))
            depth = Part(path, f"depth/{number}", read_depth, partial(_depth, header))
            geometry = stated(_sens_geometry, f"{path}: frame {number}", header, values[:16])
            about = content[:64] + repr(header).encode()
            frame = CaptureFrame("ScanNet", geometry, path, about, photo, depth)
            files, time = (path / photo.name, path / depth.name), 1e-6 * values[16]
            pairs.append(Pair(f"{number:06}", *files, unit=1 / header.scale, capture=frame, time=time))
    if not pairs:
        raise ValueError(f"{path}: expected frames, there is none")
    if not any(pair.time for pair in pairs):  # as where they are not known
        pairs = [replace(pair, time=None) for pair in pairs]
    unit = "millimetres" if header.scale == 1000 else f"1/{header.scale:g} m"
    return PairingResult(tuple(pairs), (describe_capture("a recording of ScanNet", unit, pairs, poses=True),))


def _read_header(path: Path, file: BufferedReader) -> _Sens:
    with refusing(f"{path}: expected a recording of ScanNet (.sens), got a damaged or foreign file", struct.error):
        version, length = _BEGINNING.unpack(file.read(_BEGINNING.size))
        if version != _VERSION or length > _LONGEST_NAME:
            raise ValueError(f"{path}: expected a recording of ScanNet (.sens) of version 4, got another file")
        file.seek(length, 1)
        values = _HEADER.unpack(file.read(_HEADER.size))
    matrix, (colour, depth) = values[:16], values[64:66]
    wide, high, narrow, low, scale, count = values[66:]
    if colour not in (0, 1, 2) or depth not in (0, 1):
        expected = "colour that is raw, PNG or JPEG (0, 1, 2) and depth that is raw or of zlib (0, 1)"
        raise ValueError(f"{path}: expected {expected}, got compression {colour} and {depth}")
    if not all(1 <= side <= _LARGEST_SIDE for side in (wide, high, narrow, low)) or not 1 <= scale <= 1e6:
        got = f"{wide} x {high}, {narrow} x {low} and {scale:g}"
        raise ValueError(f"{path}: expected sizes and values per metre, got {got}")
    numbers = [matrix[0], matrix[5], matrix[2], matrix[6]]
    return _Sens(numbers, (colour, depth), (high, wide), (low, narrow), scale, count)


def _photo(header: _Sens, content: bytes) -> np.ndarray:
    return decode_photo(content) if header.compression[0] else as_pixels(content, "u1", (*header.photo, 3))


def _depth(header: _Sens, content: bytes) -> np.ndarray:
    content = inflate(content, 2 * header.depth[0] * header.depth[1]) if header.compression[1] else content
    return as_pixels(content, "<u2", header.depth)


def _sens_geometry(place: str, header: _Sens, values: tuple[float, ...]) -> Geometry:
    return _placed(intrinsics_camera(place, header.photo, header.intrinsics), np.reshape(values, (4, 4)), place)


def find_export(folder: Path) -> PairingResult | None:
    """Return the frames of a folder of ScanNet's exports."""
    matrices = [folder / "intrinsic" / f"intrinsic_{kind}.txt" for kind in ("color", "depth")]
    matrices = [path for path in matrices if path.is_file()]
    photos, depths = numbered_files(folder / "color", PHOTO_SUFFIXES), numbered_files(folder / "depth", (".png",))
    both, unpaired = paired(photos, depths)
    if not matrices or not both:
        return None
    pairs = []
    for number in both:
        path = folder / "pose" / f"{photos[number].stem}.txt"
        content = b"".join(read_limited(each, MOST_TEXT) for each in (*matrices, path) if each.is_file())
        frame = CaptureFrame("ScanNet", partial(_export_geometry, matrices, path), path, content)
        pairs.append(Pair(photos[number].stem, photos[number], depths[number], unit=1e-3, capture=frame))
    note = describe_capture("an export of ScanNet", "millimetres", pairs, poses=(folder / "pose").is_dir())
    return PairingResult(tuple(pairs), (note,), unpaired)


def _export_geometry(matrices: list[Path], path: Path, size: Size) -> Geometry:
    numbers = [read_numbers(each, 16)[[0, 5, 2, 6]].tolist() for each in matrices]
    for place, each in enumerate(numbers):
        with contextlib.suppress(ValueError):  # it is of other pixels
            camera = fitting_camera(str(matrices[place]), (size,), each)
            break
    else:
        camera = fitting_camera(str(matrices[0]), (size, _SIZE), numbers[0])
    return with_pose(camera, path)


def with_pose(camera: Camera | None, path: Path, notes: tuple[Assumption, ...] = ()) -> Geometry:
    """Return a camera with the pose of 4 x 4 numbers in a text file; none if it is missing, or tracking was lost."""
    matrix = read_numbers(path, 16).reshape(4, 4) if path.is_file() else np.full((4, 4), np.nan)
    return _placed(camera, matrix, str(path), notes)


def _placed(camera: Camera | None, matrix: np.ndarray, place: str, notes: tuple[Assumption, ...] = ()) -> Geometry:
    """Return a camera with a pose, (4, 4), that is not finite where there is none."""
    if not np.isfinite(matrix).all():
        return Geometry(camera, None, (*notes, NO_POSE))
    return Geometry(camera, as_rigid(matrix, place), notes)


_Row3 = Annotated[list[float], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]


class _Entry(BaseModel, strict=True):
    """What the JSON says of a frame; numbers may be NaN here, each frame's are checked when it is read."""

    intrinsic: Annotated[list[_Row3], Field(min_length=3, max_length=3)] | None = None
    aligned_pose: Annotated[list[_Row4], Field(min_length=4, max_length=4)] | None = None


class _Entries(RootModel[dict[str, _Entry]]):
    """The JSON by the names of the frames."""


def find_scannetpp(folder: Path) -> PairingResult | None:
    """Return the frames of the iPhone in a scene of ScanNet++, or of its folder ``iphone``."""
    folder = folder / "iphone" if (folder / "iphone" / _JSON).is_file() else folder
    path, packed = folder / _JSON, folder / "depth.bin"
    maps, parts = numbered_files(folder / "depth", (".png",), "frame_"), dict[int, Part]()
    photos = numbered_files(folder / "rgb", (".jpg", ".png"), "frame_")
    video = next((folder / name for name in _VIDEOS if (folder / name).is_file()), None)
    if not path.is_file() or not (maps or packed.is_file()) or not (photos or video):
        return None
    expected = "expected ScanNet++'s intrinsics and poses; "
    entries = parse_model(_Entries, read_text(path, _LARGEST_JSON), path, expected).root
    if not maps:
        parts = _parts(packed)
        maps = {number: packed / part.name for number, part in parts.items()}
    frames, warnings = dict[int, VideoFrame](), list[Assumption]()
    if video is not None and not photos and maps:
        photos, frames, warnings = frames_of_video(video, maps)
    both, unpaired = paired(photos, maps)
    pairs = []
    for number in sorted(both):
        entry = entries.get(f"frame_{number:06}", _Entry())
        geometry, content = partial(_iphone_geometry, f"{path}: frame_{number:06}", entry), entry.model_dump_json()
        sources = frames.get(number), parts.get(number)
        frame = CaptureFrame("ScanNet++ iPhone", geometry, path, content.encode(), *sources)
        pairs.append(Pair(f"{number:06}", photos[number], maps[number], unit=1e-3, capture=frame))
    note = describe_capture("the iPhone of a scene of ScanNet++", "millimetres", pairs, poses=True)
    return PairingResult(tuple(pairs), (note, *warnings), unpaired)


def _parts(path: Path) -> dict[int, Part]:
    size, place, found = path.stat().st_size, 0, dict[int, Part]()
    while place < size:
        length = int.from_bytes(read_section(path, place, 4), "little")
        start, place = place + 4, place + 4 + length
        if not 0 < length <= _LARGEST_MAP or place > size:
            raise ValueError(
                f"{path}: expected maps one by one, map {len(found)} is damaged, or all are compressed together: "
                "ScanNet++'s prepare_iphone_data.py unpacks those to depth/"
            )
        fetch = partial(read_section, path, start, length)
        found[len(found)] = Part(path, f"{len(found):06}", fetch, _map)
    return found


def _map(content: bytes) -> np.ndarray:
    """Return a map in millimetres, (192, 256): uint16 as LZ4, or float32 in metres as raw deflate."""
    with refusing(f"LZ4 data need the package lz4: {how_to_install('captures')}", ImportError):
        import lz4.block  # noqa: PLC0415 - an extra
    count = _MAP[0] * _MAP[1]
    with contextlib.suppress(lz4.block.LZ4BlockError, MemoryError):
        values = lz4.block.decompress(content, uncompressed_size=2 * count)
        if len(values) == 2 * count:
            return np.frombuffer(values, "<u2").reshape(_MAP)
    return 1000 * np.frombuffer(inflate(content, 4 * count, -zlib.MAX_WBITS), "<f4").reshape(_MAP)


def _iphone_geometry(place: str, entry: _Entry, size: Size) -> Geometry:
    camera, notes = None, [] if entry.aligned_pose else [NO_POSE]
    if entry.intrinsic is not None:
        (fx, _, cx), (_, fy, cy), _ = entry.intrinsic
        camera = fitting_camera(place, (size, USUAL_SIZE), (fx, fy, cx, cy))
    return Geometry(camera, as_rigid(entry.aligned_pose, place) if entry.aligned_pose else None, tuple(notes))
