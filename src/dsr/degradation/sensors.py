"""Depth cameras by name: how they measure, how exactly, and where they fail, each figure with its source.

What no source at hand confirms is None. Figures hold at a sensor's native width; in maps of another width focal length,
disparity and noise in pixels scale with it, so that the errors in metres stay. ``docs/sensors.md`` has the table, too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
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
        spread: standard deviation of one frame's depth on a bright wall by distance, pairs of metres, nearest first; it
            grows linearly between them, and from 0 to the first.
        offset: limit of the systematic error of depth by distance, likewise, which all pixels of a surface may share;
            nearer than the first it is that of the first.
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
    offset: tuple[tuple[float, float], ...] | None = None
    edges: str | None = None
    dark: str | None = None
    shiny: str | None = None
    clear: str | None = None
    sources: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


class ValueSteps(NamedTuple):
    """Steps of inverse depth that a map's values have: multiples of ``1 / constant``."""

    constant: float  # focal length times baseline over the step of disparity, in metres
    confidence: float  # from 0 to 1, how closely the values keep to them


_D400_STEP = "Intel, Subpixel Linearity Improvement for RealSense D400 (dev.intelrealsense.com): 1/32 pixel"
_D400_NOISE = "A. Grunnet-Jepsen (Intel) in librealsense issue 3904: 0.032 at best, 0.08 as a rule"
_D400_EXTENT = "measured before a board with a D435: 37 px of a photo of 2.14 times its focal length; the window has 9"
_GRASP = "Sajjan et al., ClearGrasp, ICRA 2020"
_L515 = "Intel, L515's product page, in librealsense issue 5808: at 1 m and 9 m on 95 % reflectivity"
_AZURE_OFFSET = "Microsoft, Azure Kinect DK hardware specifications: typically < 11 mm + 0.1 %, without multipath"
_AZURE = "Microsoft, Azure Kinect DK depth camera (azure-docs, articles/kinect-dk): random error and invalidation"
_KURILLO = "Kurillo et al., Evaluating the Accuracy of the Azure Kinect and Kinect v2, Sensors 2022: similar to 2.5 m"
_FANKHAUSER = "Fankhauser et al., Kinect v2 for Mobile Robot Navigation, ICAR 2015: 1.5 - 0.5 z + 0.3 z^2, mm for m"
_SARBOLANDI = "Sarbolandi et al., Kinect Range Sensing: Structured-Light versus Time-of-Flight Kinect, CVIU 2015"
_CORTI = "Corti et al., A metrological characterization of the Kinect V2 time-of-flight camera, RAS 2016"
_TECHNICAL = "K. Konolige and P. Mihelich, Technical Description of Kinect Calibration (ROS kinect_calibration)"
_NGUYEN = "Nguyen et al., Modeling Kinect Sensor Noise, 3DIMPVT 2012"
_MALLICK = "Mallick et al., Characterizations of Noise in Kinect Depth Images, IEEE Sensors Journal 2014"
_PROMPT = "PromptMoGe (sergmister/PromptMoGe, promptmoge/train/sensor_sim/model.py), against a laser scanner"
_MULTIPATH = "flying pixels between both sides of a step; concave corners are rounded by multipath"


def _stereo(name: str, width: int, pattern: str, constant: float, source: str, of: Sensor) -> Sensor:
    """Return a stereo camera by f B and its source, with the other figures of its family."""
    sources = MappingProxyType({**of.sources, "stereo_constant": source})
    return replace(of, name=name, width=width, pattern=pattern, stereo_constant=constant, sources=sources)


def _primesense(name: str, pattern: str, stereo_constant: float, source: str) -> Sensor:
    """Return a camera with PrimeSense's projector of dots."""
    noise = 1.9e-3 * 0.075 * 580
    return Sensor(
        name,
        "structured light",
        640,
        pattern,
        stereo_constant,
        1 / 8,
        noise,
        9.0,
        edges="they jitter along themselves by about 0.8 pixels; a shadow of the projector is missing on one side",
        dark="missing",
        shiny="missing",
        clear="missing, or the depth of what is behind",
        sources=MappingProxyType(
            {
                "stereo_constant": source,
                "step": _TECHNICAL,
                "noise": f"{_NGUYEN}: 1.2 mm + 1.9 mm (z - 0.4)^2, z in m, far away",
                "extent": f"{_TECHNICAL}: windows of 9 x 9 or 9 x 7",
                "edges": _NGUYEN,
                **dict.fromkeys(("dark", "shiny", "clear"), _MALLICK),
            }
        ),
    )


