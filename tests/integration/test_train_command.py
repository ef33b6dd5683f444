"""The real ``python train.py``: what it writes, logs and refuses, and how it goes on after an interruption."""

import contextlib
import csv
import importlib.util
import json
import os
import re
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from commands import Program, run_python
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import dsr.app.train as command
import dsr.app.trainer as trainer_module
from dsr.app.entry import run_command
from dsr.app.evaluate import evaluate
from dsr.training import loggers
from dsr.training.module import SuperResolution
from dsr.utils.progress import SILENT

REPOSITORY = Path(__file__).resolve().parents[2]
SMOKE = (
    "trainer=smoke", "dataset=procedural", "dataset.count=6", "dataset.size=64", "metrics.lpips=false", "device=cpu",
    "model.scheduler.warmup=1",
)  # fmt: skip
FOUR = (*SMOKE, "trainer.max_steps=4", "trainer.val_check_interval=2", "output_dir=out")


def interrupted(step, home="out"):
    return f"interrupted at step {step}; resume={home} continues from there"


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def environment(dsr_cache):
    kept = {key: value for key, value in os.environ.items() if key not in ("DSR_LPIPS_TRUNK", "HYDRA_FULL_ERROR")}
    return {**kept, "DSR_CACHE": str(dsr_cache), "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def smoke(tmp_path_factory, environment):
    """The working directory, the run's directory and the finished process of a smoke training."""
    folder = tmp_path_factory.mktemp("smoke")
    done = run_python(str(REPOSITORY / "train.py"), *SMOKE, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    [home] = (folder / "outputs" / "train").iterdir()
    return folder, home, done


@pytest.fixture
def within(monkeypatch, tmp_path, capfd):
    """Return a runner of the commands within this process: the exit code, the output and the error lines."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DSR_LPIPS_TRUNK", raising=False)
    for name, value in (("HYDRA_FULL_ERROR", "1"), ("PL_GLOBAL_SEED", "0"), ("PL_SEED_WORKERS", "1")):
        monkeypatch.setenv(name, value)  # and so put back afterwards

    def call(*arguments, name="train"):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        code = 0
        try:
            run_command(name, {"train": command.train, "eval": evaluate}[name])
        except SystemExit as ended:
            code = ended.code
        captured = capfd.readouterr()
        return code, captured.out, captured.err.splitlines()

    return call


@pytest.fixture
def interrupt(monkeypatch):
    """Return a function after which trainings are interrupted when they are about to do a step; None: not."""
    bar = trainer_module.StepProgress

    def at(step):
        class Interrupting(bar):
            def on_train_batch_start(self, trainer, *_):
                if trainer.global_step == step:
                    raise KeyboardInterrupt

        monkeypatch.setattr(trainer_module, "StepProgress", Interrupting if step is not None else bar)

    return at


@pytest.fixture
def stop(monkeypatch):
    """Return a function after which trainings get Ctrl-C in a hook once some steps are done; None: not."""
    bar = trainer_module.StepProgress

    def at(step, hook="on_validation_start"):
        def send(self, trainer, *rest):
            getattr(bar, hook)(self, trainer, *rest)
            if trainer.global_step == step:
                os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(trainer_module, "StepProgress", type("Stopping", (bar,), {hook: send}))

    return at


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


def test_training_reports_its_plan_and_where_the_weights_are(smoke):
    _, home, done = smoke
    lines = done.stdout.splitlines()
    assert re.fullmatch(r"model  msg_v x4, 326,015 parameters, (float32|bfloat16)", lines[0])
    assert lines[1] == "data   5 scenes of procedural to train on, 1 of procedural to validate with"
    assert lines[2] == "loss   lap1 + w MSE_v; w is computed from the scenes"
    assert lines[3] == "steps  2 of 2 patches of 32 x 32"
    assert lines[4] == f"log    tensorboard --logdir outputs/train/{home.name}"
    assert any(line.startswith("time   about ") for line in lines)
    prepared = [line for line in lines if line.startswith("prepare ")]
    assert [line.split(": ")[1].split(",")[0] for line in prepared] == [*(f"{n} of 5" for n in range(1, 6)), "1 of 1"]
    assert re.fullmatch(r"loss   lap1 \+ \d\.\d+ MSE_v", lines[lines.index(prepared[-1]) + 1])
    assert validated(done.stdout) == [0, 1, 2]
    assert lines[-1:] == [f"weights: outputs/train/{home.name}/weights.safetensors"]
    assert done.stderr == ""


@pytest.mark.usefixtures("line_per_report")
def test_steps_and_validations_have_lines_with_named_times_off_a_terminal(within):
    code, output, errors = within(*SMOKE, "patches.validation_scenes=2", "output_dir=out")
    assert (code, errors) == (0, [])
    times = r"elapsed \d:\d\d:\d\d, remaining \d:\d\d:\d\d"
    assert re.search(rf"^train: 1 of 2, {times}, loss \d+\.\d{{4}}$", output, re.MULTILINE)
    whole = r"train loss \d+\.\d{4} \(1 of 2, remaining \d:\d\d:\d\d\)"
    assert re.search(rf"^{whole}: validate: 1 of 2, {times}$", output, re.MULTILINE)


def test_training_writes_the_documented_files_and_nothing_else(smoke):
    folder, home, _ = smoke
    assert home.name == "msg_v_x4_smoke_count6_size64_warmup1_seed0"
    [events] = (home / "tensorboard").glob("events.*")
    assert tree(home) == [
        "checkpoints/best.ckpt", "checkpoints/last.ckpt", "config.yaml",
        f"tensorboard/{events.name}", "tensorboard/hparams.yaml", "validation.csv", "versions.json",
        "weights.safetensors",
    ]  # fmt: skip
    assert [path.name for path in folder.iterdir()] == ["outputs"]


def test_config_yaml_is_the_resolved_configuration(smoke):
    text = (smoke[1] / "config.yaml").read_text()
    assert "${" not in text
    assert "???" not in text
    config = yaml.safe_load(text)
    assert config["patches"]["patch"] == 32
    assert config["names"]["trainer"] == "smoke"
    assert config["dataset"]["size"] == 64
    assert config["names"]["model"] == "msg_v"
    assert config["loss"] == {"visual": "mse_v", "w": "auto"}


def test_versions_json_records_what_made_the_weights(smoke):
    record = json.loads((smoke[1] / "versions.json").read_text())
    assert record["packages"]["torch"] == torch.__version__
    assert record["identity"]["device"] == "cpu"
    assert record["identity"]["trainer"]["max_steps"] == 2
    assert "method" not in record["identity"]


def test_log_has_losses_scores_rates_renderings_and_the_configuration(smoke):
    home = smoke[1]
    events = events_of(home)
    tags = events.Tags()
    scores = {f"val/{name}" for name in ("RMSE_d", "RMSE_v", "DSSIM_v", "Bumpiness_d", "BadPix_v_5", "RMSE_v1")}
    assert scores | {"train/loss", "train/lap1", "train/mse_v", "train/learning_rate"} <= set(tags["scalars"])
    assert not any("LPIPS" in tag for tag in tags["scalars"])
    assert {tag.partition("/")[0] for tag in tags["scalars"]} == {"train", "val", "bicubic", "score"}
    assert sorted(scalars_of(home, "val/DSSIM_v")) == sorted(scalars_of(home, "val/RMSE_v"))
    for tag, most in {"val/RMSE_v": 2000, "val/DSSIM_v": 2000, "train/loss": 5}.items():
        assert all(0 < value < most for value in scalars_of(home, tag).values())
    assert list(scalars_of(home, "train/learning_rate").values()) == pytest.approx([1e-3, 1e-3])
    assert tags["images"] == ["renderings/procedural_0"]
    image = events.Images("renderings/procedural_0")[0]
    assert (image.height, image.width) == (4 * (128 + 16), 4 * 128)
    [text] = events.Tensors("config/text_summary")
    assert "validation_scenes: 1" in text.tensor_proto.string_val[0].decode()


def test_log_table_terminal_and_pictures_agree_on_the_number_of_the_step(smoke):
    home = smoke[1]
    with (home / "validation.csv").open(newline="") as file:
        table = sorted({int(row["step"]) for row in csv.DictReader(file)})
    assert validated(smoke[2].stdout) == table
    assert sorted(scalars_of(home, "val/RMSE_v")) == table
    assert [image.step for image in events_of(home).Images("renderings/procedural_0")] == table
    for tag in ("train/loss", "train/gradient_norm", "train/learning_rate", "train/patches_per_second"):
        assert sorted(scalars_of(home, tag)) == [1, 2], tag


def test_training_loss_is_the_sum_of_its_terms(smoke):
    loss, depth, visual = (scalars_of(smoke[1], f"train/{name}") for name in ("loss", "lap1", "mse_v"))
    w = float(smoke[2].stdout.split("lap1 + ")[-1].split()[0])
    for step, value in loss.items():
        assert value == pytest.approx(depth[step] + w * visual[step], rel=2e-3)


def test_repeated_command_is_refused_and_changes_nothing(smoke, within, monkeypatch):
    folder, home, _ = smoke
    monkeypatch.chdir(folder)
    before = {name: (home / name).read_bytes() for name in tree(home)}
    code, output, errors = within(*SMOKE)
    assert (code, output) == (2, "")
    file = f"outputs/train/{home.name}/weights.safetensors"
    assert errors == [f"error: output_dir: {file} is trained already; overwrite=true trains it again"]
    assert {name: (home / name).read_bytes() for name in tree(home)} == before


def test_overwrite_trains_anew(smoke, tmp_path, within):
    shutil.copytree(smoke[1], tmp_path / "out")
    (tmp_path / "out" / "weights.safetensors").write_bytes(b"old")
    code, output, errors = within(*SMOKE, "output_dir=out", "overwrite=true")
    assert (code, errors) == (0, [])
    assert "resumed" not in output
    assert validated(output) == [0, 1, 2]
    assert same_weights(tmp_path / "out", smoke[1])
    assert len(list((tmp_path / "out" / "tensorboard").glob("events.*"))) == 1


def test_interrupted_overwrite_leaves_no_weights_of_the_run_before(smoke, tmp_path, within, interrupt):
    shutil.copytree(smoke[1], tmp_path / "out")
    arguments = (*SMOKE, "output_dir=out", "seed=1")
    interrupt(1)
    assert within(*arguments, "overwrite=true")[0] == 130
    assert not (tmp_path / "out" / "weights.safetensors").exists()
    interrupt(None)
    code, output, errors = within(*arguments)
    assert (code, errors) == (0, [])
    assert "resumed" in output
    assert not same_weights(tmp_path / "out", smoke[1])


def test_directory_of_another_training_is_kept(tmp_path, within, interrupt):
    interrupt(1)
    assert within(*SMOKE, "output_dir=out")[0] == 130
    before = tree(tmp_path)
    code, _, errors = within(*SMOKE, "output_dir=out", "seed=1", "patches.batch=1")
    assert code == 2
    assert errors == [
        "error: output_dir: out holds a run with another patches.batch, seed; another output_dir keeps it, "
        "overwrite=true replaces it"
    ]
    assert tree(tmp_path) == before


def test_evaluation_with_the_weights_scores_like_the_best_validation(smoke, tmp_path, within):
    home = smoke[1]
    code, _, errors = within(
        "method=msg_v", f"weights='{home / 'weights.safetensors'}'", "dataset=procedural", "dataset.count=6",
        "dataset.size=64", "metrics.lpips=false", "device=cpu", "method.ensemble=1", "output_dir=out", name="eval",
    )  # fmt: skip
    assert (code, errors) == (0, [])
    with (tmp_path / "out" / "scores.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["scene"] == "00005" and row["variant"] in ("", "max")]
    worst = {row["metric"]: float(row["value"]) for row in rows}
    validations = scalars_of(home, "val/RMSE_v")
    best = min(validations, key=validations.get)
    for name, factor in {"RMSE_v": 1000, "RMSE_d": 1000, "DSSIM_v": 1000, "Bumpiness_d": 1}.items():
        assert factor * worst[name] == pytest.approx(scalars_of(home, f"val/{name}")[best], rel=1e-4), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["method=msg"], "expected weights of model msg, got those of msg_v"),
        (["method=msg_v", "scale=8"], "weights are for scale 4, the run is at scale 8"),
    ],
)
def test_evaluation_refuses_weights_of_another_model_or_scale(smoke, tmp_path, within, arguments, message):
    path = smoke[1] / "weights.safetensors"
    code, output, errors = within(
        *arguments, f"weights='{path}'", "dataset.size=64", "metrics.lpips=false", name="eval"
    )
    assert (code, output) == (2, "")
    assert errors == [f"error: {path}: {message}"]
    assert tree(tmp_path) == []


def test_msg_is_trained_on_depth_alone_and_its_weights_are_those_of_method_msg(tmp_path, within):
    code, output, errors = within(*SMOKE, "model=msg", "output_dir=out", "scale=2")
    assert (code, errors) == (0, [])
    assert "loss   mse" in output.splitlines()
    assert "train/mse_v" not in events_of(tmp_path / "out").Tags()["scalars"]
    code, _, errors = within(
        "method=msg", "weights=out/weights.safetensors", "scale=2", "dataset.size=64", "dataset.scenes=[statue]",
        "metrics.lpips=false", "output_dir=scores", name="eval",
    )  # fmt: skip
    assert (code, errors) == (0, [])


def test_last_steps_are_validated_where_the_interval_does_not_divide_them(tmp_path, within):
    code, output, errors = within(*SMOKE, "trainer.max_steps=3", "trainer.val_check_interval=2", "output_dir=out")
    assert (code, errors) == (0, [])
    assert validated(output) == [0, 2, 3]
    assert last_step(tmp_path / "out") == 3


def test_diverged_training_writes_no_weights_and_does_not_diverge_twice(within):
    settings = (*SMOKE, "model.optimizer.lr=1e30", "output_dir=out")
    code, _, errors = within(*settings)
    what = "out: the training diverged at step 1: the validation's RMSE_d is nan, at a learning rate of 1e+30"
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith(f"error: {what}; it has no earlier checkpoint; a lower model.optimizer.lr")
    assert [name for name in tree(Path("out")) if name.endswith((".safetensors", ".ckpt"))] == ["checkpoints/best.ckpt"]
    assert torch.load("out/checkpoints/best.ckpt", weights_only=True)["global_step"] == 0
    code, output, errors = within(*settings)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith(f"error: {what}, and would again; a lower model.optimizer.lr")
    assert "steps" not in output
    assert within(*SMOKE, "output_dir=out", "overwrite=true")[0] == 0
    assert "diverged.json" not in tree(Path("out"))


def test_mixed_precision_losses_are_close_to_full_precision(smoke, tmp_path, within):
    code, _, errors = within(*SMOKE, "precision=bfloat16", "output_dir=out")
    assert (code, errors) == (0, [])
    full, mixed = (scalars_of(home, "train/loss") for home in (smoke[1], tmp_path / "out"))
    first = min(full)
    assert mixed[first] == pytest.approx(full[first], rel=0.02)
    weights = load_file(tmp_path / "out" / "weights.safetensors").values()
    assert {value.dtype for value in weights} == {torch.float32}


USAGE_ERRORS = {
    "a weight that is none": (["loss.w=abc"], "loss.w: "),
    "a mistyped model": (["model=foo"], "model=foo: unknown; expected one of ddrnet, "),
    "a model taken away": (["~model"], "model: missing; give it as model=..."),
    "a mistyped loss": (["model.objective.depth_loss=l3"], "model.objective.depth_loss: "),
    "a patch the scale does not divide": (["patches.patch=30"], "patches.patch: "),
    "no step": (["trainer.max_steps=0"], "trainer.max_steps: "),
    "a learning rate of nan": (["model.optimizer.lr=nan"], "model.optimizer: "),
    "an argument of the optimiser that there is not": (
        ["+model.optimizer.momentum=0.9"],
        "model.optimizer.momentum: unknown key; ",
    ),
    "a misspelt argument of the trainer": (["+trainer.max_step=3"], "trainer.max_step: unknown key; "),
    "an argument of the trainer that dsr sets": (
        ["+trainer.num_nodes=2"],
        "trainer.num_nodes: unknown key; dsr sets it",
    ),
    "a trainer that Lightning refuses": (["+trainer.gradient_clip_algorithm=foo"], "trainer: "),
    "a network in parts": (["+model.net._partial_=true"], "model.net._partial_: expected an object"),
    "an optimiser that is a text": (["model.scheduler=x"], "model.scheduler: expected"),
    "an unknown argument of the trainer": (["+trainer.tpu_cores=3"], "trainer.tpu_cores: unknown key; trainer takes"),
    "a callback's unknown argument": (["+callbacks.curves.x=1"], "callbacks.curves.x: unknown key; "),
    "an assumed model": (["downsampling.assumed=nearest"], "downsampling.assumed: "),
    "a visual loss of a model without": (
        ["model=msg", "loss.visual=dssim"],
        "loss.visual: model=msg has ",
    ),
    "a weight of a model without": (["model=msg", "loss.w=1"], "loss.w: model=msg has "),
    "a mistyped visual loss": (["loss.visual=ssim"], "loss.visual: "),
    "a visual loss without its network": (["loss.visual=lpips", "metrics.lpips_trunk=none.pth"], "loss.visual: lpips "),
    "a mistyped key": (["trainer.step=3"], "trainer.step: unknown key; expected one of "),
    "too few scenes": (["dataset.count=1"], "patches.validation_scenes: "),
    "a measured map": (["downsampling=measured"], "downsampling: "),
    "a scale": (["scale=3"], "scale: "),
    "a foreign directory": (["output_dir=foreign"], "output_dir: foreign holds files of something else"),
    "a file as directory": (["output_dir=file"], "output_dir: file: expected a folder to write, got a file"),
}


@pytest.mark.parametrize("case", USAGE_ERRORS)
def test_usage_error_is_one_line_with_exit_code_2_and_writes_nothing(tmp_path, within, case):
    arguments, start = USAGE_ERRORS[case]
    (tmp_path / "file").write_text("no directory")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.txt").write_text("precious")
    code, output, errors = within(*SMOKE, *arguments)
    assert (code, output) == (2, "")
    assert len(errors) == 1, errors
    assert errors[0].startswith(f"error: {start}")
    assert tree(tmp_path) == ["file", "foreign/thesis.txt"]
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize("name", loggers.OPTIONAL)
def test_logger_that_is_not_installed_is_named_before_anything_is_written(tmp_path, within, name):
    if importlib.util.find_spec(name) is not None:
        pytest.skip(f"{name} is installed")
    line = f"error: logger={name}: expected {name}, which is not installed; pip install -e '.[{name}]' in a checkout"
    assert within(*SMOKE, f"logger={name}") == (2, "", [line])
    assert tree(tmp_path) == []


def test_list_of_loggers_logs_to_each_and_goes_on_with_each(tmp_path, within, interrupt):
    interrupt(3)
    assert within(*FOUR, "logger=[tensorboard,csv]")[0] == 130
    interrupt(None)
    code, output, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert "log    tensorboard --logdir out, csv\n" in output
    home = tmp_path / "out"
    with (home / "csv" / "metrics.csv").open(newline="") as file:
        rows = {int(row["step"]): row for row in csv.DictReader(file)}
    table = {step: float(row["val/RMSE_v"]) for step, row in rows.items() if row["val/RMSE_v"]}
    assert table == pytest.approx(scalars_of(home, "val/RMSE_v"))
    assert list(table) == [0, 2, 4]
    assert yaml.safe_load((home / "csv" / "hparams.yaml").read_text())["names"]["model"] == "msg_v"
    tags = events_of(home).Tags()
    assert tags["images"] == ["renderings/procedural_0"]
    assert {"config/text_summary", "custom_scalars__config__"} <= set(tags["tensors"])


def test_training_without_a_logger_has_its_table_of_validations(tmp_path, within):
    code, _, errors = within(*SMOKE, "output_dir=out", "~logger")
    assert (code, errors) == (0, [])
    assert not {path.name for path in (tmp_path / "out").iterdir()} & {"tensorboard", "csv"}
    assert (tmp_path / "out" / "validation.csv").is_file()


def test_patch_larger_than_a_scene_is_refused_when_the_scenes_are_there(tmp_path, within):
    code, output, errors = within(*SMOKE, "patches.patch=128")
    assert code == 2
    assert output.startswith("model  msg_v x4, ")
    assert errors == ["error: patches.patch: expected at most 00000's 64 x 64, got 128"]
    assert tree(tmp_path) == []


def test_estimate_is_the_sum_of_scenes_to_prepare_steps_and_validations(within, interrupt, monkeypatch):
    monkeypatch.setattr(command, "seconds_to_prepare", lambda *_: (100.0, 14))
    monkeypatch.setattr(command, "seconds_per_step", lambda *_: 20.0)
    monkeypatch.setattr(command, "seconds_per_validation", lambda *_: 3.0)
    interrupt(3)
    code, output, _ = within(*FOUR, "trainer.val_check_interval=4", "trainer.accumulate_grad_batches=2")
    assert code == 130
    scenes = "2 min for 14 scenes that are not in the cache"
    steps, validations = "3 min for 4 steps of 40 s", "9 s for 3 validations of 3 s"
    assert f"time   about 4 min: {scenes}, {steps}, {validations}, as measured now" in output.splitlines()
    interrupt(None)
    monkeypatch.setattr(command, "seconds_to_prepare", lambda *_: (0.0, 0))
    _, output, _ = within("resume=out")
    assert "time   about 83 s: 80 s for 2 steps of 40 s, 3 s for 1 validation of 3 s, as measured now" in (
        output.splitlines()
    )


def test_scenes_that_are_not_ready_are_counted_and_a_few_measured(monkeypatch):
    class Slow:
        def __init__(self):
            self.ready, self.now = ["a"], 0.0

        def unprepared(self, scenes):
            return [scene for scene in scenes if scene not in self.ready]

        def prepare(self, scenes, say):
            for scene in scenes:
                self.now += 20.0 if scene == "b" else 5.0  # the first one compiles
                self.ready.append(scene)
                yield scene

    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    source = Slow()
    monkeypatch.setattr(time, "perf_counter", lambda: source.now)
    seconds, count = trainer_module.seconds_to_prepare(source, list("abcdefgh"), SILENT)
    assert (count, source.ready) == (4, list("abcd"))
    assert seconds == 4 * 5.0 / 2
    assert trainer_module.seconds_to_prepare(source, list("abcd"), SILENT) == (0, 0)


def test_run_and_its_log_are_there_before_scenes_are_prepared_and_the_same_command_goes_on(
    smoke, tmp_path, within, monkeypatch
):
    seen = []
    prepare = command.prepare_scenes

    def look(*_):
        seen.extend(tree(tmp_path / "out"))
        seen.extend(events_of(tmp_path / "out").Tags()["tensors"])
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "prepare_scenes", look)
    assert within(*SMOKE, "output_dir=out")[0] == 130
    assert {"config.yaml", "versions.json", "config/text_summary", "custom_scalars__config__"} <= set(seen)
    monkeypatch.setattr(command, "prepare_scenes", prepare)
    code, output, errors = within(*SMOKE, "output_dir=out")
    assert (code, errors, validated(output)) == (0, [], [0, 1, 2])
    assert same_weights(tmp_path / "out", smoke[1])


def test_first_validation_changes_no_step(smoke, tmp_path, within, monkeypatch):
    monkeypatch.setattr(trainer_module.FirstValidation, "on_train_start", lambda *_: None)
    code, output, errors = within(*SMOKE, "output_dir=out")
    assert (code, errors, validated(output)) == (0, [], [1, 2])
    assert scalars_of(tmp_path / "out", "train/loss") == scalars_of(smoke[1], "train/loss")
    ends = [torch.load(home / "checkpoints" / "last.ckpt", weights_only=True) for home in (tmp_path / "out", smoke[1])]
    assert all(torch.equal(ends[0]["state_dict"][name], value) for name, value in ends[1]["state_dict"].items())


def test_scores_of_bicubic_interpolation_are_a_line_beside_those_of_the_network(tmp_path, within, interrupt):
    table = (*FOUR, "logger=csv")
    interrupt(3)
    assert within(*table)[0] == 130
    interrupt(None)
    assert within(*table)[0] == 0
    with (tmp_path / "out" / "csv" / "metrics.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["val/RMSE_v"]]
    assert [row["step"] for row in rows] == ["0", "2", "4"]
    names = [name.removeprefix("val/") for name in rows[0] if name.startswith("val/")]
    for name in names:
        [score] = {row[f"bicubic/{name}"] for row in rows}
        assert float(score) > 0, name
    assert len({row["val/RMSE_v"] for row in rows}) == 3
    with (tmp_path / "out" / "validation.csv").open(newline="") as file:
        kept = {(row["step"], row["set"]) for row in csv.DictReader(file)}
    assert kept == {(step, kind) for step in "024" for kind in ("val", "bicubic")}


def test_training_interrupted_during_its_first_validation_begins_with_it_again(smoke, tmp_path, within, stop):
    stop(0)
    assert within(*SMOKE, "output_dir=out")[::2] == (130, [interrupted(0)])
    stop(None)
    code, output, errors = within(*SMOKE, "output_dir=out")
    assert (code, errors, validated(output)) == (0, [], [0, 1, 2])
    assert same_weights(tmp_path / "out", smoke[1])
    assert (tmp_path / "out" / "validation.csv").read_text() == (smoke[1] / "validation.csv").read_text()


def test_weights_that_training_makes_worse_stay(smoke, tmp_path, within):
    weights = smoke[1] / "weights.safetensors"
    code, _, errors = within(*SMOKE, f"start.weights='{weights}'", "model.optimizer.lr=0.01", "output_dir=out")
    assert (code, errors) == (0, [])
    scores = scalars_of(tmp_path / "out", "val/RMSE_v")
    assert min(scores, key=scores.get) == 0
    assert same_weights(tmp_path / "out", smoke[1])


def test_interrupted_training_gives_bit_identical_weights(tmp_path, within, interrupt):
    code, output, errors = within(*FOUR[:-1], "output_dir=whole")
    assert (code, errors) == (0, [])
    assert validated(output) == [0, 2, 4]
    handler = signal.getsignal(signal.SIGINT)
    for step, reached in ((3, 2), (2, 2)):  # within an epoch, then right where it went on
        interrupt(step)
        code, output, errors = within(*FOUR)
        assert (code, errors) == (130, [interrupted(step)])
        assert not (tmp_path / "out" / "weights.safetensors").exists()
        assert last_step(tmp_path / "out") == reached
    assert signal.getsignal(signal.SIGINT) is handler
    interrupt(None)
    code, output, errors = within(*FOUR)
    assert (code, errors) == (0, [])
    assert "steps  4 of 2 patches of 32 x 32, resumed" in output
    assert validated(output) == [4]
    assert same_weights(tmp_path / "out", tmp_path / "whole")
    for tag in ("val/RMSE_v", "train/loss", "train/learning_rate"):
        assert scalars_of(tmp_path / "out", tag) == scalars_of(tmp_path / "whole", tag), tag


def validate_with(monkeypatch, *scores):
    """Let validations have these scores, one after the other."""
    left, end = iter(scores), SuperResolution.on_validation_epoch_end

    def scored(self):
        end(self)
        self.log("val/RMSE_v", next(left), logger=False)

    monkeypatch.setattr(SuperResolution, "on_validation_epoch_end", scored)


def test_training_resumes_from_its_last_validation_even_if_it_was_not_the_best(
    tmp_path, within, interrupt, monkeypatch
):
    validate_with(monkeypatch, 0.3, 0.1, 0.2, 0.3)
    interrupt(2)
    arguments = (*SMOKE, "trainer.max_steps=3", "output_dir=out")
    assert within(*arguments)[0] == 130
    assert last_step(tmp_path / "out") == 2
    interrupt(None)
    code, output, _ = within(*arguments)
    assert (code, validated(output)) == (0, [3])
    best = torch.load(tmp_path / "out" / "checkpoints" / "best.ckpt", weights_only=True)
    assert best["global_step"] == 1
    weights = load_file(tmp_path / "out" / "weights.safetensors")
    assert all(torch.equal(value, best["state_dict"][f"average.{name}"]) for name, value in weights.items())


def test_last_weights_are_kept_on_request(tmp_path, within, monkeypatch):
    validate_with(monkeypatch, 0.1, 0.2, 0.3, 0.4)
    assert within(*SMOKE, "trainer.max_steps=3", "keep=last", "output_dir=out")[0] == 0
    last = torch.load(tmp_path / "out" / "checkpoints" / "last.ckpt", weights_only=True)
    assert last["global_step"] == 3
    weights = load_file(tmp_path / "out" / "weights.safetensors")
    assert all(torch.equal(value, last["state_dict"][f"average.{name}"]) for name, value in weights.items())
    code, _, errors = within(*SMOKE, "keep=first", "output_dir=other")
    assert (code, errors) == (2, ["error: keep: expected one of best, last, got first"])


def test_checkpoint_of_a_stranger_removes_nothing_outside_the_run(tmp_path, within, interrupt):
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "thesis.txt").write_text("precious")
    interrupt(3)
    assert within(*FOUR)[0] == 130
    interrupt(None)
    last = tmp_path / "out" / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(last, weights_only=True)
    [state] = [each for each in checkpoint["callbacks"].values() if each.get("monitor")]
    path = f"{last.parent}/../../victim"
    state |= {"best_k_models": {path: state["kth_value"] + 100}, "kth_best_model_path": path}
    del state["dirpath"]
    torch.save(checkpoint, last)
    code, output, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert (tmp_path / "victim" / "thesis.txt").read_text() == "precious"
    [line] = [line for line in output.splitlines() if "victim" in line]
    assert line == f"note: {path} is not taken from the checkpoint, only files in out/checkpoints are"


EXPANDED = torch.zeros(1, dtype=torch.float64).expand(1 << 20, 1 << 20)  # 8 TB with a first sum


def state_of(checkpoint, monitor):
    [state] = [each for each in checkpoint["callbacks"].values() if each.get("monitor", "") == monitor]
    return state


def damage(*keys, value):
    """Return what sets an entry of a checkpoint, given the keys that lead to it."""

    def change(checkpoint):
        for key in keys[:-1]:
            checkpoint = checkpoint[key]
        checkpoint[keys[-1]] = value

    return change


class Unpickled:
    """Makes a directory where it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


STEPS = (
    "loops", "fit_loop", "epoch_loop.automatic_optimization.optim_progress", "optimizer", "step", "total", "completed",
)  # fmt: skip
BATCHES = ("loops", "fit_loop", "epoch_loop.batch_progress")
GROUP, FIRST = ("optimizer_states", 0, "param_groups", 0), ("optimizer_states", 0, "state", 0)
REFUSED = {
    "arguments that are objects": damage("hyper_parameters", value={"net": Unpickled()}),
    "a state of a callback that is an object": damage("callbacks", "Curves", value=Unpickled()),
    "steps below zero": damage(*FIRST, "step", value=torch.tensor(-5.0)),
    "steps without number": damage(*FIRST, "step", value=torch.tensor(float("nan"))),
    "steps of a vector": damage(*FIRST, "step", value=torch.zeros(1)),
    "no average": lambda checkpoint: checkpoint["optimizer_states"][0]["state"][0].pop("exp_avg_sq"),
    "averages of whole numbers": lambda checkpoint: checkpoint["optimizer_states"][0]["state"][0].update(
        exp_avg=checkpoint["optimizer_states"][0]["state"][0]["exp_avg"].long()
    ),
    "parameters in another order": lambda checkpoint: checkpoint["optimizer_states"][0]["param_groups"][0][
        "params"
    ].reverse(),
    "a group that is none": damage(*GROUP, value=(1,)),
    "one beta": damage(*GROUP, "betas", value=(0.9,)),
    "a rate without number": damage(*GROUP, "lr", value=float("nan")),
    "batches below zero": damage(*BATCHES, "current", "ready", value=-3),
    "more steps than the training has": damage(*STEPS, value=10**12),
    "bicubic scores as text": damage("bicubic", value={"bicubic": {"RMSE": "x"}}),
    "bicubic scores without end": damage("bicubic", value={"bicubic": {"RMSE": 10**400}}),
    "bicubic scores of many": damage("bicubic", value={"bicubic": {"RMSE": torch.zeros(3)}}),
    "bicubic scores without names": damage("bicubic", value=[1]),
    "no callbacks": lambda checkpoint: checkpoint.pop("callbacks"),
    "callbacks without names": damage("callbacks", value=[1]),
    "sums as text": damage("callbacks", "Curves", "sums", value={"train/loss": "x"}),
    "sums that broadcast": damage("callbacks", "Curves", "sums", value={"train/loss": torch.zeros(3, 1000, 2)}),
    "sums that repeat": damage("callbacks", "Curves", "sums", value={"train/loss": EXPANDED}),
    "sums of other names": damage("callbacks", "Curves", "sums", value={"../../x": torch.zeros(2)}),
    "a score as text": lambda checkpoint: state_of(checkpoint, "val/RMSE_v").update(
        best_model_score="x", kth_value="x"
    ),
    "scores as text": lambda checkpoint: state_of(checkpoint, "val/RMSE_v").update(kth_value={"a": 1}),
    "a schedule of methods": damage("lr_schedulers", 0, "base_lrs", value="x"),
    "a schedule as text": damage("lr_schedulers", 0, "last_epoch", value="x"),
    "a schedule of objects": damage("lr_schedulers", 0, "lr_lambdas", value=[{"__call__": 1}]),
    "no schedule": damage("lr_schedulers", value=[]),
    "a rate as text": damage("optimizer_states", 0, "param_groups", 0, "lr", value="x"),
    "a rate without end": damage("optimizer_states", 0, "param_groups", 0, "lr", value=10**400),
    "a rate of many": damage("optimizer_states", 0, "param_groups", 0, "lr", value=torch.zeros(9)),
    "groups without end": damage("optimizer_states", 0, "param_groups", value=[{}] * 9),
    "averages of another size": damage("optimizer_states", 0, "state", 0, "exp_avg", value=torch.zeros(7)),
    "averages that repeat": damage("optimizer_states", 0, "state", 0, "exp_avg", value=EXPANDED),
    "averages as text": damage("optimizer_states", 0, "state", value={0: "x"}),
    "no optimiser": damage("optimizer_states", value=[]),
    "steps as text": damage(*BATCHES, "total", "ready", value="x"),
    "steps of another size": damage(*BATCHES, "current", "ready", value=torch.zeros(3)),
    "no loops": damage("loops", value={}),
    "no weights": damage("state_dict", value={}),
    "weights that repeat": damage("state_dict", "net.guidance.0.conv.weight", value=EXPANDED),
    "a version of no kind": damage("pytorch-lightning_version", value="\x1b[2J"),
    "an earlier version": lambda checkpoint: checkpoint.update(
        {"pytorch-lightning_version": "0.9.0", "checkpoint_callback_best_model_path": "mine/thesis.txt",
         "checkpoint_callback_best": 0.1, "early_stop_callback_wait": 1, "early_stop_callback_patience": 1}
    ),
}  # fmt: skip
NAMED = {
    "more steps than the training has": f"{'.'.join(STEPS)}: expected at most 4 steps, got 1000000000000",
    **dict.fromkeys((name for name in REFUSED if name.startswith("bicubic")), "(bicubic: "),
    "sums as text": "sums",
    "a score as text": "kth_value",
    "a schedule as text": "lr_schedulers.0.last_epoch",
    "no schedule": "lr_schedulers",
    "a rate as text": "optimizer_states.0.param_groups.0.lr",
    "averages of another size": "optimizer_states.0.state.0.exp_avg",
    "averages as text": "optimizer_states.0.state.0",
    "no loops": "loops.fit_loop",
    "no weights": "net.guidance.0.conv.weight",
    "steps below zero": "optimizer_states.0.state.0.step",
    "steps of a vector": "optimizer_states.0.state.0.step",
    "no average": "exp_avg_sq",
    "parameters in another order": "optimizer_states.0.param_groups.0.params",
    "one beta": "optimizer_states.0.param_groups.0.betas",
    "batches below zero": "loops.fit_loop.epoch_loop.batch_progress.current.ready",
}
"""What lines of refused states name."""
TAKEN = {
    "a step that is no tensor": damage(*FIRST, "step", value=3),
    "no averages": lambda checkpoint: checkpoint["optimizer_states"][0]["state"].pop(0),
    "averages of no parameter": damage("optimizer_states", 0, "state", 999, value={"exp_avg": torch.zeros(3)}),
    "another kind of averages": damage(*GROUP, "amsgrad", value=True),
    "callbacks of other classes": lambda checkpoint: checkpoint["callbacks"].update(
        {"OnExceptionCheckpoint": {"dirpath": "mine"}, "BasePredictionWriter": {"output_dir": "mine"},
         "\x1b]0;evil\x07ModelCheckpoint": {"best_model_path": "mine/thesis.txt"}}
    ),
    "files of other names": lambda checkpoint: state_of(checkpoint, None).update(
        {"dirpath": "mine", "filename": "thesis.txt", "last_model_path": "mine/thesis.txt", "best_model_path": "mine"}
    ),
    "parts": damage("hyper_parameters", value={"net": {"_target_": "os.mkdir", "path": "x"}}),
    "another number of steps": damage("global_step", value="x"),
    "a state of the data": damage("PatchData", value={"__dict__": 1, "patches": None}),
    "methods of a schedule": lambda checkpoint: checkpoint["lr_schedulers"][0].update(get_lr="x", optimizer=1),
    "methods of progress": damage("loops", "fit_loop", "epoch_progress", "total", "reset", value=1),
    "methods of a group": damage("optimizer_states", 0, "param_groups", 0, "step", value="x"),
}  # fmt: skip


@pytest.fixture(scope="module")
def stranger(tmp_path_factory, environment):
    """The folder of a run that is interrupted after three steps of four."""
    folder = tmp_path_factory.mktemp("stranger")
    code = (
        "import sys, dsr.app.trainer as made; from dsr.app.entry import run_train\n"
        "class Interrupting(made.StepProgress):\n"
        "    def on_train_batch_start(self, trainer, *_):\n"
        "        if trainer.global_step == 3: raise KeyboardInterrupt\n"
        "if __name__ == '__main__':\n"
        "    made.StepProgress = Interrupting; run_train(sys.argv[1:])"
    )
    (folder / "interrupted.py").write_text(code)
    done = run_python(str(folder / "interrupted.py"), *FOUR, cwd=folder, env=environment)
    assert done.returncode == 130, done.stderr
    return folder / "out"


@pytest.fixture
def crafted(stranger, tmp_path):
    """Return what writes a copy of the run with a changed checkpoint, beside something precious."""

    def write(change):
        shutil.copytree(stranger, tmp_path / "out")
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "thesis.txt").write_text("precious")
        last = tmp_path / "out" / "checkpoints" / "last.ckpt"
        checkpoint = torch.load(last, weights_only=True)
        change(checkpoint)
        torch.save(checkpoint, last)

    return write


@pytest.mark.parametrize("case", REFUSED)
def test_state_that_is_none_of_the_training_is_refused_in_one_line(crafted, tmp_path, within, case):
    crafted(REFUSED[case])
    code, _, errors = within("resume=out")
    line = "error: out/checkpoints/last.ckpt: expected a checkpoint of this training, got a damaged or foreign one"
    assert (code, len(errors)) == (2, 1), errors
    assert errors[0].startswith(line)
    assert NAMED.get(case, "") in errors[0].removeprefix(line)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "out"]
    assert tree(tmp_path / "mine") == ["thesis.txt"]


