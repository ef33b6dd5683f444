"""Every experiment is documented, composes, and is valid; recipes of weights are those that made them."""

import contextlib
import re
from itertools import product

import pytest
from omegaconf import OmegaConf

from dsr.app.composition import compose
from dsr.app.experiments import register_resolvers, with_keys_of_swept_groups, without_overridden_sweeps
from dsr.app.schema import EvalConfig, TrainConfig, plain_config
from dsr.app.training_runs import training_data
from dsr.methods.base import Method
from dsr.methods.networks.weight_choice import packaged_names
from dsr.utils.configuration import ConfigError, build, config_directories, list_choices, load_target

DIRECTORIES = config_directories()
FOLDER = DIRECTORIES[0] / "experiment"
EVALUATIONS = ("all_methods", "downsampling_mismatch", "field_benchmarks", "noise", "paper_tables",
               "published_networks", "sensors", "visual_losses")  # fmt: skip
FULL = ["trainer=full", "dataset.count=800", "model.scheduler.warmup=500"]
PDN = ["model=pdn", *FULL, "model.average=0.998"]
DG = ["model=dg", "model.objective.depth_loss=lap1", "model.objective.w=auto", "dataset.count=800",
      "model.optimizer.weight_decay=0", "model.average=0.998", "precision=float32"]  # fmt: skip
DDRNET = ["model=ddrnet", "dataset.count=360", "model.average=0.998", "patches.photo=0", "precision=float32"]
SPARSE_TO_DENSE = ["model=sparse_to_dense", "dataset.count=360", "patches.photo=0", "patches.patch=192",
                   "patches.batch=4", "precision=bfloat16"]  # fmt: skip
FACETS_BOX = ["model=facets_box", *FULL, "patches.patch=128", "patches.batch=4", "patches.photo=0"]
FACETS = ["model=facets", "degradation=everything", "dataset.count=800", "patches.patch=384", "patches.batch=1",
          "trainer.val_check_interval=2000", "patches.photo=0", "model.optimizer.lr=4e-4", "model.scheduler.warmup=500",
          "model.average=0.9995", "precision=bfloat16"]  # fmt: skip
FIRST = [*FACETS, "degradation.folds=0"]
SECOND = [*FACETS, "model.scheduler.warmup=300", "seed=1"]
SHORT = ["trainer.max_steps=1000", "trainer.val_check_interval=500", "model.scheduler.warmup=100",
         "model.average=0.998", "model.optimizer.lr=3e-4"]  # fmt: skip
