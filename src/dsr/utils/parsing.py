"""Values from other people's files: numbers that are numbers, and JSON that is JSON."""

from __future__ import annotations

import json
import math
from numbers import Real
from typing import Any, NoReturn, TypeGuard

import numpy as np

_MOST_DIGITS = 300
"""Digits of a whole number that a float can still hold."""


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a value is a finite number; true and false are none, and neither is 10**400."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def readable(name: str) -> str:
    """Return a file's name as text: bytes that are no UTF-8, which Python reads as surrogates, are escaped."""
    return name.encode(errors="backslashreplace").decode()


def parse_json(text: str | bytes, *, finite: bool = True) -> Any:
    """Return what JSON holds: Python's reader, without what is no JSON or cannot be computed with.

    Args:
        text: the JSON.
        finite: whether NaN and infinity, which Python writes and JSON does not have, are refused.

    Raises:
        ValueError: it is no JSON, is nested too deeply, or has a number that no float can hold.

    """
    only: Any = {"parse_constant": _refuse, "parse_float": _parse_float} if finite else {}
    try:
        return json.loads(text, parse_int=_parse_int, **only)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _refuse(text: str) -> NoReturn:
    raise ValueError(f"expected finite numbers, got {text[:20]}")


def _parse_int(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        _refuse(text)
    return int(text)


def _parse_float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        _refuse(text)
    return value
