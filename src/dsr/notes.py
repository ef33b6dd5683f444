"""Notes on input: assumptions that were made, and warnings of implausible values, with the limits of all warnings."""

import inspect
import re
import warnings
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

# an option of the command, which is a word of its own and no part of a path
_OPTION = re.compile(r"(?<!\S)(?:--([a-z]+(?:-[a-z]+)*)|-(o))(?!\w|[-/\\.]\S)")
_ARGUMENTS = {"depth-unit": "unit", "o": "folder"}  # options of the command that have another name in Python

CHECKS = 4  # version of the checks: to be increased when a warning is added or a limit changes

# By code: the value from which on a warning is given, or the command refuses or asks. What to do about each is in
# docs/checks.md, what the values come from in docs/measurements/checks.md. After a dot: another condition of a code.
LIMITS: dict[str, float] = {
    "cameras-damaged": 1,  # frames
    "edges-beside": 3.0,  # pixels of the photo, at most 800 on its longer side, between its edges and the depth map's
    "neighbours-disagree": 0.2,  # share of the neighbours that see a pixel and agree on it; warned of below
    "poses": 0.25,  # share of the pixels by which frames agree in more under another reading
    "poses-disagree": 0.3,  # share of the pixels in which neighbouring frames disagree
    "poses-far": 10.0,  # median depths between all compared frames, though their maps are alike
    "poses-missing": 1,  # frames without a pose in the file
    "truths-differ": 2,  # ground truths of scenes of one name
    "along-the-ray": 0.85,  # share of the planar windows that are planar only along the ray
    "falls-with-distance": 2.0,  # linear windows of values over those of their reciprocals
    "depth-near": 0.05,  # metres, 99th percentile; warned of below
    "depth-far": 200.0,  # metres, 1st percentile
    "view-narrow": 5.0,  # degrees of horizontal view; warned of below
    "view-wide": 130.0,  # degrees of horizontal view
    "focal-ratio": 1.1,  # larger over smaller focal length
    "off-centre": 0.25,  # of the size, from its middle to the principal point
    "other-picture": 0.1,  # of the size, if the numbers fit another size or order
    "beside-axis": 80.0,  # degrees from the axis to the picture; refused
    "near-millimetres": 0.5,  # metres, 99th percentile of whole numbers; warned of below
    "far-millimetres": 6.0,  # metres, median of whole numbers; the command asks
    "far-metres": 10.0,  # metres, median of floats without planes; the command asks
    "far-floats": 30.0,  # metres, median of floats; the command asks
    "float-millimetres": 500.0,  # median of floats that are not whole; the command asks below
    "baseline-short": 0.001,  # metres; warned of below
    "baseline-long": 5.0,  # metres
    "other-frame": 1.0,  # depth and photos of other frames, like cameras and no transform
    "extrinsics-inverse": 3.0,  # standard deviations by which edges agree better with the inverse matrix
    "field-of-view": 4.0,  # standard deviations by which edges agree better with another field of view
    "photo-order": 2,  # pairs whose depth map fits another one's photo better
    "photo-other": 2.0,  # standard deviations of the agreement of edges; warned of below
    "photo-turned": 4.5,  # standard deviations by which edges agree better with a mirrored or rotated photo
    "far-millimetres.least": 0.05,  # metres, median below which no unit is assumed
    "far-millimetres.most": 80.0,  # metres, median beyond which no unit is assumed
    "float-millimetres.whole": 200.0,  # median of floats from which on they are no metres
    "far-millimetres.5": 0.5,  # metres, least median of multiples of 5 in 1/5000 m
    "far-millimetres.10": 0.3,  # metres, least median of multiples of 10 in 0.1 mm
}


class Assumption(NamedTuple):
    """Something assumed about the files, or found in them; with a code, a warning that it can hardly be right."""

    text: str  # statement, equal for all pictures to which it applies
    detail: str = ""  # figures of a single picture
    code: str = ""  # of a warning, one of LIMITS; empty where there is nothing to warn of
    value: float | None = None  # what a warning's limit was compared with

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
        return {
            "code": self.code,
            "message": self.message,
            "detail": self.detail,
            "value": self.value,
            "threshold": LIMITS.get(self.code),
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
    """Return the warning of a :meth:`Assumption.record`."""
    message, detail, value = str(entry["message"]), str(entry["detail"]), entry["value"]
    text = message.removesuffix(f" ({detail})")
    return Assumption(text, detail, str(entry["code"]), None if value is None else float(value))


def expect_no_warning(where: str, notes: Iterable[Assumption], *, brief: bool = False) -> None:
    """Raise an error for warnings, as ``--strict`` asks; ``brief`` leaves out the figures of a single picture."""
    messages = [each.text if brief else each.message for each in notes if each.code]
    if messages:
        more = f", and {len(messages) - 1} more" if len(messages) > 1 else ""
        raise ValueError(f"{where}: {messages[0]}{more}; --strict refuses what is otherwise a warning")
