"""Unit and range type of a depth map, identified from its stored values; an error where two are equally likely.

The clues are the median, the range, steps that all values are multiples of, the size and the camera of known data sets,
single pixels as of a laser scanner, and the planes of the map (:func:`dsr.geometry.planes.inverse_votes`). A map of few
different values shows nothing but its median.
"""

from typing import NamedTuple, NoReturn

import numpy as np

from dsr.geometry.camera import Camera, RangeType, baseline_times_focal
from dsr.geometry.planes import InverseVotes, inverse_votes
from dsr.io.depth_files import expect_known
from dsr.io.reading import SUNRGBD_BITS
from dsr.notes import LIMITS, Assumption
from dsr.utils.progress import show_length

TURNED_BACK = f"bits are turned back by {SUNRGBD_BITS}, as SUN RGB-D turns them: millimetres, also in the result"
_OVERRIDE = "--depth-unit overrides it"
# metres of a plausible median; a unit that gives another one is not assumed
_MIN_MEDIAN, _MAX_MEDIAN = (LIMITS[f"far-millimetres.{end}"] for end in ("least", "most"))
# units of whole numbers that cannot be millimetres, the most likely first
_OTHER_UNITS = ((1e-4, "0.1 mm"), (1e-6, "micrometres"), (1e-2, "centimetres"))
_SPARSE = 0.6  # share of holes from which on whole numbers may come from a laser scanner
_SCATTERED = 0.6  # and do, if fewer of the known pixels have a known one below
_FEWEST_LEVELS = 16  # different values below which a map shows nothing but its median
_SAMPLE = 200_000  # values that are looked at
_MOST = 0.99  # share of the values that are multiples of a step; 0.9 if farther ones have other bits
_LEVELS = 256
_ENDS = 4  # pixels that have the smallest, and the largest, value of a normalised map
# width, focal lengths, metres per value, and the data set whose published calibration that is
_KNOWN_CAMERAS: tuple[tuple[int, float, float, float, str], ...] = (
    (640, 481.2, 480.0, 1 / 5000, "ICL-NUIM"),
    (640, 517.3, 516.5, 1 / 5000, "TUM RGB-D, freiburg1"),
    (640, 520.9, 521.0, 1 / 5000, "TUM RGB-D, freiburg2"),
    (640, 535.4, 539.2, 1 / 5000, "TUM RGB-D, freiburg3"),
)
_REPLICA = 1200, 680  # width and height of renderings that store 1/6553.5 m (NICE-SLAM, configs/Replica)
# steps to a pixel in which disparities are stored, and by whom
_FIXED_POINT = ((8, "OAK"), (16, "OpenCV's StereoSGBM"), (32, "OAK"), (256, "KITTI"))
_MOST_NARROW = 99.9  # percentile of disparities in pixels that lies below the width of their map
_KITTI_WIDTHS, _KITTI_HEIGHTS = range(1216, 1243), range(350, 377)  # whose depth and disparity is in 1/256 (its devkit)


class Meaning(NamedTuple):
    """The meaning of stored values."""

    unit: float  # metres (pixels) per value
    assumptions: tuple[Assumption, ...]
    range_type: RangeType | None = None  # disparity where the values are; None where they show none
    bits: int = 0  # how far they were turned to the left; the unit holds after turning them back


