"""Scenes of structure from motion: sparse models of COLMAP, and ``transforms.json`` of nerfstudio and instant-ngp.

https://colmap.github.io/format.html; src/colmap/scene/reconstruction_io_binary.cc and src/colmap/sensor/models.h of
https://github.com/colmap/colmap. Numbers are little-endian:

    cameras.bin    count u8; camera i4, model i4, width u8, height u8, its numbers f8
    images.bin     count u8; image u4, quaternion w x y z and translation f8, camera u4, name and 0, count u8 of
                   observations: x, y f8, point u8 (2^64 - 1 for none)
    points3D.bin   count u8; point u8, x, y, z f8, colour 3 u1, error f8, count u8 of observations: u4, u4
    *.txt          the same in lines; of an image's two the second has the observations and may be empty

Poses lead from the world to the camera (x right, y down, z forward); the centre of the first pixel is at 0.5. A photo
is that of an image whose name ends its path, else of the only one of its stem. The unit of both is taken for the metre.

https://docs.nerf.studio/quickstart/data_conventions.html: intrinsics and lens coefficients of all frames or each, with
the first pixel's corner at (0, 0), and poses of OpenGL's camera.
"""

import functools
import io
import math
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsr.geometry.camera import Lens
from dsr.geometry.poses import from_quaternion, invert
from dsr.io.frames import CaptureFrame, Geometry, Size, Source, file_state, stated
from dsr.io.pairs import PHOTO_SUFFIXES, Pair, PairingResult
from dsr.io.trajectories import check_pose, intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import (
    decode_text,
    is_number,
    leads_outside,
    naming,
    natural_key,
    numbers_in,
    parse_json,
    path_within,
    read_limited,
    read_text,
    refusing,
)

_APP = "COLMAP"
_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0")  # of the model in a folder of photos
_LARGEST = 1 << 30
_LARGEST_SIDE = 1 << 15
_NONE = 2**64 - 1  # the point of an observation that has none
_FEWEST = 16  # observed points of a photo from which they make a map
_BROWN, _FISHEYE = ("brown_conrady", (4, 8)), ("kannala_brandt", (4,))


class _Model(NamedTuple):
    """A camera model: numbers of focal length, of coefficients, and the lens with its possible numbers of these."""

    name: str
    focal: int
    bends: int
    lens: tuple[str, tuple[int, ...]] | None = None


_MODELS = {
    0: _Model("SIMPLE_PINHOLE", 1, 0), 1: _Model("PINHOLE", 2, 0), 2: _Model("SIMPLE_RADIAL", 1, 1, _BROWN),
    3: _Model("RADIAL", 1, 2, _BROWN), 4: _Model("OPENCV", 2, 4, _BROWN), 5: _Model("OPENCV_FISHEYE", 2, 4, _FISHEYE),
    6: _Model("FULL_OPENCV", 2, 8, _BROWN), 8: _Model("SIMPLE_RADIAL_FISHEYE", 1, 1, _FISHEYE),
    9: _Model("RADIAL_FISHEYE", 1, 2, _FISHEYE),
    10: _Model("THIN_PRISM_FISHEYE", 2, 8, ("thin_prism_fisheye", (8,))),
}  # fmt: skip
_BY_NAME = {model.name: model for model in _MODELS.values()}


class _Camera(NamedTuple):
    model: _Model
    width: int
    height: int
    numbers: tuple[float, ...]


class _Image(NamedTuple):
    """An image as it is stored: ``quaternion`` w x y z, ``observed``: column, row and point of each, (n, 3) float64."""

    name: str
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    observed: np.ndarray


def model_file(place: Path) -> Path | None:
    """Return the file of images of a model, given by itself or as a folder; None if there is none."""
    files = [place]
    if place.is_dir():
        files = [place / part / f"images{suffix}" for part in _PLACES for suffix in (".bin", ".txt")]
    for file in files:
        if file.name in ("images.bin", "images.txt") and file.is_file() and _beside(file, "cameras").is_file():
            return file
    return None


def _beside(file: Path, name: str) -> Path:
    return file.with_name(name + file.suffix)


def _damaged(path: Path) -> AbstractContextManager[None]:
    return refusing(f"{path}: expected a model of {_APP}, got a damaged or truncated file", struct.error)


def _read_model(file: Path) -> tuple[dict[int, _Camera], list[_Image]]:
    """Return the cameras of a model and its images by name, given the file of images with that of cameras beside it."""
    path, binary = _beside(file, "cameras"), file.suffix == ".bin"
    with _damaged(path):
        cameras = (_cameras_of_bytes if binary else _cameras_of_text)(path, read_limited(path, _LARGEST))
    with _damaged(file):
        images = (_images_of_bytes if binary else _images_of_text)(file, read_limited(file, _LARGEST))
    for image in images:
        if image.camera not in cameras:
            raise ValueError(f"{file}: image {image.name!r:.80}: expected a camera of the model, got {image.camera}")
    return cameras, sorted(images, key=lambda image: natural_key(image.name))


