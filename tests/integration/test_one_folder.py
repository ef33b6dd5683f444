"""Commands with different settings in one folder: it is that of the one that is at work there, the other is refused."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest
from commands import Program, run_python
from small_frames import write_frames

from dsr.evaluation.sharing import Claims

REPOSITORY = Path(__file__).resolve().parents[2]
UPSAMPLE = ("-m", "dsr", "upsample", "frames", "-o", "out", "--depth-unit", "mm", "--device", "cpu", "--only", "depth",
            "--method", "tgv")  # fmt: skip
ONE = ("-m", "dsr", "upsample", "-o", "out", "--fov", "60", "--device", "cpu", "--only", "depth", "--method", "tgv",
       "--depth-unit", "mm")  # fmt: skip
EVALUATE = (
    str(REPOSITORY / "eval.py"), "dataset=simgeo", "dataset.size=48", "dataset.scenes=[statue,cube_no_texture]",
    "metrics.lpips=false", "device=cpu", "method=bicubic", "output_dir=out",
)  # fmt: skip
TRAIN = (
    str(REPOSITORY / "train.py"), "trainer=smoke", "dataset=procedural", "dataset.count=3", "dataset.size=48",
    "metrics.lpips=false", "device=cpu", "logger=csv", "output_dir=out",
)  # fmt: skip
RIVALS = {
    "upsample, method": (UPSAMPLE, (*UPSAMPLE, "--method", "bicubic")),
    "upsample, unit": (UPSAMPLE, (*UPSAMPLE, "--depth-unit", "0.002")),
    "upsample, overwritten": (UPSAMPLE, (*UPSAMPLE, "--fill", "all", "--overwrite")),
    "eval, method": (EVALUATE, (*EVALUATE, "method=nearest")),
    "eval, overwritten": (EVALUATE, (*EVALUATE, "method=nearest", "overwrite=true")),
    "eval, seed": (EVALUATE, (*EVALUATE, "seed=1")),
    "eval, metrics": (EVALUATE, (*EVALUATE, "metrics=field")),
    "train, scale": (TRAIN, (*TRAIN, "scale=2", "overwrite=true")),
    "train, the same": (TRAIN, TRAIN),
}
"""A command, and another one that comes while the first is at work."""


@pytest.fixture
def environment(tmp_path, dsr_cache):
    write_frames(tmp_path / "frames", 3, holes=0)
    return {**os.environ, "DSR_CACHE": str(dsr_cache), "OMP_NUM_THREADS": "1"}


def is_at_work(folder):
    """Return whether a command takes part in the work on a folder."""
    return any((folder / ".claims").glob("member-*")) if (folder / ".claims").is_dir() else False


def wait_for_members(count, folder, program):
    """Wait until so many processes take part in the work on a folder, or a program has ended."""
    deadline = time.monotonic() + 120
    while not program.ended and len(list((folder / ".claims").glob("member-*"))) < count:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def stop_at_work(program, folder):
    """Stop a program as soon as it is at work in a folder, but not while it becomes a member."""
    deadline = time.monotonic() + 120
    while True:
        assert not program.ended, program.communicate()
        assert time.monotonic() < deadline
        if is_at_work(folder):
            program.send_signal(signal.SIGSTOP)
            if (claim := Claims(folder).take("members")) is not None:
                claim.close()
                return
            program.send_signal(signal.SIGCONT)
        time.sleep(0.002)


@pytest.mark.parametrize("case", RIVALS)
def test_second_command_is_refused_and_the_first_has_its_results(case, tmp_path, environment):
    first, second = RIVALS[case]
    with Program(*first, cwd=tmp_path, env=environment) as program:
        stop_at_work(program, tmp_path / "out")
        refused = run_python(*second, cwd=tmp_path, env=environment)
        program.send_signal(signal.SIGCONT)
        said = program.communicate()
    assert (program.returncode, said[1]) == (0, "")
    assert (refused.returncode, refused.stderr.count("\n"), refused.stderr[:7]) == (2, 1, "error: ")
    assert f"process {program.pid} of " in refused.stderr or " holds a run with another " in refused.stderr
    assert not (tmp_path / "out" / ".claims").exists()
    again = run_python(*first, cwd=tmp_path, env=environment)
    kept = "complete already" in again.stdout or "re-used: 2" in again.stdout or "is trained already" in again.stderr
    assert kept, again


def test_second_picture_waits_for_the_first_and_is_refused(tmp_path, environment):
    pictures = [
        (*ONE, "--rgb", f"frames/rgb/{name}.png", "--depth", f"frames/depth/{name}.png") for name in ("001", "002")
    ]
    with Program(*pictures[0], cwd=tmp_path, env=environment) as first:
        stop_at_work(first, tmp_path / "out")
        with Program(*pictures[1], cwd=tmp_path, env=environment) as second:
            first.send_signal(signal.SIGCONT)
            ends = {}
            for name, program in (("001", first), ("002", second)):
                ends[name] = (program.communicate(), program)
    assert sorted(program.returncode for _, program in ends.values()) == [0, 2]
    [kept] = [name for name, (_, program) in ends.items() if not program.returncode]
    assert json.loads((tmp_path / "out" / "info.json").read_text())["inputs"]["rgb"]["file"] == f"{kept}.png"


@pytest.mark.parametrize("case", ["upsample, method", "eval, overwritten", "train, scale"])
def test_killed_command_keeps_nobody_out(case, tmp_path, environment):
    first, second = RIVALS[case]
    with Program(*first, cwd=tmp_path, env=environment) as program:
        stop_at_work(program, tmp_path / "out")
        program.send_signal(signal.SIGKILL)
        program.communicate()
    done = run_python(*second, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "out" / ".claims").exists()


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((*UPSAMPLE, "--shard", "1/2"), (*UPSAMPLE, "--shard", "2/2", "--workers", "2")),
        (UPSAMPLE, (*UPSAMPLE, "--only", "depth,before_after")),
        (EVALUATE, (*EVALUATE, "workers=2", "threads=1")),
    ],
)
def test_commands_of_the_same_settings_work_together(first, second, tmp_path, environment):
    with Program(*first, cwd=tmp_path, env=environment) as program:
        stop_at_work(program, tmp_path / "out")
        with Program(*second, cwd=tmp_path, env=environment) as other:
            wait_for_members(2, tmp_path / "out", other)
            program.send_signal(signal.SIGCONT)
            for each in (program, other):
                assert each.communicate()[1] == ""
                assert each.returncode == 0
    assert not (tmp_path / "out" / ".claims").exists()
    assert run_python(*second, cwd=tmp_path, env=environment).returncode == 0
