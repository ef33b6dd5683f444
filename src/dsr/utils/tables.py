"""Texts in CSV files that no spreadsheet takes for a formula.

A cell that begins with ``=``, ``+``, ``-``, ``@``, a tab or a line end is run by spreadsheets
(https://owasp.org/www-community/attacks/CSV_Injection). Texts that do get an apostrophe in front, which makes them
texts there, and so do those that begin with apostrophes before one, so that reading gives back every text as it was.
A carriage return, which is not quoted and would begin a row, is written as its symbol. Numbers stay as they are.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

_RETURN = "\N{SYMBOL FOR CARRIAGE RETURN}"
_FORMULA = re.compile(r"'*[=+\-@\t\r\n]")
_GUARDED = re.compile(r"'+[=+\-@\t\r\n]")


def guard(value: Any) -> Any:
    """Return a value for a cell of a CSV file: a text that could be a formula gets an apostrophe in front."""
    if not isinstance(value, str):
        return value
    return (f"'{value}" if _FORMULA.match(value) else value).replace("\r", _RETURN)


def unguard(value: Any) -> Any:
    """Return the value that :func:`guard` was given."""
    if not isinstance(value, str):
        return value
    text = value.replace(_RETURN, "\r")
    return text[1:] if _GUARDED.match(text) else text


def guarded(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table to be written as CSV, with all its texts guarded, those of its head and index too."""
    table = table.rename(columns=guard, index=guard)
    return table.assign(**{name: table[name].map(guard) for name in _texts(table)})


def unguarded(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table that was read from CSV with its texts as they were; its head and index are left alone."""
    return table.assign(**{name: table[name].map(unguard) for name in _texts(table)})


def _texts(table: pd.DataFrame) -> list[str]:
    """Return the names of the columns that may hold texts."""
    return [name for name in table.columns if table[name].dtype.kind not in "biufcmM"]
