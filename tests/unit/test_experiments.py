"""Every experiment is documented, composes, and is valid."""

import contextlib

import pytest
from omegaconf import OmegaConf

from dsr.app.schema import EvalConfig, TrainConfig, compose, plain_config, register
from dsr.app.training_runs import training_data
from dsr.methods.base import Method
from dsr.methods.weights import packaged_names
from dsr.utils.configuration import ConfigError, build, config_directories, list_choices, load_target

DIRECTORIES = config_directories()
FOLDER = DIRECTORIES[0] / "experiment"
EVALUATIONS = ("all_methods", "downsampling_mismatch", "field_benchmarks", "noise", "paper_tables",
               "published_networks", "reference", "sensors", "visual_losses")  # fmt: skip
RECIPES = [name for name in list_choices("experiment", DIRECTORIES) if name not in EVALUATIONS]


def experiment(name, command, *overrides):
    return plain_config(compose(command, [f"+experiment={name}", *overrides], DIRECTORIES))


def sweep_of(name):
    """Return overrides with each choice of an experiment's sweep, not all their combinations."""
    register()
    params = OmegaConf.load(FOLDER / f"{name}.yaml").hydra.sweeper.params
    keys = {str(key): str(value).split(",") for key, value in params.items()}
    longest = max(map(len, keys.values()))
    return [[f"{key}={values[job % len(values)]}" for key, values in keys.items()] for job in range(longest)]


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_is_valid(name):
    settings = TrainConfig.of(experiment(name, "train"))
    build("model", settings.model)
    training_data(settings)


def test_a_recipe_starts_from_weights_that_another_one_makes():
    starts = [OmegaConf.load(FOLDER / f"{name}.yaml").get("start") or {} for name in RECIPES]
    used = {path for start in starts for key, path in start.items() if key in ("weights", "shared")} - {None}
    made = {f"outputs/train/{name}/weights.safetensors" for name in RECIPES}
    packaged = {f"src/dsr/methods/weights/{name}.safetensors" for name in packaged_names()}
    assert len(used) > 10
    assert used <= made | packaged


@pytest.mark.slow
@pytest.mark.parametrize("name", EVALUATIONS)
def test_all_jobs_of_an_experiment_are_valid(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DSR_DATA", raising=False)
    jobs = sweep_of(name)
    assert len(jobs) > 1
    for overrides in jobs:
        plain = experiment(name, "eval", *overrides)
        settings = EvalConfig.of(plain)
        for group in ("downsampling", "noise", "holes"):
            build(group, plain[group])
        absent = plain["names"]["dataset"] in ("lu", "middlebury8", "ddrnet", "rgbdd_real")
        with pytest.raises(ConfigError, match="expected its files in") if absent else contextlib.nullcontext():
            build("dataset", plain["dataset"])
        assert issubclass(load_target("method", settings.method), Method)
