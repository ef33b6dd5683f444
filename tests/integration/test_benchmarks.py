"""The benchmarks run: small, for what they print, not for how fast."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL = {
    "train_speed.py": (("--patch", "32", "--batch", "2", "--steps", "1"), 3),
    "prepare_speed.py": (("--scenes", "2", "--height", "160", "--width", "240"), 2),
    "dip_speed.py": (("--size", "64", "--steps", "1", "--quality-steps", "2"), 4),
}
"""Arguments, and how many ratios are printed."""


@pytest.mark.parametrize("name", SMALL)
def test_benchmark_prints_ratios(name: str) -> None:
    arguments, ratios = SMALL[name]
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / name), *arguments], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r"\d\.\d+ times as fast", done.stdout)) == ratios


def test_method_cost_benchmark_measures(shared: Path) -> None:
    command = [sys.executable, str(BENCHMARKS / "methods_cost.py"), "--scenes", str(shared / "scenes")]
    done = subprocess.run(
        [*command, "--methods", "nearest", "--scale", "4"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"\| `nearest` \| - \| \d+\.\d\d \| \d+ \|", done.stdout.splitlines()[-1])
