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
from typing import Any

from omegaconf import DictConfig, OmegaConf

from dsr.app.composition import compose
from dsr.app.schema import NAMED, Config, Identity, given_keys, plain_config, user_directories
from dsr.utils.configuration import config_directories, list_choices
from dsr.utils.ratios import round_ratio

NOT_IDENTITY = ("output_dir", "overwrite", "metrics", "weights", "resume", "run", "trust", "workers", "threads",
                "logger")  # fmt: skip
"""Keys of a configuration that are not in a run's identity, which has the weights by their content."""
_ELSEWHERE = (*NOT_IDENTITY, "names", "scale", "seed", "device", "precision")
"""Keys that are no settings that differ: they are in each name, or a matter of the machine."""
_NO_SETTINGS = ("_target_", "_partial_", "validation_of", "weights_files")
_REFERENCE = re.compile(r"\$\{([a-z_][\w.]*)\}")  # a value that is that of another key
_LONGEST, _LONGEST_VALUE = 100, 60
_ABSENT = object()


def run_name(kind: str, config: Config, identity: Identity) -> tuple[str, bool]:
    """Return the name of a run of ``eval`` or ``train``, and whether it has every setting that is not the default."""
    head = "method" if "method" in config else "model"
    places = config_directories(user_directories())
    listed: Any = OmegaConf.load(places[0] / f"{kind}.yaml")
    usual = {str(group): str(name) for each in listed["defaults"] if not isinstance(each, str)
             for group, name in each.items() if group in NAMED and group in config["names"]}  # fmt: skip
    chosen = {group: str(config["names"][group]) for group in usual}
    known = [f"{group}={name}" for group, name in chosen.items() if name in list_choices(group, places)]
    composed = _compose(kind, (*known, f"scale={config['scale']}"), tuple(places))
    names = [name for group, name in chosen.items()
             if group != head and (name != usual[group] or (kind, group) == ("eval", "dataset"))]  # fmt: skip
    settings = [_setting(key, value) for key, value in _differing(config, composed, head).items()]
    if config.get("run") is not None:
        settings.append((_setting("run", Path(config["run"]).absolute().name)[0], False))
    elif identity["weights_sha256"] is not None and (
        config.get("weights") != plain_config(composed).get("weights")
        or any(key.startswith("method.weights") for key in given_keys())
    ):
        settings.append((f"weights-{str(identity['weights_sha256'])[:8]}", True))
    if "alignment" in identity:
        settings.append(_setting("alignment", identity["alignment"]))
    if "precision" in given_keys():
        settings.append((str(config["precision"]), True))
    begin = (config["names"][head], f"x{round_ratio(config['scale'])}")
    name = "_".join((*begin, *names, *(text for text, _ in settings)))
    complete = len(known) == len(chosen) and all(whole for _, whole in settings) and len(name) <= _LONGEST
    return f"{name[:_LONGEST]}_seed{config['seed']}", complete


@functools.lru_cache(maxsize=256)
def _compose(kind: str, overrides: tuple[str, ...], places: tuple[Path, ...]) -> DictConfig:
    """Return a composed configuration, which is not to be changed; what it takes from the environment is read later."""
    return compose(kind, overrides, places[1:])


def _differing(config: Config, composed: DictConfig, head: str) -> dict[str, Any]:
    """Return the settings that differ from the defaults, by the last part of their keys if it is the only one.

    The default of a value that is another key's, as in ``${loss.w}``, is what ``config`` has for that key.
    """
    found: dict[str, Any] = {}
    count: Counter[str] = Counter()

    def compare(key: str, value: Any, usual: Any, text: Any) -> None:
        if isinstance(text, str) and (reference := _REFERENCE.fullmatch(text)):
            usual = functools.reduce(lambda node, part: node[part], reference[1].split("."), config)
            if value == usual:
                return
        if not isinstance(value, Mapping) or ("." in key and "_target_" not in value):
            count[key.rpartition(".")[2]] += 1
            if value != usual and key.rpartition(".")[2] not in _NO_SETTINGS:
                found[key] = value
            return
        for name, inner in value.items():
            parts = (each.get(name, _ABSENT) if isinstance(each, Mapping) else _ABSENT for each in (usual, text))
            compare(f"{key}.{name}", inner, *parts)

    skipped = (*_ELSEWHERE, head) if config.get("run") is not None else _ELSEWHERE
    plain, texts = plain_config(composed), OmegaConf.to_container(composed, resolve=False)
    for group, node in config.items():
        if group not in skipped and isinstance(node, Mapping):
            compare(group, node, plain.get(group, {}), texts.get(group, {}))  # type: ignore[union-attr]
    ends = {key: key.rpartition(".")[2] for key in found}
    return {ends[key] if count[ends[key]] == 1 else key: value for key, value in found.items()}


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
