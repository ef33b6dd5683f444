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
