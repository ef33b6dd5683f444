"""The benchmarks run: small, for what they print, not for how fast."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_python

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL = {
    "train_speed.py": (("--patch", "32", "--batch", "2", "--steps", "1"), 3),
    "prepare_speed.py": (("--scenes", "2", "--height", "160", "--width", "240"), 2),
    "dip_speed.py": (("--size", "64", "--steps", "1", "--quality-steps", "2"), 4),
}  # Arguments, and how many ratios are printed

pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("name", SMALL)
def test_benchmark_prints_ratios(name: str) -> None:
    arguments, ratios = SMALL[name]
    done = run_python(str(BENCHMARKS / name), *arguments, cwd=BENCHMARKS.parent)
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r"\d\.\d+ times as fast", done.stdout)) == ratios


def test_method_cost_benchmark_measures(shared: Path) -> None:
    command = (str(BENCHMARKS / "methods_cost.py"), "--scenes", str(shared / "scenes"))
    done = run_python(*command, "--methods", "nearest", "--scale", "4", cwd=BENCHMARKS.parent)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"\| `nearest` \| - \| \d+\.\d\d \| \d+ \|", done.stdout.splitlines()[-1])


def run_benchmark(name: str, *arguments: str) -> str:
    """Run a benchmark and return what it printed."""
    done = run_python(str(BENCHMARKS / name), *arguments, cwd=BENCHMARKS.parent)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_flatness_is_the_published_one(shared: Path) -> None:
    arguments = ("--floors", "depth_camera_0", "--methods", "", "--frames", "1")
    raw, filtered = run_benchmark("flatness.py", "--shared", str(shared), *arguments).splitlines()[2:]
    assert raw.startswith("| input | 36.8 |")
    assert filtered.startswith("| bilateral filter of OpenCV | 15.8 |")


def test_benchmark_of_poses_counts_what_is_noticed() -> None:
    lines = run_benchmark("poses.py", "--scenes", "1", "--size", "48", "--right").splitlines()
    (row,) = [line for line in lines if line.startswith("| right |")]
    assert re.fullmatch(r"\| right( \| \d / \d / \d / \d){7} \|", row)


def test_benchmark_of_encodings_counts_what_is_said() -> None:
    printed = run_benchmark("depth_encodings.py", "--frames", "2", "--reduce", "2").splitlines()
    (_, frames, *answers), _, *rows = [[cell.strip() for cell in line.split("|")[:-1]] for line in printed]
    assert (frames, answers) == ("2 frames", ["read rightly", "warned", "refused", "silent"])
    counts = {name: [int(cell) for cell in cells] for _, name, *cells in rows}
    assert all(sum(each) == 2 for each in counts.values())
    for right in ("millimetres, 16 bits", "float metres", "float millimetres", "SUN RGB-D's bits"):
        assert counts[right] == [2, 0, 0, 0], right
    for without_unit in ("0 to 1", "8 bits for viewing", "false colours", "disparity, 8 bits"):
        assert counts[without_unit] == [0, 0, 2, 0], without_unit


def test_pairs_have_their_published_rows(shared: Path, tmp_path: Path) -> None:
    for name in ("rgbdd_real", "cleargrasp", "icl_nuim", "middlebury2005", "middlebury2006", "middlebury2014",
                 "tartanair", "depth_camera", "ddrnet", "sunrgbd", "../modern", "../scenes"):  # fmt: skip
        (tmp_path / "real" / name).mkdir(parents=True)
    ddrnet, camera = ("real/ddrnet/color_map", "real/ddrnet/depth_map"), "real/sunrgbd/open3d_sample"
    for name in (*ddrnet, "real/iphone_lidar", camera, "scenes/books"):
        (tmp_path / name).symlink_to(shared / name)
    command = (sys.executable, str(BENCHMARKS / "pairs.py"), "--shared", str(tmp_path), "--rendered", "8")
    done = subprocess.run([*command, "--workers", "1"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    published = (BENCHMARKS.parent / "docs" / "measurements" / "checks.md").read_text()
    measured, expected = (
        {row[0]: [*row[1:9], row[10]] for line in text.splitlines() if len(row := line.strip("| ").split(" | ")) == 11}
        for text in (done.stdout, published)
    )  # but for those with another photo, which is drawn from all
    rows = ("ddrnet raw", "iphone_lidar", "books raw")
    assert {name: measured[name] for name in rows} == {name: expected[name] for name in rows}
    assert measured["rendered"][0] == "8"
