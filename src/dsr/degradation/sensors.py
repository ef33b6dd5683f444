"""Depth cameras by name and by the values of their maps: how they measure, and how exactly.

Figures that no source confirms are None. The others hold at a sensor's native width; in maps of another width focal
length, disparity and noise in pixels scale with it, so that the errors in metres stay. ``docs/sensors.md`` has the
source of each figure.
"""

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

_ByDistance = tuple[tuple[float, float], ...]  # pairs of a distance and a value in metres, nearest first


@dataclass(frozen=True)
class Sensor:
    """A depth camera."""

    name: str  # of the camera or the family
    kind: Literal["stereo", "structured light", "time of flight", "lidar"]
    width: int  # of its native depth map, in pixels
    pattern: str  # of device names, a regular expression without regard to case
    stereo_constant: float | None = None  # focal length times baseline, in pixels times metres
    step: float | None = None  # of its disparity, in pixels
    noise: float | None = None  # standard deviation of its disparity on a textured wall, in pixels
    extent: float | None = None  # pixels of its map over which the noise is correlated
    spread: _ByDistance | None = None  # standard deviation of one frame's depth on a bright wall; 0 at the camera
    offset: _ByDistance | None = None  # limit of the systematic error, which all pixels of a surface may share


_NGUYEN = 1.9e-3 * 0.075 * 580  # noise of structured light far away, 1.9 mm z^2, as disparity
_WIDE = r"(?!.*([-_ ]w(?![a-z])|lite|[-_ ]sr|[-_ ]lr|tof))"
_ARKIT = (
    r"arkit|record3d|stray scanner|polycam|3d scanner app|scannet\+\+|iphone ?1[2-9] ?pro|ipad.*\bpro|"
    r"iphone(13,[34]|14,[23]|15,[23]|16,[12]|17,[12])\b"
)
_PHONES = r"time.?of.?flight|\btof\b|\bsm-(g977|n97[56]|g98[568])|huawei.*p[34]0 pro|\bvog-"

SENSORS = (  # of several whose pattern fits a name the first is taken
    Sensor("RealSense D415", "stereo", 1280, r"\bd41[05]\b", 0.0548 * 941, step=1 / 32, noise=0.08, extent=17.0),
    Sensor("RealSense D435", "stereo", 1280, r"\bd43[05]i?f?\b", 0.050 * 640, step=1 / 32, noise=0.08, extent=17.0),
    Sensor("RealSense D455", "stereo", 1280, r"\bd45[0-7]f?\b", 0.095 * 637, step=1 / 32, noise=0.08, extent=17.0),
    Sensor(
        "RealSense L515", "lidar", 1024, r"\bl515",
        spread=((1.0, 0.0025), (9.0, 0.0155)), offset=((1.0, 0.005), (9.0, 0.014)),
    ),
    Sensor(
        "Azure Kinect", "time of flight", 640, r"azure|kinect 4|\bk4a|femto.?bolt",
        spread=((1.0, 0.0013), (2.0, 0.0017), (2.5, 0.0021)), offset=((0.5, 0.0115), (5.5, 0.0165)),
    ),
    Sensor(
        "Kinect v2", "time of flight", 512, r"kinect.*(v2|one|2\.0|\b2\b)|\bkv2\b|xbox nui sensor",
        spread=((1.0, 0.0013), (2.0, 0.0017), (3.0, 0.0027), (4.0, 0.0043)),
    ),
    Sensor(
        "Kinect v1", "structured light", 640, r"kinect|\bkv1\b|xbox nui", 0.075 * 580,
        step=1 / 8, noise=_NGUYEN, extent=9.0,
    ),
    Sensor(
        "Xtion", "structured light", 640, r"xtion|primesense|carmine", 0.075 * 570.3,
        step=1 / 8, noise=_NGUYEN, extent=9.0,
    ),
    Sensor("Astra", "structured light", 640, r"\bastra(?!.*(\b2\b|stereo))"),
    Sensor("OAK-D Lite", "stereo", 640, r"\boak.?d.?lite", 0.075 * 433, step=1 / 8),
    Sensor("OAK-D Pro", "stereo", 1280, rf"\boak.?d.?(s2|pro){_WIDE}", 0.075 * 783, step=1 / 8),
    Sensor("OAK-D", "stereo", 1280, rf"\boak.?d(?![a-z]){_WIDE}", 0.075 * 882.5, step=1 / 8),
    Sensor("ARKit lidar", "lidar", 256, _ARKIT, extent=6.0),
    Sensor("phone time of flight", "time of flight", 240, _PHONES),
)  # fmt: skip


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
        """Return the least standard deviation of depth that the sensor can have, in metres, of any shape; 0 if unknown.

        It is that of its disparity, z^2 noise / (f B), where no noise is less than the rounding to steps, or its spread
        at that distance, if that is larger. Steps are those that the map's values show, else of the native width.
        """
        least, sensor = torch.zeros_like(depth), self.sensor
        constant = self.constant or _counts(sensor)
        if constant and sensor.step is not None:
            steps = max((sensor.noise or 0.0) / sensor.step, 12**-0.5)
            least = depth.square() * (steps / constant)
        if sensor.spread is not None:
            least = torch.maximum(least, _interpolate(depth, ((0.0, 0.0), *sensor.spread)))
        return least

    def offset_error(self, depth: Tensor) -> Tensor | None:
        """Return the expected systematic error of depth in metres, half of its limit; None where no limit is known."""
        limit = self.sensor.offset
        return None if limit is None else _interpolate(depth, limit) / 2


