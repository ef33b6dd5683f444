"""Which targets and files a run's ``config.yaml`` may name: it may have been written by somebody else.

A ``_target_`` is imported and called with the arguments beside it. A person who types one, or keeps it in a directory
of their own (``--config-dir``), decides that; a ``config.yaml`` in a directory that came from elsewhere does not. Such
a file may name the targets that the files of dsr's own ``conf/GROUP`` name for the same group. Others need ``trust``.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf

from dsr.app.schema import Config, expect_name
from dsr.utils.configuration import ConfigError, config_directories
from dsr.utils.console import open_console, show, without_credentials
from dsr.utils.guards import TooLargeError, read_limited

_LARGEST = 1 << 18
"""Largest size of a run's configuration in bytes."""
_DEEPEST = 30
"""Largest depth of nested keys and lists."""
_TARGETS = ("_target_", "network")
"""Keys whose value is imported."""
_EXTRA = ("metrics", "extra")
"""The key with a list of metrics to import."""
_GROUP_OF = {"validation": "dataset", "patches": "trainer"}
"""Groups whose targets are those of another."""
_PARTS_OF_MODEL = ("optimizer", "scheduler")
"""Keys of a model that are groups of their own."""
_TRAINED_MODULE = "dsr.training.module.SuperResolution"
"""What ``conf/train.yaml`` makes of each model."""


@dataclass(frozen=True)
class Trust:
    """Which targets besides dsr's the person who runs the command allows.

    Args:
        anything: whether all are.
        targets: dotted paths, ``module.name``.

    """

    anything: bool = False
    targets: frozenset[str] = frozenset()

    @classmethod
    def of(cls, value: Any, directories: Sequence[Path] = ()) -> Trust:
        """Return the targets that the key ``trust`` and the user's own configuration directories allow.

        Args:
            value: of the key: null or false, true, a target, or a list of them.
            directories: those of ``--config-dir``; what their files name is allowed.

        Raises:
            ConfigError: the value is none of these.

        """
        named = [value] if isinstance(value, str) else value if isinstance(value, list) else []
        if not (value is None or isinstance(value, bool | list | str)) or not all(isinstance(e, str) for e in named):
            raise ConfigError(f"trust: expected true, false, or targets such as module.Name, got {value!r}")
        own = {target for directory in directories for group in _targets_in(directory).values() for target in group}
        return cls(value is True, frozenset(named) | own)

    def allows(self, target: str) -> bool:
        """Return whether a target may be imported."""
        return self.anything or target in self.targets


def read_plain_yaml(path: Path) -> dict[str, Any]:
    """Return the keys of a YAML file of plain values.

    Aliases, by which a short text stands for a huge one, tags, which make objects, and interpolations, which read the
    environment, are refused; a run's configuration has none.

    Raises:
        ConfigError: the file is missing, too large or no YAML, or has one of these.

    """
    try:
        text = read_limited(path, _LARGEST).decode()
    except TooLargeError as error:
        raise ConfigError(str(error)) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: expected a readable YAML file, got {type(error).__name__}") from error
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            _expect_plain(path, event)
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:  # OmegaConf needs a long time for them
                raise ConfigError(f"{path}: line {event.start_mark.line + 1}: expected plain values, got nested ones")
        content = OmegaConf.to_container(OmegaConf.create(text), resolve=False) if text.strip() else None
    except ConfigError:
        raise
    except Exception as error:  # not YAML, nested too deeply, a key of another type, ...
        raise ConfigError(f"{path}: expected YAML of keys and plain values, got {type(error).__name__}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected keys and values")
    return {str(key): value for key, value in content.items()}


def expect_trusted(path: Path, config: Config, trust: Trust) -> None:
    """Check the targets and names in a run's configuration; print a note for each foreign target that is allowed.

    Args:
        path: the file, for messages.
        config: its content, with the current paths of its targets.
        trust: what the person who runs the command allows.

    Raises:
        ConfigError: a target is neither dsr's nor allowed, or a name would lead out of a directory.

    """
    _expect_names(path, config)
    _expect_own_log(path, config, trust)
    others = [(key, target) for key, target in imported(config) if not _is_own(key, target)]
    refused = [(key, target) for key, target in others if not trust.allows(target)]
    if refused:
        key, target = refused[0]
        names = list(dict.fromkeys(each for _, each in refused))
        allow = f"trust={names[0]}" if len(names) == 1 else f"'trust=[{','.join(names)}]'"
        raise ConfigError(
            f"{path}: {'.'.join(key)}: expected a target of dsr's own {_group_of(key)} group, got {target!r}, "
            f"whose code would run; if you trust it, {allow} allows it"
        )
    if os.environ.get("LOCAL_RANK", "0") == "0":
        for key, target in others:
            show(open_console(), f"note: {path}: {'.'.join(key)} {target} is not dsr's; it is run, as you allow")


