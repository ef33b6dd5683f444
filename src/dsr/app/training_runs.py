"""Read the directory of a training: its configuration, its data, and how to evaluate its network.

The directory may come from somebody else. A ``_target_`` is imported and called with the arguments beside it. A person
who types one, or keeps it in a directory of their own (``--config-dir``), decides that; a run's ``config.yaml`` does
not. In each group it may name the targets that the group's files in dsr's own ``conf`` name. Others need ``trust``.
"""

import contextlib
import dataclasses
import functools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.app.run_directory import IMPORTED, entries_of, imported
from dsr.app.schema import Config, TrainConfig, expect_name, user_directories
from dsr.data.scene_source import SceneSource, subset
from dsr.degradation.downsampling import Downsampling
from dsr.methods.networks.network import DisparityNetwork
from dsr.training.data_module import Part, PatchData
from dsr.training.degradation import Degradation
from dsr.training.settings import PatchSettings
from dsr.utils.configuration import ConfigError, build, config_directories, load_target
from dsr.utils.guards import is_number, read_limited

WEIGHTS = "weights.safetensors"
_FROM_RUN = ("scale", "downsampling", "noise", "seed", "dataset")
_NOT_WITH_RUN = ("method", "scale", "weights")
# The nodes of the arguments that errors of a training's parts begin with.
_NODES = dict.fromkeys((each.name for each in dataclasses.fields(PatchSettings)), "patches")
_NODES |= {"objective": "model", "depth_loss": "model.objective", "shading": "model.objective", "visual": "loss"}
_LARGEST = 1 << 18  # bytes of a run's configuration
_DEEPEST = 30  # nested keys and lists
_GROUP_OF = {"validation": "dataset", "patches": "trainer"}  # whose files name the targets of a key
_LIGHTNING = ("logger", "callbacks", "trainer")  # nodes of Lightning's classes, which write files
_PLACES = ("save_dir", "dir", "root_dir", "tracking_uri")  # of loggers; dsr gives them the run's directory


def read_config(folder: Path, trust: Any = None) -> dict[str, Any]:
    """Read the configuration of a training, which may come from somebody else, from its run's directory."""
    path = folder / "config.yaml"
    config = read_plain_yaml(path) if path.is_file() else {}
    if "model" not in config:
        what = "its config.yaml names no model" if config else "it has no readable config.yaml"
        raise ConfigError(f"{folder}: expected the directory of a training, {what}")
    try:
        TrainConfig.of(config)
        for key in ("model", "dataset", "downsampling", "noise"):
            if not isinstance(config["names"].get(key), str):
                raise ConfigError(f"names.{key}: expected text, got {config['names'].get(key)!r:.60}")
        if "_target_" not in (config["model"].get("net") or ()):
            raise ConfigError("model.net._target_: missing")
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    expect_trusted(path, config, trust, user_directories())
    return config


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


def expect_trusted(path: Path, config: Config, trust: Any, directories: Sequence[Path] = ()) -> None:
    """Check the configuration of a run, which may be a stranger's: what it imports, and which files it names.

    Besides dsr's own, the targets that files in ``directories`` name, in their groups, and those of ``trust`` may be
    imported: null, false, a target or a list of them; true for all that there are.
    """
    if trust is True:
        return
    named = [trust] if isinstance(trust, str) else trust or []
    if not (isinstance(named, list) and all(isinstance(each, str) for each in named)):
        raise ConfigError(f"trust: expected true, false, or targets such as module.Name, got {trust!r}")
    places = (config_directories()[0], *directories)
    allowed = {("", each) for each in named}.union(*map(_targets_in, places))
    for key, target in imported(config):
        group = key[1] if key[1] in ("optimizer", "scheduler") else _GROUP_OF.get(key[0], key[0])
        of_metrics = group == "metrics" and target.startswith("dsr.metrics.")
        if not of_metrics and allowed.isdisjoint({("", target), (group, target)}):
            raise ConfigError(
                f"{path}: {'.'.join(key)}: expected a target of dsr's own {group}, got {target!r}, whose code would "
                f"run; if you trust it, trust={target} allows it, trust=true allows all"
            )
    for key, value in entries_of(config):
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


@functools.cache
def _targets_in(directory: Path) -> frozenset[tuple[str, str]]:
    """Return group ("" outside of groups) and target of all that files name, except methods, which no training has."""
    pattern = re.compile(rf"\b(?:{'|'.join(IMPORTED)}): *([\w.]+)")
    found: set[tuple[str, str]] = set()
    for path in directory.rglob("*.yaml"):
        *groups, _ = path.relative_to(directory).parts
        if groups != ["method"]:
            group = groups[0] if groups and groups != ["experiment"] else ""
            found |= {(group, target) for target in pattern.findall(path.read_text(encoding="utf-8"))}
    return frozenset(found)


