"""The name that is meant by a misspelt one."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(given: object, known: Iterable[str]) -> str:
    """Return ``; did you mean NAME?`` for the known name most like a given one, to end a message; empty if none is."""
    names = {name.lower(): name for name in known}
    near = get_close_matches(str(given).lower(), names, 1)
    return f"; did you mean {names[near[0]]}?" if near else ""
