"""Measure dsr: quality on data with a truth, speed against a plain way, growth of time and memory.

    python benchmarks/run.py [quality|speed|growth] [CASE ...] [--shared DIR] [--device cpu] [--json FILE] [--set KEY=VALUE ...]
    python benchmarks/run.py compare A.json B.json

Without a case, all cases of the kind are measured; without a kind, they are listed with what ``--set`` may change.
``--set`` concerns the chosen cases that have the key. A case whose data are not there is skipped. ``speed`` prints
ratios, each of one process in which both ways take turns; ``quality`` and ``growth`` print values, see each case.
``compare`` prints what two files have and the second over the first.
"""  # noqa: E501 - the command's usage

from __future__ import annotations

import argparse
import csv
import inspect
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import nn

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.recipe import Run, read_recipe
from dsr.utils.files import replacing, write_text
from dsr.utils.versions import package_versions

ROOT = Path(__file__).resolve().parents[1]
SIDE = 64  # Pixels of the small scenes
Scores = dict[str, float]
Case = Callable[..., Scores]


def pixels(*, points: str = "256,512,1024,2048,3464", csv: str = "") -> Scores:
    """``dsr upsample`` with ``facets`` and all outputs, of a square photo of so many pixels a side; per million."""

    def prepare(folder: Path, side: int) -> None:
        write_pair(folder / "rgb.png", folder / "depth.png", side, 0, 8)

    return grow("pixels", points, csv, prepare, UPSAMPLE.split(), lambda side: side * side / 1e6)


def scenes(*, points: str = "1,10,100,1000", csv: str = "") -> Scores:
    """``dsr upsample`` with ``nearest``, depth alone, of folders of so many photos and maps of 64 x 64."""

    def prepare(folder: Path, count: int) -> None:
        for kind in ("rgb", "depth"):
            (folder / kind).mkdir()
        for number in range(count):
            write_pair(folder / "rgb" / f"{number:04}.png", folder / "depth" / f"{number:04}.png", SIDE, number, 2)

    command = UPSAMPLE.replace(".png", "") + " --method nearest --only depth"
    return grow("scenes", points, csv, prepare, command.split())


def runs(*, points: str = "1,10,30,100,300", csv: str = "") -> Scores:
    """``dsr report``: tables, metric study and page, of so many runs of two scenes of 64 x 64."""
    return grow("runs", points, csv, prepare_runs, REPORT.split())


UPSAMPLE = "-m dsr upsample --rgb rgb.png --depth depth.png --depth-unit mm --fov 45 -o out"
EVALUATE = "dataset=folder dataset.root=scenes method=nearest metrics.lpips=false scale=4 output_dir=run"
REPORT = "-m dsr report runs -o report --workers 1 --only tables,metrics,page"


def grow(
    what: str, points: str, csv: str, prepare: Callable[[Path, int], None], command: Sequence[str],
    amount: Callable[[int], float] = float,
) -> Scores:  # fmt: skip
    """Return CPU seconds and the most memory of a command on one thread, by amount; ``csv`` keeps them in a file."""
    found: Scores = {}
    for point in map(int, points.split(",")):
        with tempfile.TemporaryDirectory() as place:
            prepare(Path(place), point)
            seconds, gigabytes = measure(Path(place), command)
        found |= {f"{amount(point):.6g}, s": seconds, f"{amount(point):.6g}, GB": gigabytes}
        if csv:
            write_points(Path(csv), what, found)
    return found


WATCH = """import json, os, subprocess, sys
process = subprocess.Popen(sys.argv[1:], stdout=sys.stderr)
_, status, used = os.wait4(process.pid, 0)
print(json.dumps((os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9)))
"""  # A small process in between, as Linux counts the memory of the one that starts another as the other's