def _frame(file: Path, image: _Image, camera: _Camera) -> CaptureFrame:
    placed = (image.quaternion, image.translation, camera)
    geometry = stated(_geometry, f"{file}: image {image.name!r:.80}", *placed)
    return CaptureFrame(_APP, geometry, file, repr(placed).encode())


def add_model(found: PairingResult, file: Path) -> PairingResult:
    """Return pairs with the cameras and poses of a model; the same with a note if it has none of their photos."""
    cameras, images = _read_model(file)
    names = {image.name: image for image in images}
    stems = Counter(Path(image.name).stem for image in images)
    lone = {Path(name).stem: image for name, image in names.items() if stems[Path(name).stem] == 1}
    pairs, count = [], 0
    for pair in found.pairs:
        parts = pair.rgb.parts
        ends = ("/".join(parts[place:]) for place in range(len(parts)))
        image = next((names[end] for end in ends if end in names), None) or lone.get(pair.rgb.stem)
        if image is None:
            pairs.append(pair)
            continue
        count += 1
        frame, own = _frame(file, image, cameras[image.camera]), pair.capture
        if own is not None:  # which has pictures, and the depth camera
            geometry = functools.partial(_joined, frame, own)
            frame = replace(own, geometry=geometry, description=file, content=frame.content + own.content)
        pairs.append(replace(pair, capture=frame))
    if not count:
        text = f"no poses: {file.name} of {_APP} has {len(names)} images, none of these names"
        return replace(found, assumptions=(*found.assumptions, Assumption(text)))
    return replace(found, pairs=tuple(pairs), assumptions=(*found.assumptions, _note(count, len(pairs), file)))


def _joined(model: CaptureFrame, capture: CaptureFrame, size: Size) -> Geometry:
    """Return camera, pose and lens of a model, and the depth camera of a capture, or what is wrong with it."""
    found, own = model.geometry_of(size), capture.geometry_of(size)
    return found if found.damage else found._replace(rig=own.rig, damage=own.damage)


def _note(count: int, total: int, file: Path) -> Assumption:
    text = f"cameras and poses of {_APP}: {file.parent.name}/{file.name}; its unit is assumed to be the metre"
    return Assumption(text, f"{count} of {total} photos")


def find_colmap(folder: Path) -> PairingResult | None:
    """Return the photos of a model in a folder without depth maps, with its points as depth; None if there is none."""
    file = model_file(folder)
    if file is None or not (points := _beside(file, "points3D")).is_file():
        return None
    (cameras, images), pairs, lone = _read_model(file), [], []
    for image in images:
        places = (folder / part for part in ("images", ".", "rgb", "color") if not leads_outside(image.name))
        photo = next((place / image.name for place in places if (place / image.name).is_file()), None)
        if photo is None or photo.suffix.lower() not in PHOTO_SUFFIXES:
            continue
        if int((image.observed[:, 2] >= 0).sum()) < _FEWEST:
            lone.append(photo)
            continue
        camera = cameras[image.camera]
        frame = replace(_frame(file, image, camera), depth=_SparseDepth(points, image.name, image, camera))
        pairs.append(Pair(Path(image.name).with_suffix("").as_posix(), photo, points, unit=1.0, capture=frame))
    if not pairs:
        return None
    note = Assumption(f"depth is that of the points of {points.name}, a coarse and sparse map")
    return PairingResult(tuple(pairs), (_note(len(pairs), len(images), file), note), tuple(lone))


@dataclass(frozen=True, eq=False)
class _SparseDepth(Source):
    """The depth of the points that an image shows, about a pixel for each; of several in a pixel the nearest."""

    image: _Image
    camera: _Camera

    def read(self) -> np.ndarray:
        """Return the depth, (h, w) float32 in the unit of the model, NaN in holes."""
        numbers, places = _points(self.file, file_state(self.file, "points"))
        seen = self.image.observed
        if not len(numbers):
            seen = seen[:0]
        else:
            found = np.searchsorted(numbers, seen[:, 2], side="right") - 1  # -1 is that of the last one
            known = numbers[found] == seen[:, 2]
            seen, places = seen[known], places[found[known]]
        width, height = self.camera.width, self.camera.height
        step = math.sqrt(width * height / max(len(seen), 4))
        size = max(2, round(height / step)), max(2, round(width / step))
        depth = np.full(size, np.nan, np.float32)
        if not len(seen):
            return depth
        pose = _pose(str(self.file), self.image.quaternion, self.image.translation)
        columns, rows, _ = seen.T
        z = places @ pose[2, :3] + pose[2, 3]
        inside = (z > 0) & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
        order = np.flatnonzero(inside)[np.argsort(-z[inside])]
        row, column = (rows[order] * size[0] / height).astype(int), (columns[order] * size[1] / width).astype(int)
        depth[row, column] = z[order]
        return depth