@pytest.mark.parametrize("case", TAKEN)
def test_state_that_is_not_the_training_s_has_no_say(crafted, tmp_path, within, case):
    crafted(TAKEN[case])
    code, output, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert "\x1b" not in output
    assert last_step(tmp_path / "out") == 4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "out"]
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "precious"


def test_error_of_the_training_itself_is_not_one_of_the_checkpoint(tmp_path, within, interrupt, monkeypatch):
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "own_errors.py").write_text(
        "import torch\nfrom pathlib import Path\nfrom lightning.pytorch.callbacks import Callback\n"
        "def act(trainer):\n"
        "    exec(Path('act').read_text() if Path('act').is_file() else '')\n"
        "class Own(Callback):\n"
        "    def on_train_start(self, trainer, *_):\n        act(trainer)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))
    interrupt(3)
    assert within(*FOUR, "+callbacks.own._target_=own_errors.Own")[0] == 130
    interrupt(None)
    (tmp_path / "act").write_text("{}['of mine']")
    with pytest.raises(KeyError, match="of mine"):
        within("resume=out", "trust=own_errors.Own")
    for line, reported in (
        ("torch.empty(1 << 60)", "error: not enough memory; "),
        ("[each.data.fill_(torch.nan) for each in trainer.model.parameters()]", "error: out: the training diverged at"),
    ):
        (tmp_path / "act").write_text(line)
        code, _, errors = within("resume=out", "trust=own_errors.Own")
        assert code == 2
        assert errors[-1].startswith(reported)


LINKS = {
    "checkpoints": "mine",
    "tensorboard": "mine",
    "csv": "mine",
    "tensorboard/hparams.yaml": "mine/new.yaml",
    "checkpoints/last.ckpt": "last.ckpt",
    "checkpoints/best.ckpt": "mine/thesis.txt",
    "validation.csv": "mine/thesis.txt",
    "weights.safetensors": "nowhere",
    "config.yaml": "config.yaml",
}


@pytest.mark.parametrize("name", LINKS)
def test_link_out_of_the_run_is_refused_and_nothing_is_written(crafted, tmp_path, within, name):
    crafted(lambda checkpoint: None)
    path = tmp_path / "out" / name
    if path.is_file() and LINKS[name] in ("last.ckpt", "config.yaml"):
        path.rename(tmp_path / LINKS[name])
    elif path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    path.symlink_to(tmp_path / LINKS[name])
    before = tree(tmp_path)
    for arguments in (["resume=out"], [*FOUR, "overwrite=true"]):
        code, output, errors = within(*arguments)
        assert (code, output, len(errors)) == (2, "", 1)
        assert f"out/{name}" in errors[0]
    assert tree(tmp_path) == before
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "precious"


def test_run_in_a_folder_that_is_a_link_goes_on(crafted, tmp_path, within):
    crafted(lambda checkpoint: None)
    (tmp_path / "out").rename(tmp_path / "disk")
    (tmp_path / "out").symlink_to("disk")
    code, _, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert (tmp_path / "out").is_symlink()


def test_training_that_lacks_only_its_weights_file_gets_it(smoke, tmp_path, within):
    code, _, _ = within(*SMOKE, "output_dir=out")
    assert code == 0
    (tmp_path / "out" / "weights.safetensors").unlink()
    code, output, errors = within(*SMOKE, "output_dir=out")
    assert (code, errors) == (0, [])
    assert validated(output) == []
    assert same_weights(tmp_path / "out", smoke[1])


@contextlib.contextmanager
def running(tmp_path, environment, *arguments):
    """Run a training of many steps in a process of its own; yield it once there is something to go on from."""
    command = (str(REPOSITORY / "train.py"), *SMOKE, "output_dir=out", *arguments)
    with Program(*command, cwd=tmp_path, env=environment) as process:
        deadline = time.monotonic() + 60
        last = tmp_path / "out" / "checkpoints" / "last.ckpt"
        while not last.exists() and not process.ended and time.monotonic() < deadline:
            time.sleep(0.02)
        yield process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interruption_exits_with_its_signal_saves_its_step_and_says_how_to_resume(tmp_path, environment, number):
    with running(tmp_path, environment, "trainer.max_steps=500", "trainer.val_check_interval=3") as process:
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert not (tmp_path / "out" / "weights.safetensors").exists()
    step = last_step(tmp_path / "out")
    assert 3 <= step < 500
    assert errors == f"{interrupted(step)}\n"


@pytest.mark.parametrize(("steps", "step", "again"), [(6, 4, [6]), (6, 6, []), (5, 5, [])])
def test_training_interrupted_during_a_validation_goes_on_after_it(tmp_path, within, stop, steps, step, again):
    arguments = (*SMOKE, f"trainer.max_steps={steps}", "trainer.val_check_interval=2")
    assert within(*arguments, "output_dir=whole")[0] == 0
    stop(step)
    code, _, errors = within(*arguments, "output_dir=out")
    assert (code, errors) == (130, [interrupted(step)])
    assert last_step(tmp_path / "out") == step
    stop(None)
    code, output, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert validated(output) == again
    assert same_weights(tmp_path / "out", tmp_path / "whole")
    assert (tmp_path / "out" / "validation.csv").read_text() == (tmp_path / "whole" / "validation.csv").read_text()
    assert sorted(path.name for path in (tmp_path / "out" / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]


def test_training_interrupted_during_two_validations_does_no_step_differently(tmp_path, within, stop):
    arguments = (*SMOKE, "trainer.max_steps=3")  # with a validation after each
    assert within(*arguments, "output_dir=whole")[0] == 0
    for step in (1, 2):
        stop(step)
        assert within(*arguments, "output_dir=out")[::2] == (130, [interrupted(step)])
    stop(None)
    code, output, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert validated(output) == [3]
    assert (tmp_path / "out" / "validation.csv").read_text() == (tmp_path / "whole" / "validation.csv").read_text()
    progress, whole = (
        torch.load(tmp_path / home / "checkpoints" / "last.ckpt", weights_only=True)["loops"]
        for home in ("out", "whole")
    )
    assert progress == whole


def test_resume_from_any_step_gives_bit_identical_weights(tmp_path, within, stop):
    arguments = (*SMOKE, "trainer.max_steps=6", "trainer.val_check_interval=4", "trainer.accumulate_grad_batches=2")
    assert within(*arguments, "output_dir=whole")[0] == 0
    stop(3, "on_train_batch_end")
    code, _, errors = within(*arguments, "output_dir=out")
    assert (code, errors) == (130, [interrupted(3)])
    assert last_step(tmp_path / "out") == 3
    stop(None)
    code, output, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert "resumed" in output
    assert validated(output) == [4, 6]
    assert same_weights(tmp_path / "out", tmp_path / "whole")
    assert (tmp_path / "out" / "validation.csv").read_text() == (tmp_path / "whole" / "validation.csv").read_text()
    for tag in ("val/RMSE_v", "train/learning_rate"):
        assert scalars_of(tmp_path / "out", tag) == scalars_of(tmp_path / "whole", tag), tag


def test_killed_run_resumes_to_bit_identical_weights(tmp_path, within, environment):
    many = ("trainer.max_steps=24", "trainer.val_check_interval=4")
    with running(tmp_path, environment, *many) as process:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not (tmp_path / "out" / "weights.safetensors").exists()
    code, output, errors = within("resume=out")
    assert (code, errors) == (0, [])
    assert "resumed" in output
    assert within(*SMOKE, *many, "output_dir=whole")[0] == 0
    assert same_weights(tmp_path / "out", tmp_path / "whole")
    assert (tmp_path / "out" / "validation.csv").read_text() == (tmp_path / "whole" / "validation.csv").read_text()


def test_resume_takes_the_runs_own_configuration_alone(smoke, tmp_path, within):
    code, _, errors = within("resume=nowhere")
    assert (code, errors) == (
        2, ["error: nowhere: expected the directory of a training, it has no readable config.yaml"],
    )  # fmt: skip
    code, _, errors = within(f"resume='{smoke[1]}'", "trainer.max_steps=5", "scale=2")
    assert (code, errors) == (
        2, ["error: resume: continues with the run's own configuration; trainer.max_steps, scale cannot be changed"],
    )  # fmt: skip
    code, _, errors = within(f"resume='{smoke[1]}'")
    assert code == 2
    assert errors[0].endswith("is trained already; overwrite=true trains it again")


def validation_of(home):
    """Return the scores of the last validation, by set and metric, to the last digit."""
    with (home / "validation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {(row["set"], row["metric"]): float(row["value"]) for row in rows if row["step"] == rows[-1]["step"]}


def means_of(folder):
    return json.loads((folder / "summary.json").read_text())["mean"]


def test_evaluation_of_a_run_gives_the_scores_that_training_logged(tmp_path, within):
    code, _, errors = within(
        *SMOKE, "trainer.val_check_interval=2", "patches.validation_scenes=2", "output_dir=out",
        "noise=gaussian_multiplicative", "noise.std=0.01", "seed=3",
    )  # fmt: skip
    assert (code, errors) == (0, [])
    code, output, errors = within("run=out", "metrics.lpips=false", "output_dir=scores", name="eval")
    assert (code, errors) == (0, [])
    assert "cube_high_freq" not in output  # trained on
    logged = {metric: value for (kind, metric), value in validation_of(tmp_path / "out").items() if kind == "val"}
    means = means_of(tmp_path / "scores")
    assert len(means) > 10
    assert means == pytest.approx(logged, rel=1e-14)
    with (tmp_path / "scores" / "scores.csv").open(newline="") as file:
        assert {row["downsampling"] for row in csv.DictReader(file)} == {"box+gaussian_multiplicative-0.01"}


def test_evaluation_of_a_run_on_another_dataset_keeps_its_setting(smoke, tmp_path, within):
    code, _, errors = within(
        f"run='{smoke[1]}'", "dataset=procedural", "dataset.count=1", "dataset.size=64", "metrics.lpips=false",
        "output_dir=scores", name="eval",
    )  # fmt: skip
    assert (code, errors) == (0, [])
    assert json.loads((tmp_path / "scores" / "summary.json").read_text())["dataset"] == "procedural"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run=nowhere"], "nowhere: expected the directory of a training, it has no readable config.yaml"),
        (["run={run}", "method=bicubic"], "method: run={run} sets it, too; leave one of them out"),
        (["run={run}", "scale=8"], "scale: run={run} sets it, too; leave one of them out"),
    ],
)
def test_run_that_cannot_be_evaluated_is_refused(smoke, tmp_path, within, arguments, message):
    run = tmp_path / "run"
    shutil.copytree(smoke[1], run)
    code, output, errors = within(*(each.format(run=run) for each in arguments), "metrics.lpips=false", name="eval")
    assert (code, output, errors) == (2, "", [f"error: {message.format(run=run)}"])


def test_unfinished_run_cannot_be_evaluated(tmp_path, within, interrupt):
    interrupt(1)
    assert within(*SMOKE, "output_dir=out")[0] == 130
    code, _, errors = within("run=out", "metrics.lpips=false", name="eval")
    assert (code, errors) == (2, ["error: run: out has no weights.safetensors; the training is not finished"])


def test_mixtures_train_on_all_parts_and_validate_with_each(tmp_path, within):
    code, output, errors = within(
        "trainer=smoke", "trainer.val_check_interval=2", "metrics.lpips=false", "device=cpu", "output_dir=out",
        "dataset=mixture",
        "dataset.parts.procedural.count=2", "dataset.parts.procedural.size=64",
        "~dataset.parts.folder", "~dataset.shares.folder",
        "+dataset@dataset.parts.other=procedural", "dataset.parts.other.count=6", "dataset.parts.other.size=64",
        "dataset.parts.other.seed=1", "+dataset.shares.other=0.5",
    )  # fmt: skip
    assert (code, errors) == (0, [])
    assert "data   6 scenes of mixture to train on, 1 of procedural, 1 of procedural_2 to validate with" in output
    scores = validation_of(tmp_path / "out")
    sets = ("", "_procedural", "_procedural_2")
    assert {kind for kind, _ in scores} == {f"{what}{each}" for what in ("val", "bicubic") for each in sets}
    mean = (scores["val_procedural", "RMSE_v"] + scores["val_procedural_2", "RMSE_v"]) / 2
    assert scores["val", "RMSE_v"] == pytest.approx(mean, rel=1e-12)
    tags = events_of(tmp_path / "out").Tags()
    assert {"val/RMSE_v", "val_procedural/RMSE_v", "val_procedural_2/DSSIM_v"} <= set(tags["scalars"])
    assert {"renderings/procedural_0", "renderings/procedural_2_0"} <= set(tags["images"])
    code, _, errors = within("run=out", "metrics.lpips=false", "output_dir=scores", name="eval")
    assert (code, errors) == (0, [])
    for kind in ("procedural", "procedural_2"):
        assert means_of(tmp_path / "scores" / kind)["RMSE_v"] == pytest.approx(scores[f"val_{kind}", "RMSE_v"], 1e-14)


def test_other_dataset_validates_beside_the_held_out_scenes(tmp_path, within):
    code, output, errors = within(
        *SMOKE, "output_dir=out", "+dataset@validation.mine=procedural", "validation.mine.count=1",
        "validation.mine.size=64", "validation.mine.seed=9",
    )  # fmt: skip
    assert (code, errors) == (0, [])
    assert "1 of procedural, 1 of mine to validate with" in output
    assert ("val_mine", "DSSIM_v") in validation_of(tmp_path / "out")


def test_evaluation_datasets_are_not_trained_on(within, tmp_path):
    code, _, errors = within("trainer=smoke", "dataset=simgeo", "metrics.lpips=false", "output_dir=out")
    assert (code, errors) == (2, [
        "error: dataset=simgeo: its scenes are to evaluate on, not to train on; "
        "+dataset@validation.simgeo=simgeo validates with them"
    ])  # fmt: skip
    assert not (tmp_path / "out").exists()


def test_training_starts_from_given_weights(smoke, tmp_path, within):
    weights = smoke[1] / "weights.safetensors"
    rate = "model.optimizer.lr=1e-12"
    code, _, errors = within(*SMOKE, f"start.weights='{weights}'", rate, "output_dir=out")
    assert (code, errors) == (0, [])
    one, other = (load_file(folder / "weights.safetensors") for folder in (smoke[1], tmp_path / "out"))
    assert all(torch.allclose(one[name], other[name], atol=1e-6) for name in one)
    code, _, errors = within(*SMOKE, f"start.weights='{weights}'", "model=facets", "output_dir=other")
    assert code == 2
    assert "expected weights of Facets" in errors[0]
    code, _, errors = within(*SMOKE, "start.weights=nowhere", "output_dir=other")
    assert (code, errors) == (2, ["error: start.weights: nowhere: no such weights file"])


def test_network_that_fits_any_scale_starts_from_weights_of_another(tmp_path, within):
    small = ("model=dg", "model.net.stages=1", "model.net.filters=4", "model.net.size=3")
    assert within(*SMOKE, *small, "output_dir=four")[0] == 0
    weights = "start.weights=four/weights.safetensors"
    code, _, errors = within(
        *SMOKE,
        *small,
        "scale=8",
        weights,
        "model.optimizer.lr=1e-12",
        "model.optimizer.weight_decay=0",
        "output_dir=eight",
    )
    assert (code, errors) == (0, [])
    one, other = (load_file(tmp_path / name / "weights.safetensors") for name in ("four", "eight"))
    assert all(torch.allclose(one[name], other[name], atol=1e-6) for name in one)
    code, _, errors = within(*SMOKE, *small, "model.net.filters=5", weights, "output_dir=other")
    assert code == 2
    assert "expected weights of DynamicGuidance" in errors[0]


def test_network_that_depends_on_the_scale_refuses_weights_of_another(smoke, within):
    code, _, errors = within(*SMOKE, "scale=8", f"start.weights='{smoke[1]}/weights.safetensors'", "output_dir=other")
    assert code == 2
    assert errors[0].endswith("weights are for scale 4, the run is at scale 8, where MSGNet has other parameters")


@pytest.mark.parametrize(
    ("model", "size"),
    [
        ("facets", ("degradation=everything", "model.net.deep=8", "model.net.blocks=3")),
        ("facets_box", ("model.net.blocks=1",)),
    ],
)
def test_facets_train_and_their_weights_are_those_of_the_method(tmp_path, within, model, size):
    code, output, errors = within(*SMOKE, f"model={model}", "model.net.width=8", *size, "output_dir=out")
    assert (code, errors) == (0, [])
    assert output.startswith(f"model  {model} x4")
    assert ("loss   20 Lap_1 + RMSE_v + 2 RMSE (8 of soft maps)" in output) == (model == "facets")
    code, _, errors = within(
        f"method={model}", "weights=out/weights.safetensors", "dataset.size=64", "dataset.scenes=[statue]",
        "metrics.lpips=false", "output_dir=scores", name="eval",
    )  # fmt: skip
    assert (code, errors) == (0, [])
    given = ("start.weights=out/weights.safetensors", "start.shared=out/weights.safetensors", "scale=8")
    given = (*given, "start.frozen=[errors.bias]")
    code, _, errors = within(*SMOKE, f"model={model}", "model.net.width=8", *size, *given, "output_dir=larger")
    if model == "facets_box":
        assert code == 2
        assert "weights are for scale 4, the run is at scale 8" in errors[0]
        return
    assert (code, errors) == (0, [])
    first = load_file(tmp_path / "out" / "weights.safetensors")
    last = torch.load(tmp_path / "larger" / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    larger = {name.removeprefix("average."): value for name, value in last.items() if name.startswith("average.")}
    same = {name.split(".")[0] for name, value in first.items() if torch.equal(value, larger.get(name, value + 1))}
    assert same >= {"trunk", "planes", "blend", "wide"}
    assert "choice" not in same
    assert torch.equal(first["errors.bias"], larger["errors.bias"])
    assert not torch.equal(first["errors.weight"], larger["errors.weight"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("model=facets",), "degradation: "),
        (("model=facets", "degradation=everything", "loss.w=2"), "loss.w: "),
        (("start.frozen=[wide.*]",), "start.frozen: "),
        (("degradation=everything", "degradation.soft=2"), "degradation.soft: "),
        (("model=facets", "degradation=everything", "degradation.scales={4: 1, 8: 1}"), "degradation.scales: "),
        (("model=facets", "degradation=everything", "start.weights=SMOKE"), "expected weights of FacetsUNet"),
    ],
)
def test_losses_and_degradations_that_do_not_fit_are_refused(smoke, within, arguments, message):
    given = [each.replace("SMOKE", f"'{smoke[1]}/weights.safetensors'") for each in arguments]
    code, _, errors = within(*SMOKE, *given, "output_dir=refused")
    assert code == 2
    assert len(errors) == 1
    assert message in errors[0]
