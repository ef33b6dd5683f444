"""Measure how time and memory of the commands grow with pixels, scenes and runs, and draw it.

    python benchmarks/growth.py --what pixels [--points 256,512,1024,2048,3464] [--csv growth.csv]
    python benchmarks/growth.py --what scenes [--points 1,10,100,1000]
    python benchmarks/growth.py --what runs [--points 1,10,30,100,300]
    python benchmarks/growth.py --figure docs/pictures/growth.svg [--csv growth.csv]

pixels: ``dsr upsample`` with ``facets``, all its outputs, on a square photo of so many pixels a side. scenes: ``dsr
upsample`` with ``nearest`` on folders of so many photos and maps of 64 x 64 pixels, listing and pairing included, the
depth alone as output. runs: ``dsr report`` of so many runs of two scenes of 64 x 64 pixels: tables, metric study and
page.

A point is one command, a process of its own on one thread: CPU seconds, and the most memory that it held. Prints them
beside the straight line through the first and the last point: a point is on the line at 1. ``--csv`` keeps the points,
after each of them, with those of the other axes that the file has.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from dsr.geometry.camera import Camera
from dsr.utils.files import replacing, write_text

ROOT = Path(__file__).resolve().parents[1]
_SIDE = 64
"""Size of the small scenes, pixels."""


class Point(NamedTuple):
    """A measurement.

    Args:
        what: pixels, scenes or runs.
        amount: how many; for pixels in millions.
        seconds: CPU seconds.
        gigabytes: the most memory.

    """

    what: str
    amount: float
    seconds: float
    gigabytes: float


class Axis(NamedTuple):
    """An axis of the figure.

    Args:
        points: what is measured by default.
        label: label of the axis.
        title: command that is measured.
        prepare: makes the input of a point in a directory.
        command: arguments of Python for a point.
        factor: amount on the axis from that of a point.

    """

    points: tuple[int, ...]
    label: str
    title: str
    prepare: Callable[[Path, int], None]
    command: tuple[str, ...]
    factor: Callable[[int], float] = float


def scene(side: int, number: int) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Return an 8-bit photo (H, W, 3), a depth map (H, W) in metres, and the camera of waves and steps."""
    x, y = np.meshgrid(np.arange(side) / side, np.arange(side) / side)
    depth = 2 + 0.3 * np.sin(6 * x + number) + 0.2 * np.cos(5 * y) + 0.5 * (x + 0.4 * y > 0.7)
    shade = 0.5 + 0.3 * np.sin(40 * x) * np.sin(31 * y) + 0.2 * (x + 0.4 * y > 0.7)
    photo = np.rint(255 * np.clip(np.stack([shade, shade**2, 1 - shade], axis=-1), 0, 1)).astype(np.uint8)
    return photo, depth, Camera(side, side, 1.2 * side, 1.2 * side, (side - 1) / 2, (side - 1) / 2)


def prepare_photo(folder: Path, side: int) -> None:
    """Write a photo and a depth map with an eighth of its pixels a side."""
    _write_pair(folder / "rgb.png", folder / "depth.png", side, 0, 8)


def prepare_photos(folder: Path, count: int) -> None:
    """Write small photos, and depth maps with half of their pixels a side."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir()
    for number in range(count):
        _write_pair(folder / "rgb" / f"{number:04}.png", folder / "depth" / f"{number:04}.png", _SIDE, number, 2)


def _write_pair(rgb: Path, depth_lr: Path, side: int, number: int, scale: int) -> None:
    """Write a photo, and a depth map in millimetres."""
    photo, depth, _ = scene(side, number)
    cv2.imwrite(str(rgb), photo)
    cv2.imwrite(str(depth_lr), np.rint(1000 * depth[scale // 2 :: scale, scale // 2 :: scale]).astype(np.uint16))


def prepare_scenes(folder: Path, count: int) -> None:
    """Write scenes."""
    for number in range(count):
        photo, depth, camera = scene(_SIDE, number)
        place = folder / "scenes" / f"{number:04}"
        place.mkdir(parents=True)
        cv2.imwrite(str(place / "rgb.png"), photo)
        np.save(place / "depth.npy", depth)
        write_text(place / "camera.json", json.dumps(asdict(camera)))


def prepare_runs(folder: Path, count: int) -> None:
    """Evaluate two scenes once, and copy the run under other labels."""
    prepare_scenes(folder, 2)
    measure(folder, (*_EVALUATE, "scale=4", "output_dir=run"))
    for number in range(count):
        run = folder / "runs" / f"{number:04}"
        shutil.copytree(folder / "run", run)
        for file, change in (("summary.json", _label), ("versions.json", _label_identity)):
            content = json.loads((run / file).read_text())
            change(content, number)
            write_text(run / file, json.dumps(content))


def _label(summary: dict[str, Any], number: int) -> None:
    summary["label"] = f"Method {number}"


def _label_identity(versions: dict[str, Any], number: int) -> None:
    versions["identity"]["method"]["label"] = f"Method {number}"


_EVALUATE = (str(ROOT / "eval.py"), "dataset=folder", "dataset.root=scenes", "method=nearest", "metrics.lpips=false")
_UPSAMPLE = ("-m", "dsr", "upsample", "--rgb", "rgb.png", "--depth", "depth.png", "--depth-unit", "mm", "--fov", "45")
_UPSAMPLE_FOLDER = ("-m", "dsr", "upsample", "--rgb", "rgb", "--depth", "depth", "--depth-unit", "mm", "--fov", "45",
                    "--method", "nearest", "--only", "depth")  # fmt: skip
AXES = {
    "pixels": Axis(
        (256, 512, 1024, 2048, 3464), "million pixels", "dsr upsample", prepare_photo,
        (*_UPSAMPLE, "-o", "out"), lambda side: side * side / 1e6,
    ),
    "scenes": Axis(
        (1, 10, 100, 1000), "scenes of 64 x 64", "dsr upsample of a folder", prepare_photos,
        (*_UPSAMPLE_FOLDER, "-o", "out"),
    ),
    "runs": Axis(
        (1, 10, 30, 100, 300), "runs of two scenes of 64 x 64", "dsr report", prepare_runs,
        ("-m", "dsr", "report", "runs", "-o", "report", "--workers", "1", "--only", "tables,metrics,page"),
    ),
}  # fmt: skip


def measure(folder: Path, command: Sequence[str]) -> tuple[float, float]:
    """Run Python in a directory, and return its CPU seconds and the most memory in GB.

    Raises:
        subprocess.CalledProcessError: it fails.

    """
    paths = os.pathsep.join(filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(  # noqa: S603 - this project's commands
            [sys.executable, *command], cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            output.seek(0)
            sys.stderr.write(output.read().decode(errors="replace"))
            raise subprocess.CalledProcessError(process.returncode, command)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e9


def points_of(what: str, amounts: Sequence[int]) -> Iterator[Point]:
    """Measure the points of an axis."""
    axis = AXES[what]
    for amount in amounts:
        with tempfile.TemporaryDirectory() as place:
            axis.prepare(Path(place), amount)
            yield Point(what, axis.factor(amount), *measure(Path(place), axis.command))


def read_points(path: Path | None) -> list[Point]:
    """Return the points of a file, none if it does not exist."""
    if path is None or not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [Point(row["what"], *(float(row[name]) for name in Point._fields[1:])) for row in rows]


def write_points(path: Path, points: Sequence[Point]) -> None:
    """Write points to a file."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Point._fields)
        writer.writerows((each.what, f"{each.amount:.6g}", f"{each.seconds:.4g}", f"{each.gigabytes:.4g}")
                         for each in points)  # fmt: skip


