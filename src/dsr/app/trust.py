"""Which targets and files a run's ``config.yaml`` may name: it may have been written by somebody else.

A ``_target_`` is imported and called with the arguments beside it. A person who types one, or keeps it in a directory
of their own (``--config-dir``), decides that; a ``config.yaml`` in a directory that came from elsewhere does not. In
each group such a file may name the targets that the group's files in dsr's own ``conf`` name. Others need ``trust``.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.app.schema import Config, expect_name
from dsr.utils.configuration import ConfigError, config_directories
from dsr.utils.guards import read_limited

_LARGEST = 1 << 18  # bytes of a run's configuration
_DEEPEST = 30  # nested keys and lists
_TARGETS = ("_target_", "network")  # keys whose value is imported
_GROUP_OF = {"validation": "dataset", "patches": "trainer"}  # whose files name the targets of a key
_LIGHTNING = ("logger", "callbacks", "trainer")  # nodes of Lightning's classes, which write files
_PLACES = ("save_dir", "dir", "root_dir", "tracking_uri")  # of loggers; dsr gives them the run's directory


def allowed_targets(trust: Any, directories: Sequence[Path] = ()) -> frozenset[tuple[str, str]] | None:
    """Return the targets besides dsr's, with their groups, that a person's own directories and ``trust`` allow.

    ``trust`` is null, false, true, for which None is returned, a target or a list of them, which any group may have.
    """
    if trust is True:
        return None
    named = [trust] if isinstance(trust, str) else trust or []
    if not (isinstance(named, list) and all(isinstance(each, str) for each in named)):
        raise ConfigError(f"trust: expected true, false, or targets such as module.Name, got {trust!r}")
    return frozenset({("", each) for each in named}).union(*map(_targets_in, directories))


def read_plain_yaml(path: Path) -> dict[str, Any]:
    """Return the keys of a YAML file; aliases, which a bomb is made of, and interpolations are refused."""
    depth = 0
    try:
        text = read_limited(path, _LARGEST).decode()
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST or "${" in getattr(event, "value", ""):
                line = event.start_mark.line + 1
                raise ConfigError(f"{path}: line {line}: expected plain values, got an alias, ${{...}} or nested ones")
        content = OmegaConf.to_container(OmegaConf.create(text))
    except ConfigError:
        raise
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise ConfigError(f"{path}: expected YAML of keys and plain values, got {type(error).__name__}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected keys and values")
    return {str(key): value for key, value in content.items()}


def expect_trusted(path: Path, config: Config, trusted: frozenset[tuple[str, str]] | None) -> None:
    """Check the configuration of a run, which may be a stranger's: what it imports, and which files it names.

    ``trusted`` are the targets besides dsr's that may be imported, each with its group; None for all.
    """
    if trusted is None:
        return
    allowed = _targets_in(config_directories()[0]) | trusted
    for key, target in imported(config):
        group = key[1] if key[1] in ("optimizer", "scheduler") else _GROUP_OF.get(key[0], key[0])
        of_metrics = group == "metrics" and target.startswith("dsr.metrics.")
        if not of_metrics and allowed.isdisjoint({("", target), (group, target)}):
            raise ConfigError(
                f"{path}: {'.'.join(key)}: expected a target of dsr's own {group}, got {target!r}, whose code would "
                f"run; if you trust it, trust={target} allows it, trust=true allows all"
            )
    for key, value in _nodes(config):
        if key[0] == "names" and key[1:]:
            expect_name(f"{path}: {'.'.join(key)}", str(value))
        if key[:-1] in (("validation",), ("dataset", "parts")):
            expect_name(f"{path}: {'.'.join(key)}", key[-1])
        if key[0] in _LIGHTNING and isinstance(value, str):
            leads = re.match(r"\s*[/\\~]|\w+:", value) or "$" in value or ".." in re.split(r"[/\\]", value)
            leads = leads or (key[0] == "logger" and key[-1] in _PLACES and value != "mlruns")
            if leads and value != os.environ.get("MLFLOW_TRACKING_URI"):
                raise ConfigError(
                    f"{path}: {'.'.join(key)}: expected nothing outside of the run, got {value!r:.60}; "
                    "if you trust it, trust=true allows it"
                )


def _nodes(node: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the key and the value of all entries of a configuration."""
    entries = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
    for name, value in entries:
        key = (*above, str(name))
        yield key, value
        yield from _nodes(value, key)


def imported(config: Config) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the key and the value of all entries that are imported, those of ``metrics.extra`` included."""
    for key, value in _nodes(config):
        metric = key[:2] == ("metrics", "extra") and not isinstance(value, list)
        if value is not None and (key[-1] in _TARGETS or metric):
            yield key, str(value)


@functools.cache
def _targets_in(directory: Path) -> frozenset[tuple[str, str]]:
    """Return the group and the target of all that a directory's files name; files outside of groups have the group "".

    Methods' files are left out: a training's configuration has no method.
    """
    pattern = re.compile(rf"\b(?:{'|'.join(_TARGETS)}): *([\w.]+)")
    found: set[tuple[str, str]] = set()
    for path in directory.rglob("*.yaml"):
        *groups, _ = path.relative_to(directory).parts
        if groups != ["method"]:
            group = groups[0] if groups and groups != ["experiment"] else ""
            found |= {(group, target) for target in pattern.findall(path.read_text(encoding="utf-8"))}
    return frozenset(found)
