"""Format errors of pydantic as one line: the key, the expected and the actual value."""

from __future__ import annotations

from pydantic import ValidationError


def describe(error: ValidationError) -> str:
    """Return the first thing that is wrong, such as ``trials.a1.scale: expected a valid integer, got 'x'``."""
    first = error.errors(include_url=False, include_context=False)[0]
    key = ".".join(map(str, first["loc"]))
    what = {"missing": "it is missing", "json_invalid": "got damaged JSON"}.get(first["type"])
    if what is None:
        expected = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
        what = f"expected {expected}, got {first['input']!r:.60}"
    return f"{key}: {what}" if key else what