MORE_NOISE = [
    "degradation.kernels={box: 0.3, nearest: 0.12, bilinear: 0.12, bicubic: 0.28, gaussian: 0.1, spread: 0.08}",
    "degradation.noises={none: 0.32, white: 0.22, correlated: 0.08, structured: 0.13, flight: 0.12, lidar: 0.05, "
    "stereo: 0.08}",
]  # fmt: skip
CLEAN = [
    *FIRST, "trainer.val_check_interval=1000", "patches.patch=192", "patches.batch=4", "seed=2",
    "degradation.kernels={box: 1, nearest: 0, bilinear: 0, bicubic: 0, gaussian: 0, spread: 0}",
    "degradation.noises={none: 1, white: 0, correlated: 0, structured: 0, flight: 0, lidar: 0, stereo: 0}",
    "degradation.holes={none: 1, blobs: 0, shadows: 0, steps: 0, dark: 0, pixels: 0}",
    "degradation.displaced=0", "degradation.rounded=0", "degradation.soft=0", "degradation.relief=0.15",
    "degradation.photo=0.1", "degradation.textured=0.04", "degradation.told=1",
]  # fmt: skip
MSG_V = ["model=msg_v", *FULL, "loss.w=1.5"]
RECIPES = {
    "msg_v_x4_stage1": ["model=msg_v", *FULL, "loss.w=0.36", "patches.photo=0"],
    "msg_v_x4_stage2": [*MSG_V, "trainer.max_steps=4000", "model.optimizer.lr=4e-4", "model.average=0.999",
                        "patches.photo=0"],
    "msg_v_x4_stage3": [*MSG_V, "trainer.max_steps=4000", "model.optimizer.lr=4e-4", "model.average=0.999"],
    "msg_v_x4": [*MSG_V, "trainer.max_steps=12000", "model.optimizer.lr=6e-4", "seed=1"],
    "msg_v_x8_stage1": ["model=msg_v", "scale=8"],
    "msg_v_x8": [*MSG_V, "scale=8", "trainer.max_steps=12000", "model.optimizer.lr=8e-4", "seed=1"],
    "msg_x4": ["model=msg", *FULL, "trainer.max_steps=10000"],
    "msg_x8": ["model=msg", *FULL, "trainer.max_steps=10000", "scale=8"],
    "msg_v_x4_noisy": [*MSG_V, "noise=gaussian_multiplicative", "noise.std=0.003", "trainer.max_steps=5000",
                       "model.optimizer.lr=6e-4", "seed=2"],
    "facets_box_x4": [*FACETS_BOX, "loss.w=0.27"],
    "facets_box_x8": [*FACETS_BOX, "loss.w=0.28", "scale=8"],
    "facets_x2_stage1": [*FIRST, "scale=2", "degradation.scales={1: 0.6, 2: 0.4}", "patches.patch=192",
                         "trainer.max_steps=12000"],
    "facets_x2": [*SECOND, "scale=2", "degradation.scales={1: 0.75, 2: 0.25}", "degradation.folds=0.4",
                  "degradation.noises={none: 0.2, white: 0.15, correlated: 0.15, structured: 0.2, flight: 0.1, "
                  "lidar: 0.05, stereo: 0.15}", "patches.patch=256", "trainer.max_steps=4200"],
    "facets_x4_stage1": [*FIRST, "trainer.max_steps=26000"],
    "facets_x4": [*SECOND, *MORE_NOISE, "trainer.max_steps=5600"],
    "facets_x4_clean": [*CLEAN, "trainer.max_steps=12800"],
    "facets_x8_stage1": [*FIRST, "scale=8", "trainer.max_steps=10000", "patches.patch=512", "model.optimizer.lr=3e-4"],
    "facets_x8": [*SECOND, *MORE_NOISE, "scale=8", *SHORT, "patches.patch=512",
                  "start.shared=outputs/train/facets_x4/weights.safetensors"],
    "facets_x8_clean": [*CLEAN, "scale=8", "trainer.max_steps=12500", "patches.patch=256", "patches.batch=2",
                        "model.scheduler.warmup=300", "model.average=0.999"],
    "facets_x16": [*FACETS, "scale=16", *SHORT, "patches.patch=512",
                   "start.shared=outputs/train/facets_x4/weights.safetensors"],
    "pdn_x4": [*PDN, "trainer.max_steps=3000", "model.scheduler.warmup=200", "trainer.val_check_interval=1000"],
    "pdn_x8": [*PDN, "scale=8", "trainer.max_steps=1000", "model.scheduler.warmup=50", "model.optimizer.lr=5e-4",
               "trainer.val_check_interval=500"],
    "dg_x4": [*DG, "trainer.max_steps=2000", "trainer.val_check_interval=500", "model.optimizer.lr=0.02",
              "model.scheduler.warmup=100", "patches.patch=64", "patches.batch=5"],
    "dg_x8": [*DG, "scale=8", "trainer.max_steps=1200", "trainer.val_check_interval=400", "model.optimizer.lr=0.01",
              "model.scheduler.warmup=50", "patches.batch=3"],
    "sparse_to_dense_x4": [*SPARSE_TO_DENSE, "trainer.max_steps=16000"],
    "sparse_to_dense_x8": [*SPARSE_TO_DENSE, "scale=8", "trainer.max_steps=5000", "model.optimizer.lr=5e-4",
                           "model.scheduler.warmup=100"],
    "ddrnet_x4": [*DDRNET, "trainer.max_steps=4000", "model.scheduler.warmup=200", "patches.patch=64",
                  "patches.batch=4"],
    "ddrnet_x8": [*DDRNET, "scale=8", "trainer.max_steps=2000", "model.optimizer.lr=5e-4", "model.scheduler.warmup=50",
                  "patches.batch=2"],
}  # fmt: skip
"""The overrides of ``train.py`` that each training had, but for ``start.weights``."""
STARTS = {
    "msg_v_x4_stage2": "outputs/train/msg_v_x4_stage1/weights.safetensors",
    "msg_v_x4_stage3": "outputs/train/msg_v_x4_stage2/weights.safetensors",
    "msg_v_x4": "outputs/train/msg_v_x4_stage3/weights.safetensors",
    "msg_v_x8": "outputs/train/msg_v_x8_stage1/weights.safetensors",
    "msg_v_x4_noisy": "src/dsr/methods/weights/msg_v_x4.safetensors",
    "pdn_x8": "outputs/train/pdn_x4/weights.safetensors",
    "dg_x8": "outputs/train/dg_x4/weights.safetensors",
    "ddrnet_x8": "outputs/train/ddrnet_x4/weights.safetensors",
    "facets_x2_stage1": "outputs/train/facets_x4_stage1/weights.safetensors",
    "facets_x2": "outputs/train/facets_x2_stage1/weights.safetensors",
    "facets_x4_clean": "outputs/train/facets_box_x4/weights.safetensors",
    "facets_x8_clean": "outputs/train/facets_box_x8/weights.safetensors",
    "facets_x4_stage1": "outputs/train/facets_box_x4/weights.safetensors",
    "facets_x4": "outputs/train/facets_x4_stage1/weights.safetensors",
    "facets_x8_stage1": "outputs/train/facets_x4_stage1/weights.safetensors",
    "facets_x8": "outputs/train/facets_x8_stage1/weights.safetensors",
    "facets_x16": "outputs/train/facets_x8/weights.safetensors",
    "sparse_to_dense_x8": "outputs/train/sparse_to_dense_x4/weights.safetensors",
}
"""What they started from."""