def _geometry(place: str, quaternion: Sequence[float], translation: Sequence[float], camera: _Camera) -> Geometry:
    model, numbers = camera.model, camera.numbers
    fx, fy, (cx, cy) = numbers[0], numbers[model.focal - 1], numbers[model.focal : model.focal + 2]
    found = intrinsics_camera(place, (camera.height, camera.width), (fx, fy, cx - 0.5, cy - 0.5))
    bends = numbers[model.focal + 2 :]
    lens = None
    if model.lens is not None:
        name, counts = model.lens
        count = next(each for each in counts if each >= len(bends))
        with naming(place):
            lens = Lens(name, (*bends, *[0.0] * (count - len(bends))))
    return Geometry(found, invert(_pose(place, quaternion, translation)), lens=lens if lens and lens.bends else None)


def _pose(place: str, quaternion: Sequence[float], translation: Sequence[float]) -> np.ndarray:
    w, *xyz = quaternion
    return from_quaternion(translation, (*xyz, w), place)


@dataclass
class _Bytes:
    """A binary file, read from its beginning; ``place`` is how far. A struct.error if it ends early."""

    content: bytes
    place: int = 0

    def read(self, layout: str) -> tuple[Any, ...]:
        """Return the next values of a layout of :mod:`struct`."""
        found = struct.unpack_from(f"<{layout}", self.content, self.place)
        self.place += struct.calcsize(f"<{layout}")
        return found


def _checked(
    path: Path, model: _Model | None, came: object, width: float, height: float, numbers: Sequence[float]
) -> _Camera:
    if model is None:
        raise ValueError(f"{path}: expected a camera model of {', '.join(_BY_NAME)}, got {came!s:.40}")
    if len(numbers) != (count := model.focal + 2 + model.bends):
        raise ValueError(f"{path}: expected {count} numbers of {model.name}, got {len(numbers)}")
    if not all(1 <= side <= _LARGEST_SIDE and float(side).is_integer() for side in (width, height)):
        raise ValueError(f"{path}: expected a width and a height in pixels, got {width:g} x {height:g}")
    return _Camera(model, int(width), int(height), tuple(numbers))


def _cameras_of_bytes(path: Path, content: bytes) -> dict[int, _Camera]:
    file, cameras = _Bytes(content), {}
    for _ in range(*file.read("Q")):
        number, kind, width, height = file.read("iiQQ")
        model = _MODELS.get(kind)
        numbers = () if model is None else file.read(f"{model.focal + 2 + model.bends}d")
        cameras[number] = _checked(path, model, kind, width, height, numbers)
    return cameras