def line_of(points: Sequence[Point], field: str) -> Callable[[float], float]:
    """Return the straight line through the first and the last point."""
    first, last = points[0], points[-1]
    low, high = getattr(first, field), getattr(last, field)
    slope = (high - low) / (last.amount - first.amount) if len(points) > 1 else 0.0
    return lambda amount: low + slope * (amount - first.amount)


def show(points: Sequence[Point]) -> None:
    """Print the points of each axis as Markdown, beside the straight line."""
    for what, axis in AXES.items():
        own = [each for each in points if each.what == what]
        if not own:
            continue
        lines = {field: line_of(own, field) for field in ("seconds", "gigabytes")}
        print(f"\n| {axis.label} | s | of the line | GB | of the line |\n| ---: | ---: | ---: | ---: | ---: |")
        for each in own:
            ratios = {field: getattr(each, field) / line(each.amount) for field, line in lines.items()}
            print(f"| {each.amount:.3g} | {each.seconds:.3g} | {ratios['seconds']:.2f} | {each.gigabytes:.3g} | "
                  f"{ratios['gigabytes']:.2f} |")  # fmt: skip


def draw(path: Path, points: Sequence[Point]) -> None:
    """Draw the points of all axes, and the straight line of each."""
    import matplotlib as mpl  # noqa: PLC0415 - for the figure alone
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(9, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(AXES))
    fields = (("seconds", "CPU seconds", "#d1495b"), ("gigabytes", "memory, GB", "#0f6ba8"))
    for column, (what, axis) in enumerate(AXES.items()):
        own = [each for each in points if each.what == what]
        panels[0, column].set_title(axis.title, fontsize=10)
        panels[1, column].set_xlabel(axis.label)
        for panel, (field, label, colour) in zip(panels[:, column], fields, strict=True):
            if own:
                ends = [own[0].amount, own[-1].amount]
                panel.plot(ends, list(map(line_of(own, field), ends)), color="0.7", linewidth=1)
            panel.plot(
                [each.amount for each in own], [getattr(each, field) for each in own], "o", color=colour, clip_on=False
            )
            panel.set_xlim(left=0)
            panel.set_ylim(bottom=0)
            panel.spines[["top", "right"]].set_visible(False)
            if column == 0:
                panel.set_ylabel(label)
    with mpl.rc_context({"svg.hashsalt": "growth", "svg.fonttype": "none"}), replacing(path) as temporary:
        figure.savefig(temporary, metadata={"Date": None} if path.suffix == ".svg" else None)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", choices=tuple(AXES))
    parser.add_argument("--points", type=lambda text: [int(part) for part in text.split(",")])
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    points = [each for each in read_points(options.csv) if each.what != options.what]
    if options.what is not None:
        for point in points_of(options.what, options.points or AXES[options.what].points):
            points.append(point)
            print(f"{point.what} {point.amount:.4g}: {point.seconds:.2f} s, {point.gigabytes:.3f} GB", flush=True)
            if options.csv is not None:
                write_points(options.csv, points)
    show(points)
    if options.figure is not None:
        draw(options.figure, points)


if __name__ == "__main__":
    main()