def experiment(name, command, *overrides):
    return plain_config(compose(command, [f"+experiment={name}", *overrides], DIRECTORIES))


def sweep_of(name):
    """Return the overrides of each job of an experiment."""
    register_resolvers()
    params = OmegaConf.load(FOLDER / f"{name}.yaml").hydra.sweeper.params
    keys = [(str(key), str(value).split(",")) for key, value in params.items()]
    return [[f"{key}={value}" for (key, _), value in zip(keys, values, strict=True)]
            for values in product(*(values for _, values in keys))]  # fmt: skip


def test_every_experiment_is_tested_here():
    assert list_choices("experiment", DIRECTORIES) == sorted([*EVALUATIONS, *RECIPES])


@pytest.mark.parametrize("name", [*EVALUATIONS, *RECIPES])
def test_an_experiment_opens_with_its_table_figures_cost_and_command(name):
    lines = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "# @package _global_"
    comment = " ".join(line.removeprefix("# ") for line in lines[1:] if line.startswith("#"))
    assert re.search(r"Table: .+ Expected.+\d.+ Cost: .*\d.+ Command: ", comment)
    script, flag = ("eval.py", "-m ") if name in EVALUATIONS else ("train.py", "")
    assert f"Command: python {script} {flag}+experiment={name}" in comment


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_recipe_is_the_training_that_made_the_weights(name):
    documented = plain_config(compose("train", RECIPES[name], DIRECTORIES))
    documented["start"]["weights"] = STARTS.get(name)
    documented["output_dir"] = f"outputs/train/{name}"
    assert experiment(name, "train") == documented


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_is_valid(name):
    settings = TrainConfig.of(experiment(name, "train"))
    build("model", settings.model)
    training_data(settings)


def test_a_recipe_starts_from_weights_that_another_one_makes():
    made = {f"outputs/train/{name}/weights.safetensors" for name in RECIPES}
    packaged = {f"src/dsr/methods/weights/{name}.safetensors" for name in packaged_names()}
    assert set(STARTS.values()) <= made | packaged


def test_all_packaged_weights_have_a_recipe():
    assert {name for name in RECIPES if "stage" not in name} == set(packaged_names())


@pytest.mark.slow
@pytest.mark.parametrize("name", EVALUATIONS)
def test_all_jobs_of_an_experiment_are_valid(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DSR_DATA", raising=False)
    jobs = sweep_of(name)
    assert len(jobs) > 1
    choices = {override for overrides in jobs for override in overrides}
    for choice in sorted(choices):  # each of them, not all combinations
        plain = experiment(name, "eval", choice)
        settings = EvalConfig.of(plain)
        for group in ("downsampling", "noise", "holes"):
            build(group, plain[group])
        absent = plain["names"]["dataset"] in ("lu", "middlebury8", "ddrnet", "rgbdd_real")
        with pytest.raises(ConfigError, match="expected its files in") if absent else contextlib.nullcontext():
            build("dataset", plain["dataset"])
        assert issubclass(load_target("method", settings.method), Method)


def test_paper_tables_runs_the_data_sets_that_are_here(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DSR_DATA", str(tmp_path))
    (tmp_path / "middlebury2014").mkdir()
    (tmp_path / "simgeo").mkdir()
    assert {job[-1] for job in sweep_of("paper_tables")} == {"dataset=simgeo", "dataset=middlebury"}
    assert "left out" in (note := capsys.readouterr().err)
    assert note.count("\n") == 1
    assert "icl" in note


def test_a_value_on_the_command_line_replaces_the_sweep_over_it():
    arguments = ["+experiment=noise", "method=facets", "scale=8"]
    assert without_overridden_sweeps(arguments, DIRECTORIES) == [*arguments, "~hydra.sweeper.params.method"]


def test_keys_of_swept_groups_may_be_added():
    keys = ["method.range=truth", "dataset.root=DIR", "seed=1"]
    for sweep in (["-m", "method=pgsr,svlrm"], ["--multirun", "+experiment=published_networks"]):
        found = with_keys_of_swept_groups([*sweep, *keys], DIRECTORIES)
        assert found[:3] == [*sweep, "++method.range=truth"]
        assert found[4:] == ["seed=1"]
    assert with_keys_of_swept_groups(["-m", "scale=4,8", *keys], DIRECTORIES) == ["-m", "scale=4,8", *keys]
    assert with_keys_of_swept_groups(["method=pgsr", *keys], DIRECTORIES) == ["method=pgsr", *keys]


def test_own_experiments_are_narrowed_too(tmp_path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("hydra: {sweeper: {params: {seed: '0,1'}}}\n")
    found = without_overridden_sweeps(["+experiment=mine", "seed=2"], (*DIRECTORIES, tmp_path))
    assert found[-1] == "~hydra.sweeper.params.seed"


def test_an_experiment_without_a_sweep_is_left_as_it_is():
    arguments = ["+experiment=facets_box_x4", "scale=8"]
    assert without_overridden_sweeps(arguments, DIRECTORIES) == arguments
