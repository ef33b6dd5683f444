"""``dsr upsample --workers``: the same results from several processes, problems and all."""

import json

import numpy as np
import pytest
from PIL import Image

from dsr.cli import main

FAST = ("--method", "bicubic", "--only", "depth,before_after", "--fov", "60", "--depth-unit", "mm")
KILLER = '''
import os, signal
from pathlib import Path

from dsr.methods.base import Method

class Killer(Method):
    """Repeats pixels; is killed at maps of about 1.3 m, several times, as if for want of memory."""

    range_type = "orthogonal"

    def __init__(self, marks, times):
        self.marks, self.times = Path(marks), times

    def __call__(self, sample, progress=None):
        if 1.29 < float(sample.depth_lr.min()) < 1.31 and len(list(self.marks.iterdir())) < self.times:
            (self.marks / str(os.getpid())).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return sample.depth_lr.repeat_interleave(4, 1).repeat_interleave(4, 2)
'''


def make_frames(folder, count):
    """Write a folder of frames whose depth begins at 1 m, 1.1 m, ..."""
    rng = np.random.default_rng(0)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for number in range(count):
        photo = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(photo).save(folder / "rgb" / f"{number:03}.png")
        depth = (1000 + 100 * number + np.arange(16)[None] * 10 + np.zeros((12, 1))).astype(np.uint16)
        Image.fromarray(depth).save(folder / "depth" / f"{number:03}.png")
    return folder


@pytest.fixture
def folder(tmp_path):
    """Return a folder of five frames, of which one has a damaged depth map."""
    frames = make_frames(tmp_path / "frames", 5)
    (frames / "depth" / "002.png").write_bytes(b"\x89PNG nothing")
    return frames


@pytest.fixture
def killing(tmp_path, monkeypatch):
    """Return a function that upsamples eight frames with two workers that are killed so many times at the fourth."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "killing.py").write_text(KILLER)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    (tmp_path / "conf" / "method").mkdir(parents=True)
    (tmp_path / "marks").mkdir()
    node = f"_target_: killing.Killer\nmarks: {tmp_path / 'marks'}\ntimes: 0\n"
    (tmp_path / "conf" / "method" / "killer.yaml").write_text(node)
    frames = str(make_frames(tmp_path / "frames", 8))
    options = ("--config-dir", str(tmp_path / "conf"), "--only", "depth", "--fov", "60", "--depth-unit", "mm")

    def run(times):
        method = ("--method", "killer", "--set", f"times={times}", "--workers", "2")
        return main(["upsample", frames, "-o", str(tmp_path / "out"), *options, *method])

    return run


def test_pictures_of_workers_that_are_killed_twice_fail_and_the_same_command_goes_on(killing, tmp_path, capsys):
    assert killing(2) == 2
    assert " killed " in capsys.readouterr().err
    assert not (tmp_path / "out" / "003" / "depth.png").exists()
    assert killing(2) == 0
    assert len(list((tmp_path / "out").glob("*/depth.png"))) == 8


def test_several_workers_write_what_one_writes(folder, tmp_path, capsys):
    assert main(["upsample", str(folder), "-o", str(tmp_path / "one"), *FAST]) == 2
    alone = capsys.readouterr()
    assert main(["upsample", str(folder), "-o", str(tmp_path / "two"), *FAST, "--workers", "2"]) == 2
    both = capsys.readouterr()
    assert "5 pictures: 4 done, 1 failed" in both.out
    assert [line for line in alone.err.splitlines() if "error" in line] == [
        line for line in both.err.splitlines() if "error" in line
    ]
    for name in ("000", "001", "003", "004"):
        first, second = (tmp_path / run / name for run in ("one", "two"))
        assert (first / "depth.png").read_bytes() == (second / "depth.png").read_bytes()
        assert (first / "before_after.png").is_file() == (second / "before_after.png").is_file()
        reported, other = (json.loads((place / "info.json").read_text()) for place in (first, second))
        assert {**reported, "seconds": 0} == {**other, "seconds": 0}
    assert main(["upsample", str(folder), "-o", str(tmp_path / "two"), *FAST]) == 2
    assert "4 complete already" in capsys.readouterr().out
