"""Depth cameras by name: how they measure, how exactly, and where they fail, each figure with its source.

What is not known is None. Figures hold at a sensor's native width; in maps of another width focal length, disparity and
noise in pixels scale with it, so that the errors in metres stay.

Looked up where the sources say: OAK-D's focal length and baseline, the steps of OAK-D and Kinect v1, the D415's focal
length and baseline, the D400's noise, Azure Kinect's error, ARKit's figures. All others are remembered of the sources
that are named, and still to be checked there. No command uses this table yet.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

Kind = Literal["stereo", "structured light", "time of flight", "lidar"]


@dataclass(frozen=True)
class Sensor:
    """A depth camera.

    Args:
        name: of the camera or the family.
        kind: how it measures.
        width: of its native depth map, in pixels.
        pattern: of device names, a regular expression without regard to case.
        stereo_constant: focal length times baseline, in pixels times metres.
        step: of its disparity, in pixels.
        noise: standard deviation of its disparity on a textured wall, in pixels.
        extent: over how many pixels of its map the noise is alike.
        spread: standard deviation of depth by distance, pairs of metres; it grows linearly between them.
        edges: what it does at depth steps.
        dark: on dark surfaces.
        shiny: on glossy and mirroring ones.
        clear: on transparent ones.
        sources: of the figures, by their names here.

    """

    name: str
    kind: Kind
    width: int
    pattern: str
    stereo_constant: float | None = None
    step: float | None = None
    noise: float | None = None
    extent: float | None = None
    spread: tuple[tuple[float, float], ...] | None = None
    edges: str | None = None
    dark: str | None = None
    shiny: str | None = None
    clear: str | None = None
    sources: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


class ValueSteps(NamedTuple):
    """Steps of inverse depth that a map's values have: multiples of ``1 / constant``.

    ``constant``: focal length times baseline over the step of disparity, in metres. ``confidence``: from 0 to 1, how
    closely the values keep to them, 1 for exactly.
    """

    constant: float
    confidence: float


_D400 = "Intel, RealSense D400 Series Product Family Datasheet (337029): baseline, field of view at 1280 x 720"
_D400_STEP = "Intel, Subpixel Linearity Improvement for RealSense D400 (dev.intelrealsense.com): 1/32 pixel"
_D400_NOISE = "A. Grunnet-Jepsen (Intel) in librealsense issue 3904: 0.032 at best, 0.08 as a rule"
_GRASP = "Sajjan et al., ClearGrasp, ICRA 2020: missing, or that of the background"
_SARBOLANDI = "Sarbolandi et al., Kinect Range Sensing: Structured-Light versus Time-of-Flight Kinect, CVIU 2015"
_MALLICK = "Mallick et al., Characterizations of Noise in Kinect Depth Images, IEEE Sensors Journal 2014"
_TECHNICAL = "K. Konolige and P. Mihelich, Technical Description of Kinect Calibration (ROS kinect_calibration)"
_NGUYEN = "Nguyen et al., Modeling Kinect Sensor Noise, 3DIMPVT 2012: 1.2 mm + 1.9 mm (z - 0.4)^2"
_PRIMESENSE = (
    "Boehm, Accuracy Investigation for Structured-light Based Consumer 3D Sensors, PFG 2014: PrimeSense's design"
)
_AZURE = "Microsoft, Azure Kinect DK hardware specification: random error, at most; confirmed by Tölgyessy et al. 2021"
_TOLGYESSY = "Tölgyessy et al., Evaluation of the Azure Kinect, Sensors 2021"
_L515 = "Intel, RealSense LiDAR Camera L515 Datasheet: standard deviation at 1 m and at 9 m, 95 % reflectivity"
_PROMPT = "PromptMoGe, calibration of a phone's lidar against a laser scanner (promptmoge/train/calibration)"
_LUXONIS = "Luxonis, documentation of stereo depth: 7.5 cm, 882.5 px at 1280 x 800"
_STEREO_EDGES = "near surfaces are fattened by about half a matching window; what one camera alone sees is missing"
_MULTIPATH = "flying pixels between both sides of a step; concave corners are rounded by multipath"


def _d400(name: str, pattern: str, stereo_constant: float, constant_source: str = _D400) -> Sensor:
    """Return a camera of Intel's D400 series."""
    return Sensor(
        name,
        "stereo",
        1280,
        pattern,
        stereo_constant,
        1 / 32,
        0.08,
        edges=_STEREO_EDGES,
        clear="missing, or the depth of what is behind",
        sources=MappingProxyType(
            {
                "stereo_constant": constant_source,
                "step": _D400_STEP,
                "noise": _D400_NOISE,
                "edges": "Scharstein and Szeliski, A Taxonomy of Dense Two-Frame Stereo Correspondence, IJCV 2002",
                "clear": _GRASP,
            }
        ),
    )


