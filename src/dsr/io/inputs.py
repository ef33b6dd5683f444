"""Reading of a pair of files as rgb in [0, 1] and depth in metres, with the assumptions that this needed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.agreement import judge
from dsr.geometry.camera import ASSUMED_FOV, Camera, Lens, RangeType, undistort
from dsr.geometry.plausible import expect_possible
from dsr.geometry.resampling import registered_camera, warp_depth
from dsr.io.cameras import (
    CameraFile,
    doubt_camera,
    doubt_depth,
    find_camera,
    read_any_camera,
    scale_camera,
    scale_to_photo,
)
from dsr.io.depth_files import (
    ICL_CAMERA,
    ICL_SUFFIX,
    Encoding,
    decode,
    expect_known,
    find_holes,
    read_depth_file,
    turn_back_bits,
)
from dsr.io.frames import SLACK, Geometry, Rig
from dsr.io.images import Size, pixels_in_header, read_mask
from dsr.io.pairs import Pair, find_camera_file, role_of_words, words_of
from dsr.io.photos import read_exif, read_photo, same_aspect
from dsr.io.reading import SUNRGBD_BITS, CameraChoice, Reading
from dsr.io.trajectories import read_transform
from dsr.io.units import TURNED_BACK, Meaning, expect_narrow, interpret
from dsr.notes import LIMITS, Assumption
from dsr.sample import FARTHEST, NEAREST
from dsr.utils.guards import expect_size, natural_key, pixels_beside
from dsr.utils.progress import show_length

_Kind = tuple[Path, str, str, bool]  # folder, suffix, type of value, and whether disparities were ruled out
_DISPARITY_WORDS = frozenset({"disparity", "disp"})
_DOUBTED = 8  # about how many maps of a folder are asked whether what makes the first one doubtful holds for them, too


class FolderUnits:
    """The unit and range type of each kind of map from the first by name that has a known pixel, whatever was read."""

    def __init__(self, pairs: Sequence[Pair] = ()) -> None:
        self._pairs = sorted(pairs, key=lambda pair: (natural_key(pair.depth.name), natural_key(pair.name)))
        self._meanings: dict[_Kind, Meaning] = {}

    def interpret(
        self, pair: Pair, stored: np.ndarray, hole_value: float | None, camera: Camera, *, may_fall: bool
    ) -> Meaning:
        """Identify unit and range type of a pair's stored values, (h, w); see :func:`dsr.io.units.interpret`."""
        kind = (pair.depth.parent, pair.depth.suffix.lower(), str(stored.dtype), may_fall)
        if kind not in self._meanings:
            path, first = next(self._maps(kind, hole_value), (pair.depth, stored))
            meaning = interpret(str(path), first, find_holes(first, hole_value)[0], camera, may_fall=may_fall)
            certain = tuple(note for note in meaning.assumptions if not note.code)
            if len(certain) < len(meaning.assumptions):
                for _, other in self._maps(kind, hole_value, max(len(self._pairs) // _DOUBTED, 1)):
                    alike = interpret(str(path), other, find_holes(other, hole_value)[0], camera, may_fall=False)
                    if not any(note.code for note in alike.assumptions):  # the first one is an exception
                        meaning = meaning._replace(assumptions=certain)
                        break
            self._meanings[kind] = meaning
        return self._meanings[kind]

    def _maps(self, kind: _Kind, hole_value: float | None, every: int = 1) -> Iterator[tuple[Path, np.ndarray]]:
        """Yield those of every so many maps that are of a kind and have a known pixel."""
        for pair in self._pairs[::every]:
            if (pair.depth.parent, pair.depth.suffix.lower()) != kind[:2]:
                continue
            try:
                stored = _stored(pair)
            except ValueError:  # a damaged map is reported when its own turn comes
                continue
            if str(stored.dtype) == kind[2] and not find_holes(stored, hole_value)[0].all():
                yield pair.depth, stored


@dataclass(frozen=True)
class Picture:
    """A pair of photo and depth map as tensors."""

    rgb: Tensor  # (3, H, W) float32 in [0, 1]
    depth_lr: Tensor  # (1, h, w) float32 orthogonal depth in metres, NaN in holes
    camera: Camera  # of the photo's pixels
    encoding: Encoding  # of the depth file
    assumptions: tuple[Assumption, ...]
    pose: np.ndarray | None = None  # camera (x right, y down, z forward) to the capture's world, (4, 4) float64, metres
    confidence: Tensor | None = None  # (1, h, w) float32 from 0 to 1, of the low-resolution map
    device_name: str = ""  # of the app or the device, as the files state it
    up: str = ""  # the axis of the world that points up, one of dsr.io.frames.UPS
    time: float | None = None  # in seconds, as the capture or the files' names have it


def read_picture(pair: Pair, reading: Reading, units: FolderUnits | None = None) -> Picture:
    """Return a pair of files as tensors, read as the user says; ``units`` are those of the whole folder."""
    stored = _stored(pair)
    size_lr: Size = (stored.shape[0], stored.shape[1])
    source, notes = None if pair.capture is None else pair.capture.photo, list[Assumption]()
    if source is not None:
        pixels = source.read()
    else:
        pixels, notes = read_photo(pair.rgb, size_lr)
    size: Size = (pixels.shape[0], pixels.shape[1])
    geometry, damaged = read_geometry(pair, size, reading)
    described = _camera(pair, reading, geometry, size, size_lr, notes)
    expect_possible(described.camera, _camera_source(pair, reading))
    pixels, lens = _undistorted(pixels, geometry, described.camera, reading, notes)
    pixels = _cut(pixels, pair.factor, size_lr, notes)
    size = (pixels.shape[0], pixels.shape[1])
    rig = _rig(pair, reading, geometry, size_lr)
    if rig is None:
        _expect_lower_resolution(pair, size, size_lr)
    camera = described.camera.crop(0, 0, *size)
    if reading.baseline is not None:
        camera = replace(camera, baseline=reading.baseline)
    of_depth = camera.rescale(size_lr[1], size_lr[0]) if rig is None else rig.camera
    values = _interpret(pair, reading, described, stored, FolderUnits() if units is None else units, of_depth)
    stored, holes, range_type = values.stored, values.holes, values.encoding.range_type
    notes += [*values.notes, *values.hole_notes]
    if pair.mask is not None:
        mask = read_mask(pair.mask, pixels_beside(*size_lr))
        expect_size(f"{pair.mask}: expected a mask of the depth map's", mask, size_lr)
        holes |= ~mask
    confidence, confident = _confidence(pair, reading, size_lr, holes)
    expect_known(pair.depth, stored, holes)
    lens_lr = lens if rig is None else rig.lens
    if lens_lr is not None and lens_lr.bends:
        stored, holes = undistort(stored, of_depth, lens_lr, 0), undistort(holes, of_depth, lens_lr, hole=True)
        confidence = None if confidence is None else undistort(confidence, of_depth, lens_lr, 0)
        confident.append(Assumption("the lens distortion of the depth map is undone", str(lens_lr)))
    depth_lr = decode(stored, holes, values.encoding, of_depth)
    notes += [*_expect_distances(pair.depth, depth_lr, holes, range_type), *confident, *damaged]
    notes += [*doubt_camera(described.camera, "camera", size_lr), *doubt_depth(depth_lr, of_depth, range_type)]
    rgb = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1))).float() / 255
    if rig is not None:
        if range_type == "disparity" and camera.baseline is None:
            camera = replace(camera, baseline=rig.camera.baseline)  # that of the result's disparities, too
        depth_lr = _to_photo(pair, reading, depth_lr, rig, camera, rgb, notes)
    return Picture(
        rgb,
        depth_lr,
        camera,
        values.encoding,
        tuple(notes),
        geometry.pose,
        None if confidence is None or rig is not None else torch.from_numpy(confidence)[None],
        device_name=read_exif(pair.rgb).model if pair.capture is None else pair.capture.app,
        up=geometry.up,
        time=pair.named_time if pair.time is None else pair.time,
    )