_OAK = Sensor(
    "OAK",
    "stereo",
    1280,
    "",
    step=1 / 8,
    edges="near surfaces are fattened by about half a matching window; what one camera alone sees is missing",
    clear="missing, or the depth of what is behind",
    sources=MappingProxyType(
        {
            "step": "Luxonis, DepthAI StereoDepth: 3 fractional bits in subpixel mode unless more are set",
            "edges": "Scharstein and Szeliski, A Taxonomy of Dense Two-Frame Stereo Correspondence, IJCV 2002",
            "clear": _GRASP,
        }
    ),
)
_D400 = replace(
    _OAK,
    step=1 / 32,
    noise=0.08,
    extent=17.0,
    sources=MappingProxyType({**_OAK.sources, "step": _D400_STEP, "noise": _D400_NOISE, "extent": _D400_EXTENT}),
)
_WIDE = r"(?!.*([-_ ]w(?![a-z])|lite|[-_ ]sr|[-_ ]lr|tof))"

SENSORS = (  # of several whose pattern fits a name the first is taken
    _stereo(
        "RealSense D415",
        1280,
        r"\bd41[05]\b",
        0.0548 * 941,
        "librealsense issue 1430: a D415's 940.9 px at 1280 x 720; librealsense, doc/depth-from-stereo.md: 54.8 mm",
        _D400,
    ),
    _stereo(
        "RealSense D435",
        1280,
        r"\bd43[05]i?f?\b",
        0.050 * 640,
        "librealsense issues 3314 (a D435's 638.0 px at 1280 x 720) and 10575 (50 mm); the values of one's maps: 32.0",
        _D400,
    ),
    _stereo(
        "RealSense D455",
        1280,
        r"\bd45[0-7]f?\b",
        0.095 * 637,
        "librealsense issue 8577: a D455's 636.8 px at 1280 x 720; Luxonis, OAK vs RealSense: 95 mm",
        _D400,
    ),
    Sensor(
        "RealSense L515",
        "lidar",
        1024,
        r"\bl515",
        spread=((1.0, 0.0025), (9.0, 0.0155)),
        offset=((1.0, 0.005), (9.0, 0.014)),
        sources=MappingProxyType({"spread": _L515, "offset": _L515}),
    ),
    Sensor(
        "Azure Kinect",
        "time of flight",
        640,
        r"azure|kinect 4|\bk4a|femto.?bolt",
        spread=((1.0, 0.0013), (2.0, 0.0017), (2.5, 0.0021)),
        offset=((0.5, 0.0115), (5.5, 0.0165)),
        edges="values between both sides of a step, or missing; so are concave corners",
        dark="noisier, or missing",
        shiny="missing where the light saturates",
        sources=MappingProxyType(
            {"spread": _KURILLO, "offset": _AZURE_OFFSET, **dict.fromkeys(("edges", "dark", "shiny"), _AZURE)}
        ),
    ),
    Sensor(
        "Kinect v2",
        "time of flight",
        512,
        r"kinect.*(v2|one|2\.0|\b2\b)|\bkv2\b|xbox nui sensor",
        spread=((1.0, 0.0013), (2.0, 0.0017), (3.0, 0.0027), (4.0, 0.0043)),
        edges=_MULTIPATH,
        dark="off by a small offset",
        sources=MappingProxyType({"spread": _FANKHAUSER, "edges": _SARBOLANDI, "dark": _CORTI}),
    ),
    _primesense(
        "Kinect v1",
        r"kinect|\bkv1\b|xbox nui",
        0.075 * 580,
        f"{_TECHNICAL}; 43.4 by the slope that OpenKinect's wiki measured (Talk:Imaging Information)",
    ),
    _primesense(
        "Xtion",
        r"xtion|primesense|carmine",
        0.075 * 570.3,
        "SUN RGB-D's Xtion: 570.3 px, and its values agree; ISPRS Archives, part B3: Kinect's chip, about 75 mm",
    ),
    Sensor("Astra", "structured light", 640, r"\bastra(?!.*(\b2\b|stereo))"),
    _stereo(
        "OAK-D Lite",
        640,
        r"\boak.?d.?lite",
        0.075 * 433,
        "Luxonis, OAK-D-Lite (DM9095): 1.3 mm, pixels of 3 um; Luxonis, OAK vs RealSense: 75 mm",
        _OAK,
    ),
    _stereo(
        "OAK-D Pro",
        1280,
        rf"\boak.?d.?(s2|pro){_WIDE}",
        0.075 * 783,
        "Luxonis, OAK-FFC-OV9282 (its camera): 2.35 mm, pixels of 3 um; Luxonis, OAK vs RealSense: 75 mm",
        _OAK,
    ),
    _stereo(
        "OAK-D",
        1280,
        rf"\boak.?d(?![a-z]){_WIDE}",
        0.075 * 882.5,
        "Luxonis, FAQ of stereo depth: 7.5 cm, 882.5 px at 1280 x 800",
        _OAK,
    ),
    Sensor(
        "ARKit lidar",
        "lidar",
        256,
        r"arkit|record3d|stray scanner|polycam|3d scanner app|scannet\+\+|iphone ?1[2-9] ?pro|ipad.*\bpro|"
        r"iphone(13,[34]|14,[23]|15,[23]|16,[12]|17,[12])\b",
        extent=6.0,
        edges="of a step 14 % fall between neighbours and 52 % over three pixels; never a hole",
        dark="twice as noisy",
        sources=MappingProxyType(dict.fromkeys(("extent", "edges", "dark"), _PROMPT)),
    ),
    Sensor(
        "phone time of flight",
        "time of flight",
        240,
        r"time.?of.?flight|\btof\b|\bsm-(g977|n97[56]|g98[568])|huawei.*p[34]0 pro|\bvog-",
    ),
)


