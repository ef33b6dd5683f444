"""The names of runs, composed of the settings that differ from the command's defaults.

A name consists of the method or model, the scale, in evaluations the data set, the choices and settings that differ
from the defaults, and the seed: ``msg_v_x8_w0.72_seed0``. The defaults of a choice's settings are those of its file.
What a run computes, such as the weight ``w`` for ``loss.w=auto``, is not in its name.
"""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from dsr.app.composition import compose
from dsr.app.schema import NAMED, Config, Identity, given_keys, plain_config, user_directories
from dsr.utils.configuration import config_directories, list_choices
from dsr.utils.ratios import round_ratio

NOT_IDENTITY = (
    "output_dir",
    "overwrite",
    "metrics",
    "weights",
    "resume",
    "run",
    "trust",
    "workers",
    "threads",
    "logger",
)
"""Keys of a configuration that are not in a run's identity, which has the weights by their content."""
_ELSEWHERE = (*NOT_IDENTITY, "names", "scale", "seed", "device", "precision")
"""Keys that are no settings that differ: they are in each name, or a matter of the machine."""
_NO_SETTINGS = ("_target_", "_partial_", "validation_of", "weights_files")
_REFERENCE = re.compile(r"\$\{([a-z_][\w.]*)\}")
"""A value that is that of another key."""
_LONGEST, _LONGEST_VALUE = 100, 60


def run_name(kind: str, config: Config, identity: Identity) -> tuple[str, bool]:
    """Return the name of a run, and whether it contains every setting that differs from the defaults.

    Args:
        kind: ``eval`` or ``train``.
        config: the run's configuration.
        identity: see :func:`dsr.app.run_directory.identity_of`.

    """
    head = "method" if "method" in config else "model"
    usual, defaults, complete = _defaults(kind, config)
    named = {group: config["names"][group] for group in usual if group != head}
    names = [name for group, name in named.items() if name != usual[group] or (kind, group) == ("eval", "dataset")]
    settings = [_setting(key, value) for key, value in _differing(config, defaults, head).items()]
    if config.get("run") is not None:
        settings.append((_setting("run", Path(config["run"]).absolute().name)[0], False))
    elif identity["weights_sha256"] is not None and (
        config.get("weights") != defaults.get("weights")
        or any(key.startswith("method.weights") for key in given_keys())
    ):
        settings.append((f"weights-{str(identity['weights_sha256'])[:8]}", True))
    if "alignment" in identity:
        settings.append(_setting("alignment", identity["alignment"]))
    if "precision" in given_keys():
        settings.append((str(config["precision"]), True))
    begin = (config["names"][head], f"x{round_ratio(config['scale'])}")
    name = "_".join((*begin, *names, *(text for text, _ in settings)))
    complete = complete and all(whole for _, whole in settings) and len(name) <= _LONGEST
    return f"{name[:_LONGEST]}_seed{config['seed']}", complete


def _defaults(kind: str, config: Config) -> tuple[dict[str, str], dict[str, Any], bool]:
    """Return the default choices of groups, the defaults for this configuration's choices, and whether all have any."""
    places = config_directories(user_directories())
    listed: Any = OmegaConf.load(places[0] / f"{kind}.yaml")
    usual = {str(group): str(name) for each in listed["defaults"] if not isinstance(each, str)
             for group, name in each.items() if group in NAMED and group in config["names"]}  # fmt: skip
    chosen = {group: str(config["names"][group]) for group in usual}
    known = [f"{group}={name}" for group, name in chosen.items() if name in list_choices(group, places)]
    composed = _compose(kind, (*known, f"scale={config['scale']}"), tuple(places))
    return usual, _with_references(composed, config), len(known) == len(chosen)


@functools.lru_cache(maxsize=256)
def _compose(kind: str, overrides: tuple[str, ...], places: tuple[Path, ...]) -> DictConfig:
    """Return a composed configuration, which is not to be changed; what it takes from the environment is read later."""
    return compose(kind, overrides, places[1:])


def _differing(config: Config, defaults: Config, head: str) -> dict[str, Any]:
    """Return the settings that differ from the defaults, by the last part of their keys if it is the only one."""
    skipped = (*_ELSEWHERE, head) if config.get("run") is not None else _ELSEWHERE
    groups = {group: node for group, node in config.items() if group not in skipped and isinstance(node, Mapping)}
    leaves = {f"{group}.{key}": value for group, node in groups.items() for key, value in _leaves(node).items()}
    usual = {f"{group}.{key}": value for group in groups for key, value in _leaves(defaults.get(group, {})).items()}
    same = tuple(f"{key}." for key, value in usual.items() if isinstance(value, _Reference))  # nodes among them
    leaves = {k: value for k, value in leaves.items() if usual.get(k) != _Reference(value) and not k.startswith(same)}
    ends = {key: key.rpartition(".")[2] for key in leaves}
    count = Counter(ends.values())
    return {
        ends[key] if count[ends[key]] == 1 else key: value for key, value in leaves.items()
        if ends[key] not in _NO_SETTINGS and (key not in usual or usual[key] != value)
    }  # fmt: skip


def _leaves(node: Config) -> dict[str, Any]:
    """Return the values of a node, and of the nodes in it, by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in node.items():
        inner = isinstance(value, Mapping) and "_target_" in value
        found |= {f"{key}.{end}": each for end, each in _leaves(value).items()} if inner else {str(key): value}
    return found


def _with_references(composed: DictConfig, config: Config) -> dict[str, Any]:
    """Return the defaults as plain values, where those that are another key's have what ``config`` has for that key."""
    plain = plain_config(composed)

    def value_of(key: str) -> Any:
        return functools.reduce(lambda node, part: node[part], key.split("."), config)

    def follow(values: dict[str, Any], raw: dict[str, Any]) -> None:
        for key, text in raw.items():
            if isinstance(text, dict) and isinstance(values[key], dict):
                follow(values[key], text)
            elif isinstance(text, str) and (reference := _REFERENCE.fullmatch(text)):
                values[key] = _Reference(value_of(reference[1]))

    follow(plain, OmegaConf.to_container(composed, resolve=False))  # type: ignore[arg-type]
    return plain


class _Reference(NamedTuple):
    """The value of another key."""

    value: Any


def _setting(key: str, value: Any) -> tuple[str, bool]:
    """Return a setting in short, and whether that is all of it."""
    if isinstance(value, bool | None):
        return f"{key}-{'null' if value is None else str(value).lower()}", True
    if isinstance(value, int | float):
        return f"{key}{value}", True
    if isinstance(value, Mapping):
        return key, False
    text = value if isinstance(value, str) else "+".join(map(str, value))
    end = "-".join(Path(text).parts[-2:])
    short = re.sub(r"[^\w.+-]+", "-", end)[:_LONGEST_VALUE].strip("-")
    return f"{key}-{short}", short == text
