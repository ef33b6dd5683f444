"""Measure ``dsr report`` of 13 runs, and where its time goes.

    python benchmarks/report_speed.py [--runs DIR] [--workers 1,2] [--no-profile]

Without ``--runs``, the embedded scenes are evaluated first, with six methods at x4 and x8, and with a seventh at x4,
which takes two minutes. Prints for each number of workers the seconds that the command took, and the CPU seconds of all
its processes; then, of one process under cProfile, the share of the time of each part.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from dsr.cli import main as dsr
from dsr.utils.console import USAGE_ERROR

ROOT = Path(__file__).resolve().parents[1]
METHODS = "nearest,bilinear,bicubic,guided_filter,fast_global_smoother,facets"
PARTS = {
    "reading runs": ("run_files.py", "load_results"),
    "tables": ("table_layouts.py", "write_tables"),
    "metric study": ("correlation_figure.py", "save_scatter_matrix"),
    "figures: reading and rendering": ("shown_scenes.py", "shown_scenes"),
    "figures: layout": ("pictures/grids.py", "draw_grid"),
    "figures: PDF": ("backend_pdf.py", "print_pdf"),
    "PDF: fonts": ("backend_pdf.py", "writeFonts"),
    "PDF: pictures": ("backend_pdf.py", "writeImages"),
    "figures: PNG": ("pictures/canvas.py", "_write_png"),
    "page: scenes": ("page/scene_content.py", "scene_data"),
    "page: compression of pictures": ("page/value_pictures.py", "add"),
    "page: expected errors": ("page/scene_content.py", "calibration_data"),
}
"""File and function of each part; some are parts of others."""


def python(arguments: list[str]) -> tuple[float, float]:
    """Run Python, and return the seconds that it took and the CPU seconds of its processes."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / "src")}
    start = time.perf_counter()
    process = subprocess.Popen(  # noqa: S603 - this project's commands
        [sys.executable, *arguments], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, arguments)
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime


def evaluate(folder: Path) -> None:
    """Make the 13 runs."""
    for scale, methods in (("4", f"{METHODS},bilateral"), ("8", METHODS)):
        for method in methods.split(","):
            target = f"output_dir={folder / 'runs' / f'{method}_x{scale}'}"
            python(["eval.py", "dataset=simgeo", f"scale={scale}", f"method={method}", target])


def profile(runs: Path, output: Path) -> None:
    """Print the share of each part of the command's time."""
    profiler = cProfile.Profile()
    if profiler.runcall(dsr, ["report", str(runs), "-o", str(output), "--workers", "1"]) == USAGE_ERROR:
        raise SystemExit(USAGE_ERROR)
    stats = pstats.Stats(profiler)
    total = stats.total_tt  # type: ignore[attr-defined]
    print("\n| part | share |\n| --- | ---: |")
    for part, (file, function) in PARTS.items():
        found = [
            values[3]
            for (path, _, name), values in stats.stats.items()  # type: ignore[attr-defined]
            if path.endswith(file) and name == function
        ]
        print(f"| {part} | {sum(found) / total:.0%} |")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path)
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--no-profile", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if options.runs is None:
            evaluate(folder)
        runs = options.runs or folder / "runs"
        for workers in options.workers.split(","):
            output = folder / f"report{workers}"
            seconds, used = python(["-m", "dsr", "report", str(runs), "-o", str(output), "--workers", workers])
            print(f"{workers} workers: {seconds:.1f} s, {used:.1f} CPU seconds", flush=True)
        if not options.no_profile:
            profile(runs, folder / "profiled")


if __name__ == "__main__":
    main()
