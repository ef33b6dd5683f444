"""``dsr upsample --workers``: the same results from several processes, problems and all."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from dsr.cli import main

FAST = ("--method", "bicubic", "--only", "depth,before_after", "--fov", "60", "--depth-unit", "mm")


@pytest.fixture
def folder(tmp_path):
    """Return a folder of five frames, of which one has a damaged depth map."""
    rng = np.random.default_rng(0)
    for kind in ("rgb", "depth"):
        (tmp_path / "frames" / kind).mkdir(parents=True)
    for number in range(5):
        photo = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(photo).save(tmp_path / "frames" / "rgb" / f"{number:03}.png")
        depth = (1000 + 100 * number + np.arange(16)[None] * 10 + np.zeros((12, 1))).astype(np.uint16)
        Image.fromarray(depth).save(tmp_path / "frames" / "depth" / f"{number:03}.png")
    (tmp_path / "frames" / "depth" / "002.png").write_bytes(b"\x89PNG nothing")
    return tmp_path / "frames"


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
        told, other = (json.loads((place / "info.json").read_text()) for place in (first, second))
        assert {**told, "seconds": 0} == {**other, "seconds": 0}
    assert main(["upsample", str(folder), "-o", str(tmp_path / "two"), *FAST]) == 2
    assert "4 complete already" in capsys.readouterr().out


def test_number_of_workers_is_checked(folder, tmp_path, capsys):
    assert main(["upsample", str(folder), "-o", str(tmp_path / "out"), *FAST, "--workers", "0"]) == 2
    assert "error: --workers: expected 1 or more, got 0" in capsys.readouterr().err