def read_map(path: Path, reading: Reading, camera: Camera | None = None) -> tuple[Tensor, tuple[Assumption, ...]]:
    """Return a depth map without its photo, (1, h, w) float32 in metres, NaN in holes, and what its values mean.

    What a camera file beside it says of the values counts, as for a pair. ``camera`` is of the same view, of any size;
    None for that of the file beside it, or an assumed one.
    """
    stored = read_depth_file(path)
    size: Size = (stored.shape[0], stored.shape[1])
    apart = role_of_words(words_of(path.parent.name)) == "depth"  # a folder of maps, its camera file above it
    pair = Pair(path.stem, path, path, find_camera_file(path.parent, path.parent.parent if apart else path.parent))
    content = None if pair.camera is None else read_any_camera(pair.camera)
    own = content if isinstance(content, CameraFile) else None
    if own is None:
        own = CameraFile(ICL_CAMERA if _is_icl(pair) else Camera.from_fov(ASSUMED_FOV, size[1], size[0]))
    of_depth = scale_camera(str(pair.camera or path) if camera is None else "camera", camera or own.camera, size)
    of_depth = replace(of_depth, baseline=reading.baseline or of_depth.baseline)
    values = _interpret(pair, reading, own, stored, FolderUnits(), of_depth)
    range_type = values.encoding.range_type
    expect_known(path, values.stored, values.holes)
    depth = decode(values.stored, values.holes, values.encoding, of_depth)
    _expect_distances(path, depth, values.holes, range_type)
    notes = values.notes if own.depth_unit is None else []
    known = camera is not None or isinstance(content, CameraFile) or _is_icl(pair)
    if range_type != "orthogonal" and not known:
        notes.append(Assumption(f"camera: none given, {ASSUMED_FOV:g} degrees of horizontal view assumed (--camera)"))
    return depth, (*notes, *doubt_depth(depth, of_depth, range_type))


