"""Notes on input: assumptions that were made, and warnings of implausible values, with the limits of all warnings."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

_OPTION = re.compile(r"(?<!\S)(?:--([a-z]+(?:-[a-z]+)*)|-(o))(?!\w|[-/\\.]\S)")
"""An option of the command, which is a word of its own and no part of a path."""
_ARGUMENTS = {"depth-unit": "unit", "o": "folder"}
"""Options of the command that have another name in Python."""

CHECKS = 4
"""Number of the present checks; another one where a warning is added, or a limit changes."""


class Limit(NamedTuple):
    """From which value on a warning is given.

    Args:
        threshold: the value.
        quantity: what is compared with it, with its unit.
        source: the measurement, or the fact, that it comes from.

    """

    threshold: float
    quantity: str
    source: str


LIMITS: dict[str, Limit] = {
    "cameras-damaged": Limit(
        1,
        "frames whose capture describes its cameras in a damaged way, where another camera or one of COLMAP is given",
        "a pose and a depth camera beside the photo's, which it may describe, too, are missing then",
    ),
    "edges-beside": Limit(
        3.0,
        "pixels of the photo, at most 800 on its longer side, between its edges and those of the depth map",
        "7 of 823 right pairs are beyond it, 2 of them one frame that is displaced",
    ),
    "neighbours-disagree": Limit(
        0.2,
        "of the neighbouring frames that see a pixel, the share that agrees on it; below, there is a warning",
        "right poses: 0.33 to 1.00, millimetres for metres: 0.00 to 0.02",
    ),
    "poses": Limit(
        0.25,
        "share of the pixels, by which frames agree in more under another reading of the poses",
        "right poses of 105 rendered and 60 recorded sequences: no warning",
    ),
    "poses-disagree": Limit(
        0.3,
        "share of the pixels in which neighbouring frames disagree under the poses, and less without any motion",
        "right poses of 48 rendered sequences: at most 0.26, or less than half of that without motion",
    ),
    "poses-far": Limit(
        10.0,
        "times the median depth, between all frames that are compared, though their depth maps are alike",
        "two views of 90 degrees that face a wall have nothing of it in common from 2 on",
    ),
    "poses-missing": Limit(
        1,
        "frames that have no pose in the file of `--poses`",
        "results of such frames have no place in the world",
    ),
    "truths-differ": Limit(
        2,
        "ground truths of the scenes of one name in the runs of a report or a study",
        "scores against different ground truths cannot be compared",
    ),
    "along-the-ray": Limit(
        0.85,
        "share of the planar windows that are planar only if values are distances along the ray",
        "none of 133 right maps reaches it, the nearest has 0.83; of 133 along the ray 85 do",
    ),
    "falls-with-distance": Limit(
        2.0,
        "windows in which the values are linear, over those in which their reciprocals are",
        "none of 133 right maps reaches it; of their reciprocals 69 do",
    ),
    "depth-near": Limit(0.05, "metres, of the 99th percentile, below which it is", "no depth camera measures nearer"),
    "depth-far": Limit(
        200.0,
        "metres, of the 1st percentile",
        "laser scanners of cars end at 120 m, photos of a landscape begin nearer",
    ),
    "view-narrow": Limit(5.0, "degrees of horizontal view, below which it is", "400 mm of focal length on 35 mm film"),
    "view-wide": Limit(130.0, "degrees of horizontal view", "no lens without distortion sees more; 122 is sold"),
    "focal-ratio": Limit(
        1.1,
        "larger over smaller focal length",
        "37 cameras of data sets and devices stay below 1.01; a photo stretched from 16:9 to 4:3 has 1.33",
    ),
    "off-centre": Limit(
        0.25,
        "of the size, from its middle to the principal point",
        "37 cameras of data sets and devices stay below 0.13; crops reach 0.25",
    ),
    "other-picture": Limit(
        0.1,
        "of the size, from its middle to the principal point, if the numbers fit another size or order",
        "of 37 cameras of data sets and devices 3 are beyond, and fit no other size",
    ),
    "beside-axis": Limit(
        80.0,
        "degrees from the axis to the picture; refused, not warned of",
        "a lens without distortion of 160 degrees would show it at its very edge",
    ),
    "near-millimetres": Limit(
        0.5,
        "metres, of the 99th percentile of whole numbers as millimetres, below which it is",
        "of 71 maps of sensors the nearest ends at 0.93 m; 65 of 113 in centimetres end nearer",
    ),
    "far-millimetres": Limit(
        6.0,
        "metres, of the median of whole numbers as millimetres; the command asks for the unit, no warning",
        "of 71 maps of sensors none is beyond 5.2 m; stored in 1/5000 m 63 would be",
    ),
    "far-metres": Limit(
        10.0,
        "metres, of the median of floats, if planes do not show that they are depth; the command asks for the unit",
        "of 71 maps of sensors none is beyond 5.2 m; disparities of Middlebury have medians of 26 to 40 px",
    ),
    "far-floats": Limit(
        30.0,
        "metres, of the median of floats; the command asks up to `float-millimetres.whole`",
        "centimetres of a table begin here; no depth camera of rooms measures so far",
    ),
    "float-millimetres": Limit(
        500.0,
        "of the median of floats above `float-millimetres.whole` that are not whole; the command asks below it",
        "the Kinect v2, whose drivers store such floats, begins at 0.5 m; rooms in centimetres are mostly below 5 m",
    ),
    "baseline-short": Limit(0.001, "metres, below which it is", "phones have cameras 10 mm apart"),
    "baseline-long": Limit(5.0, "metres", "KITTI's car has 0.54 m, and rigs of 2 m are rare"),
    "other-frame": Limit(
        1.0,
        "depth and photos of other frames with cameras that are alike, and no transform between them",
        "drivers that register depth name the photo's frame; others may have two cameras of one kind",
    ),
    "extrinsics-inverse": Limit(
        3.0,
        "standard deviations of chance by which edges agree better with the inverse of `--extrinsics`",
        "right matrices of 24 rendered pairs: at most -0.2; the inverse of 17 of them reaches it, from 5 cm apart on",
    ),
    "field-of-view": Limit(
        4.0,
        "standard deviations of chance by which edges agree better with another field of view, where edges exist",
        "440 right pairs: at most 2.2; of 359 that are 0.7 to 1.5 times as wide 209 reach it, 34 of 130 small maps",
    ),
    "photo-order": Limit(
        2,
        "pairs, of at most 12 over all, whose depth map fits another one's photo better, by as much as `photo-turned`",
        "none of 400 right lists of 12, and all of 400 that are reversed or one off",
    ),
    "photo-other": Limit(
        2.0,
        "standard deviations of chance, and less, of the agreement of edges, where edges exist",
        "1 % of right pairs, and 95 % of those with another photo, are below it",
    ),
    "photo-turned": Limit(
        4.5,
        "standard deviations of chance by which edges agree better with a mirrored or turned photo",
        "none of 823 right pairs, and 92 % of those with a mirrored or turned photo, reach it",
    ),
    "edges-beside.elsewhere": Limit(
        5.0,
        "standard deviations of chance, of the agreement of edges at a displacement beyond 4 % of the size",
        "none of 383 right pairs reaches it, 2 reach 4.5; of 182 shifted ones 171 reach it, 163 reach 7",
    ),
    "edges-beside.lead": Limit(
        2.0,
        "standard deviations by which that agreement is larger than without a displacement",
        "without it, 2 more of 383 right pairs get the warning",
    ),
    "edges-beside.chance": Limit(
        2.8,
        "standard errors by which the photo's gradients at the displaced depth edges exceed those at a typical shift",
        "5 of 383 right pairs meet all these conditions, 2 of them one frame that is displaced",
    ),
    "edges-beside.others": Limit(
        2.0, "standard errors by which they exceed those at the best other shift", "as for `edges-beside.chance`"
    ),
    "edges-beside.none": Limit(
        3.0, "standard errors by which they exceed those without a displacement", "as for `edges-beside.chance`"
    ),
    "edges-beside.contrast": Limit(1.2, "times the gradients at a typical shift", "as for `edges-beside.chance`"),
    "edges-beside.edges": Limit(
        300,
        "pixels of depth edges, below which no displacement up to 8 % is searched",
        "25 in each of the fewest parts",
    ),
    "edges-beside.tiles": Limit(
        12,
        "parts of 32 x 32 pixels that have edges, below which no displacement up to 8 % is searched",
        "the standard error of 12 parts is itself off by a fifth",
    ),
    "photo-other.side": Limit(
        80,
        "pixels of the depth map's longer side, below which edges do not exist",
        "3 of 383 right pairs are below `photo-other` with it, 5 without it",
    ),
    "photo-other.length": Limit(
        300,
        "pixels of contours on the grid, below which edges do not exist",
        "3 of 383 right pairs are below `photo-other`, 31 without the four conditions",
    ),
    "photo-other.coherence": Limit(
        0.6,
        "mean coherence of neighbouring edges, below which they do not exist",
        "3 of 383 right pairs are below `photo-other` with it, 6 without it",
    ),
    "photo-other.spread": Limit(
        0.045,
        "standard deviation of the agreement by chance, from which on edges do not exist",
        "3 of 383 right pairs are below `photo-other`, 31 without the four conditions",
    ),
    "other-picture.size": Limit(
        0.05,
        "relative difference of twice the principal point from another size, up to which it fits that",
        "half of `other-picture`: the numbers have to fit the other size clearly better",
    ),
    "other-picture.offset": Limit(
        0.05,
        "of the size, from its middle to the principal point, up to which numbers fit in another order",
        "half of `other-picture`: the numbers have to fit in the other order clearly better",
    ),
    "other-picture.ratio": Limit(
        1.03,
        "larger over smaller focal length, up to which numbers fit in another order",
        "37 cameras of data sets and devices stay below 1.01",
    ),
    "far-millimetres.least": Limit(
        0.05,
        "metres, of the median, below which no unit is assumed",
        "no depth camera measures nearer; of 110 maps of sensors and data sets the nearest median is 0.6 m",
    ),
    "far-millimetres.most": Limit(
        80.0,
        "metres, of the median, beyond which no unit is assumed",
        "studies on KITTI score depth up to here; of 110 maps of sensors and data sets the farthest median is 5.2 m",
    ),
    "along-the-ray.planes": Limit(
        6,
        "planar windows that are planar only if values are distances along the ray",
        "none of 28 right maps of sensors and data sets has any",
    ),
    "falls-with-distance.planes": Limit(
        10,
        "windows in which the values are linear, and not their reciprocals",
        "28 right maps of sensors and data sets have at most 4",
    ),
    "poses.tolerance": Limit(
        0.04,
        "difference of two depths over the farther one, up to which frames agree in a pixel",
        "right poses of 15 rendered sequences, off by 1 cm and half a degree, agree in 83 to 97 % of the pixels so",
    ),
    "poses.overlap": Limit(
        0.3,
        "share of a frame's points in another one's view, below which the two are not compared",
        "of 10 pairs of photos, 4 degrees and more apart, 3 to 6 are below it; of a video none is",
    ),
    "poses.explained": Limit(
        0.7,
        "share of the pixels in which frames agree under the other reading",
        "right poses of 15 rendered sequences: 0.83 to 0.97",
    ),
    "poses.weight": Limit(
        0.5,
        "pairs of frames that disagree wholly without motion, or as much of more pairs; fewer distinguish nothing",
        "15 rendered sequences whose camera moves have 3.1 to 22",
    ),
    "poses-disagree.still": Limit(
        1.2,
        "times as many pixels disagree under the poses as without any motion",
        "15 rendered sequences: right poses 0.1 to 0.27 times as many; with y up 1.15 to 1.6 in videos",
    ),
    "poses-far.alike": Limit(
        0.7,
        "share of the pixels in which frames agree without any motion",
        "videos have 0.72 to 0.90, photos 0.06 to 0.17, as medians over their pairs",
    ),
    "float-millimetres.whole": Limit(
        200.0,
        "of the median of floats, from which on they are no metres; whole ones, or few different ones, are millimetres",
        "laser scanners of cars end at 120 m; the nearest median of 110 maps of sensors and data sets is 0.6 m",
    ),
    "far-millimetres.5": Limit(
        0.5,
        "metres, of the median of multiples of 5 in 1/5000 m, below which they are not read as such",
        "the nearest median of 110 maps of sensors and data sets is 0.6 m",
    ),
    "far-millimetres.10": Limit(
        0.3,
        "metres, of the median of multiples of 10 in 0.1 mm, below which they are not read as such",
        "half of the nearest median of 110 maps of sensors and data sets, 0.6 m",
    ),
}
"""By code: every warning that a command gives about its input, and what it refuses or asks for; see docs/checks.md.

