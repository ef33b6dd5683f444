"""Records that are made of checked ones."""

from __future__ import annotations

from typing import Any, TypeVar

_Record = TypeVar("_Record")


def unchecked(kind: type[_Record], **values: Any) -> _Record:
    """Return a record of all its fields' values, of which the maker is sure, without its checks."""
    record = object.__new__(kind)
    vars(record).update(values)
    return record


def derived(record: _Record, **changes: Any) -> _Record:
    """Return a copy of a record with other values of some fields, which are not checked."""
    return unchecked(type(record), **{**vars(record), **changes})