def measure(folder: Path, command: Sequence[str]) -> tuple[float, float]:
    """Run Python in a directory, and return its CPU seconds and the most memory in GB."""
    paths = os.pathsep.join(filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    arguments = [sys.executable, "-c", WATCH, sys.executable, *command]
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    code, seconds, gigabytes = json.loads(done.stdout)
    if code:
        raise RuntimeError(f"{' '.join(command)} ended with {code}: {done.stderr[-500:]}")
    return seconds, gigabytes


def write_points(path: Path, what: str, found: Mapping[str, float]) -> None:
    """Write what was measured of a kind to a table, beside what it has of others; ``pictures.py growth`` draws it."""
    fields = ("what", "amount", "seconds", "gigabytes")
    rows = list(csv.DictReader(path.read_text().splitlines())) if path.is_file() else []
    rows = [row for row in rows if row["what"] != what]
    for amount in dict.fromkeys(key.partition(",")[0] for key in found):
        values = (what, amount, f"{found[f'{amount}, s']:.4g}", f"{found[f'{amount}, GB']:.4g}")
        rows.append(dict(zip(fields, values, strict=True)))
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fields, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def waves(side: int, number: int) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Return an 8-bit photo (H, W, 3), a depth map (H, W) in metres, and the camera of waves and steps."""
    x, y = np.meshgrid(np.arange(side) / side, np.arange(side) / side)
    depth = 2 + 0.3 * np.sin(6 * x + number) + 0.2 * np.cos(5 * y) + 0.5 * (x + 0.4 * y > 0.7)
    shade = 0.5 + 0.3 * np.sin(40 * x) * np.sin(31 * y) + 0.2 * (x + 0.4 * y > 0.7)
    photo = np.rint(255 * np.clip(np.stack([shade, shade**2, 1 - shade], axis=-1), 0, 1)).astype(np.uint8)
    return photo, depth, Camera(side, side, 1.2 * side, 1.2 * side, (side - 1) / 2, (side - 1) / 2)


def write_pair(rgb: Path, depth_lr: Path, side: int, number: int, scale: int) -> None:
    """Write a photo, and a depth map in millimetres."""
    photo, depth, _ = waves(side, number)
    cv2.imwrite(str(rgb), photo)
    cv2.imwrite(str(depth_lr), np.rint(1000 * depth[scale // 2 :: scale, scale // 2 :: scale]).astype(np.uint16))


def prepare_runs(folder: Path, count: int) -> None:
    """Evaluate two scenes once, and copy the run under other labels."""
    for number in range(2):
        photo, depth, camera = waves(SIDE, number)
        place = folder / "scenes" / f"{number:04}"
        place.mkdir(parents=True)
        cv2.imwrite(str(place / "rgb.png"), photo)
        np.save(place / "depth.npy", depth)
        write_text(place / "camera.json", json.dumps(asdict(camera)))
    measure(folder, (str(ROOT / "eval.py"), *EVALUATE.split()))
    for number in range(count):
        run = folder / "runs" / f"{number:04}"
        shutil.copytree(folder / "run", run)
        summary, versions = (json.loads((run / f"{name}.json").read_text()) for name in ("summary", "versions"))
        summary["label"] = versions["identity"]["method"]["label"] = f"Method {number}"
        write_text(run / "summary.json", json.dumps(summary))
        write_text(run / "versions.json", json.dumps(versions))


METHODS = (
    "bicubic,bilateral,guided_filter,joint_bilateral,fast_global_smoother,tgv,srfs,eg,"
    "pdn,dg,sparse_to_dense,ddrnet,msg_v,facets"
)


def methods(
    *, shared: Path, device: str = "cpu", scene: str = "lucy", methods: str = METHODS, scales: str = "4,8",
    weights: str = "", ensemble: int = 0, repeats: int = 2, threads: int = 1,
) -> Scores:  # fmt: skip
    """Methods on one scene: CPU seconds, MB beyond the problem's own, parameters; each in a process of its own.

    The least seconds of the repeats count. Networks of other authors need the folder of their ``weights``; packaged
    ones average four turns, unless ``ensemble=1``.
    """
    folder = need(shared / "scenes" / scene)
    found: Scores = {}
    for name in methods.split(","):
        for scale in map(int, scales.split(",")):
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                given = (name, scale, folder, device, weights, ensemble, repeats, threads)
                cost = pool.submit(cost_of_method, *given).result()
            found |= {f"{name} x{scale}, {key}": value for key, value in cost.items()}
    return found


def cost_of_method(
    name: str, scale: int, folder: Path, device: str, weights: str, ensemble: int, repeats: int, threads: int
) -> Scores:
    """Return the cost of a call; none of a method that does not have the scale, or whose weights are not there."""
    torch.set_num_threads(threads)
    recipe = read_recipe(name)
    if ensemble and "ensemble" in recipe.at():
        recipe = read_recipe(name, {"ensemble": ensemble})
    if not recipe.at().get("weights", {}).get("packaged"):
        recipe = recipe.with_weights(Path(weights) if weights else None)
    try:
        method = recipe.build(scale, Run(device=torch.device(device)))
    except (ValueError, OSError):
        return {}
    sample = make_sample(
        Folder(str(folder.parent), [folder.name]).load(folder.name), scale, Downsampling("box"), method.range_type
    )
    before, seconds = peak(), []
    for _ in range(repeats):
        start = time.process_time()
        method(sample)
        seconds.append(time.process_time() - start)
    networks = [value for value in vars(method).values() if isinstance(value, nn.Module)]
    parameters = sum(parameter.numel() for network in networks for parameter in network.parameters())
    return {"s": min(seconds), "MB": peak() - before, "parameters": parameters}


def peak() -> float:
    """Return the most memory that this process has held, in MB; of Linux."""
    [line] = [each for each in Path("/proc/self/status").read_text().splitlines() if each.startswith("VmHWM")]
    return int(line.split()[1]) * 1024 / 1e6


def need(path: Path) -> Path:
    """Return a path that is there."""
    if not path.exists():
        raise FileNotFoundError(f"needs {path}")
    return path


def cases() -> dict[str, dict[str, Case]]:
    """Return the cases by kind and name."""
    import quality  # noqa: PLC0415 - for a process of ``methods``, which measures its memory
    import speed  # noqa: PLC0415

    kinds = {"quality": quality.CASES, "speed": speed.CASES, "growth": (pixels, scenes, runs, methods)}
    return {
        kind: {case.__name__.replace("_", "-"): case for case in of_kind}  # type: ignore[attr-defined]
        for kind, of_kind in kinds.items()
    }


def settings(case: Case) -> dict[str, Any]:
    """Return what ``--set`` may change of a case, with the defaults."""
    parameters = inspect.signature(case).parameters.values()
    return {each.name: each.default for each in parameters if each.name not in ("shared", "device")}


def choose(words: Sequence[str]) -> dict[str, Case]:
    """Return the cases that kinds and names choose."""
    kinds = cases()
    names = {name: case for of_kind in kinds.values() for name, case in of_kind.items()}
    chosen: dict[str, Case] = {}
    named = [word for word in words if word not in kinds]
    for word in words:
        if word not in kinds and word not in names:
            raise SystemExit(f"expected {', '.join(kinds)}, or a case of {', '.join(names)}; got {word}")
        chosen |= {word: names[word]} if word in names else {} if named else kinds[word]
    return chosen


def with_settings(chosen: Mapping[str, Case], pairs: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the arguments that ``--set`` gives each case."""
    given: dict[str, dict[str, Any]] = {name: {} for name in chosen}
    for pair in pairs:
        key, _, text = pair.partition("=")
        having = [name for name, case in chosen.items() if key in settings(case)]
        if not having:
            raise SystemExit(f"--set: expected a key of the chosen cases, got {key}")
        for name in having:
            given[name][key] = type(settings(chosen[name])[key])(text)
    return given


def compare(before: Path, after: Path) -> None:
    """Print what two files have, and the second over the first."""
    results = [json.loads(path.read_text())["results"] for path in (before, after)]
    for name in dict.fromkeys((*results[0], *results[1])):
        old, new = (each.get(name, {}) for each in results)
        for key in dict.fromkeys((*old, *new)):
            a, b = old.get(key), new.get(key)
            values = "  ".join("-".rjust(10) if each is None else f"{each:10.4g}" for each in (a, b))
            print(f"{name:<12} {key:<40} {values}  {b / a:8.3f}" if a and b else f"{name:<12} {key:<40} {values}")


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", metavar="KIND or CASE")
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    if options.words[:1] == ["compare"]:
        compare(*map(Path, options.words[1:]))
        return
    if not options.words:
        for kind, of_kind in cases().items():
            for name, case in of_kind.items():
                text = " ".join(f"{key}={value}" for key, value in settings(case).items())
                print(f"{kind} {name}: {(case.__doc__ or '').splitlines()[0]}\n    {text}")
        return
    chosen = choose(options.words)
    given = with_settings(chosen, options.set)
    results: dict[str, Scores] = {}
    for name, case in chosen.items():
        common = {"shared": options.shared, "device": options.device}
        common = {key: value for key, value in common.items() if key in inspect.signature(case).parameters}
        try:
            results[name] = case(**common, **given[name])
        except FileNotFoundError as error:
            print(f"{name}: skipped: {error}", flush=True)
            continue
        for key, value in results[name].items():
            print(f"{name:<12} {key:<40} {value:.4g}", flush=True)
        if options.json:
            machine = {"processor": platform.processor() or platform.machine(), "threads": torch.get_num_threads()}
            facts = {"versions": package_versions(), "device": options.device, **machine}
            write_text(options.json, json.dumps({**facts, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
