"""What is said about input: what was assumed about it, and warnings of what can hardly be right, with all limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple


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
        "a person sees it in the relit surface from about 3 on",
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
}
"""By code: every warning that a command gives about its input; docs/checks.md shows them."""


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
        threshold = LIMITS[self.code].threshold
        return {"code": self.code, "message": self.message, "value": self.value, "threshold": threshold}


def expect_no_warning(where: str, messages: Sequence[str]) -> None:
    """Take warnings for an error, as ``--strict`` asks.

    Raises:
        ValueError: there is one.

    """
    if messages:
        more = f", and {len(messages) - 1} more" if len(messages) > 1 else ""
        raise ValueError(f"{where}: {messages[0]}{more}; --strict refuses what is otherwise a warning")
