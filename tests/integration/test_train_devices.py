"""Trainings on two devices, processes of this machine that talk by gloo, against trainings on one."""

import csv
import os
import socket
from pathlib import Path

import pytest
import torch
from commands import Program, run_python
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

REPOSITORY = Path(__file__).resolve().parents[2]
TRAIN = str(REPOSITORY / "train.py")
SMALL = (
    "trainer=smoke", "dataset=procedural", "dataset.count=6", "dataset.size=64", "metrics.lpips=false", "device=cpu",
    "precision=float32", "trainer.max_steps=4", "trainer.val_check_interval=2", "patches.validation_scenes=3", "seed=3",
    "model=facets", "model.net.deep=8", "model.net.blocks=3", "model.net.width=8", "degradation=everything",
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
    done = run_python(TRAIN, *SMALL, "patches.batch=4", "output_dir=one", cwd=folder, env=environment)
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
        if each.global_step == {step} and each.global_rank in {ranks}:
            os.kill(os.getpid(), signal.{name})

trainer.StepProgress = Killing
from dsr.utils.interruption import start
if __name__ == "__main__":
    start("dsr.app.entry", "run_train")
"""


def killer(folder, step, name, ranks):
    """Write a program that trains until a step at which some of its processes get a signal, and return its path."""
    program = folder / f"{name}_{step}.py"
    program.write_text(KILLER.format(source=str(REPOSITORY / "src"), step=step, name=name, ranks=ranks))
    return str(program)


def as_torchrun(program, folder, environment, *arguments):
    """Run the two processes of a training as torchrun starts them; return their exit codes and lines of errors."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    common = {"TORCHELASTIC_RUN_ID": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2",
              "LOCAL_WORLD_SIZE": "2", "GROUP_RANK": "0"}  # fmt: skip
    pair = [
        Program(program, *SMALL, *TWO, *arguments, cwd=folder,
                env={**environment, **common, "RANK": str(rank), "LOCAL_RANK": str(rank)})
        for rank in range(2)
    ]  # fmt: skip
    errors = [each.communicate(100)[1].splitlines() for each in pair]
    return [each.returncode for each in pair], errors


def test_killed_training_of_two_devices_goes_on_to_the_same_weights(two, environment):
    folder, _ = two
    codes, errors = as_torchrun(killer(folder, 1, "SIGTERM", (0, 1)), folder, environment, "output_dir=killed")
    assert codes == [143, 143], errors
    assert errors == [["interrupted at step 2; resume=killed continues from there"], []]
    program = killer(folder, 3, "SIGKILL", (0,))
    done = run_python(program, *SMALL, *TWO, "output_dir=killed", cwd=folder, env=environment)
    assert done.returncode == -9, done.stderr
    assert "resumed" in done.stdout
    done = run_python(TRAIN, *SMALL, *TWO, "output_dir=killed", cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    assert "resumed" in done.stdout
    assert same_weights(folder / "two", folder / "killed")


def test_process_that_is_lost_ends_the_others_in_one_line(tmp_path, environment):
    some = ("patches.validation_scenes=1", "output_dir=out")  # which the first one validates alone
    codes, errors = as_torchrun(killer(tmp_path, 3, "SIGKILL", (1,)), tmp_path, environment, *some)
    assert codes == [2, -9], errors
    assert len(errors[0]) == 1, errors
    start, end = errors[0][0].split(" (")[0], errors[0][0].rpartition("); ")[2]
    assert start == "error: another process of the training ended"
    assert end == "the same command continues from the latest checkpoint"
    assert errors[1] == []


def test_network_with_layers_that_have_no_part_in_it_trains_on_two_devices(tmp_path, environment):
    fixed = [each for each in SMALL if "scales" not in each]  # three blocks come before the wide layers
    done = run_python(
        TRAIN, *fixed, *TWO, "trainer.max_steps=2", "output_dir=out", cwd=tmp_path, env=environment
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
    done = run_python(
        str(program), *SMALL, "trainer.max_steps=1", "output_dir=out", cwd=tmp_path, env=environment | slurm
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "handlers True <function requeued." in done.stdout  # and none of Lightning's
    assert (tmp_path / "out" / "weights.safetensors").is_file()