def recognise(device_name: str) -> Sensor | None:
    """Return the sensor of a device's name as recordings, EXIF data and apps state it; None for an unknown one."""
    return next((each for each in SENSORS if re.search(each.pattern, device_name, re.IGNORECASE)), None)


def sensor_named(name: str) -> Sensor:
    """Return the sensor of one of the names of ``SENSORS``, without regard to case, or of a device's name."""
    found = next((each for each in SENSORS if each.name.casefold() == name.casefold()), None) or recognise(name)
    if found is None or not _has_figures(found):
        known = ", ".join(each.name for each in SENSORS if _has_figures(each))
        raise ValueError(f"sensor: expected auto, none or one of {known}, got {name!r}")
    return found


def _has_figures(sensor: Sensor) -> bool:
    """Return whether anything is known of how exact a sensor is."""
    return sensor.stereo_constant is not None or sensor.spread is not None


class Identified(NamedTuple):
    """The sensor of a map, and what identified it: the request, the file or the values."""

    sensor: Sensor
    by: Literal["request", "file", "values"]
    constant: float | None = None  # f B over the step of disparity that the map's values show, in metres, if any

    def least_error(self, depth: Tensor) -> Tensor:
        """Return :func:`least_error`, in the mode of the sensor that the map's values show."""
        return least_error(self.sensor, depth, self.constant)

    def offset_error(self, depth: Tensor) -> Tensor | None:
        """Return the expected systematic error of depth in metres, half of its limit; None where no limit is known."""
        limit = self.sensor.offset
        return None if limit is None else _interpolate(depth, limit) / 2


def identify(depth: Tensor, name: str = "auto", device_name: str = "") -> Identified | None:
    """Return the sensor of a map: the named one, else the one identified by its values and the device's name.

    Where these contradict each other the values count: a device's name may be that of the photo's camera.

    Args:
        depth: (1, h, w) in metres, NaN in holes, as it was read.
        name: of one of ``SENSORS`` or of a device; ``auto``, or ``none`` for none.
        device_name: of the device, as its files state it; empty where they do not.

    """
    if name == "none":
        return None
    named = None if name == "auto" else sensor_named(name)
    steps = recognise_values(depth)
    constant = None if steps is None else steps.constant
    if named is not None:
        if constant is not None and _mismatch(named, constant) > _ALIKE:
            own = _counts(named)
            raise ValueError(
                f"sensor: expected depth in steps of disparity with f B / step = {own:.0f} m, as of a {named.name}, or "
                f"of one of its other modes, got {constant:.0f} m"
            )
        return Identified(named, "request", constant)
    named = recognise(device_name)
    if named is not None and _has_figures(named) and (constant is None or _mismatch(named, constant) <= _ALIKE):
        return Identified(named, "file", constant)
    if constant is None:
        return None
    best = min((each for each in SENSORS if each.step is not None), key=lambda each: _mismatch(each, constant, _USUAL))
    return Identified(best, "values", constant) if _mismatch(best, constant, _USUAL) <= _NEAR else None


_NEAR, _ALIKE = 0.02, 0.06
"""Relative difference up to which steps identify a sensor, and beyond which they contradict one; cameras of a type
differ by 2 %."""
_USUAL = (1.0, 848 / 1280, 0.6, 0.5)
_PARTS = (*_USUAL, 2 / 3, 480 / 1280, 424 / 1280, 0.2)
"""Focal lengths of stereo cameras' modes over that of the native width: 848, 640 x 480 (cropped), 640 x 360 and others;
disparity is counted in pixels of the mode."""


