"""The programs of ``examples/``."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_frames import write_frames

import dsr

REPOSITORY = Path(__file__).resolve().parents[2]


def test_frames_by_ray_are_those_of_dsr_upsample(tmp_path):
    pytest.importorskip("ray", reason="pip install ray")
    write_frames(tmp_path / "frames", 3, holes=0)
    environment = {
        **os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), os.environ.get("PYTHONPATH", "")]),
        "RAY_ADDRESS": "local", "RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
        "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    program = [sys.executable, REPOSITORY / "examples" / "ray_upsample.py"]
    subprocess.run(
        [*program, "frames", "out", "27.7", "27.7", "15.5", "11.5"],
        cwd=tmp_path, env=environment, check=True, timeout=280, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["000.npy", "001.npy", "002.npy"]
    rgb = np.array(Image.open(tmp_path / "frames" / "rgb" / "002.png"))
    depth = np.array(Image.open(tmp_path / "frames" / "depth" / "002.png"), np.float32) / 1000
    expected = dsr.upsample(rgb, depth, dsr.Camera(32, 24, 27.7, 27.7, 15.5, 11.5))
    np.testing.assert_allclose(np.load(tmp_path / "out" / "002.npy"), expected, rtol=1e-5)
