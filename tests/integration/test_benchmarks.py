"""The benchmarks print the published figures."""

from pathlib import Path

import pytest
from commands import run_python

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
pytestmark = pytest.mark.nightly


def run_benchmark(name: str, *arguments: str) -> str:
    """Run a benchmark and return what it printed."""
    done = run_python(str(BENCHMARKS / name), *arguments, cwd=BENCHMARKS.parent)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_flatness_is_the_published_one(shared: Path) -> None:
    arguments = ("--shared", str(shared), "--set", "methods=", "filters=19/0.05/5")
    printed = run_benchmark("run.py", "floors", *arguments).splitlines()
    raw, filtered = (float(line.split()[-1]) for line in printed if "depth_camera_0" in line)
    assert (raw, filtered) == (pytest.approx(36.8, abs=0.05), pytest.approx(15.8, abs=0.05))


def test_bicubic_rows_without_the_border_are_the_published_ones(shared: Path, tmp_path: Path) -> None:
    settings = ("methods=cubic_convolution", "scales=4", f"out={tmp_path / 'tables.md'}")
    run_benchmark("run.py", "peers", "--shared", str(shared), "--set", *settings)
    lines = [[cell.strip() for cell in line.split("|")] for line in (tmp_path / "tables.md").read_text().splitlines()]
    rows = {cells[1]: cells[4:6] for cells in lines if cells[2:4] == ["Cubic convolution", "6"]}
    for benchmark, row in (("middlebury8 x4", "2.30"), ("lu x4", "2.47")):
        published, ours = rows[benchmark]
        assert (published, f"{float(ours):.2f}") == (row, row)