def _structured(name: str, pattern: str, stereo_constant: float, sources: Mapping[str, str]) -> Sensor:
    """Return a camera with PrimeSense's projector of dots, or one like it."""
    return Sensor(
        name,
        "structured light",
        640,
        pattern,
        stereo_constant,
        1 / 8 if "step" in sources else None,
        0.083 if "noise" in sources else None,
        9.0 if "extent" in sources else None,
        edges="they jitter along themselves by about 0.8 pixels; a shadow of the projector is missing on one side",
        dark="missing",
        shiny="missing",
        clear="missing, or the depth of what is behind",
        sources=MappingProxyType({**sources, "edges": _NGUYEN, **dict.fromkeys(("dark", "shiny", "clear"), _MALLICK)}),
    )


_DOTS = MappingProxyType({"step": _TECHNICAL, "noise": f"{_NGUYEN}, far away", "extent": f"{_TECHNICAL}: its window"})

SENSORS = (
    _d400(
        "RealSense D415", r"\bd41[05]i?\b", 51.7, "librealsense, doc/depth-from-stereo.md: a D415's 942.8 px, 54.8 mm"
    ),
    _d400(
        "RealSense D435",
        r"\bd43[05][if]?\b",
        640 * 0.050,
        f"{_D400}; Intel, Subpixel Linearity Improvement: 90 degrees",
    ),
    _d400("RealSense D455", r"\bd45[0-7]f?\b", 1280 / 2 / np.tan(np.radians(87 / 2)) * 0.095),
    Sensor(
        "RealSense L515",
        "lidar",
        1024,
        r"\bl515",
        spread=((1.0, 0.0025), (9.0, 0.0155)),
        sources=MappingProxyType({"spread": _L515}),
    ),
    Sensor(
        "Azure Kinect",
        "time of flight",
        640,
        r"azure|kinect 4|\bk4a",
        spread=((0.5, 0.017), (3.86, 0.017)),
        edges=_MULTIPATH,
        dark="noisier, or missing",
        sources=MappingProxyType({"spread": _AZURE, "edges": _TOLGYESSY, "dark": _TOLGYESSY}),
    ),
    Sensor(
        "Kinect v2",
        "time of flight",
        512,
        r"kinect.*(v2|one|2\.0|\b2\b)",
        edges=_MULTIPATH,
        dark="noisier, and too far",
        clear="a mixture of the surface and what is behind",
        sources=MappingProxyType(dict.fromkeys(("edges", "dark", "clear"), _SARBOLANDI)),
    ),
    _structured("Kinect v1", r"kinect", 0.075 * 580, {"stereo_constant": _TECHNICAL, **_DOTS}),
    _structured(
        "Xtion",
        r"xtion|primesense|carmine",
        0.075 * 320 / np.tan(np.radians(58 / 2)),
        {"stereo_constant": f"ASUS, Xtion Pro Live: 58 degrees; {_PRIMESENSE}", **_DOTS},
    ),
    _structured(
        "Astra",
        r"\bastra",
        0.075 * 320 / np.tan(np.radians(60 / 2)),
        {"stereo_constant": "Orbbec, Astra Series specification: 75 mm, 60 degrees"},
    ),
    Sensor(
        "OAK-D",
        "stereo",
        1280,
        r"\boak.?d\b(?!.?(lite|sr|lr|tof))",
        0.075 * 882.5,
        1 / 8,
        edges=_STEREO_EDGES,
        sources=MappingProxyType(
            {
                "stereo_constant": _LUXONIS,
                "step": "Luxonis, DepthAI StereoDepth: 3 fractional bits unless more are set",
                "edges": "Scharstein and Szeliski, A Taxonomy of Dense Two-Frame Stereo Correspondence, IJCV 2002",
            }
        ),
    ),
    Sensor(
        "ARKit lidar",
        "lidar",
        256,
        r"arkit|iphone.*\bpro|ipad.*\bpro",
        extent=6.0,
        edges="of a step 14 % fall between neighbours and 52 % over three pixels; never a hole",
        dark="twice as noisy",
        sources=MappingProxyType(dict.fromkeys(("extent", "edges", "dark"), _PROMPT)),
    ),
    Sensor(
        "phone time of flight", "time of flight", 240, r"time.?of.?flight|\btof\b|\bsm-[gn]9[78]\d|huawei.*p[34]0 pro"
    ),
)
"""Of several whose pattern fits a name the first is taken."""


def recognise(device_name: str) -> Sensor | None:
    """Return the sensor of a device's name as recordings, EXIF data and apps state it; None for an unknown one."""
    return next((each for each in SENSORS if re.search(each.pattern, device_name, re.IGNORECASE)), None)