A name with a dot is another condition of the warning, or the question, before the dot.
"""


class Assumption(NamedTuple):
    """Something that was assumed about the files, or found in them; with a code, a warning that it can hardly be right.

    Attributes:
        text: statement, equal for all pictures to which it applies.
        detail: figures of a single picture.
        code: that of a warning, one of :data:`LIMITS`; empty where there is nothing to warn of.
        value: what a warning's limit was compared with.

    """

    text: str
    detail: str = ""
    code: str = ""
    value: float | None = None

    def __str__(self) -> str:
        return f"warning: {self.message}" if self.code else self.message

    @property
    def statement(self) -> str:
        """The text, as a warning if it is one."""
        return f"warning: {self.text}" if self.code else self.text

    @property
    def message(self) -> str:
        """The text and its detail."""
        return f"{self.text} ({self.detail})" if self.detail else self.text

    def record(self) -> dict[str, Any]:
        """Return a warning as values for JSON."""
        limit = LIMITS.get(self.code)
        return {
            "code": self.code,
            "message": self.message,
            "detail": self.detail,
            "value": self.value,
            "threshold": None if limit is None else limit.threshold,
        }


def in_python(text: str) -> str:
    """Return a message of a command in the wording for Python, where options are arguments."""
    return _OPTION.sub(lambda found: _ARGUMENTS.get(name := found[1] or found[2], name.replace("-", "_")), text)


def warn(notes: Iterable[Assumption]) -> None:
    """Give notes as Python's warnings, from the place outside of dsr that called."""
    level, frame = 1, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "dsr":
        level, frame = level + 1, frame.f_back
    for note in notes:
        warnings.warn(in_python(note.message), UserWarning, level)


def read_warning(entry: Mapping[str, Any]) -> Assumption:
    """Return the warning of a :meth:`Assumption.record`.

    Raises:
        KeyError, TypeError, ValueError: it is none.

    """
    message, detail, value = str(entry["message"]), str(entry["detail"]), entry["value"]
    text = message.removesuffix(f" ({detail})")
    return Assumption(text, detail, str(entry["code"]), None if value is None else float(value))


def expect_no_warning(where: str, notes: Iterable[Assumption], *, brief: bool = False) -> None:
    """Take warnings for an error, as ``--strict`` asks.

    Args:
        where: what they are about, at the beginning of the message.
        notes: among which there may be warnings.
        brief: whether the message is without figures, equal for all pictures.

    Raises:
        ValueError: there is one.

    """
    messages = [each.text if brief else each.message for each in notes if each.code]
    if messages:
        more = f", and {len(messages) - 1} more" if len(messages) > 1 else ""
        raise ValueError(f"{where}: {messages[0]}{more}; --strict refuses what is otherwise a warning")
