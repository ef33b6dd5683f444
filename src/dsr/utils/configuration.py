"""Build the object that a node of the configuration describes, as ``hydra.utils.instantiate`` does.

A node names its class or function as ``_target_``; the other keys are the arguments. Those that are nodes themselves
are built first; with ``_partial_`` the result is a :func:`functools.partial`. The schema of a node is therefore the
signature of its target, and a new method needs one module and one file. What Hydra's function lacks are messages that
name the key, and quickness: an error of the target that begins with an argument's name (``sharpness: expected ...``) is
shown with the key that sets it (``method.sharpness: expected ...``).
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import inspect
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import yaml

from dsr.utils.guards import TooLargeError, read_limited
from dsr.utils.versions import how_to_install

Node = Mapping[str, Any]
"""A node of the configuration: ``_target_``, perhaps ``_partial_``, and arguments of the target."""
_MISSING = "???"
_TARGET, _PARTIAL = "_target_", "_partial_"
_MANY = 20
"""Of more arguments than these, a message names those like the mistyped one."""

_PACKAGE = Path(__file__).resolve().parents[1]
_LARGEST = 2**20
"""Bytes of a file of the user's."""
_MOST_VALUES = 100_000
"""Values of a file of the user's, where each alias counts as what it stands for."""
_PLACES = (_PACKAGE / "conf", _PACKAGE.parents[1] / "conf")
"""Where the project's own files are: in an installed package, and in a checkout."""


class ConfigError(ValueError):
    """A configuration that cannot be run: one line that names the key, what was expected and what came."""


def expect_library(key: str, module: str, extra: str) -> None:
    """Check that a library is installed, without importing it."""
    if importlib.util.find_spec(module) is None:
        library = module.rpartition(".")[2]
        raise ConfigError(f"{key}: expected {library}, which is not installed; {how_to_install(extra)}")


def build(group: str, node: Mapping[str, Any], given: Mapping[str, Any] | None = None, name: str | None = None) -> Any:
    """Build the object that a node describes.

    Args:
        group: the node's place in the configuration, for messages.
        node: ``_target_``, perhaps ``_partial_``, and arguments of the target.
        given: values of the whole run (scale, weights, device, ...); the target gets those that its signature names.
        name: of the group's choice, for messages.

    Raises:
        ConfigError: a key is unknown, missing or of another type, or the target rejects a value.

    """
    _expect_whole(group, node)
    return _make(group, node, given or {}, name)


def _make(group: str, node: Mapping[str, Any], given: Mapping[str, Any], name: str | None = None) -> Any:
    """Build the object, or the partial, that a node describes."""
    target, arguments = _checked(group, node, given, name)
    arguments = {key: _built(f"{group}.{key}", value) for key, value in arguments.items()}
    if node.get(_PARTIAL):
        return functools.partial(target, **arguments)
    try:
        return target(**arguments)
    except (ValueError, OSError) as error:
        raise ConfigError(with_key(str(error), group, inspect.signature(target).parameters)) from error
    except Exception as error:  # Lightning's own, which derives from none of these
        if type(error).__name__ != "MisconfigurationException" and not target.__module__.startswith("lightning."):
            raise
        raise ConfigError(f"{group}: {' '.join(str(error).split())}") from error


def check(group: str, node: Mapping[str, Any], given: Mapping[str, Any] | None = None) -> None:
    """Check what can be checked before :func:`build`: that a node has the keys of its target, of the right types.

    Raises:
        ConfigError: it has not.

    """
    _expect_whole(group, node)
    _checked(group, node, given or {}, None)


def _expect_whole(group: str, node: Any) -> None:
    """Refuse a partial where an object is needed; only the arguments of another node may be one."""
    if isinstance(node, Mapping) and node.get(_PARTIAL):
        raise ConfigError(f"{group}.{_PARTIAL}: expected an object, which a partial is not; leave it out")


def _checked(
    group: str, node: Mapping[str, Any], given: Mapping[str, Any], name: str | None
) -> tuple[Any, dict[str, Any]]:
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
            near = get_close_matches(key, own) if len(own) > _MANY else []
            accepted = ", ".join(near or own) or "none"
            raise ConfigError(f"{group}.{key}: unknown key; {choice} takes {accepted}")
        expect_usable(f"{group}.{key}", value)
        if value == _MISSING:
            raise ConfigError(f"{group}.{key}: {choice} needs it: {group}.{key}=...")
        if key in hints and not _is_node(value) and not _fits(value, hints[key]):
            raise ConfigError(f"{group}.{key}: expected {_describe(hints[key])}, got {value!r:.60}")
    return target, {**arguments, **given}


def _is_node(value: Any) -> bool:
    """Return whether a value is a node to build, or has some within it."""
    values = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    return (isinstance(value, Mapping) and _TARGET in value) or any(map(_is_node, values))


def _built(key: str, value: Any) -> Any:
    """Return a value with the nodes in it built."""
    if not _is_node(value):
        return value
    if isinstance(value, list):
        return [_built(f"{key}.{number}", each) for number, each in enumerate(value)]
    if _TARGET in value:
        return _make(key, value, {})
    return {name: _built(f"{key}.{name}", each) for name, each in value.items()}