def least_error(sensor: Sensor, depth: Tensor) -> Tensor:
    """Return the standard deviation of depth below which a sensor's disparity allows none, z^2 noise / (f B).

    Where its noise is not known, the rounding to its step counts: step / sqrt(12).

    Args:
        sensor: the sensor.
        depth: in metres, any shape.

    Returns:
        Metres, in the shape of ``depth``; 0 for a sensor without a known disparity.

    """
    noise = sensor.noise
    if noise is None and sensor.step is not None:
        noise = sensor.step / 12**0.5
    if noise is None or sensor.stereo_constant is None:
        return torch.zeros_like(depth)
    return depth.square() * (noise / sensor.stereo_constant)


_CONSTANTS = (16.0, 4096.0)
"""Range of constants that are looked for, in metres: 16 pixel metres in whole pixels to 128 in steps of 1/32."""
_ROUNDINGS = (1e-3, 1e-4)
"""Metres to which maps are rounded."""
_SEEN = 2.0
"""A step of depth shows if it is so many times what values are rounded to."""
_COMMON = 4
"""Pixels that a value must have; rarer ones come from resampling."""
_BAND = 1.2
"""Ratio of the constants that are looked for in the same values, those far enough to show them."""
_FEWEST, _CYCLES = 12, 8
"""Distinct values, and steps between the smallest and the largest, that are needed."""
_CONFIDENT, _SIGNIFICANT = 0.6, 25.0
"""Least confidence; and least N confidence^2 for N values, minus the logarithm of the chance that random ones have."""
_NEAREST = 0.1
"""Metres; nearer values are left out."""
_MOST = 400
"""Values that are looked at, drawn at random."""
_DENSE = 1.2
"""Distinct values over the number of steps between the smallest and the largest, from which they keep to no steps."""
_HARMONIC = 0.8
"""Values that are multiples of a step are also multiples of its parts: the largest step is taken whose confidence is
at least this share of the best."""
_FINE = 4
"""Samples of the spectrum for each cycle that fits into the range of inverse depth."""


def recognise_values(depth: Tensor) -> ValueSteps | None:
    """Return the steps of inverse depth in which a stereo or structured-light camera's map has its values.

    Its values are f B / d for disparities d in whole steps. Where the rounding to millimetres, or tenths of them, does
    not hide it, inverse depths are therefore multiples of step / (f B), and the sum of exp(2 pi i C / z) over the
    distinct values has a peak at C = f B / step.

    Args:
        depth: (1, h, w) in metres, NaN in holes, as it was read: neither resampled nor filtered.

    Returns:
        None where the values keep to no steps, or too few of them are seen.

    """
    values, counts = torch.unique(depth[depth.isfinite()].double(), return_counts=True)
    distinct = values[(counts >= _COMMON) & (values >= _NEAREST)].cpu().numpy()
    rounding = next((each for each in _ROUNDINGS if _is_rounded(distinct, each)), 0.0)
    found: list[ValueSteps] = []
    low = _CONSTANTS[0]
    while low < _CONSTANTS[1]:
        high = _BAND * low
        seen = 1 / distinct[distinct >= (_SEEN * rounding * high) ** 0.5]
        if _FEWEST <= len(seen) <= _DENSE * high * np.ptp(seen) + 1 and low * np.ptp(seen) >= _CYCLES:
            found += _peaks(seen, low, high)
        low = high
    if not found:
        return None
    best = max(each.confidence for each in found)
    return min(each for each in found if each.confidence >= _HARMONIC * best)


def _is_rounded(values: np.ndarray, unit: float) -> bool:
    """Return whether depths are whole multiples of a unit, up to the precision of float32."""
    multiples = values / unit
    return bool(np.all(np.abs(multiples - np.round(multiples)) <= 1e-3 + 2e-7 * multiples))


def _peaks(inverse: np.ndarray, low: float, high: float) -> list[ValueSteps]:
    """Return the constants in a range to which distinct inverse depths keep."""
    number, extent = len(inverse), np.ptp(inverse)
    constants = np.arange(low, high, 1 / (_FINE * extent))
    dense = number > _DENSE * constants * extent + 1
    if number > _MOST:
        number, inverse = _MOST, np.random.default_rng(0).choice(inverse, _MOST, replace=False)
    chunks = np.array_split(constants, len(constants) // 4096 + 1)
    sizes = np.concatenate([_coherence(inverse, chunk) for chunk in chunks])
    good = (sizes >= _CONFIDENT) & (number * sizes**2 >= _SIGNIFICANT) & ~dense
    peak = np.r_[False, (sizes[1:-1] >= sizes[:-2]) & (sizes[1:-1] > sizes[2:]), False]
    found = []
    for constant in constants[good & peak]:
        near = constant + np.linspace(-1, 1, 81) / (_FINE * extent)
        fine = _coherence(inverse, near)
        found.append(ValueSteps(float(near[fine.argmax()]), float(fine.max())))
    return found


def _coherence(inverse: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """Return the length of the mean of exp(2 pi i C / z) for each constant C."""
    phases = (2 * np.pi) * np.multiply.outer(constants, inverse)
    return np.hypot(np.cos(phases).mean(axis=1), np.sin(phases).mean(axis=1))