def _expect_plain(path: Path, event: yaml.Event) -> None:
    """Refuse an alias, a tag or an interpolation."""
    line = event.start_mark.line + 1
    if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
        raise ConfigError(f"{path}: line {line}: expected plain values, got an alias")
    if getattr(event, "tag", None) is not None:
        raise ConfigError(f"{path}: line {line}: expected plain values, got the tag {event.tag}")
    if isinstance(event, yaml.ScalarEvent) and "${" in event.value:
        raise ConfigError(f"{path}: line {line}: expected plain values, got the interpolation {event.value:.60}")


_Key = tuple[str, ...]
"""The parts of a dotted key."""


def _nodes(node: Any, above: _Key = ()) -> Iterator[tuple[_Key, Any]]:
    """Yield the key and the value of all entries of a configuration."""
    entries = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
    for name, value in entries:
        key = (*above, str(name))
        yield key, value
        yield from _nodes(value, key)


def imported(config: Config) -> Iterator[tuple[_Key, str]]:
    """Yield the key and the value of all entries that are imported."""
    for key, value in _nodes(config):
        metric = key[:2] == _EXTRA and not isinstance(value, list)
        if value is not None and (key[-1] in _TARGETS or metric):
            yield key, str(value)


def _group_of(key: _Key) -> str:
    """Return the group of choices that a key belongs to."""
    if key[0] == "model" and key[1] in _PARTS_OF_MODEL:
        return key[1]
    return _GROUP_OF.get(key[0], key[0])


def _is_own(key: _Key, target: str) -> bool:
    """Return whether dsr's own files name a target for the group of a key; of metrics, whether it lies in dsr's."""
    if key[:2] == _EXTRA:
        return target.startswith("dsr.metrics.")
    return target in _targets_in(config_directories()[0]).get(_group_of(key), ())


def _expect_names(path: Path, config: Config) -> None:
    """Refuse names, which become those of files and folders, that would lead elsewhere."""
    for key, value in _nodes(config):
        names = [value] if key[0] == "names" and key[1:] else []
        names += [key[-1]] if key[:-1] in (("validation",), ("dataset", "parts")) else []
        for name in map(str, names):
            expect_name(f"{path}: {'.'.join(key)}", name)


def _expect_own_log(path: Path, config: Config, trust: Trust) -> None:
    """Refuse a log that would be written outside of the run, or sent somewhere without trust."""
    for key, value in _nodes(config):
        place = f"{path}: {'.'.join(key)}"
        if key[0] == "logger" and key[-1] == "save_dir":
            raise ConfigError(f"{place}: expected no directory, the log is in the run's; got {value!r:.60}")
        if key[0] != "logger" or value is None:
            continue
        if key[-1] in ("name", "version", "sub_dir"):
            expect_name(place, str(value))
        if key[-1] == "tracking_uri" and not trust.anything and value != os.environ.get("MLFLOW_TRACKING_URI"):
            raise ConfigError(
                f"{place}: expected no address to send the log to, got {without_credentials(str(value))!r:.60}; "
                "if you trust it, trust=true or the same in $MLFLOW_TRACKING_URI allows it"
            )


@functools.lru_cache(maxsize=8)
def _targets_in(directory: Path) -> dict[str, frozenset[str]]:
    """Return the targets that the files of a directory's groups name, by group."""
    found: dict[str, set[str]] = {}
    for file in sorted(directory.glob("*/*.yaml")):
        try:
            content = yaml.safe_load(read_limited(file))
        except (OSError, ValueError, RecursionError, yaml.YAMLError):  # reported where it is composed
            continue
        named = {target for _, target in imported(content)} if isinstance(content, dict) else set()
        extra = content.get("extra") if isinstance(content, dict) else None
        named |= set(map(str, extra)) if file.parent.name == "metrics" and isinstance(extra, list) else set()
        found.setdefault(file.parent.name, set()).update(named)
    found.setdefault("model", set()).add(_TRAINED_MODULE)
    return {group: frozenset(targets) for group, targets in found.items()}
