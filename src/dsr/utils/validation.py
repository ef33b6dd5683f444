"""Format errors of pydantic as one line: the key, the expected and the actual value."""

from __future__ import annotations

import re
from collections.abc import Iterable

from pydantic import ValidationError


def describe(error: ValidationError, known: Iterable[str] = ()) -> str:
    """Return the first thing that is wrong, such as ``trials.a1.scale: expected a valid integer, got 'x'``.

    Args:
        error: what the validation raised.
        known: the keys to name where one is unknown.

    """
    first = error.errors(include_url=False, include_context=False)[0]
    key = ".".join(map(str, first["loc"]))
    message = re.sub(r"^(\w+ should (be|have) |Value error, )", "", first["msg"])
    what = {
        "missing": "it is missing",
        "json_invalid": message.replace("Invalid JSON:", "got damaged JSON:"),
        "extra_forbidden": f"unknown key; expected {', '.join(known)}",
    }.get(first["type"], f"expected {message}, got {first['input']!r:.60}")
    return f"{key}: {what}" if key else what
