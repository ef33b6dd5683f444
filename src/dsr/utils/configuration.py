"""Build the object that a node of the configuration describes, as ``hydra.utils.instantiate`` does.

A node names its class or function as ``_target_``; the other keys are the arguments. Those that are nodes themselves
are built first; with ``_partial_`` the result is a :func:`functools.partial`. The schema of a node is therefore the
signature of its target, and a new method needs one module and one file. What Hydra's function lacks are messages that
name the key, and quickness: an error of the target that begins with an argument's name (``sharpness: expected ...``) is
shown with the key that sets it (``method.sharpness: expected ...``).
"""

import dataclasses
import functools
import importlib
import importlib.util
import inspect
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from dsr.utils.guards import did_you_mean
from dsr.utils.versions import how_to_install

Node = Mapping[str, Any]  # ``_target_``, perhaps ``_partial_``, and arguments of the target
_MISSING = "???"
_TARGET, _PARTIAL = "_target_", "_partial_"
_NODE = f"a node with {_TARGET}"
# What pydantic's types of errors mean to the writer of a configuration, where its text is about JSON.
_EXPECTED = {"bool_type": "true or false", "list_type": "a list", "tuple_type": "a list", "dict_type": "keys",
             "missing": "more values", "too_long": "fewer values", "needs_python_object": _NODE,
             "callable_type": _NODE}  # fmt: skip
_PACKAGE = Path(__file__).resolve().parents[1]
_PLACES = (_PACKAGE / "conf", _PACKAGE.parents[1] / "conf")  # of an installed package, and of a checkout


class ConfigError(ValueError):
    """A configuration that cannot be run: one line that names the key, what was expected and what came."""


def expect_library(key: str, module: str, extra: str) -> None:
    """Check that a library is installed, without importing it."""
    if importlib.util.find_spec(module) is None:
        library = module.rpartition(".")[2]
        raise ConfigError(f"{key}: expected {library}, which is not installed; {how_to_install(extra)}")


def build(group: str, node: Any, given: Mapping[str, Any] | None = None, name: str | None = None) -> Any:
    """Build the object that a node describes; its target gets those of the ``given`` values that its signature names.

    ``group`` is the node's place in the configuration and ``name`` that of the group's choice, for messages.
    """
    if isinstance(node, Mapping) and node.get(_PARTIAL):  # only the arguments of another node may be one
        raise ConfigError(f"{group}.{_PARTIAL}: expected an object, which a partial is not; leave it out")
    return _make(group, node, given or {}, name)


def _make(group: str, node: Node, given: Mapping[str, Any], name: str | None = None) -> Any:
    target, arguments = _checked(group, node, given, name)
    arguments = {key: _built(f"{group}.{key}", value) for key, value in arguments.items()}
    if node.get(_PARTIAL):
        return functools.partial(target, **arguments)
    try:
        return target(**arguments)
    except Exception as error:  # Lightning's own errors derive from Exception alone
        if not isinstance(error, ValueError | OSError) and not target.__module__.startswith("lightning."):
            raise
        message = " ".join(str(error).split())
        if message.partition(":")[0] in inspect.signature(target).parameters:
            message = f"{group}.{message}"
        elif not target.__module__.startswith("dsr."):
            message = f"{group}: {message}"
        raise ConfigError(message) from error