def studies_of_run(plain: Config, given: Sequence[str]) -> Iterator[tuple[dict[str, Any], SceneSource | None]]:
    """Yield what ``eval.py run=RUN_DIR`` with ``given`` keys evaluates: settings and data set, None for their own."""
    folder = Path(plain["run"]).expanduser()
    run = read_config(folder, plain.get("trust"))
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise ConfigError(f"run: {folder} has no {WEIGHTS}; the training is not finished")
    for key in given:
        if key.partition(".")[0] in _NOT_WITH_RUN:
            raise ConfigError(f"{key}: run={folder} sets it, too; leave one of them out")
    chosen = {key.partition(".")[0] for key in given}
    own = {key: run[key] for key in _FROM_RUN if key not in chosen}
    name = run["names"]["model"]
    network = run["model"]["net"]
    kind = load_target("model.net", network)
    if not (isinstance(kind, type) and issubclass(kind, DisparityNetwork)):
        raise ConfigError(f"run={folder}: model.net._target_: expected a network, got {network['_target_']}")
    method = {"model": name, **kind.method}
    if not str(network["_target_"]).startswith("dsr."):
        method["network"] = str(network["_target_"])
    names = {**plain["names"], **{key: run["names"][key] for key in own if key in run["names"]}, "method": name}
    base = {**plain, **own, "names": names, "label": None, "method": method, "weights": str(weights)}
    if "dataset" in chosen:
        yield base, None
        return
    data = training_data(TrainConfig.of(run))
    for kind, (source, scenes) in data.held_out.items():
        several = len(data.held_out) > 1 and base["output_dir"] is not None
        place = {"output_dir": str(Path(base["output_dir"]) / kind)} if several else {}
        there = {"names": {**names, "dataset": kind}, "dataset": {"validation_of": str(folder)}}
        yield {**base, **place, **there}, subset(source, scenes)


def training_data(settings: TrainConfig, devices: int = 1, device: torch.device | str = "cpu") -> PatchData:
    """Build the patches that the configuration describes, for a number of devices."""
    downsampling = settings.build("downsampling")
    if not isinstance(downsampling, Downsampling):
        raise ConfigError("downsampling: training needs a model such as box, measured is none")
    degradation = Degradation(settings.scale, downsampling, settings.build("noise"))
    everything = settings.build("degradation")
    validation = {name: build(f"validation.{name}", node) for name, node in settings.validation.items()}
    patches = settings.build("patches")
    if not isinstance(patches, PatchSettings):
        raise ConfigError(f"patches._target_: expected {PatchSettings.__name__}, got {type(patches).__name__}")
    with keyed():
        return PatchData(
            _parts(settings),
            patches,
            degradation,
            seed=settings.seed,
            validation=validation,
            everything=everything,
            patches_per_step=patches.batch * settings.accumulate * devices,
            device=device,
        )


@contextlib.contextmanager
def keyed() -> Iterator[None]:
    """Turn an error of a training's parts into a ConfigError that names the configuration key."""
    try:
        yield
    except (ValueError, OSError) as error:
        node = _NODES.get(str(error).partition(":")[0])
        raise ConfigError(f"{node}.{error}" if node else str(error)) from error


def _parts(settings: TrainConfig) -> list[Part]:
    node = settings.dataset
    if "parts" not in node:
        return [Part(settings.build("dataset"))]
    parts, fractions = node["parts"], node.get("shares")
    if not isinstance(parts, Mapping) or not parts:
        raise ConfigError(f"dataset.parts: expected data sets by name, got {parts!r:.60}")
    if not isinstance(fractions, Mapping) or parts.keys() != fractions.keys():
        raise ConfigError(f"dataset.shares: expected a number for each of {', '.join(parts)}, got {fractions}")
    for name, fraction in fractions.items():
        if not is_number(fraction) or fraction < 0:
            raise ConfigError(f"dataset.shares.{name}: expected 0 or a positive number, got {fraction!r}")
    used = {name: fraction for name, fraction in fractions.items() if fraction > 0}
    if not used:
        raise ConfigError("dataset.shares: expected a positive number among them, all are 0")
    return [Part(build(f"dataset.parts.{name}", parts[name]), fraction) for name, fraction in used.items()]