def read_geometry(pair: Pair, size: Size, reading: Reading) -> tuple[Geometry, list[Assumption]]:
    """Return what the capture of a photo of some size states; damaged cameras are a warning if others are given."""
    if pair.capture is None:
        return Geometry(), []
    found = pair.capture.geometry_of(size)
    if found.apart and reading.rig is None:
        raise ValueError(found.apart)
    if not found.damage:
        return found, []
    known = found.camera is not None or reading.camera != CameraChoice()  # of a model, or of the user
    if not known or (pair.capture.apart and reading.rig is None):
        raise ValueError(found.damage)
    text = "the capture's cameras are damaged: the given one is used, and no pose or depth camera of the capture"
    return found, [Assumption(text, found.damage, "cameras-damaged", 1)]


class _Values(NamedTuple):
    """What the values of a map are: they with their bits turned back, their holes, and how they are encoded."""

    stored: np.ndarray
    holes: np.ndarray
    encoding: Encoding
    notes: list[Assumption]
    hole_notes: list[Assumption]


def _interpret(
    pair: Pair, reading: Reading, described: CameraFile, stored: np.ndarray, units: FolderUnits, camera: Camera
) -> _Values:
    range_type, notes = _range_type(pair, reading, described)
    hole_value = described.hole_value if reading.hole_value is None else reading.hole_value
    meaning = _unit(pair, reading, described, range_type, stored)
    if meaning is None:
        meaning = units.interpret(pair, stored, hole_value, camera, may_fall=range_type is None)
    range_type = meaning.range_type or range_type or "orthogonal"
    if range_type == "disparity" and camera.baseline is None:
        raise ValueError(f"{pair.depth}: disparities need the distance between the two cameras: --baseline METRES")
    if meaning.bits:
        stored = turn_back_bits(str(pair.depth), stored, meaning.bits)
    above = stored.shape[1] / meaning.unit if range_type == "disparity" else 0.0
    above = math.inf if reading.hole_value == 0 else above
    holes, mark, hole_notes = find_holes(stored, hole_value, above=above)
    if range_type == "disparity" and reading.unit is None and meaning.unit == 1:
        expect_narrow(str(pair.depth), stored[~holes], camera)
    inside = pair.capture is not None and pair.capture.depth is not None
    suffix = ".npy" if inside or _is_icl(pair) else pair.depth.suffix.lower()  # the others cannot be written
    encoding = Encoding(suffix, str(stored.dtype), meaning.unit, mark, range_type)
    return _Values(stored, holes, encoding, [*notes, *meaning.assumptions], hole_notes)


def _stored(pair: Pair) -> np.ndarray:
    if pair.capture is not None and pair.capture.depth is not None:
        return pair.capture.depth.read()
    photo = pixels_in_header(pair.rgb)
    return read_depth_file(pair.depth, None if photo is None else pixels_beside(*photo))


def _expect_distances(path: Path, depth_lr: Tensor, holes: np.ndarray, range_type: RangeType) -> list[Assumption]:
    """Return a note on values that became holes because they are no distances, after checking that some are."""
    lost = float((depth_lr.isnan()[0].numpy() & ~holes).mean())
    if not bool(depth_lr.isfinite().any()):
        what = "disparity above 0" if range_type == "disparity" else f"depth of {NEAREST:g} to {FARTHEST:g} m"
        raise ValueError(f"{path}: expected at least one {what}, got none")
    if not lost or range_type == "disparity":
        return []
    return [
        Assumption(f"depths nearer than {NEAREST:g} m or farther than {FARTHEST:g} m count as holes", f"{lost:.1%}")
    ]


