"""The names of runs, which say what their configurations have that the command's defaults have not.

A name consists of the method or model, the scale, in evaluations the data set, the choices and settings that differ
from the defaults, and the seed: ``msg_v_x8_w0.72_seed0``. The defaults of a choice's settings are those of its file.
What a run computes, such as the weight ``w`` for ``loss.w=auto``, is not in its name.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from dsr.app.composition import compose
from dsr.app.schema import given_keys, plain_config, user_directories
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
_ELSEWHERE = (*NOT_IDENTITY, "scale", "seed", "device", "precision")
"""Keys that are no settings that differ: they are in each name, or a matter of the machine."""
_NO_SETTINGS = ("name", "label", "target", "validation_of")
_LONGEST, _LONGEST_VALUE = 100, 60


def run_name(kind: str, config: Mapping[str, Any], identity: Mapping[str, Any]) -> tuple[str, bool]:
    """Return the name of a run, and whether it says everything that the configuration has.

    Args:
        kind: ``eval`` or ``train``.
        config: the run's configuration.
        identity: see :func:`dsr.app.run_directory.identity_of`.

    """
    head = "method" if "method" in config else "model"
    usual, defaults, complete = _defaults(kind, config)
    named = {group: config[group]["name"] for group in usual if group != head}
    names = [name for group, name in named.items() if name != usual[group] or (kind, group) == ("eval", "dataset")]
    settings = [_setting(key, value) for key, value in _differing(config, defaults, head).items()]
    if config.get("run") is not None:
        settings.append((_setting("run", Path(config["run"]).absolute().name)[0], False))
    elif config.get("weights") != defaults.get("weights"):
        settings.append((f"weights-{str(identity['weights_sha256'])[:8]}", True))
    if "precision" in given_keys():
        settings.append((str(config["precision"]), True))
    name = "_".join((config[head]["name"], f"x{round_ratio(config['scale'])}", *names, *(text for text, _ in settings)))
    complete = complete and all(whole for _, whole in settings) and len(name) <= _LONGEST
    return f"{name[:_LONGEST]}_seed{config['seed']}", complete


def _defaults(kind: str, config: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, Any], bool]:
    """Return the default choices of groups, the defaults for this configuration's choices, and whether all have any."""
    places = config_directories(user_directories())
    listed: Any = OmegaConf.load(places[0] / f"{kind}.yaml")
    usual = {str(group): str(name) for each in listed["defaults"] if not isinstance(each, str)
             for group, name in each.items() if group not in NOT_IDENTITY and group in config}  # fmt: skip
    chosen = {group: str(config[group]["name"]) for group in usual}
    known = [f"{group}={name}" for group, name in chosen.items() if name in list_choices(group, places)]
    composed = _compose(kind, (*known, f"scale={config['scale']}"), tuple(places))
    return usual, plain_config(composed), len(known) == len(chosen)


@functools.lru_cache(maxsize=256)
def _compose(kind: str, overrides: tuple[str, ...], places: tuple[Path, ...]) -> DictConfig:
    """Return a composed configuration, which is not to be changed; what it takes from the environment is read later."""
    return compose(kind, overrides, places)


def _differing(config: Mapping[str, Any], defaults: Mapping[str, Any], head: str) -> dict[str, Any]:
    """Return the settings that differ from the defaults, by the last part of their keys if it is the only one."""
    skipped = (*_ELSEWHERE, head) if config.get("run") is not None else _ELSEWHERE
    groups = {group: node for group, node in config.items() if group not in skipped and isinstance(node, Mapping)}
    found = {}
    for group, node in groups.items():
        for key, value in node.items():
            same = key in defaults.get(group, {}) and defaults[group][key] == value
            if same or key in _NO_SETTINGS or str(key).startswith("weights"):
                continue
            alone = sum(key in other for other in groups.values()) == 1
            found[str(key) if alone else f"{group}.{key}"] = value
    return found


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
