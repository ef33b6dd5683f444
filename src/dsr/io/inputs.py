"""One pair of somebody's files as a photo in [0, 1] and a depth map in metres, with all that was assumed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dsr.data.formats.files import CameraFile, read_mask
from dsr.geometry.camera import Camera, RangeType
from dsr.io.cameras import CameraChoice, camera_of
from dsr.io.depth_files import read_depth_file
from dsr.io.encoding import Assumption, Encoding, decode, find_holes, guess_unit
from dsr.io.names import words_of
from dsr.io.pairs import Pair
from dsr.io.photos import Size, read_photo, same_aspect

_DISPARITY_WORDS = frozenset({"disparity", "disp"})


@dataclass(frozen=True)
class Reading:
    """How the files are to be read; None is for what they tell themselves, or for what is usual.

    Args:
        camera: the camera.
        unit: metres per value of the depth files; pixels per value of disparities.
        range_type: what the values measure.
        baseline: between the two cameras of a disparity, in metres.
        hole_value: a value that stands for a hole, beside the usual ones.

    """

    camera: CameraChoice = field(default_factory=CameraChoice)
    unit: float | None = None
    range_type: RangeType | None = None
    baseline: float | None = None
    hole_value: float | None = None


@dataclass(frozen=True)
class Picture:
    """A pair, read.

    Args:
        rgb: (3, H, W) float32 in [0, 1].
        coarse: (1, h, w) float32 orthogonal depth in metres, NaN in holes.
        camera: of the photo's pixels.
        encoding: how the depth file counts.
        facts: what was assumed.

    """

    rgb: Tensor
    coarse: Tensor
    camera: Camera
    encoding: Encoding
    facts: tuple[Assumption, ...]


UnitMemory = dict[tuple[Path, str, str], tuple[float, list[Assumption]]]
"""Units told from a first depth map, by folder, suffix and type of value: the maps beside it have the same."""


def read_picture(pair: Pair, reading: Reading, units: UnitMemory) -> Picture:
    """Read a pair.

    Args:
        pair: the files.
        reading: how.
        units: of depth maps read before; what is found out here is added.

    Raises:
        ValueError: a file is missing or damaged, or the files do not fit each other.

    """
    stored = read_depth_file(pair.depth)
    coarse_size: Size = (stored.shape[0], stored.shape[1])
    pixels, facts = read_photo(pair.rgb, coarse_size)
    described, camera_facts = _camera(pair, reading, (pixels.shape[0], pixels.shape[1]), coarse_size)
    pixels, cut_facts = _cut_to_multiple(pixels, pair.factor, coarse_size)
    size: Size = (pixels.shape[0], pixels.shape[1])
    _expect_coarser(pair, size, coarse_size)
    camera = described.camera.crop(0, 0, *size)
    if reading.baseline is not None:
        camera = replace(camera, baseline=reading.baseline)
    hole_value = described.hole_value if reading.hole_value is None else reading.hole_value
    holes, mark, hole_facts = find_holes(stored, hole_value)
    if pair.mask is not None:
        holes |= ~_mask(pair.mask, coarse_size)
    if holes.all():
        raise ValueError(f"{pair.depth}: expected at least one known pixel, all are holes")
    range_type, range_facts = _range_type(pair, reading, described, camera)
    unit, unit_facts = _unit(pair, reading, described, range_type, stored, holes, units)
    encoding = Encoding(pair.depth.suffix.lower(), str(stored.dtype), unit, mark, range_type)
    coarse = decode(stored, holes, encoding, camera.rescale(coarse_size[1], coarse_size[0]))
    if not bool(coarse.isfinite().any()):
        raise ValueError(f"{pair.depth}: expected at least one disparity above 0, got none")
    rgb = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1))).float() / 255
    all_facts = (*facts, *camera_facts, *cut_facts, *range_facts, *unit_facts, *hole_facts)
    return Picture(rgb, coarse, camera, encoding, all_facts)


def _cut_to_multiple(pixels: np.ndarray, factor: int | None, coarse: Size) -> tuple[np.ndarray, list[Assumption]]:
    """Return the part of a photo that a map ``factor`` times coarser covers."""
    if factor is None:
        return pixels, []
    covered = pixels[: coarse[0] * factor, : coarse[1] * factor]
    if covered.shape == pixels.shape or covered.shape[:2] != (coarse[0] * factor, coarse[1] * factor):
        return pixels, []
    return covered, [
        Assumption("the photo is cut to the part that the depth map covers", f"{pixels.shape[1]} x {pixels.shape[0]}")
    ]


def _expect_coarser(pair: Pair, size: Size, coarse: Size) -> None:
    """Say where the two pictures cannot belong together."""
    (height, width), (low, narrow) = size, coarse
    what = f"the photo {pair.rgb.name} has {width} x {height} (width x height)"
    if low > height or narrow > width:
        raise ValueError(f"{pair.depth}: expected no more pixels than the photo, got {narrow} x {low}; {what}")
    if not same_aspect(size, coarse) and abs(low - height * narrow / width) >= 1:
        raise ValueError(
            f"{pair.depth}: expected the photo's aspect and field of view, got {narrow} x {low}; {what}: "
            "crop the one that sees more"
        )
    if low < 2 or narrow < 2:
        raise ValueError(f"{pair.depth}: expected at least 2 x 2 pixels, got {narrow} x {low}")


def _camera(pair: Pair, reading: Reading, size: Size, coarse: Size) -> tuple[CameraFile, list[Assumption]]:
    """Return the camera that the user gives, else the one beside the pictures, else one assumed."""
    if reading.camera != CameraChoice() or pair.camera is None:
        return camera_of(reading.camera, pair.rgb, size, coarse)
    described, facts = camera_of(CameraChoice(file=pair.camera), pair.rgb, size, coarse)
    return described, [Assumption(f"camera: {pair.camera.name} beside the pictures"), *facts]


def _mask(path: Path, size: Size) -> np.ndarray:
    """Return where the mask says that depth is known."""
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
    """Return what the values measure: as the user says, else by the file's name, else by the camera file."""
    facts: list[Assumption] = []
    if reading.range_type is not None:
        range_type = reading.range_type
    elif _DISPARITY_WORDS & set(words_of(pair.depth.stem)):
        range_type = "disparity"
        facts.append(Assumption("values are taken for disparities, by the file's name"))
    else:
        range_type = described.range_type or "orthogonal"
        if described.range_type not in (None, "orthogonal"):
            facts.append(Assumption(f"values are of range type {range_type}, says the camera file"))
    if range_type == "disparity" and camera.baseline is None:
        raise ValueError(f"{pair.depth}: disparities need the distance between the two cameras: --baseline METRES")
    return range_type, facts


def _unit(
    pair: Pair, reading: Reading, described: CameraFile, range_type: RangeType,
    stored: np.ndarray, holes: np.ndarray, units: UnitMemory,
) -> tuple[float, list[Assumption]]:  # fmt: skip
    """Return metres per value (for disparities, pixels), and what was assumed."""
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