def _images_of_bytes(_path: Path, content: bytes) -> list[_Image]:
    file, images = _Bytes(content), []
    for _ in range(*file.read("Q")):
        _, *numbers, camera = file.read("I7dI")
        length = content.find(b"\0", file.place) - file.place  # of the name
        (name, _), (count,) = file.read(f"{length}sc"), file.read("Q")
        (observations,) = file.read(f"{24 * count}s")
        stored = np.frombuffer(observations, [("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
        points = np.where(stored["point"] == _NONE, -1.0, stored["point"].astype(np.float64))
        observed = np.stack((stored["x"], stored["y"], points), axis=1)
        text = name.decode("utf-8", "replace")
        images.append(_Image(text, tuple(numbers[:4]), tuple(numbers[4:]), camera, observed))
    return images


def _lines(content: bytes) -> Iterator[str]:
    """Yield the lines of a text without comments; empty ones count."""
    for line in io.StringIO(decode_text(content), newline=None):
        if not line.startswith("#"):
            yield line.rstrip("\n")


def _cameras_of_text(path: Path, content: bytes) -> dict[int, _Camera]:
    cameras = {}
    for line in filter(str.strip, _lines(content)):
        words = line.split()
        numbers = numbers_in([*words[:1], *words[2:]])
        if len(numbers) < 3 or not numbers[0].is_integer():
            raise ValueError(f"{path}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line!r:.80}")
        number, width, height, *numbers = numbers
        cameras[int(number)] = _checked(path, _BY_NAME.get(words[1]), words[1], width, height, numbers)
    return cameras


def _images_of_text(path: Path, content: bytes) -> list[_Image]:
    images, lines = [], iter(_lines(content))
    for line in lines:
        if not line.strip():
            continue
        *words, name = line.strip().split(maxsplit=9)
        numbers, stored = numbers_in(words), next(lines, "")
        seen = numbers_in(stored.split())
        damaged = len(seen) % 3 or bool(seen) != bool(stored.strip()) or not all(map(math.isfinite, seen))
        if len(numbers) != 9 or not numbers[8].is_integer() or damaged:
            what = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of X Y POINT3D_ID of each point"
            raise ValueError(f"{path}: expected {what}, got {line!r:.80}")
        observed = np.array(seen, np.float64).reshape(-1, 3)
        images.append(_Image(name, tuple(numbers[1:5]), tuple(numbers[5:8]), int(numbers[8]), observed))
    return images


@functools.lru_cache(maxsize=1)
def _points(path: Path, _state: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the points of a file of a size and a time, (n,) float64 in order, and their places."""
    content, number = read_limited(path, _LARGEST), "<f8"
    stored = bytearray()  # number and place of each
    if path.suffix == ".bin":
        number, file = "<u8", _Bytes(content)
        with _damaged(path):
            for _number in range(*file.read("Q")):
                stored += file.read("32s11x")[0]
                (count,) = file.read("Q")
                file.read(f"{8 * count}x")
    else:
        for line in filter(str.strip, _lines(content)):
            numbers = numbers_in(line.split()[:4])
            if len(numbers) != 4 or not numbers[0].is_integer():
                raise ValueError(f"{path}: expected POINT3D_ID X Y Z, got {line!r:.80}")
            stored += struct.pack("<4d", *numbers)
    points = np.frombuffer(stored, [("number", number), ("place", "<f8", 3)])
    order = np.argsort(points["number"], kind="stable")
    return points["number"][order].astype(np.float64), points["place"][order]


def add_transforms(folder: Path, found: PairingResult) -> PairingResult | None:
    """Return pairs with cameras and poses of ``transforms.json`` in a folder or, as dsr writes it, above; else None."""
    files = [place / "transforms.json" for place in (folder, folder.parent)]
    file = next((path for path in files if path.is_file()), None)
    if file is None:
        return None
    pairs, count = {pair.rgb: pair for pair in found.pairs}, 0
    photos = {path.with_suffix(""): path for path in pairs}  # for names without suffixes
    try:
        entries = parse_json(read_text(file))
        unit = entries.get("depth_unit_scale_factor")
        for view in entries["frames"]:
            photo = path_within(file.parent, view["file_path"], file)
            photo = photos.get(photo, photo)
            depth = path_within(file.parent, view["depth_file_path"], file) if view.get("depth_file_path") else None
            depth = depth if depth and depth.is_file() else None
            pair = pairs.get(photo) or (Pair(photo.stem, photo, depth) if depth and file.parent == folder else None)
            if pair is None:
                continue
            own_entries = {**entries, **view, "frames": ()}
            geometry = functools.partial(_transform, f"{file}: {view['file_path']}", own_entries)
            frame = CaptureFrame("nerfstudio", geometry, file, repr(own_entries).encode())
            own = unit if is_number(unit) and unit > 0 else pair.unit
            pairs[photo], count = replace(pair, depth=depth or pair.depth, unit=own, capture=frame), count + 1
    except (ValueError, TypeError, KeyError, AttributeError):  # of another program
        return None
    if not count:
        return None
    text = "cameras and poses: transforms.json; its unit is assumed to be the metre"
    note = Assumption(text, f"{count} of {len(pairs)} photos")
    return replace(found, pairs=tuple(pairs.values()), assumptions=(*found.assumptions, note))


def _transform(place: str, view: dict[str, Any], size: tuple[int, int]) -> Geometry:
    expected = f"{place}: expected numbers of a camera and a pose of 4 x 4"
    with refusing(expected, ValueError, TypeError, KeyError, ArithmeticError):
        width, height = int(view.get("w", size[1])), int(view.get("h", size[0]))
        fx = view["fl_x"] if "fl_x" in view else width / 2 / math.tan(view.get("camera_angle_x", 0) / 2 or math.nan)
        centre = view.get("cx", width / 2) - 0.5, view.get("cy", height / 2) - 0.5
        intrinsics = (fx, view.get("fl_y", fx), *centre)
        camera = None if math.isnan(fx) else intrinsics_camera(place, (height, width), intrinsics)
        fisheye = "FISHEYE" in str(view.get("camera_model")) or bool(view.get("is_fisheye"))
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
        lens = Lens("kannala_brandt" if fisheye else "brown_conrady", tuple(float(view.get(name, 0)) for name in names))
        matrix = np.array(view["transform_matrix"], np.float64) if "transform_matrix" in view else None
        if matrix is not None and matrix.shape != (4, 4):
            raise TypeError
    return Geometry(camera, None if matrix is None else check_pose(place, matrix, opengl=True), lens=lens)
