"""The benchmarks run: small, for what they print, not for how fast."""

import json
from pathlib import Path

import pytest
from commands import run_python

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL = {
    "train-step": (("patch=32", "batch=2", "turns=1"), 2),
    "prepare": (("scenes=2", "height=160", "width=240"), 2),
    "dip-step": (("size=64", "turns=1"), 2),
}  # Settings, and how many ratios are printed

pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("name", SMALL)
def test_benchmark_prints_ratios(name: str, tmp_path: Path) -> None:
    settings, ratios = SMALL[name]
    printed = run_benchmark("run.py", name, "--json", str(tmp_path / "ratios.json"), "--set", *settings)
    found = json.loads((tmp_path / "ratios.json").read_text())["results"][name]
    assert len(printed.splitlines()) == len(found) == ratios
    assert min(found.values()) > 0
    compared = run_benchmark("run.py", "compare", *2 * [str(tmp_path / "ratios.json")]).splitlines()
    assert [line.split()[-1] for line in compared] == ["1.000"] * ratios


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


def test_benchmark_of_encodings_counts_what_is_said() -> None:
    printed = run_benchmark("mistakes.py", "encodings", "--frames", "2", "--reduce", "2").splitlines()
    (_, frames, *answers), _, *rows = [[cell.strip() for cell in line.split("|")[:-1]] for line in printed]
    assert (frames, answers) == ("2 frames", ["read rightly", "warned", "refused", "silent"])
    counts = {name: [int(cell) for cell in cells] for _, name, *cells in rows}
    assert all(sum(each) == 2 for each in counts.values())
    for right in ("millimetres, 16 bits", "float metres", "float millimetres", "SUN RGB-D's bits"):
        assert counts[right] == [2, 0, 0, 0], right
    for without_unit in ("0 to 1", "8 bits for viewing", "false colours", "disparity, 8 bits"):
        assert counts[without_unit] == [0, 0, 2, 0], without_unit
