"""Read the directory of a training: its configuration, its data, and how to evaluate its network."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dsr.app.schema import Config, TrainConfig, user_directories
from dsr.app.trust import allowed_targets, expect_trusted, read_plain_yaml
from dsr.data.scene_source import SceneSource, SceneSubset
from dsr.degradation.downsampling import Downsampling
from dsr.methods.networks.network import DisparityNetwork
from dsr.training.data_module import Part, PatchData
from dsr.training.degradation import Degradation
from dsr.training.settings import PatchSettings
from dsr.utils.configuration import ConfigError, build, load_target
from dsr.utils.guards import is_number

WEIGHTS = "weights.safetensors"
_FROM_RUN = ("scale", "downsampling", "noise", "seed", "dataset")
_NOT_WITH_RUN = ("method", "scale", "weights")
# The nodes of the arguments that errors of a training's parts begin with.
_NODES = dict.fromkeys((each.name for each in dataclasses.fields(PatchSettings)), "patches")
_NODES |= {"depth_loss": "model.objective", "shading": "model.objective", "visual": "loss"}


def read_config(folder: Path, trust: Any = None) -> dict[str, Any]:
    """Read the configuration of a training, which may come from somebody else, from its run's directory."""
    path = folder / "config.yaml"
    if not path.is_file():
        raise ConfigError(f"{folder}: expected the directory of a training, it has no readable config.yaml")
    config = read_plain_yaml(path)
    if "model" not in config:
        raise ConfigError(f"{folder}: expected the directory of a training, its config.yaml names no model")
    try:
        TrainConfig.of(config)
        for key in ("model", "dataset", "downsampling", "noise"):
            if not isinstance(config["names"].get(key), str):
                raise ConfigError(f"names.{key}: expected text, got {config['names'].get(key)!r:.60}")
        if "_target_" not in (config["model"].get("net") or ()):
            raise ConfigError("model.net._target_: missing")
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    expect_trusted(path, config, allowed_targets(trust, user_directories()))
    return config


def studies_of_run(plain: Config, given: Sequence[str]) -> Iterator[tuple[dict[str, Any], SceneSource | None]]:
    """Yield the evaluations of ``eval.py run=RUN_DIR``: configuration and data set (None for the configuration's own).

    ``given`` are the keys that the command line sets.
    """
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
        raise ConfigError(
            f"{folder / 'config.yaml'}: model.net._target_: expected a network, got {network['_target_']}"
        )
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
        yield {**base, **place, **there}, SceneSubset(source, scenes)


def training_data(settings: TrainConfig, devices: int = 1) -> PatchData:
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
    """Build the data sets to train on, with their fractions."""
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