# Relative difference up to which steps identify a sensor, and beyond which they contradict one; cameras of a type
# differ by 2 %
_NEAR, _ALIKE = 0.02, 0.06
# Focal lengths of stereo cameras' modes over that of the native width: 848, 640 x 480 (cropped), 640 x 360 and others;
# disparity is counted in pixels of the mode
_USUAL = (1.0, 848 / 1280, 0.6, 0.5)
_PARTS = (*_USUAL, 2 / 3, 480 / 1280, 424 / 1280, 0.2)


def identify(depth: Tensor, name: str = "auto", device_name: str = "") -> Identified | None:
    """Return the sensor of a map, (1, h, w) in metres, NaN in holes, as it was read; None for an unknown one.

    ``name`` is that of one of ``SENSORS`` or of a device, or ``none``. With ``auto``, the values and ``device_name``,
    as the map's files state it, identify a sensor; the values are decisive, as the name may be of the photo's camera.
    """
    if name == "none":
        return None
    steps = recognise_values(depth)
    constant = None if steps is None else steps.constant
    if name != "auto":
        named = sensor_named(name)
        if constant is not None and _mismatch(named, constant) > _ALIKE:
            raise ValueError(
                f"sensor: expected depth in steps of disparity with f B / step = {_counts(named):.0f} m, as of a "
                f"{named.name}, or of one of its other modes, got {constant:.0f} m"
            )
        return Identified(named, "request", constant)
    stated = recognise(device_name)
    if stated is not None and _has_figures(stated) and (constant is None or _mismatch(stated, constant) <= _ALIKE):
        return Identified(stated, "file", constant)
    if constant is None:
        return None
    best = min((each for each in SENSORS if each.step is not None), key=lambda each: _mismatch(each, constant, _USUAL))
    return Identified(best, "values", constant) if _mismatch(best, constant, _USUAL) <= _NEAR else None


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


def _interpolate(depth: Tensor, points: _ByDistance) -> Tensor:
    """Return values at distances, linear between points and constant beyond them."""
    distances, values = zip(*points, strict=True)
    return torch.from_numpy(np.interp(depth.detach().double().cpu().numpy(), distances, values)).to(depth)


class ValueSteps(NamedTuple):
    """Steps of inverse depth that a map's values have: multiples of ``1 / constant``."""

    constant: float  # focal length times baseline over the step of disparity, in metres
    confidence: float  # from 0 to 1, how closely the values keep to them


_CONSTANTS = (16.0, 4096.0)  # sought, in metres: 16 pixel metres in whole pixels to 128 in steps of 1/32
_ROUNDINGS = (1e-3, 1.25e-4, 1e-4)  # metres to which cameras' files are rounded
_SEEN = 2.0  # smallest step of depth that shows, over what values are rounded to
_COMMON = 4  # pixels that a value must have; rarer ones come from resampling
_BAND = 1.2  # ratio of the constants that are looked for in the same values, those far enough to show them
_FEWEST, _CYCLES = 12, 8  # distinct values, and steps between the smallest and the largest, that are needed
# Least confidence; and least N confidence^2 for N values, minus the logarithm of the chance that random ones have
_CONFIDENT, _SIGNIFICANT = 0.6, 25.0
_NEAREST = 0.1  # metres; nearer values are left out
_PIXELS = 2**20  # about how many pixels are looked at; of larger maps some rows
_MOST = 400  # values that are looked at, drawn at random
_DENSE = 1.2  # distinct values over steps between the smallest and the largest, from which they keep to no steps
# Multiples of a step are also multiples of its parts: the largest step with this share of the best confidence is taken.
_HARMONIC = 0.8
_FINE = 4  # samples of the spectrum for each cycle that fits into the range of inverse depth


def recognise_values(depth: Tensor) -> ValueSteps | None:
    """Return the steps of inverse depth in which a stereo or structured-light camera's map has its values.

    The map, (1, h, w) in metres, is as it was read: neither resampled nor filtered. Its inverse depths are multiples of
    step / (f B), where the rounding to millimetres does not hide it, and the sum of exp(2 pi i C / z) over the distinct
    values has a peak at C = f B / step. None if the values keep to no steps, too few of them are seen, or they are not
    rounded as cameras write them: the values of a computed plane may keep to steps, too.
    """
    depth = depth[:, :: max(1, round(depth.numel() / _PIXELS))]
    values, counts = torch.unique(depth[depth.isfinite()].double(), return_counts=True)
    distinct = values[(counts >= _COMMON) & (values >= _NEAREST)].cpu().numpy()
    if not len(distinct):
        return None
    for rounding in _ROUNDINGS:
        multiples = distinct / rounding
        if np.all(np.abs(multiples - np.round(multiples)) <= 1e-3 + 2e-7 * multiples):  # as precise as float32
            break
    else:
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
