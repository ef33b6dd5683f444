"""The name that is meant by a misspelt one."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(given: object, known: Iterable[str]) -> str:
    """Return ``; did you mean NAME?`` to end a message, or an empty text where no known name is like the given one.

    That is the only name with all words of the given one, such as ``--depth-unit`` for ``--unit``, or else the name of
    the most similar letters.
    """
    names = {name.lower(): name for name in known}
    words = _words(str(given))
    near = [name for name in names if words and words <= _words(name)]
    if len(near) != 1:
        near = get_close_matches(str(given).lower(), names, 1)
    return f"; did you mean {names[near[0]]}?" if near else ""


def _words(name: str) -> set[str]:
    """Return the words of a name in lower case, without a plural's s."""
    return {word.rstrip("s") for word in re.findall(r"[^\W_]+", name.lower())}