def _is_icl(pair: Pair) -> bool:
    return pair.capture is None and pair.depth.suffix.lower() == ICL_SUFFIX


def _confidence(
    pair: Pair, reading: Reading, size_lr: Size, holes: np.ndarray
) -> tuple[np.ndarray | None, list[Assumption]]:
    """Return the confidence, (h, w), after adding pixels of too little of it to the holes, and the assumptions."""
    if pair.confidence is None:
        if reading.min_confidence is not None:
            raise ValueError(f"{pair.depth}: expected a confidence map for --min-confidence, there is none")
        return None, []
    confidence = pair.confidence.read(size_lr)
    assumptions = []
    if reading.min_confidence is not None:
        unsure = confidence < reading.min_confidence - SLACK
        holes |= unsure
        text = f"confidence below {reading.min_confidence:g} counts as a hole"
        assumptions = [Assumption(text, f"{float(unsure.mean()):.1%}")]
    return confidence, assumptions


def _undistorted(
    pixels: np.ndarray, geometry: Geometry, camera: Camera, reading: Reading, notes: list[Assumption]
) -> tuple[np.ndarray, Lens | None]:
    """Return a photo without the lens distortion that its capture states, and the lens, unless the camera is given."""
    if geometry.lens is None or not geometry.lens.bends:
        return pixels, None
    if reading.camera != CameraChoice():
        text = "the lens distortion that the capture states is not undone: the camera is given"
        notes.append(Assumption(text, str(geometry.lens)))
        return pixels, None
    if geometry.camera is None:
        return pixels, None
    notes.append(Assumption("the lens distortion of the photo is undone", str(geometry.lens)))
    return undistort(pixels, camera, geometry.lens), geometry.lens


def _cut(pixels: np.ndarray, factor: int | None, size_lr: Size, notes: list[Assumption]) -> np.ndarray:
    if factor is None:
        return pixels
    size = size_lr[0] * factor, size_lr[1] * factor
    covered = pixels[: size[0], : size[1]]
    if covered.shape == pixels.shape or covered.shape[:2] != size:
        return pixels
    size_before = f"{pixels.shape[1]} x {pixels.shape[0]}"
    notes.append(Assumption("the photo is cut to the part that the depth map covers", size_before))
    return covered


def _expect_lower_resolution(pair: Pair, size: Size, size_lr: Size) -> None:
    (height, width), (low, narrow) = size, size_lr
    what = f"the photo {pair.rgb.name} has {width} x {height} (width x height)"
    if low > height or narrow > width:
        raise ValueError(f"{pair.depth}: expected no more pixels than the photo, got {narrow} x {low}; {what}")
    if not same_aspect(size, size_lr) and abs(low - height * narrow / width) >= 1:
        text = f"the photo's aspect and field of view, got {narrow} x {low}; {what}: crop the one that sees more"
        raise ValueError(f"{pair.depth}: expected {text}")
    if low < 2 or narrow < 2:
        raise ValueError(f"{pair.depth}: expected at least 2 x 2 pixels, got {narrow} x {low}")


def _camera(
    pair: Pair, reading: Reading, geometry: Geometry, size: Size, size_lr: Size, notes: list[Assumption]
) -> CameraFile:
    """Return the camera that the user gives, else the capture's, else that of a file beside it, else an assumed one."""
    if reading.camera != CameraChoice():
        found, more = find_camera(reading.camera, pair.rgb, size, size_lr)
        notes += more
        return found
    if pair.camera is None and _is_icl(pair) and size == size_lr:
        notes.append(Assumption("camera: that of ICL-NUIM"))
        return CameraFile(ICL_CAMERA)
    notes += geometry.assumptions
    if pair.capture is not None and geometry.camera is not None:
        found, more = scale_to_photo(pair.capture.description, CameraFile(geometry.camera), size)
    elif pair.camera is None:
        found, more = find_camera(reading.camera, pair.rgb, size, size_lr)
    else:
        found, more = find_camera(CameraChoice(file=pair.camera), pair.rgb, size, size_lr)
        own = pair.camera.stem == pair.rgb.stem  # one of each photo
        notes.append(Assumption(f"camera: {pair.camera.parent.name if own else pair.camera.name} beside the pictures"))
    notes += more
    return found


