"""Options about input files: units, cameras, poses; checked before the readers are imported, which takes seconds."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dsr.geometry import RangeType
from dsr.utils.options import Options, Rule, group, option, positive

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "sunrgbd": 1e-3}
SUNRGBD_BITS = 3  # how far SUN RGB-D turns the bits of its values to the left (read3dPoints.m of its toolbox)
_LARGEST_UNIT = 1e6


@dataclass(frozen=True, kw_only=True)
class CameraChoice(Options):
    """Options of the photo's camera: at most one of the three; intrinsics are in the photo's pixels."""

    file: Path | None = option(
        None, "camera.json, Open3D's JSON, or a 3 x 3 matrix", "FILE", flags="--camera", alone="camera", recorded=False
    )
    fov: float | None = option(
        None,
        "horizontal field of view of the photo",
        "DEGREES",
        alone="camera",
        rule=Rule("degrees from 1 to below 180", lambda degrees: 1 <= degrees < 180),
    )
    intrinsics: tuple[float, float, float, float] | None = option(
        None,
        "focal lengths and principal point, in pixels of the photo",
        ("FX", "FY", "CX", "CY"),
        alone="camera",
        rule=Rule(
            "FX FY CX CY in pixels, FX and FY above 0",
            lambda values: min(values[:2]) > 0 and all(map(math.isfinite, values)),
        ),
    )


@dataclass(frozen=True, kw_only=True)
class RigFiles(Options):
    """Options of a depth map that was taken by another camera than the photo's."""

    camera: Path = option(
        ..., "camera file of a depth camera elsewhere", "FILE", flags="--depth-camera", recorded=False
    )
    extrinsics: Path = option(..., "matrix from the depth camera to the photo's, metres", "FILE", recorded=False)


@dataclass(frozen=True, kw_only=True)
class Reading(Options):
    """Options about the input files; None where a value is to be read from the files or assumed."""

    camera: CameraChoice = group(CameraChoice)
    unit: float | Literal["sunrgbd"] | None = option(
        None,
        "m, cm, mm, metres per value: 0.0002, 1/5000; sunrgbd",
        "UNIT",
        flags="--depth-unit",
        parse=lambda text: text if text == "sunrgbd" else parse_unit(text),
    )
    range_type: RangeType | None = option(None, "depth along the axis (default), along the ray, or disparity")
    baseline: float | None = option(
        None, "between the cameras, for disparity", "METRES", rule=positive("number of metres")
    )
    rig: RigFiles | None = group()
    register: bool = option(False, "shift and scale the depth map to the photo's edges, if it is displaced")
    hole_value: float | None = option(None, "another value that marks missing depth", "VALUE")
    strict: bool = option(False, "refuse a picture with a warning; see docs/checks.md", recorded=False)
    min_confidence: float | None = option(
        None,
        "less confident pixels count as holes; levels 0, 1, 2 are 0, 0.5, 1",
        "0..1",
        rule=Rule("a fraction from 0 to 1", lambda fraction: 0 <= fraction <= 1),
    )

    def __post_init__(self) -> None:
        """Check the values; NaN always marks missing depth, so it is no other value that does."""
        super().__post_init__()
        if self.hole_value is not None and math.isnan(self.hole_value):
            object.__setattr__(self, "hole_value", None)


def parse_unit(text: str) -> float:
    """Return the metres per value that a text names: m, cm, mm, sunrgbd, a number, or a fraction such as 1/5000."""
    if text in _UNITS:
        return _UNITS[text]
    above, _, below = text.partition("/")
    try:
        unit = float(above) / float(below or 1)
    except (ValueError, ZeroDivisionError):
        unit = math.nan
    if not 0 < unit <= _LARGEST_UNIT:
        raise ValueError(f"expected m, cm, mm or metres per value such as 0.0002 or 1/5000, or sunrgbd, got {text!r}")
    return unit


@dataclass(frozen=True)
class Shard:
    """One of the blocks into which frames are split, in their order and as equally as possible."""

    number: int  # which one, from 1
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def block(self, frames: int) -> range:
        """Return the places of the block's frames among ``frames``; empty if there are fewer of them than blocks."""
        return range((self.number - 1) * frames // self.count, self.number * frames // self.count)


def parse_shard(text: str) -> Shard:
    """Parse ``K/N`` with K from 1 to N."""
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text, re.ASCII)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"expected K/N with K from 1 to N, such as 3/16, got {text!r:.40}")
    return Shard(int(match[1]), int(match[2]))
