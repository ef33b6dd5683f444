"""What a user says about the files: checked without what reads them, which takes seconds to import."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dsr.geometry.camera import RangeType

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "sunrgbd": 1e-3}
SUNRGBD_BITS = 3
"""How far SUN RGB-D turns the 16 bits of its millimetres to the left (``read3dPoints.m`` of its toolbox)."""
_LARGEST_UNIT = 1e6


@dataclass(frozen=True)
class CameraChoice:
    """What the user says about the camera: at most one of the three.

    Args:
        file: camera file, see :func:`dsr.io.cameras.read_any_camera`.
        fov: horizontal field of view in degrees.
        intrinsics: fx, fy, cx, cy in pixels of the photo.

    """

    file: Path | None = None
    fov: float | None = None
    intrinsics: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.fov is not None and not 1 <= self.fov < 180:
            raise ValueError(f"--fov: expected degrees from 1 to below 180, got {self.fov:g}")
        if self.intrinsics is not None and not (
            min(self.intrinsics[:2]) > 0 and all(map(math.isfinite, self.intrinsics))
        ):
            came = " ".join(f"{value:g}" for value in self.intrinsics)
            raise ValueError(f"--intrinsics: expected FX FY CX CY in pixels, FX and FY above 0, got {came}")


@dataclass(frozen=True)
class RigFiles:
    """What the user says about a depth map that another camera than the photo's took.

    Args:
        camera: camera file of the depth camera, see :func:`dsr.io.cameras.read_any_camera`.
        extrinsics: file of the transform from the depth camera to the photo's, see
            :func:`dsr.io.poses.read_transform`.

    """

    camera: Path
    extrinsics: Path


@dataclass(frozen=True)
class Reading:
    """What the user says about the files; None where it is to be read from the files or assumed.

    Args:
        camera: camera of the photo.
        unit: metres per value of the depth files; pixels per value of disparities.
        range_type: quantity that the values measure.
        baseline: distance in metres between the two cameras of disparities.
        hole_value: value that stands for a hole, in addition to the usual ones.
        min_confidence: fraction; pixels of less confidence become holes. None for no limit.
        turned_bits: how far the bits of the values are turned left, 3 in SUN RGB-D.
        rig: depth camera elsewhere than the photo's, whose map is to be warped into the photo's view; None where the
            depth map is registered.

    """

    camera: CameraChoice = field(default_factory=CameraChoice)
    unit: float | None = None
    range_type: RangeType | None = None
    baseline: float | None = None
    hole_value: float | None = None
    rig: RigFiles | None = None
    min_confidence: float | None = None
    turned_bits: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.min_confidence is not None and not 0 <= self.min_confidence <= 1:
            raise ValueError(f"--min-confidence: expected a fraction from 0 to 1, got {self.min_confidence:g}")


def parse_unit(text: str) -> float:
    """Return the metres per value that a text names: m, cm, mm, sunrgbd, a number, or a fraction such as 1/5000.

    Raises:
        ValueError: it is none of these.

    """
    if text in _UNITS:
        return _UNITS[text]
    above, _, below = text.partition("/")
    try:
        unit = float(above) / float(below or 1)
    except (ValueError, ZeroDivisionError):
        unit = math.nan
    if not 0 < unit <= _LARGEST_UNIT:
        raise ValueError(
            f"--depth-unit: expected m, cm, mm or metres per value such as 0.0002 or 1/5000, or sunrgbd, got {text!r}"
        )
    return unit
