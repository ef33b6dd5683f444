"""How far a piece of work is."""

from __future__ import annotations

from collections.abc import Callable

Steps = Callable[[int, int], object]
"""A function that is called with the number of steps done and their total."""


def part_of(steps: Steps | None, before: int, total: int) -> Steps | None:
    """Return the function to call from one part of a piece of work, whose steps follow ``before`` of ``total``."""
    return None if steps is None else lambda done, _: steps(before + done, total)
