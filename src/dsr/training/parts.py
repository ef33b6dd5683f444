"""The parts of a training as nodes of plain values, from which a checkpoint makes them again."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from dsr.utils.configuration import load_object

_TRUSTED = ("dsr.", "torch.optim.")


def node_of(kind: Any, arguments: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return a class as ``_target_`` beside arguments; None if it is no class or they are no plain values."""
    if not isinstance(kind, type) or not _is_plain(arguments):
        return None
    return {"_target_": f"{kind.__module__}.{kind.__qualname__}", **arguments}


def partial_node_of(make: Any) -> dict[str, Any] | None:
    """Return a class, or a partial of one, likewise, with ``_partial_``; None for any other function."""
    made = make if isinstance(make, functools.partial) else functools.partial(make)
    node = node_of(made.func, made.keywords)
    return None if node is None or made.args else {**node, "_partial_": True}


def read_node(name: str, node: Mapping[str, Any], kind: type) -> tuple[Any, dict[str, Any]]:
    """Return the class and the arguments that a node names.

    Args:
        name: of the part, for messages.
        node: from a checkpoint, which may come from somebody else.
        kind: what the class is to be a subclass of.

    Raises:
        ValueError: the class is neither dsr's nor torch.optim's, or none of that kind.

    """
    path = str(node.get("_target_"))
    if not path.startswith(_TRUSTED):
        raise ValueError(f"{name}: the checkpoint names {path}, which is neither dsr's nor torch.optim's; give {name}=")
    found = load_object(name, path, f"a {kind.__name__}")
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ValueError(f"{name}: expected a {kind.__name__} in the checkpoint, {path} is none")
    return found, {key: value for key, value in node.items() if key not in ("_target_", "_partial_")}


def _is_plain(value: Any) -> bool:
    """Return whether a value consists of what torch reads without running code."""
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and _is_plain(each) for key, each in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | int | float)