def _checked(group: str, node: Node, given: Mapping[str, Any], name: str | None) -> tuple[Any, dict[str, Any]]:
    """Return what a node names, and its arguments, those that are given included."""
    target = load_target(group, node)
    parameters = inspect.signature(target).parameters
    takes_any = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
    hints = get_type_hints(target.__init__ if inspect.isclass(target) else target)
    given = {key: value for key, value in given.items() if key in parameters}
    own = [key for key, each in parameters.items() if key not in given and each.kind is not each.VAR_KEYWORD]
    choice = f"{group}={name}" if name else group
    arguments = {key: value for key, value in node.items() if key not in (_TARGET, _PARTIAL)}
    for key, value in arguments.items():
        if key not in own and not takes_any:
            accepted = ", ".join(own) or "none"
            raise ConfigError(f"{group}.{key}: unknown key; {choice} takes {accepted}{did_you_mean(key, own)}")
        if value == _MISSING:
            raise ConfigError(f"{group}.{key}: {choice} needs it: {group}.{key}=...")
        if value == "":  # which as a path would be the current directory
            raise ConfigError(f"{group}.{key}: expected a text of one character or more, or null for none")
        if key in hints and not _is_node(value):
            _expect_type(f"{group}.{key}", value, hints[key])
    return target, {**arguments, **given}


def _is_node(value: Any) -> bool:
    """Return whether a value is a node to build, or has some within it."""
    values = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    return (isinstance(value, Mapping) and _TARGET in value) or any(map(_is_node, values))


def _built(key: str, value: Any) -> Any:
    if not _is_node(value):
        return value
    if isinstance(value, list):
        return [_built(f"{key}.{number}", each) for number, each in enumerate(value)]
    if _TARGET in value:
        return _make(key, value, {})
    return {name: _built(f"{key}.{name}", each) for name, each in value.items()}


def load_target(group: str, node: Node) -> Any:
    """Return the class or function that a group names."""
    if not isinstance(node, Mapping):
        raise ConfigError(f"{group}: expected keys, {_TARGET} among them, got {node!r:.60}")
    path = node.get(_TARGET)
    target = load_object(f"{group}.{_TARGET}", path, "a class or function")
    if not callable(target):
        raise ConfigError(f"{group}.{_TARGET}: expected a class or function, {path!r} is none")
    return target


def load_object(key: str, path: Any, what: str) -> Any:
    """Return the object of a module that a configuration value names."""
    if not isinstance(path, str) or "." not in path:
        raise ConfigError(f"{key}: expected module.name of {what}, got {path!r}")
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ConfigError(f"{key}: cannot import {path!r} ({error})") from error


def _expect_type(key: str, value: Any, hint: Any) -> None:
    """Check that a configuration value, which is JSON's, is of an annotated type; a whole number is a number, too."""
    from pydantic import TypeAdapter, ValidationError  # noqa: PLC0415 - a refused command line needs none

    if dataclasses.is_dataclass(hint):
        raise ConfigError(f"{key}: expected {_NODE}, got {value!r:.60}")
    kind: TypeAdapter[Any] = TypeAdapter(hint, config={"strict": True, "arbitrary_types_allowed": True})
    try:
        kind.validate_json(json.dumps(value))
    except ValidationError as error:
        if isinstance(value, list) and any(each["type"] == "needs_python_object" for each in error.errors()):
            return  # such as Collection[str], which only a Python object can be checked against: its target does
        reasons = [
            _EXPECTED.get(each["type"]) or re.sub(r"^\w+ should (be|have) (a valid )?", "", each["msg"])
            for each in error.errors()
        ]
        reasons += ["null"] if type(None) in get_args(hint) else []
        raise ConfigError(f"{key}: expected {' or '.join(dict.fromkeys(reasons))}, got {value!r:.60}") from error


def config_directories(more: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Return the directories of configuration files: the project's first, whose files no other replaces."""
    own = next((place for place in _PLACES if (place / "eval.yaml").is_file()), None)
    if own is None:
        raise ConfigError(f"{_PLACES[0]}: expected the configuration files of dsr; the installation is incomplete")
    for directory in more:
        if not directory.is_dir():
            raise ConfigError(f"--config-dir: expected a directory, got {directory}")
    return (own, *more)


def list_choices(group: str, directories: Sequence[Path]) -> list[str]:
    """Return the sorted names of the files of a group, such as ``method``, in all directories."""
    return sorted({path.stem for directory in directories for path in (directory / group).glob("*.yaml")})
