"""The real ``python train.py``: what it writes, logs and refuses, and how it goes on after an interruption."""

import csv
import importlib.util
import json
import os
import re
import shutil
import signal
from pathlib import Path

import pytest
import torch
import yaml
from bombs import Trap
from commands import run_python
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from dsr.training.module import SuperResolution
from dsr.utils.runs_table import COLUMNS

REPOSITORY = Path(__file__).resolve().parents[2]
TRAIN = str(REPOSITORY / "train.py")
SMOKE = (
    "trainer=smoke", "dataset=procedural", "dataset.count=6", "dataset.size=64", "metrics.lpips=false", "device=cpu",
    "model.scheduler.warmup=1",
)  # fmt: skip
FOUR = (*SMOKE, "trainer.max_steps=4", "trainer.val_check_interval=4", "trainer.accumulate_grad_batches=2")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """The working directory, the run's directory and the finished process of a smoke training."""
    folder = tmp_path_factory.mktemp("smoke")
    done = run_python(TRAIN, *SMOKE, cwd=folder)
    assert done.returncode == 0, done.stderr
    [home] = (folder / "outputs" / "train").iterdir()
    return folder, home, done


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The directory of a training of four steps that was not interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    done = run_python(TRAIN, *FOUR, "output_dir=whole", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "whole"


@pytest.fixture
def within(in_process):
    """Return a runner of the commands within this process, see there."""
    return lambda *arguments, name="train": in_process(name, *arguments)


@pytest.fixture
def stop(monkeypatch):
    """Return a function after which a method of the module sends Ctrl-C once when some steps are done."""

    def at(step, method="loss_terms"):
        own, sent = getattr(SuperResolution, method), []

        def interrupted(self, *given):
            if self.global_step == step and not sent:
                sent.append(step)
                os.kill(os.getpid(), signal.SIGINT)
            return own(self, *given)

        monkeypatch.setattr(SuperResolution, method, interrupted)

    return at


def defective(*_):
    raise RuntimeError("defective")


def tree(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def same_weights(first, second):
    one, other = (load_file(folder / "weights.safetensors") for folder in (first, second))
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def events_of(home):
    events = EventAccumulator(str(home / "tensorboard"), size_guidance={"tensors": 0, "scalars": 0, "images": 0})
    return events.Reload()


def scalars_of(home, tag):
    return {event.step: event.value for event in events_of(home).Scalars(tag)}


def last_step(home):
    return torch.load(home / "checkpoints" / "last.ckpt", weights_only=True)["global_step"]


def validated(output):
    return [int(line.split()[1]) for line in output.splitlines() if "validation:" in line]


def validations_of(home):
    """Return the raw scores of each validation, by step, set and metric."""
    with (home / "validation.csv").open(newline="") as file:
        return {(int(row["step"]), row["set"], row["metric"]): float(row["value"]) for row in csv.DictReader(file)}


def test_training_reports_what_it_does_and_writes_the_documented_files(smoke):
    folder, home, done = smoke
    assert re.match(r"model  msg_v x4, 326,015 parameters, (float32|bfloat16) on cpu\n", done.stdout)
    assert f"log    tensorboard --logdir outputs/train/{home.name}\n" in done.stdout
    assert validated(done.stdout) == [0, 1, 2]
    assert done.stdout.endswith(f"weights: outputs/train/{home.name}/weights.safetensors\n")
    assert done.stderr == ""
    assert home.name == "msg_v_x4_smoke_count6_size64_warmup1_seed0"
    [events] = (home / "tensorboard").glob("events.*")
    assert tree(home) == [
        "checkpoints/best.ckpt", "checkpoints/last.ckpt", "config.yaml",
        f"tensorboard/{events.name}", "tensorboard/hparams.yaml", "validation.csv", "versions.json",
        "weights.safetensors",
    ]  # fmt: skip
    assert [path.name for path in folder.iterdir()] == ["outputs"]
    config = yaml.safe_load((home / "config.yaml").read_text())
    assert (config["patches"]["patch"], config["names"]["trainer"], config["loss"]["w"]) == (32, "smoke", "auto")
    record = json.loads((home / "versions.json").read_text())
    assert (record["identity"]["device"], record["identity"]["trainer"]["max_steps"]) == ("cpu", 2)


def test_log_has_losses_scores_rates_renderings_and_the_configuration(smoke):
    home = smoke[1]
    events = events_of(home)
    tags = events.Tags()
    scores = {f"val/{name}" for name in ("RMSE_d", "RMSE_v", "DSSIM_v", "Bumpiness_d", "BadPix_v_5", "RMSE_v1")}
    curves = ("loss", "gradient_norm", "learning_rate", "patches_per_second")
    assert scores | {f"train/{name}" for name in (*curves, "lap1", "mse_v")} <= set(tags["scalars"])
    assert {tag.partition("/")[0] for tag in tags["scalars"]} == {"train", "val", "bicubic", "score"}
    assert tags["images"] == ["renderings/procedural_0"]
    assert sorted(scalars_of(home, "val/RMSE_v")) == [image.step for image in events.Images(tags["images"][0])]
    assert sorted(scalars_of(home, "val/RMSE_v")) == sorted({step for step, _, _ in validations_of(home)}) == [0, 1, 2]
    for step, value in scalars_of(home, "val/RMSE_v").items():
        assert value == pytest.approx(1000 * validations_of(home)[step, "val", "RMSE_v"])
    shown = events.summary_metadata["_hparams_/experiment"].plugin_data.content
    assert [each.name for each in HParamsPluginData.FromString(shown).experiment.hparam_infos] == list(COLUMNS)
    w = float(smoke[2].stdout.split("lap1 + ")[-1].split()[0])
    loss, depth, visual = (scalars_of(home, f"train/{name}") for name in ("loss", "lap1", "mse_v"))
    assert loss == pytest.approx({step: depth[step] + w * visual[step] for step in loss}, rel=2e-3)


def test_directory_of_a_training_is_kept_unless_overwrite_is_set(smoke, tmp_path, within):
    shutil.copytree(smoke[1], tmp_path / "out")
    before = {name: (tmp_path / "out" / name).read_bytes() for name in tree(tmp_path / "out")}
    for more, said in (((), "is trained already"), (("seed=1", "patches.batch=1"), "another patches.batch, seed")):
        code, output, [line] = within(*SMOKE, "output_dir=out", *more)
        assert (code, output, line[:19], said in line) == (2, "", "error: output_dir: ", True)
    assert {name: (tmp_path / "out" / name).read_bytes() for name in tree(tmp_path / "out")} == before
    code, output, errors = within(*SMOKE, "output_dir=out", "overwrite=true")
    assert (code, errors, validated(output)) == (0, [], [0, 1, 2])
    assert same_weights(tmp_path / "out", smoke[1])
    assert len(list((tmp_path / "out" / "tensorboard").glob("events.*"))) == 1
    (tmp_path / "out" / "weights.safetensors").unlink()
    code, output, errors = within(*SMOKE, "output_dir=out")
    assert (code, errors, validated(output)) == (0, [], [])
    assert same_weights(tmp_path / "out", smoke[1])


def test_msg_is_trained_on_depth_alone_and_validates_after_its_last_step(tmp_path, within):
    given = ("precision=bfloat16", "model=msg", "scale=2", "trainer.max_steps=3", "trainer.val_check_interval=2")
    code, output, errors = within(*SMOKE, *given, "output_dir=out")
    assert (code, errors, validated(output)) == (0, [], [0, 2, 3])
    assert "loss   mse" in output.splitlines()
    assert "train/mse_v" not in events_of(tmp_path / "out").Tags()["scalars"]
    assert {value.dtype for value in load_file(tmp_path / "out" / "weights.safetensors").values()} == {torch.float32}


def test_diverged_training_writes_no_weights(tmp_path, within):
    code, _, [line] = within(*SMOKE, "model.optimizer.lr=1e30", "output_dir=out")
    assert (code, line[:12]) == (2, "error: out: ")
    assert not list((tmp_path / "out").rglob("*.safetensors"))


USAGE_ERRORS = {
    "model.optimizer: ": ["model.optimizer.lr=nan"],
    "trainer.num_nodes: ": ["+trainer.num_nodes=2"],
    "trainer: ": ["+trainer.gradient_clip_algorithm=foo"],
    "trainer.tpu_cores: ": ["+trainer.tpu_cores=3"],
    "loss.visual: model=msg ": ["model=msg", "loss.visual=dssim"],
    "loss.visual: lpips ": ["loss.visual=lpips", "metrics.lpips_trunk=none.pth"],
    "patches.patch: ": ["patches.patch=128"],
    "start.weights: nowhere: ": ["start.weights=nowhere"],
    "start.frozen: ": ["start.frozen=[wide.*]"],
    "degradation.scales: ": ["model=facets", "degradation=everything", "degradation.scales={4: 1, 8: 1}"],
    "resume: ": ["resume=foreign"],
}


@pytest.mark.parametrize("start", USAGE_ERRORS)
def test_usage_error_is_one_line_with_exit_code_2_and_writes_nothing(tmp_path, within, start):
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.txt").write_text("precious")
    code, _, errors = within(*SMOKE, *USAGE_ERRORS[start])
    assert (code, len(errors)) == (2, 1), errors
    assert errors[0].startswith(f"error: {start}")
    assert tree(tmp_path) == ["foreign/thesis.txt"]


def test_data_set_to_evaluate_on_is_none_to_train_on(within):
    code, _, [line] = within("trainer=smoke", "dataset=simgeo", "metrics.lpips=false")
    assert (code, line[:23]) == (2, "error: dataset=simgeo: ")


@pytest.mark.skipif(importlib.util.find_spec("mlflow") is not None, reason="mlflow is installed")
def test_logger_that_is_not_installed_is_named_before_anything_is_written(tmp_path, within):
    code, output, [line] = within(*SMOKE, "logger=mlflow")
    assert (code, output, line[:22]) == (2, "", "error: logger=mlflow: ")
    assert tree(tmp_path) == []


@pytest.mark.parametrize(
    ("step", "method"),
    [
        (2, "loss_terms"),
        pytest.param(0, "validation_step", marks=pytest.mark.nightly),
        pytest.param(2, "validation_step", marks=pytest.mark.nightly),
    ],
)
def test_interrupted_training_gives_bit_identical_weights_and_logs(
    whole, tmp_path, within, stop, monkeypatch, capfd, step, method
):
    handler = signal.getsignal(signal.SIGINT)
    stop(step, method)
    code, output, errors = within(*FOUR, "output_dir=out")
    reached = step + (method == "loss_terms")
    assert (code, errors[-1]) == (130, f"interrupted at step {reached}; resume=out continues from there")
    assert signal.getsignal(signal.SIGINT) is handler
    assert not (tmp_path / "out" / "weights.safetensors").exists()
    assert not step or last_step(tmp_path / "out") == reached
    if step:
        (tmp_path / "out").rename(tmp_path / "moved")
        (tmp_path / "out").symlink_to("moved")
    if method == "loss_terms":
        with monkeypatch.context() as patch:
            patch.setattr(SuperResolution, "loss_terms", defective)
            with pytest.raises(RuntimeError, match="defective"):  # which is not taken for a damaged checkpoint
                within("resume=out")
        capfd.readouterr()
    code, output, errors = within("resume=out") if step else within(*FOUR, "output_dir=out")
    assert (code, errors) == (0, [])
    assert ("resumed" in output) == (step > 0)
    assert validated(output) == ([0, 2, 4] if step == 0 else [4])
    assert same_weights(tmp_path / "out", whole)
    assert validations_of(tmp_path / "out") == validations_of(whole)
    for tag in ("val/RMSE_v", "train/loss", "train/learning_rate"):
        assert scalars_of(tmp_path / "out", tag) == scalars_of(whole, tag), tag
    assert sorted(path.name for path in (tmp_path / "out" / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]


def test_loggers_log_to_each_and_none_is_none(tmp_path, within, stop):
    stop(1)
    assert within(*SMOKE, "logger=[tensorboard,csv]", "output_dir=out")[0] == 130
    assert within("resume=out")[::2] == (0, [])
    home, table = tmp_path / "out", {}
    for path in sorted((home / "csv").glob("version_*/metrics.csv")):
        with path.open(newline="") as file:
            table |= {int(row["step"]): float(row["val/RMSE_v"]) for row in csv.DictReader(file) if row["val/RMSE_v"]}
    assert table == pytest.approx(scalars_of(home, "val/RMSE_v"))
    assert list(table) == [0, 1, 2]
    assert yaml.safe_load((home / "csv/version_0/hparams.yaml").read_text())["names"]["model"] == "msg_v"
    code, _, errors = within(*SMOKE, "output_dir=silent", "~logger")
    assert (code, errors) == (0, [])
    assert not {path.name for path in (tmp_path / "silent").iterdir()} & {"tensorboard", "csv"}
    assert (tmp_path / "silent" / "validation.csv").is_file()


def test_initial_weights_stay_if_training_makes_them_worse_and_the_last_ones_on_request(smoke, tmp_path, within):
    worse = (*SMOKE, f"start.weights='{smoke[1]}/weights.safetensors'", "model.optimizer.lr=0.01")
    code, _, errors = within(*worse, "output_dir=out")
    assert (code, errors) == (0, [])
    scores = scalars_of(tmp_path / "out", "val/RMSE_v")
    assert min(scores, key=scores.get) == 0
    assert same_weights(tmp_path / "out", smoke[1])
    assert within(*worse, "keep=last", "output_dir=last")[0] == 0
    last = torch.load(tmp_path / "last" / "checkpoints" / "last.ckpt", weights_only=True)
    assert last["global_step"] == 2
    weights = load_file(tmp_path / "last" / "weights.safetensors")
    assert all(torch.equal(value, last["state_dict"][f"average.{name}"]) for name, value in weights.items())


def test_fast_dev_run_does_one_step_and_writes_no_weights(tmp_path, within):
    code, _, errors = within(*SMOKE, "+trainer.fast_dev_run=true", "output_dir=out")
    assert (code, errors) == (0, [])
    assert not [name for name in tree(tmp_path / "out") if name.endswith((".ckpt", ".safetensors"))]


def state_of_best(checkpoint):
    [state] = [each for each in checkpoint["callbacks"].values() if each.get("monitor")]
    return state


REFUSED = {
    "something else": dict.clear,
    "an object": lambda checkpoint: checkpoint.update(hyper_parameters=Trap(Path("executed"))),
    "files elsewhere": lambda checkpoint: state_of_best(checkpoint).update(
        best_k_models={f"{state_of_best(checkpoint)['dirpath']}/../../mine": torch.ones(())}
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_checkpoint_that_is_none_of_the_training_is_refused_in_one_line(smoke, tmp_path, within, case):
    shutil.copytree(smoke[1], tmp_path / "out")
    (tmp_path / "out" / "weights.safetensors").unlink()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    last = tmp_path / "out" / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(last, weights_only=True)
    REFUSED[case](checkpoint)
    torch.save(checkpoint, last)
    code, _, errors = within("resume=out")
    assert (code, len(errors)) == (2, 1), errors
    assert errors[0].startswith("error: out/checkpoints/last.ckpt: expected a checkpoint of this training")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "out"]
    assert tree(tmp_path / "mine") == ["thesis.txt"]


def test_link_out_of_the_run_is_refused_and_nothing_is_written(smoke, tmp_path, within):
    name = "checkpoints/best.ckpt"
    shutil.copytree(smoke[1], tmp_path / "out")
    (tmp_path / "out" / "weights.safetensors").unlink()
    path = tmp_path / "out" / name
    path.rename(tmp_path / "mine")
    path.symlink_to(tmp_path / "mine")
    before = tree(tmp_path)
    for arguments in (["resume=out"], [*SMOKE, "output_dir=out", "overwrite=true"]):
        code, output, errors = within(*arguments)
        assert (code, output, len(errors)) == (2, "", 1)
        assert f"out/{name}" in errors[0]
    assert tree(tmp_path) == before


def means_of(folder):
    return json.loads((folder / "summary.json").read_text())["mean"]


def test_mixtures_validate_with_each_part_and_evaluation_of_the_run_gives_the_scores_logged(tmp_path, within):
    code, output, errors = within(
        "trainer=smoke", "trainer.val_check_interval=2", "metrics.lpips=false", "device=cpu", "output_dir=out",
        "dataset=mixture", "noise=gaussian_multiplicative", "noise.std=0.01", "seed=3", "keep=last",
        "dataset.parts.procedural.count=2", "dataset.parts.procedural.size=64",
        "~dataset.parts.folder", "~dataset.shares.folder",
        "+dataset@dataset.parts.other=procedural", "dataset.parts.other.count=3", "dataset.parts.other.size=64",
        "dataset.parts.other.seed=1", "+dataset.shares.other=0.5", "+dataset@validation.mine=procedural",
        "validation.mine.count=1", "validation.mine.size=64", "validation.mine.seed=9",
    )  # fmt: skip
    assert (code, errors) == (0, [])
    sets = ("procedural", "procedural_2", "mine")
    assert f"data   3 scenes of mixture to train on, {', '.join(f'1 of {each}' for each in sets)} to vali" in output
    scores = {(kind, name): value for (step, kind, name), value in validations_of(tmp_path / "out").items() if step}
    assert {kind for kind, _ in scores} == {f"{what}{each}" for what in ("val", "bicubic") for each in
                                            ("", *(f"_{name}" for name in sets))}  # fmt: skip
    mean = sum(scores[f"val_{each}", "RMSE_v"] for each in sets) / 3
    assert scores["val", "RMSE_v"] == pytest.approx(mean, rel=1e-12)
    assert {"val_procedural/RMSE_v", "val_mine/DSSIM_v"} <= set(events_of(tmp_path / "out").Tags()["scalars"])
    code, _, errors = within("run=out", "metrics.lpips=false", "output_dir=scores", name="eval")
    assert (code, errors) == (0, [])
    for kind in sets:
        logged = {name: value for (each, name), value in scores.items() if each == f"val_{kind}"}
        assert means_of(tmp_path / "scores" / kind) == pytest.approx(logged, rel=1e-14)


def test_run_that_cannot_be_evaluated_is_refused(smoke, tmp_path, within):
    shutil.copytree(smoke[1], tmp_path / "run")
    (tmp_path / "run" / "weights.safetensors").unlink()
    both = (f"run='{smoke[1]}'", "method=bicubic")
    for start, *arguments in (("nowhere", "run=nowhere"), ("method", *both), ("run", "run=run")):
        code, output, [line] = within(*arguments, "metrics.lpips=false", name="eval")
        assert (code, output, line.split(": ")[:2]) == (2, "", ["error", start])


def test_network_that_fits_any_scale_starts_from_weights_of_another(smoke, tmp_path, within):
    small = ("model=dg", "model.net.stages=1", "model.net.filters=4", "model.net.size=3")
    assert within(*SMOKE, *small, "output_dir=four")[0] == 0
    still = ("model.optimizer.lr=1e-12", "model.optimizer.weight_decay=0")
    weights = "start.weights=four/weights.safetensors"
    code, _, errors = within(*SMOKE, *small, "scale=8", weights, *still, "output_dir=eight")
    assert (code, errors) == (0, [])
    one, other = (load_file(tmp_path / name / "weights.safetensors") for name in ("four", "eight"))
    assert all(torch.allclose(one[name], other[name], atol=1e-6) for name in one)
    code, _, errors = within(*SMOKE, "scale=8", f"start.weights='{smoke[1]}/weights.safetensors'", "output_dir=other")
    assert code == 2
    assert f"start.weights: {smoke[1]}/weights.safetensors: " in errors[0]


@pytest.mark.nightly
def test_facets_share_layers_with_weights_of_another_scale_and_some_are_frozen(tmp_path, within):
    small = ("model=facets", "degradation=everything", "model.net.width=8", "model.net.deep=8", "model.net.blocks=3")
    code, output, errors = within(*SMOKE, *small, "output_dir=out")
    assert (code, errors) == (0, [])
    assert "loss   20 Lap_1 + RMSE_v + 2 RMSE (8 of soft maps)" in output
    given = ("start.weights=out/weights.safetensors", "start.shared=out/weights.safetensors", "scale=8")
    code, _, errors = within(*SMOKE, *small, *given, "start.frozen=[errors.bias]", "output_dir=larger")
    assert (code, errors) == (0, [])
    first = load_file(tmp_path / "out" / "weights.safetensors")
    last = torch.load(tmp_path / "larger" / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    larger = {name.removeprefix("average."): value for name, value in last.items() if name.startswith("average.")}
    same = {name.split(".")[0] for name, value in first.items() if torch.equal(value, larger.get(name, value + 1))}
    assert same >= {"trunk", "planes", "blend", "wide"}
    assert "choice" not in same
    assert torch.equal(first["errors.bias"], larger["errors.bias"])
    assert not torch.equal(first["errors.weight"], larger["errors.weight"])


@pytest.mark.nightly
def test_losses_and_scores_of_two_devices_are_those_of_one_with_the_same_patches(tmp_path, monkeypatch):
    for name in [name for name in os.environ if name.startswith("SLURM_")]:
        monkeypatch.delenv(name)
    given = (*SMOKE, "precision=float32", "patches.validation_scenes=3", "trainer.val_check_interval=2")
    for name, more in (("one", ("patches.batch=4",)), ("two", ("trainer.devices=2", "trainer.strategy=ddp"))):
        done = run_python(TRAIN, *given, *more, f"output_dir={name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert done.stdout.count("weights: ") == 1
    assert "steps  2 of 2 patches of 32 x 32 x 2 devices" in done.stdout
    one, two = (validations_of(tmp_path / name) for name in ("one", "two"))
    assert two == pytest.approx(one, rel=1e-3)
    for tag in ("train/loss", "train/gradient_norm"):
        assert scalars_of(tmp_path / "two", tag) == pytest.approx(scalars_of(tmp_path / "one", tag), rel=1e-3)
    assert events_of(tmp_path / "two").Tags()["images"] == [f"renderings/procedural_{number}" for number in range(3)]