def interpret(
    name: str, values: np.ndarray, holes: np.ndarray, camera: Camera | None = None, *, may_fall: bool = True
) -> Meaning:
    """Identify the unit and the range type of the stored values of a map, (h, w), with holes, (h, w) bool.

    An error begins with ``name``, the file's; if two readings are as likely, it names both, with the option for each.
    ``camera``: of these pixels, if it is known. ``may_fall``: nobody said that they are no disparities.
    """
    expect_known(name, values, holes)
    known = values[~holes]
    sample = known[:: -(-known.size // _SAMPLE)]
    conclusive = np.unique(sample).size >= _FEWEST_LEVELS
    votes = InverseVotes(0, 0)
    if conclusive and may_fall:
        votes = inverse_votes(np.where(holes, np.nan, values.astype(np.float64)))
    sparse = bool(holes.mean() > _SPARSE)
    scattered = sparse and bool((~holes[1:] & ~holes[:-1]).sum() < _SCATTERED * known.size)
    of_kitti = values.shape[1] in _KITTI_WIDTHS and values.shape[0] in _KITTI_HEIGHTS
    middle, highest = float(np.median(known)), float(known.max())
    clues = conclusive, sparse, scattered, of_kitti
    seen = _Map(name, values, holes, camera, may_fall, sample, middle, highest, *clues, votes)
    return _interpret_floats(seen) if values.dtype.kind == "f" else _interpret_whole(seen)


class _Map(NamedTuple):
    name: str
    values: np.ndarray
    holes: np.ndarray
    camera: Camera | None
    may_fall: bool
    known: np.ndarray  # values, or every n-th of them
    middle: float  # the median
    highest: float
    conclusive: bool  # whether there are enough different values
    sparse: bool  # whether most pixels are missing
    scattered: bool  # whether the known pixels are single ones, as of a laser scanner
    of_kitti: bool  # whether the map has one of the sizes of KITTI
    votes: InverseVotes  # of the planes; none for what cannot be disparities

    def metres(self, unit: float) -> str:
        """Return the median in a unit."""
        return show_length(self.middle * unit)

    def ask(self, why: str, *units: tuple[str, float]) -> NoReturn:
        """Raise the error that asks for one of several units, by their names for ``--depth-unit``."""
        readings = " or ".join(f"--depth-unit {name} (median {self.metres(unit)})" for name, unit in units)
        raise ValueError(f"{self.name}: expected {readings}: {why}")


def _multiples(values: np.ndarray, step: int, share: float = _MOST) -> bool:
    """Return whether a share of the values are multiples of a step, and not of twice the step."""
    if np.unique(values // step).size < _FEWEST_LEVELS:
        return False
    return bool((values % step == 0).mean() >= share and (values % (2 * step) == 0).mean() < _MOST * share)


def _interpret_whole(seen: _Map) -> Meaning:
    lowest = float(seen.values[~seen.holes].min())
    if lowest < seen.highest < _LEVELS and not seen.votes.verdict:
        raise ValueError(
            f"{seen.name}: expected --depth-unit cm (median {seen.metres(1e-2)}), or --range-type disparity with "
            f"--baseline METRES: whole numbers up to {seen.highest:g} are too small for millimetres"
        )
    if not seen.conclusive:
        return _by_median(seen)
    if seen.values.dtype == np.uint16 and _multiples(seen.known, 1 << SUNRGBD_BITS, 0.9):
        note = Assumption(f"values are multiples of 8: {TURNED_BACK}; {_OVERRIDE}")
        return Meaning(1e-3, (note,), bits=SUNRGBD_BITS)
    falling = _interpret_falling(seen)
    if falling is not None:
        return falling
    for step in (_LEVELS, _LEVELS + 1):
        if _multiples(seen.known, step):
            raise ValueError(
                f"{seen.name}: expected depth, got multiples of {step}: a picture of 8 bits for viewing, widened to "
                "16; --depth-unit METRES if its values are metric"
            )
    return _by_data_set(seen) or _by_steps(seen) or _by_median(seen)


def _by_data_set(seen: _Map) -> Meaning | None:
    height, width = seen.values.shape
    camera = seen.camera
    for known_width, fx, fy, unit, name in _KNOWN_CAMERAS:
        if camera is not None and camera.width == known_width and np.allclose((camera.fx, camera.fy), (fx, fy), 1e-4):
            return Meaning(unit, (_whole(seen, "1/5000 m", unit, f"the camera is that of {name}"),))
    if (width, height) == _REPLICA and seen.middle / 6553.5 > 0.5:
        note = _whole(seen, "1/6553.5 m", 1 / 6553.5, "1200 x 680 is the size of Replica's maps")
        return Meaning(1 / 6553.5, (note,))
    if seen.of_kitti and seen.sparse:
        return Meaning(1 / 256, (_whole(seen, "1/256 m", 1 / 256, "size and holes are those of KITTI's maps"),))
    if seen.of_kitti:
        seen.ask("KITTI's maps have this size, and store 1/256 m", ("1/256", 1 / 256), ("mm", 1e-3), ("cm", 1e-2))
    if seen.scattered:
        why = "single pixels, as of a laser scanner, which KITTI stores in 1/256 m"
        seen.ask(why, ("1/256", 1 / 256), ("mm", 1e-3))
    return None


def _by_steps(seen: _Map) -> Meaning | None:
    for step, name, unit in ((5, "1/5000", 1 / 5000), (10, "0.0001", 1e-4)):
        if not _multiples(seen.known, step):
            continue
        nearest = LIMITS[f"far-millimetres.{step}"]
        fine, coarse = nearest <= seen.middle * unit, seen.middle * 1e-3 <= LIMITS["far-millimetres"]
        why = f"values are multiples of {step}, as of millimetres stored in {name} m"
        if fine and not coarse:
            return Meaning(unit, (_whole(seen, f"{name} m", unit, why),))
        if not coarse or (fine and step == 5):  # sensors have steps of a centimetre, too
            seen.ask(why, ("mm", 1e-3), (name, unit))
    return None


def _whole(seen: _Map, label: str, unit: float, why: str) -> Assumption:
    return Assumption(f"whole numbers are read as {label}: {why}; {_OVERRIDE}", f"median {seen.metres(unit)}")


def _by_median(seen: _Map) -> Meaning:
    middle = seen.middle
    if _MIN_MEDIAN <= middle * 1e-3 <= _MAX_MEDIAN:
        others = "TUM RGB-D and ICL-NUIM store 1/5000 m"
        if seen.conclusive and middle * 1e-3 > LIMITS["far-millimetres"]:
            why = f"as millimetres that is far for a depth camera; {others}"
            seen.ask(why, ("mm", 1e-3), ("1/5000", 1 / 5000))
        found = [Assumption("whole numbers are read as millimetres", f"median {seen.metres(1e-3)}")]
        if middle * 1e-3 > LIMITS["far-metres"]:
            found.append(Assumption(f"that is far for a sensor: {others} (--depth-unit), SUN RGB-D sunrgbd"))
        near = float(np.percentile(seen.known, 99)) * 1e-3
        if seen.conclusive and near < LIMITS["near-millimetres"]:
            text = "everything is near if whole numbers are millimetres: are they centimetres? --depth-unit mm or cm"
            found.append(Assumption(text, f"99 % within {show_length(near, 2)}", "near-millimetres", near))
        if seen.sparse:
            known = np.pad(~seen.holes, 1)
            sides = known[:-2, 1:-1] & known[2:, 1:-1] & known[1:-1, :-2] & known[1:-1, 2:]
            if (sides & known[1:-1, 1:-1]).sum() <= known.sum() / 2:  # not an object that was cut out
                text = "that is sparse, as of a laser scanner: KITTI stores 1/256 m (--depth-unit 1/256)"
                found.append(Assumption(text))
        return Meaning(1e-3, tuple(found))
    for unit, label in _OTHER_UNITS:
        if _MIN_MEDIAN <= middle * unit <= _MAX_MEDIAN:
            why = f"as millimetres the median would be {seen.metres(1e-3)}, now {seen.metres(unit)}"
            return Meaning(unit, (Assumption(f"whole numbers are read as {label}", why),))
    raise ValueError(f"{seen.name}: no usual unit makes its median of {middle:g} a distance; give one (--depth-unit)")


def _interpret_floats(seen: _Map) -> Meaning:
    middle = seen.middle
    if seen.conclusive:
        _expect_metric(seen)
        falling = _interpret_falling(seen)
        if falling is not None:
            return falling
        _expect_one_reading(seen)
    whole = seen.conclusive and bool((seen.known == np.round(seen.known)).all())
    sure = "float-millimetres.whole" if whole or not seen.conclusive else "float-millimetres"
    if middle > LIMITS[sure]:
        return Meaning(1e-3, (Assumption("floats this large are read as millimetres", f"median {middle:.4g}"),))
    found = [Assumption("floats are read as metres", f"median {seen.metres(1.0)}")]
    if middle < _MIN_MEDIAN:
        found.append(Assumption("the depth is nearer than 5 cm: is it in metres? --depth-unit gives another unit"))
    return Meaning(1.0, tuple(found))


def _expect_metric(seen: _Map) -> None:
    """Refuse floats that are normalised."""
    known, highest = seen.known.astype(np.float64), seen.highest
    if highest > 1:
        ends = ((seen.values == end).sum() for end in (0, highest))
        normalised = highest == round(highest) and all(0 < count <= _ENDS for count in ends)
    else:
        scaled = ((known * most, 1e-3 * most / 255) for most in (255, 65535))
        of_levels = any(np.allclose(each, np.round(each), 0, allowed) for each, allowed in scaled)
        normalised = highest == 1 or of_levels or seen.middle < _MIN_MEDIAN
    if normalised and not (known == np.round(known)).all():
        raise ValueError(
            f"{seen.name}: expected metric depth, got floats up to {highest:.4g} with a median of {seen.middle:.3g}, "
            "as of normalised maps; --depth-unit METRES if they are metric, such as m"
        )


def _expect_one_reading(seen: _Map) -> None:
    """Refuse floats whose median has two likely readings."""
    middle = seen.middle
    whole = bool((seen.known == np.round(seen.known)).all())
    likely_pixels = seen.may_fall and seen.votes.verdict != "rises" and not seen.scattered
    if LIMITS["far-metres"] < middle <= LIMITS["far-floats"] and likely_pixels:
        raise ValueError(
            f"{seen.name}: expected --depth-unit m (median {seen.metres(1.0)}), or --range-type disparity with "
            "--baseline METRES: floats of this size are as often pixels as metres, and there are too few planes to tell"
        )
    least = LIMITS["float-millimetres.whole"]
    if LIMITS["far-floats"] < middle <= least and not seen.scattered:
        seen.ask("floats of this size are as often centimetres as metres", ("cm", 1e-2), ("m", 1.0))
    if least < middle <= LIMITS["float-millimetres"] and not whole:
        seen.ask("floats of this size are as often centimetres as millimetres", ("cm", 1e-2), ("mm", 1e-3))


def _interpret_falling(seen: _Map) -> Meaning | None:
    if seen.votes.verdict != "falls":
        return None
    votes = seen.votes
    why = f"values fall with distance (straight over {votes.falling} of {votes.falling + votes.rising} planes)"
    if seen.camera is None or seen.camera.baseline is None:
        raise ValueError(
            f"{seen.name}: expected --range-type disparity with --baseline METRES, or --range-type orthogonal for "
            f"depth: {why}, as disparity and inverse depth do; inverse depth of a network has no metric unit"
        )
    of_kitti = seen.of_kitti and seen.highest > seen.camera.width
    if not of_kitti:
        expect_narrow(seen.name, seen.known, seen.camera)
    label = "1/256 pixel" if of_kitti else "pixels"
    text = f"values are read as disparities in {label} of the depth map: {why}; --range-type overrides it"
    return Meaning(1 / 256 if of_kitti else 1.0, (Assumption(text),), "disparity")


def expect_narrow(name: str, known: np.ndarray, camera: Camera) -> None:
    """Raise ValueError if disparities, as pixels, exceed the width of their map; it names the fixed-point units."""
    if not known.size or (highest := float(np.percentile(known, _MOST_NARROW))) < camera.width:
        return
    middle = float(np.median(known))
    fitting = [
        f"--depth-unit 1/{steps} ({whose}: median {show_length(baseline_times_focal(camera) * steps / middle)})"
        for steps, whose in _FIXED_POINT
        if highest < steps * camera.width
    ]
    raise ValueError(
        f"{name}: expected {' or '.join(fitting) or '--depth-unit PIXELS'}: disparities up to {highest:g} are "
        f"impossible in pixels of a map of width {camera.width}; --depth-unit 1 if they are right"
    )
