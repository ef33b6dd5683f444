"""Reading of a pair of files as rgb in [0, 1] and depth in metres, with the assumptions that this needed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dsr.data.formats.files import CameraFile, read_mask
from dsr.geometry.camera import Camera, RangeType
from dsr.io.cameras import CameraChoice, find_camera
from dsr.io.depth_files import read_depth_file
from dsr.io.encoding import Assumption, Encoding, decode, find_holes, guess_unit
from dsr.io.names import words_of
from dsr.io.pairs import Pair
from dsr.io.photos import Size, read_photo, same_aspect
from dsr.io.rigs import RigFiles, read_rig, to_photo

_DISPARITY_WORDS = frozenset({"disparity", "disp"})


@dataclass(frozen=True)
class Reading:
    """What the user says about the files; None where it is to be read from the files or assumed.

    Args:
        camera: camera of the photo.
        unit: metres per value of the depth files; pixels per value of disparities.
        range_type: quantity that the values measure.
        baseline: distance in metres between the two cameras of disparities.
        hole_value: value that stands for a hole, in addition to the usual ones.
        rig: depth camera elsewhere than the photo's, whose map is to be warped into the photo's view; None where the
            depth map is registered.

    """

    camera: CameraChoice = field(default_factory=CameraChoice)
    unit: float | None = None
    range_type: RangeType | None = None
    baseline: float | None = None
    hole_value: float | None = None
    rig: RigFiles | None = None


@dataclass(frozen=True)
class Picture:
    """A pair of photo and depth map as tensors.

    Args:
        rgb: (3, H, W) float32 in [0, 1].
        depth_lr: (1, h, w) float32 orthogonal depth in metres, NaN in holes.
        camera: camera of the photo's pixels.
        encoding: encoding of the depth file.
        assumptions: assumptions about the files.
        pose: from camera to world, (4, 4) float64 in metres, of a camera with the axes x right, y down, z forward, in
            the world of the capture; None where there is none.

    """

    rgb: Tensor
    depth_lr: Tensor
    camera: Camera
    encoding: Encoding
    assumptions: tuple[Assumption, ...]
    pose: np.ndarray | None = None


UnitMemory = dict[tuple[Path, str, str], tuple[float, list[Assumption]]]
"""Units by folder, suffix and type of value: the first depth map of each determines that of the others."""


def read_picture(pair: Pair, reading: Reading, units: UnitMemory) -> Picture:
    """Return a pair of files as tensors.

    Args:
        pair: the files.
        reading: what the user says about them.
        units: units of depth maps read before, to which this function adds.

    Raises:
        ValueError: a file is missing or damaged, or the files do not fit each other.

    """
    stored = read_depth_file(pair.depth)
    size_lr: Size = (stored.shape[0], stored.shape[1])
    pixels, assumptions = read_photo(pair.rgb, size_lr)
    described, camera_assumptions = _camera(pair, reading, (pixels.shape[0], pixels.shape[1]), size_lr)
    pixels, crop_assumptions = _crop_to_multiple(pixels, pair.factor, size_lr)
    size: Size = (pixels.shape[0], pixels.shape[1])
    rig = None if reading.rig is None else read_rig(reading.rig, size_lr, reading.baseline)
    if rig is None:
        _expect_lower_resolution(pair, size, size_lr)
    camera = described.camera.crop(0, 0, *size)
    if reading.baseline is not None:
        camera = replace(camera, baseline=reading.baseline)
    hole_value = described.hole_value if reading.hole_value is None else reading.hole_value
    holes, mark, hole_assumptions = find_holes(stored, hole_value)
    if pair.mask is not None:
        holes |= ~_mask(pair.mask, size_lr)
    if holes.all():
        raise ValueError(f"{pair.depth}: expected at least one known pixel, all are holes")
    range_type, range_assumptions = _range_type(pair, reading, described, camera)
    unit, unit_assumptions = _unit(pair, reading, described, range_type, stored, holes, units)
    encoding = Encoding(pair.depth.suffix.lower(), str(stored.dtype), unit, mark, range_type)
    of_depth = camera.rescale(size_lr[1], size_lr[0]) if rig is None else rig.camera
    depth_lr = decode(stored, holes, encoding, of_depth)
    if not bool(depth_lr.isfinite().any()):
        raise ValueError(f"{pair.depth}: expected at least one disparity above 0, got none")
    rgb = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1))).float() / 255
    all_assumptions = (
        *assumptions,
        *camera_assumptions,
        *crop_assumptions,
        *range_assumptions,
        *unit_assumptions,
        *hole_assumptions,
    )
    if rig is not None:
        depth_lr, warped = to_photo(depth_lr, rig, camera)
        all_assumptions = (*all_assumptions, warped)
    return Picture(rgb, depth_lr, camera, encoding, all_assumptions)


def _crop_to_multiple(pixels: np.ndarray, factor: int | None, size_lr: Size) -> tuple[np.ndarray, list[Assumption]]:
    """Return the part of a photo that a depth map with ``factor`` times larger pixels covers."""
    if factor is None:
        return pixels, []
    covered = pixels[: size_lr[0] * factor, : size_lr[1] * factor]
    if covered.shape == pixels.shape or covered.shape[:2] != (size_lr[0] * factor, size_lr[1] * factor):
        return pixels, []
    return covered, [
        Assumption("the photo is cut to the part that the depth map covers", f"{pixels.shape[1]} x {pixels.shape[0]}")
    ]


def _expect_lower_resolution(pair: Pair, size: Size, size_lr: Size) -> None:
    """Check that a depth map of size ``size_lr`` may belong to a photo of size ``size``."""
    (height, width), (low, narrow) = size, size_lr
    what = f"the photo {pair.rgb.name} has {width} x {height} (width x height)"
    if low > height or narrow > width:
        raise ValueError(f"{pair.depth}: expected no more pixels than the photo, got {narrow} x {low}; {what}")
    if not same_aspect(size, size_lr) and abs(low - height * narrow / width) >= 1:
        raise ValueError(
            f"{pair.depth}: expected the photo's aspect and field of view, got {narrow} x {low}; {what}: "
            "crop the one that sees more"
        )
    if low < 2 or narrow < 2:
        raise ValueError(f"{pair.depth}: expected at least 2 x 2 pixels, got {narrow} x {low}")


def _camera(pair: Pair, reading: Reading, size: Size, size_lr: Size) -> tuple[CameraFile, list[Assumption]]:
    """Return the camera that the user gives, else that of a file beside the pictures, else an assumed one."""
    if reading.camera != CameraChoice() or pair.camera is None:
        return find_camera(reading.camera, pair.rgb, size, size_lr)
    described, assumptions = find_camera(CameraChoice(file=pair.camera), pair.rgb, size, size_lr)
    return described, [Assumption(f"camera: {pair.camera.name} beside the pictures"), *assumptions]


def _mask(path: Path, size: Size) -> np.ndarray:
    """Return the valid mask in a file, (h, w) bool."""
    mask = read_mask(path)
    if mask.shape != size:
        raise ValueError(
            f"{path}: expected a mask of the depth map's {size[1]} x {size[0]} pixels (width x height), "
            f"got {mask.shape[1]} x {mask.shape[0]}"
        )
    return mask


def _range_type(
    pair: Pair, reading: Reading, described: CameraFile, camera: Camera
) -> tuple[RangeType, list[Assumption]]:
    """Return the range type that the user gives, else that of the file's name, else that of the camera file."""
    assumptions: list[Assumption] = []
    if reading.range_type is not None:
        range_type = reading.range_type
    elif _DISPARITY_WORDS & set(words_of(pair.depth.stem)):
        range_type = "disparity"
        assumptions.append(Assumption("values are taken for disparities, by the file's name"))
    else:
        range_type = described.range_type or "orthogonal"
        if described.range_type not in (None, "orthogonal"):
            assumptions.append(Assumption(f"values are of range type {range_type}, says the camera file"))
    if range_type == "disparity" and camera.baseline is None:
        raise ValueError(f"{pair.depth}: disparities need the distance between the two cameras: --baseline METRES")
    return range_type, assumptions


def _unit(
    pair: Pair, reading: Reading, described: CameraFile, range_type: RangeType,
    stored: np.ndarray, holes: np.ndarray, units: UnitMemory,
) -> tuple[float, list[Assumption]]:  # fmt: skip
    """Return metres per value, or pixels per value of disparities, and the assumptions."""
    if reading.unit is not None:
        return reading.unit, []
    if range_type == "disparity":
        return 1.0, [Assumption("disparities are taken for pixels of the depth map")]
    if described.depth_unit is not None:
        return described.depth_unit, [Assumption(f"unit: {described.depth_unit:g} m per value, says the camera file")]
    if pair.unit is not None:
        return pair.unit, []
    kind = (pair.depth.parent, pair.depth.suffix.lower(), str(stored.dtype))
    if kind not in units:
        units[kind] = guess_unit(str(pair.depth), stored, holes)
    return units[kind]
