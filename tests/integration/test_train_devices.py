"""Trainings on two devices, processes of this machine that talk by gloo, against trainings on one."""

import csv
import os
from pathlib import Path

import pytest
import torch
from commands import run_python
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

REPOSITORY = Path(__file__).resolve().parents[2]
TRAIN = str(REPOSITORY / "train.py")
SMALL = (
    "trainer=smoke", "dataset=procedural", "dataset.count=6", "dataset.size=64", "metrics.lpips=false", "device=cpu",
    "precision=float32", "trainer.steps=4", "trainer.validate_every=2", "trainer.validation_scenes=3", "seed=3",
    "model=facets", "model.deep=8", "model.blocks=3", "model.width=8", "degradation=everything",
    "scale=2", "degradation.scales={1: 1, 2: 1}",
)  # fmt: skip
TWO = ("trainer.devices=2", "trainer.strategy=ddp")


@pytest.fixture(scope="module")
def environment(dsr_cache):
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("SLURM_", "HYDRA_FULL"))}
    return {**kept, "DSR_CACHE": str(dsr_cache), "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def two(tmp_path_factory, environment):
    """The folder of a training on two devices of 2 patches each, ``two``, and of one on one device of 4, ``one``."""
    folder = tmp_path_factory.mktemp("devices")
    done = run_python(TRAIN, *SMALL, "trainer.batch=4", "output_dir=one", cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    done = run_python(TRAIN, *SMALL, *TWO, "output_dir=two", cwd=folder, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    return folder, done


def scalars(home):
    events = EventAccumulator(str(home / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    return {tag: {event.step: event.value for event in events.Scalars(tag)} for tag in events.Tags()["scalars"]}


def same_weights(one, other):
    first, second = (load_file(folder / "weights.safetensors") for folder in (one, other))
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_losses_and_scores_of_two_devices_are_those_of_one_with_the_same_patches(two):
    folder, done = two
    assert done.stdout.count("weights: ") == 1
    assert "steps  4 of 2 patches of 32 x 32 x 2 devices" in done.stdout
    one, both = (scalars(folder / name) for name in ("one", "two"))
    assert one.keys() == both.keys()
    for tag in one.keys() - {"train/patches_per_second"}:
        assert both[tag] == pytest.approx(one[tag], rel=1e-3, abs=1e-6), tag
    assert len(one["train/loss"]) == 2


def test_each_scene_is_validated_and_shown_once(two):
    folder, _ = two
    for name in ("one", "two"):
        with (folder / name / "validation.csv").open(newline="") as file:
            rows = [(row["step"], row["set"], row["metric"]) for row in csv.DictReader(file)]
        assert len(rows) == len(set(rows)) > 0
        images = EventAccumulator(str(folder / name / "tensorboard")).Reload().Tags()["images"]
        assert images == [f"renderings/procedural_{number}" for number in range(3)]


KILLER = """
import os, signal, sys
sys.path.insert(0, {source!r})
import dsr.app.trainer as trainer

class Killing(trainer.StepProgress):
    def on_train_batch_start(self, each, *_):
        if each.global_step == {step} and each.is_global_zero:
            os.kill(os.getpid(), signal.{name})

trainer.StepProgress = Killing
from dsr.utils.interruption import start
if __name__ == "__main__":
    start("dsr.app.entry", "run_train")
"""


def test_killed_training_of_two_devices_goes_on_to_the_same_weights(two, environment):
    folder, _ = two
    for step, name, code in [(1, "SIGTERM", 143), (3, "SIGKILL", -9)]:
        program = folder / f"killed_{name}.py"
        program.write_text(KILLER.format(source=str(REPOSITORY / "src"), step=step, name=name))
        done = run_python(str(program), *SMALL, *TWO, "output_dir=killed", cwd=folder, env=environment)
        assert done.returncode == code, done.stderr
        assert ("resumed" in done.stdout) == (name == "SIGKILL")
        if name == "SIGTERM":
            assert done.stderr.splitlines() == ["interrupted at step 2; resume=killed goes on from there"]
    done = run_python(TRAIN, *SMALL, *TWO, "output_dir=killed", cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    assert "resumed" in done.stdout
    assert same_weights(folder / "two", folder / "killed")


def test_network_with_layers_that_have_no_part_in_it_trains_on_two_devices(tmp_path, environment):
    fixed = [each for each in SMALL if "scales" not in each]  # three blocks come before the wide layers
    done = run_python(
        TRAIN, *fixed, *TWO, "trainer.steps=2", "output_dir=out", cwd=tmp_path, env=environment
    )  # with layers idle, the second step fails if torch does not look for them
    assert (done.returncode, done.stderr) == (0, "")


def test_job_of_slurm_with_one_task_trains_on_one_device_and_keeps_the_requeue_signal(tmp_path, environment):
    program = tmp_path / "handlers.py"
    program.write_text(
        "import signal, sys\n"
        f"sys.path.insert(0, {str(REPOSITORY / 'src')!r})\n"
        "import dsr.app.trainer as trainer\n"
        "mine = lambda *_: None\n"
        "for number in (signal.SIGUSR1, signal.SIGUSR2):\n"
        "    signal.signal(number, mine)\n"
        "class Looking(trainer.StepProgress):\n"
        "    def on_train_batch_start(self, each, *_):\n"
        "        handlers = [signal.getsignal(n) for n in (signal.SIGUSR1, signal.SIGUSR2)]\n"
        "        print('handlers', handlers[0] is mine, handlers[1])\n"
        "trainer.StepProgress = Looking\n"
        "from dsr.app.entry import run_train\n"
        "if __name__ == '__main__':\n"
        "    run_train()\n"
    )
    slurm = {"SLURM_JOB_ID": "7", "SLURM_JOB_NAME": "wrap", "SLURM_NTASKS": "2", "SLURM_PROCID": "0",
             "SLURM_LOCALID": "0", "SLURM_NODEID": "0", "SLURM_NODELIST": "localhost"}  # fmt: skip
    done = run_python(str(program), *SMALL, "trainer.steps=1", "output_dir=out", cwd=tmp_path, env=environment | slurm)
    assert (done.returncode, done.stderr) == (0, "")
    assert "handlers True <function requeued." in done.stdout  # and none of Lightning's
    assert (tmp_path / "out" / "weights.safetensors").is_file()
