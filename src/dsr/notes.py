"""What is said about input: what was assumed about it, and warnings of what can hardly be right, with all limits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

CHECKS = 2
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
    "edges-beside": Limit(
        3.0,
        "pixels, of a photo with 800 on its longer side, by which its edges lie beside those of the depth map",
        "7 of 823 right pairs are beyond it, 2 of them one frame that does lie beside its photo",
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
        "truths of the scenes of one name in the runs of a report or a study",
        "scores against different truths cannot be compared",
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
        "metres, of the median of whole numbers as millimetres; the unit is asked for, not warned of",
        "of 71 maps of sensors none is beyond 5.2 m; stored in 1/5000 m 63 would be",
    ),
    "far-metres": Limit(
        10.0,
        "metres, of the median of floats, if planes do not show that they are depth; asked for",
        "of 71 maps of sensors none is beyond 5.2 m; disparities of Middlebury have medians of 26 to 40 px",
    ),
    "far-floats": Limit(
        30.0,
        "metres, of the median of floats; asked for up to 200",
        "centimetres of a table begin here; no depth camera of rooms measures so far",
    ),
    "float-millimetres": Limit(
        500.0,
        "of the median of floats above 200 that are not whole; asked for below it",
        "the Kinect v2, whose drivers store such floats, begins at 0.5 m; rooms in centimetres are mostly below 5 m",
    ),
    "baseline-short": Limit(0.001, "metres, below which it is", "phones have cameras 10 mm apart"),
    "baseline-long": Limit(5.0, "metres", "KITTI's car has 0.54 m, and rigs of 2 m are rare"),
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
}
"""By code: every warning that a command gives about its input, and what it refuses or asks for; see docs/checks.md."""


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
