"""Commands in one folder: of the same settings they share the work, others are refused while one is at work there."""

import signal
import time
from pathlib import Path

import pytest
from commands import Program, run_python
from small_frames import write_frames

REPOSITORY = Path(__file__).resolve().parents[2]
UPSAMPLE = ("-m", "dsr", "upsample", "frames", "-o", "out", "--depth-unit", "mm", "--device", "cpu", "--only", "depth",
            "--method", "tgv")  # fmt: skip
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
    "eval, overwritten": (EVALUATE, (*EVALUATE, "method=nearest", "overwrite=true")),
    "train, the same": (TRAIN, TRAIN),
}  # a command, and another one that comes while the first is at work


@pytest.fixture(autouse=True)
def _frames(tmp_path):
    write_frames(tmp_path / "frames", 3, holes=0)


def stop_at_work(program, folder):
    """Stop a program as soon as it is at work in a folder."""
    deadline = time.monotonic() + 120
    while not list(folder.glob(".locks/command-*")):
        assert not program.ended, program.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(0.02)
    program.send_signal(signal.SIGSTOP)


@pytest.mark.parametrize("case", RIVALS)
def test_second_command_is_refused_and_the_first_has_its_results(case, tmp_path):
    first, second = RIVALS[case]
    with Program(*first, cwd=tmp_path) as program:
        stop_at_work(program, tmp_path / "out")
        refused = run_python(*second, cwd=tmp_path)
        program.send_signal(signal.SIGCONT)
        said = program.communicate()
    assert (program.returncode, said[1]) == (0, "")
    assert (refused.returncode, refused.stderr.count("\n"), refused.stderr[:7]) == (2, 1, "error: ")
    assert f"process {program.pid} of " in refused.stderr or " holds a run with another " in refused.stderr
    assert not (tmp_path / "out" / ".locks").exists()


def test_killed_command_keeps_nobody_out(tmp_path):
    first, second = RIVALS["eval, overwritten"]
    with Program(*first, cwd=tmp_path) as program:
        stop_at_work(program, tmp_path / "out")
        program.send_signal(signal.SIGKILL)
        program.communicate()
    done = run_python(*second, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "out" / ".locks").exists()


@pytest.mark.parametrize(
    ("first", "second"),
    [((*UPSAMPLE, "--shard", "1/2"), (*UPSAMPLE, "--shard", "2/2")), (EVALUATE, (*EVALUATE, "workers=2", "threads=1"))],
)
def test_commands_of_the_same_settings_work_together(first, second, tmp_path):
    with Program(*first, cwd=tmp_path) as program:
        stop_at_work(program, tmp_path / "out")
        with Program(*second, cwd=tmp_path) as other:
            deadline = time.monotonic() + 120
            while not other.ended and len(list(tmp_path.glob("out/.locks/command-*"))) < 2:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            program.send_signal(signal.SIGCONT)
            for each in (program, other):
                assert each.communicate()[1] == ""
                assert each.returncode == 0
    assert not (tmp_path / "out" / ".locks").exists()
    assert run_python(*second, cwd=tmp_path).returncode == 0