def _rig(pair: Pair, reading: Reading, geometry: Geometry, size_lr: Size) -> Rig | None:
    """Return the rig that the user gives, else the capture's; None if the depth map is in the photo's view."""
    if reading.rig is not None:
        content = read_any_camera(reading.rig.camera)
        if isinstance(content, np.ndarray):
            camera = Camera(size_lr[1], size_lr[0], content[0, 0], content[1, 1], content[0, 2], content[1, 2])
        else:
            camera = scale_camera(reading.rig.camera, content.camera, size_lr)
        camera = camera if reading.baseline is None else replace(camera, baseline=reading.baseline)
        return Rig(camera, read_transform(reading.rig.extrinsics))
    if pair.capture is None or geometry.rig is None:
        return None
    camera = scale_camera(str(pair.capture.description), geometry.rig.camera, size_lr)
    return geometry.rig._replace(camera=replace(camera, baseline=reading.baseline or camera.baseline))


def _to_photo(
    pair: Pair, reading: Reading, depth_lr: Tensor, rig: Rig, photo: Camera, rgb: Tensor, notes: list[Assumption]
) -> Tensor:
    """Return a depth camera's map, (1, h, w), as the photo's camera sees it, (1, h', w'), as fine as it is."""
    given, target = reading.rig is not None, registered_camera(rig.camera, photo)
    notes += doubt_camera(rig.camera, "--depth-camera" if given else "depth camera")
    warped = warp_depth(depth_lr[None], rig.camera, torch.from_numpy(rig.transform)[None], target)[0]
    if not bool(warped.isfinite().any()):
        text = "expected the transform from the depth camera's frame to the photo camera's, in metres"
        place = "--extrinsics" if given else _camera_source(pair, reading)
        raise ValueError(f"{place}: {text}; with this one the photo shows nothing of the depth map")
    if given:
        inverse = torch.from_numpy(np.linalg.inv(rig.transform))[None]
        other = warp_depth(depth_lr[None], rig.camera, inverse, target)[0]
        verdict, better = (judge(each[0].double().numpy(), rgb, zooms=()) for each in (warped, other))
        if verdict is not None and better is not None and better.contours:
            gain = better.as_given.significance - max(verdict.as_given.significance, 0)
            if gain >= LIMITS["extrinsics-inverse"]:
                text = "--extrinsics: the photo's edges fit better with the inverse matrix"
                detail = f"{better.figures}; expected the transform from the depth camera's frame to the photo camera's"
                notes.append(Assumption(text, detail, "extrinsics-inverse", gain))
    holes = f"{target.width} x {target.height}, {float(warped.isnan().float().mean()):.1%} holes"
    notes.append(Assumption("the depth map is warped into the photo's view", holes))
    return warped


def _camera_source(pair: Pair, reading: Reading) -> str:
    if reading.camera.intrinsics is not None:
        return "--intrinsics"
    capture = None if pair.capture is None else pair.capture.description
    return str(reading.camera.file or capture or pair.camera or pair.rgb)


def _range_type(pair: Pair, reading: Reading, described: CameraFile) -> tuple[RangeType | None, list[Assumption]]:
    """Return the range type that the user gives, else that of the file's name, else that of the camera file, if any."""
    if reading.range_type is not None:
        return reading.range_type, []
    if _DISPARITY_WORDS & set(words_of(pair.depth.stem)):
        return "disparity", [Assumption("values are read as disparities, by the file's name")]
    if _is_icl(pair):
        text = "values are distances along the rays in centimetres, as in ICL-NUIM's .depth"
        return "perspective", [Assumption(text)]
    if pair.along_ray:
        return "perspective", [Assumption("values are distances along the rays, as the file states")]
    if described.range_type in (None, "orthogonal"):
        return described.range_type, []
    return described.range_type, [Assumption(f"values are of range type {described.range_type}, by the camera file")]


def _unit(
    pair: Pair, reading: Reading, described: CameraFile, range_type: RangeType | None, stored: np.ndarray
) -> Meaning | None:
    """Return metres per value, or pixels per value of disparities, and the assumptions; None if nobody states them."""
    if reading.unit == "sunrgbd":
        return Meaning(1e-3, (Assumption(TURNED_BACK),), bits=SUNRGBD_BITS)
    if reading.unit is not None:
        return Meaning(reading.unit, ())
    if range_type == "disparity":
        steps = " (whole numbers may be in steps of a pixel: --depth-unit 1/16)" if stored.dtype.kind in "iu" else ""
        return Meaning(1.0, (Assumption(f"disparities are read in pixels of the depth map{steps}"),))
    if described.depth_unit is not None:
        unit = described.depth_unit
        return Meaning(unit, (Assumption(f"unit: {show_length(unit)} per value, by the camera file"),))
    if pair.unit is not None:
        return Meaning(pair.unit, (), bits=pair.bits)
    return Meaning(1e-2, ()) if _is_icl(pair) else None