def check_types(kind: type, values: Mapping[str, Any], place: str = "") -> None:
    """Check values for the fields of a dataclass that have a plain type.

    Args:
        place: what stands before the names in messages, such as ``trainer.``.

    Raises:
        ConfigError: a value is of another type than its field, or an empty text.

    """
    hints = get_type_hints(kind)
    for name, value in values.items():
        if dataclasses.is_dataclass(hints[name]) or value == _MISSING:
            continue
        expect_usable(f"{place}{name}", value)
        if not _fits(value, hints[name]):
            raise ConfigError(f"{place}{name}: expected {_describe(hints[name])}, got {value!r:.60}")


def expect_usable(key: str, value: Any) -> None:
    """Refuse a text without characters, which as a path would be the current directory, and a number beyond 64 bits."""
    if isinstance(value, str) and (not value.strip() or "\0" in value):
        raise ConfigError(f"{key}: expected a text of one character or more, or null for none; got {value!r:.60}")
    if isinstance(value, str) and value.startswith("~"):
        expand_home(key, value)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ConfigError(f"{key}: expected a number that 64 bits hold, got {value!r:.60}")


def expand_home(key: str, path: str) -> Path:
    """Return a path with ~ replaced by the user's directory."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise ConfigError(f"{key}: expected a path, got {path!r:.60} ({error})") from error


def with_key(message: str, group: str, parameters: Collection[str]) -> str:
    """Return an error message with the key that sets the argument which it begins with."""
    return f"{group}.{message}" if message.partition(":")[0] in parameters else message


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


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a configuration value is of an annotated type."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, choice) for choice in get_args(hint))
    if origin is Literal:
        return value in get_args(hint)
    if origin is not None and issubclass(origin, Sequence):
        return isinstance(value, list) and all(_fits(item, get_args(hint)[0]) for item in value)
    if origin is not None and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(_fits(item, get_args(hint)[1]) for item in value.values())
    accepted: Any = {float: (int, float), Path: str, Any: object}.get(hint, hint)
    if origin is not None or not isinstance(accepted, type | tuple):
        return origin is not Callable  # which no plain value is; another kind is its target's to check
    return isinstance(value, accepted) and (hint in (bool, Any) or not isinstance(value, bool))


def _describe(hint: Any) -> str:
    """Return a type for a reader."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        *others, last = (_describe(choice) for choice in get_args(hint))
        return f"{', '.join(others)} or {last}"
    if origin is Literal:
        names = [str(choice) for choice in get_args(hint)]
        return names[0] if len(names) == 1 else f"one of {', '.join(names)}"
    if origin is not None and issubclass(origin, Sequence):
        return f"a list of {_describe(get_args(hint)[0])}"
    if origin is not None and issubclass(origin, Mapping):
        return f"keys, each with {_describe(get_args(hint)[1])}"
    if origin is Callable:
        return "a node with _target_"
    types_of = {float: "a number", int: "a whole number", str: "text", bool: "true or false", Any: "a value",
                type(None): "null"}  # fmt: skip
    return types_of.get(hint, getattr(hint, "__name__", str(hint)))


def config_directories(more: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Return the directories of configuration files in the order in which they are searched.

    Returns:
        The project's directory first, so that no file of the user's replaces one of the project's.

    """
    own = next((place for place in _PLACES if (place / "eval.yaml").is_file()), None)
    if own is None:
        raise ValueError(f"{_PLACES[0]}: expected the configuration files of dsr; the installation is incomplete")
    for directory in more:
        try:
            there = directory.is_dir()
        except OSError:  # such as a name that is too long
            there = False
        if not there:
            raise ValueError(f"--config-dir: expected a directory, got {directory}")
        for path in directory.glob("*/*.yaml"):
            if path.exists() and not path.is_file():  # a pipe would be waited for
                raise ValueError(f"{path}: expected a file, got something else")
            try:
                _expect_moderate(path)
            except FileNotFoundError:  # a link to nowhere
                continue
            except OSError as error:  # whose own message does not always name the file
                raise ValueError(f"{path}: expected a readable file, got {error.strerror}") from error
    return (own, *more)


def list_choices(group: str, directories: Sequence[Path]) -> list[str]:
    """Return the sorted names of the files of a group, such as ``method``, in all directories."""
    return sorted({path.stem for directory in directories for path in (directory / group).glob("*.yaml")})


def list_groups(directories: Sequence[Path]) -> list[str]:
    """Return the sorted names of the groups in all directories, without those of Hydra's own settings."""
    names = {path.name for directory in directories for path in directory.iterdir() if path.is_dir()}
    return sorted(names - {"hydra"})


def _expect_moderate(path: Path) -> None:
    """Refuse a file that is huge, or a short one whose aliases stand for something huge."""
    try:
        content = read_limited(path, _LARGEST)
        if b"*" not in content:
            return
        values = _count(yaml.compose(content, Loader=yaml.SafeLoader), {})
    except TooLargeError as error:
        raise ValueError(str(error)) from error
    except (ValueError, RecursionError, yaml.YAMLError):  # reported where it is composed
        return
    if values > _MOST_VALUES:
        raise ValueError(f"{path}: expected at most {_MOST_VALUES} values, got more by its aliases")


def _count(node: yaml.Node | None, counted: dict[int, int]) -> int:
    """Return the number of values of a node, each node counted once but added wherever it stands."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in counted:
        counted[id(node)] = 1
        parts = [part for pair in node.value for part in (pair if isinstance(pair, tuple) else (pair,))]
        counted[id(node)] += sum(_count(part, counted) for part in parts)
    return counted[id(node)]