def _counts(sensor: Sensor) -> float:
    """Return f B over the step of a sensor's disparity, in metres; 0 where it is not known."""
    if sensor.stereo_constant is None or sensor.step is None:
        return 0.0
    return sensor.stereo_constant / sensor.step


def _mismatch(sensor: Sensor, constant: float, parts: tuple[float, ...] = _PARTS) -> float:
    """Return by how much steps differ from the nearest that a sensor may have, relative; 0 where it has none."""
    own = _counts(sensor)
    if not own:
        return 0.0
    return min(abs(constant / (part * own) - 1) for part in (parts if sensor.kind == "stereo" else parts[:1]))


def least_error(sensor: Sensor, depth: Tensor, constant: float | None = None) -> Tensor:
    """Return the standard deviation in metres of depth of any shape below which a sensor states none; 0 if not known.

    That of its disparity, z^2 noise / (f B), where no noise is less than the rounding to steps, and its spread at that
    distance; the larger one. ``constant`` is f B over the step of disparity; None for that of its native width.
    """
    least = torch.zeros_like(depth)
    constant = constant or _counts(sensor)
    if constant and sensor.step is not None:
        steps = max((sensor.noise or 0.0) / sensor.step, 12**-0.5)
        least = depth.square() * (steps / constant)
    if sensor.spread is not None:
        least = torch.maximum(least, _interpolate(depth, ((0.0, 0.0), *sensor.spread)))
    return least


def _interpolate(depth: Tensor, points: tuple[tuple[float, float], ...]) -> Tensor:
    """Return values at distances, linear between points and constant beyond them."""
    distances, values = zip(*points, strict=True)
    return torch.from_numpy(np.interp(depth.detach().double().cpu().numpy(), distances, values)).to(depth)


_CONSTANTS = (16.0, 4096.0)  # sought, in metres: 16 pixel metres in whole pixels to 128 in steps of 1/32
_ROUNDINGS = (1e-3, 1.25e-4, 1e-4)  # metres to which cameras' files are rounded
_SEEN = 2.0  # smallest step of depth that shows, over what values are rounded to
_COMMON = 4  # pixels that a value must have; rarer ones come from resampling
_BAND = 1.2  # ratio of the constants that are looked for in the same values, those far enough to show them
_FEWEST, _CYCLES = 12, 8  # distinct values, and steps between the smallest and the largest, that are needed
_CONFIDENT, _SIGNIFICANT = 0.6, 25.0
"""Least confidence; and least N confidence^2 for N values, minus the logarithm of the chance that random ones have."""
_NEAREST = 0.1  # metres; nearer values are left out
_PIXELS = 2**20  # about how many pixels are looked at; of larger maps some rows
_MOST = 400  # values that are looked at, drawn at random
_DENSE = 1.2  # distinct values over steps between the smallest and the largest, from which they keep to no steps
# Multiples of a step are also multiples of its parts: the largest step with this share of the best confidence is taken.
_HARMONIC = 0.8
_FINE = 4  # samples of the spectrum for each cycle that fits into the range of inverse depth


def recognise_values(depth: Tensor) -> ValueSteps | None:
    """Return the steps of inverse depth in which a stereo or structured-light camera's map has its values.

    Its values are f B / d for disparities d in whole steps. Where the rounding to millimetres, or tenths of them, does
    not hide it, inverse depths are therefore multiples of step / (f B), and the sum of exp(2 pi i C / z) over the
    distinct values has a peak at C = f B / step.

    Args:
        depth: (1, h, w) in metres, NaN in holes, as it was read: neither resampled nor filtered.

    Returns:
        None where the values keep to no steps, or too few of them are seen, or they are not rounded as cameras write
        them: those of a computed plane may keep to steps, too.

    """
    depth = depth[:, :: max(1, round(depth.numel() / _PIXELS))]
    values, counts = torch.unique(depth[depth.isfinite()].double(), return_counts=True)
    distinct = values[(counts >= _COMMON) & (values >= _NEAREST)].cpu().numpy()

    def is_rounded(unit: float) -> bool:  # up to the precision of float32
        multiples = distinct / unit
        return bool(np.all(np.abs(multiples - np.round(multiples)) <= 1e-3 + 2e-7 * multiples))

    rounding = next(filter(is_rounded, _ROUNDINGS), None)
    if rounding is None or not len(distinct):
        return None
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
