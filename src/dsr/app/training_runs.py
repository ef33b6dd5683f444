"""Read the directory of a training: its configuration, its data, and how to evaluate its network."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from dsr.app.moved_targets import update_targets
from dsr.app.schema import TrainConfig, TrainerConfig
from dsr.data.base import SceneSource, SceneSubset
from dsr.degradation.downsampling import Downsampling
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.training.data_module import Part, PatchData
from dsr.training.degradation import Degradation
from dsr.training.settings import PatchSettings
from dsr.utils.builder import ConfigError, build, load_target, with_key

WEIGHTS = "weights.safetensors"
_FROM_RUN = ("scale", "downsampling", "noise", "seed", "dataset")
_NOT_WITH_RUN = ("method", "scale", "weights")


def read_config(folder: Path) -> dict[str, Any]:
    """Read the configuration of a training, with the current paths of its targets.

    Raises:
        ConfigError: the directory is not that of a training.

    """
    try:
        config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    except Exception as error:  # a file that is missing, not text or not YAML raises many types
        raise ConfigError(f"{folder}: expected the directory of a training, it has no readable config.yaml") from error
    if not isinstance(config, dict) or "model" not in config:
        raise ConfigError(f"{folder}: expected the directory of a training, its config.yaml names no model")
    return {str(key): update_targets(value) for key, value in config.items()}


def studies_of_run(
    plain: Mapping[str, Any], given: Sequence[str]
) -> Iterator[tuple[dict[str, Any], SceneSource | None]]:
    """Yield what ``eval.py run=RUN_DIR`` evaluates: configurations, with data sets (None for the configuration's own).

    Args:
        plain: the composed configuration of ``eval.py``.
        given: the keys that the command line sets.

    Raises:
        ConfigError: the directory holds no finished training, or a key contradicts it.

    """
    folder = Path(plain["run"]).expanduser()
    run = read_config(folder)
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise ConfigError(f"run: {folder} has no {WEIGHTS}; the training is not finished")
    for key in given:
        if key.partition(".")[0] in _NOT_WITH_RUN:
            raise ConfigError(f"{key}: run={folder} sets it, too; leave one of them out")
    chosen = {key.partition(".")[0] for key in given}
    own = {key: run[key] for key in _FROM_RUN if key not in chosen}
    name = run["model"]["name"]
    method = {"name": name, "label": name, "model": name, **_as_validated(run["model"])}
    network = str(run["model"]["target"])
    if not network.startswith("dsr."):
        method["network"] = network
    base = {**plain, **own, "method": method, "weights": str(weights)}
    if "dataset" in chosen:
        yield base, None
        return
    data = training_data(TrainConfig.of(run))
    for kind, (source, names) in data.validation_scenes().items():
        several = len(data.validation_sets) > 1 and base["output_dir"] is not None
        place = {"output_dir": str(Path(base["output_dir"]) / kind)} if several else {}
        yield {**base, **place, "dataset": {"name": kind, "validation_of": str(folder)}}, SceneSubset(source, names)


def _as_validated(model: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the method that runs a network as validations do: one pass, told what is known of maps."""
    if issubclass(load_target("model", model), FacetsUNet):
        return {"target": "dsr.methods.networks.any_map.build_any_map"}
    return {"target": "dsr.methods.networks.trained.build_trained", "ensemble": 1}


def training_data(settings: TrainConfig) -> PatchData:
    """Build the patches that the configuration describes."""
    trainer = settings.trainer
    downsampling = build("downsampling", settings.downsampling)
    if not isinstance(downsampling, Downsampling):
        raise ConfigError("downsampling: training needs a model such as box, measured is none")
    degradation = Degradation(settings.scale, downsampling, build("noise", settings.noise))
    everything = build("degradation", settings.degradation)
    validation = {name: build(f"validation.{name}", node) for name, node in settings.validation.items()}
    try:
        patches = PatchSettings(**common(PatchSettings, trainer))
        return PatchData(
            _parts(settings.dataset),
            patches,
            degradation,
            seed=settings.seed,
            validation=validation,
            everything=everything,
        )
    except ValueError as error:
        raise keyed(error) from error


def keyed(error: Exception) -> ConfigError:
    """Return an error of a training's parts as a ConfigError that names the configuration key."""
    names = [field.name for field in dataclasses.fields(TrainerConfig)]
    message = with_key(with_key(str(error), "trainer", names), "model", ["depth_loss", "shading"])
    return ConfigError(with_key(message, "loss", ["visual"]))


def common(target: type, settings: TrainerConfig) -> dict[str, Any]:
    """Return the trainer's settings that are also fields of a dataclass, by name."""
    theirs = {field.name for field in dataclasses.fields(target)}
    return {name: value for name, value in dataclasses.asdict(settings).items() if name in theirs}


def _parts(node: Mapping[str, Any]) -> list[Part]:
    """Build the data sets to train on, with their fractions."""
    if "parts" not in node:
        return [Part(build("dataset", node))]
    parts, fractions = node["parts"], node.get("shares")
    if not isinstance(parts, Mapping) or not isinstance(fractions, Mapping) or parts.keys() != fractions.keys():
        raise ConfigError(f"dataset.shares: expected a number for each of {', '.join(parts)}, got {fractions}")
    for name, fraction in fractions.items():
        if isinstance(fraction, bool) or not isinstance(fraction, (int, float)) or not fraction >= 0:
            raise ConfigError(f"dataset.shares.{name}: expected 0 or a positive number, got {fraction!r}")
    used = {name: fraction for name, fraction in fractions.items() if fraction > 0}
    if not used:
        raise ConfigError("dataset.shares: expected a positive number among them, all are 0")
    return [Part(build(f"dataset.parts.{name}", parts[name]), fraction) for name, fraction in used.items()]
