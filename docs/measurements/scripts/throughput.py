# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Frames a second of ``dsr upsample`` per core, with one and with two workers, and where the time goes.

    python docs/measurements/scripts/throughput.py [--frames 24] [--rounds 3] [--rgb PHOTO --depth MAP] [--ratio 4]
                                   [--method facets] [--only depth] [--device cpu]
    python docs/measurements/scripts/throughput.py --profile [--ratio 1]
    python docs/measurements/scripts/throughput.py --list 100000

Frames are a photo of 640 x 480 and a noisy map of 160 x 120, or with ``--ratio 1`` of 640 x 480, in millimetres,
rendered unless a pair is given, each under a name of its own. One worker runs on one core, two on two, in turns, and
the fastest round of each counts; what a sixth of the frames takes is taken off, for the time to start. Seconds of a
core are those in which a process has one, so they depend less than those on the clock on what else runs. ``--profile``
says instead where one worker's time goes, and ``--list`` how long it takes to list small files.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

STEPS = ("read_picture", "inputs_with_neighbours", "align", "write_parts")
"""Functions that :mod:`dsr.app.upsample.frame` spends a frame's time with; the last one writes the parts."""


def render(folder: Path, ratio: int) -> tuple[Path, Path]:
    """Write a photo of 640 x 480 and a noisy map that is smaller by a ratio, or of the same size."""
    import torch  # noqa: PLC0415

    from dsr.degradation.downsampling import Downsampling, make_sample  # noqa: PLC0415 - seconds to import
    from dsr.degradation.noise import Kinect  # noqa: PLC0415
    from dsr.sample import Scene  # noqa: PLC0415
    from dsr.synthetic.procedural.random_scene import make_camera, random_scene  # noqa: PLC0415
    from dsr.synthetic.procedural.random_scene import render as render_scene  # noqa: PLC0415

    scene = random_scene(np.random.default_rng(5))
    made = render_scene(scene, 640)
    camera = make_camera(scene.viewpoint, 640).crop(80, 0, 480, 640)
    rgb, depth = made.rgb[80:560], made.depth[80:560]
    photo = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1).float() / 255
    true = torch.from_numpy(depth.copy())[None]
    if ratio == 1:
        depth_lr = Kinect()(true, torch.Generator().manual_seed(0))
    else:
        scene_maps = Scene("throughput", "frame", photo, camera, true)
        depth_lr = make_sample(scene_maps, ratio, Downsampling("box"), "disparity", Kinect()).depth_lr
    cv2.imwrite(str(folder / "photo.jpg"), rgb[..., ::-1])
    millimetres = (1e3 * depth_lr[0].nan_to_num(0)).round().clamp(0, 65535).numpy().astype(np.uint16)
    cv2.imwrite(str(folder / "map.png"), millimetres)
    return folder / "photo.jpg", folder / "map.png"


class Cost(NamedTuple):
    """What a command took: seconds on the clock, and seconds of all its processes on their cores."""

    wall: float
    cpu: float


def upsample(arguments: list[str], cores: set[int]) -> Cost:
    """Run the command on some cores with one thread each, and return what it took."""
    started = time.perf_counter()
    process = subprocess.Popen(  # noqa: S603 - this project's command
        [sys.executable, "-m", "dsr", "upsample", *arguments],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),  # noqa: PLW1509 - there are no threads
    )
    _, code, used = os.wait4(process.pid, 0)
    if code:
        raise RuntimeError(f"dsr upsample {arguments} ended with {os.waitstatus_to_exitcode(code)}")
    return Cost(time.perf_counter() - started, used.ru_utime + used.ru_stime)


def measure(folder: Path, source: Path, frames: int, rounds: int, options: list[str]) -> None:
    """Print the rates."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    taken: dict[tuple[str, int], list[Cost]] = {}
    for _ in range(rounds):
        for workers in (1, 2):
            output = folder / f"out{workers}"
            command = [str(source), *options, "--fov", "60", "--workers", str(workers), "-o", str(output)]
            for name, shard in (("some", ["--shard", "1/6"]), ("all", [])):
                cost = upsample([*command, *shard], set(cores[:workers]))
                taken.setdefault((name, workers), []).append(cost)
                shutil.rmtree(output)
    best = {
        key: Cost(min(each.wall for each in costs), min(each.cpu for each in costs)) for key, costs in taken.items()
    }
    more = frames - frames // 6
    cost = {}
    for workers in (1, 2):
        long, short = best["all", workers], best["some", workers]
        cost[workers] = Cost((long.wall - short.wall) / more, (long.cpu - short.cpu) / more)
    for workers, each in cost.items():
        print(
            f"workers: {workers}, cores: {workers}: {1 / each.wall:.2f} frames/s on the clock, {each.cpu:.2f} s of a "
            f"core for a frame, which is {1 / each.cpu:.2f} frames/s per core"
        )
    print(f"two workers: {cost[1].wall / cost[2].wall:.2f} times as many frames on the clock, ", end="")
    print(f"{2 * cost[1].cpu / cost[2].cpu:.2f} times if their cores are idle")


def profile(folder: Path, source: Path, given: list[str], frames: int) -> None:
    """Print where one worker's time goes, in milliseconds of a core for a frame."""
    import torch  # noqa: PLC0415

    from dsr.app.upsample import frame  # noqa: PLC0415
    from dsr.app.upsample.parts import PARTS  # noqa: PLC0415
    from dsr.cli import main as dsr  # noqa: PLC0415

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    spent: Counter[str] = Counter()

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            started = time.thread_time()
            try:
                return function(*arguments, **named)
            finally:
                spent[name] += time.thread_time() - started

        return call

    command = ["upsample", str(source), *given, "--fov", "60", "-o"]
    dsr([*command, str(folder / "warm")])
    for name in STEPS:
        setattr(frame, name, timed(name, getattr(frame, name)))
    frame.AnyRatio.upsample = timed("upsample", frame.AnyRatio.upsample)
    for name, part in PARTS.items():
        if part.write is not None:
            PARTS[name] = part._replace(write=timed(name, part.write))
    started = time.process_time()
    dsr([*command, str(folder / "profile")])
    print(f"{1e3 * (time.process_time() - started) / frames:.0f} ms of a core for a frame, of which")
    for name in ("upsample", *STEPS, *PARTS):
        print(f"  {name:24s} {1e3 * spent[name] / frames:7.0f} ms", flush=True)


def measure_listing(folder: Path, count: int) -> None:
    """Print the seconds to list frames and to pair them."""
    from dsr.io.layouts import find_pairs_of_folder  # noqa: PLC0415

    for kind in ("rgb", "depth"):
        (folder / kind).mkdir()
        for number in range(count):
            (folder / kind / f"{number:07}.png").write_bytes(b"x")
    started = time.perf_counter()
    find_pairs_of_folder(folder)
    print(f"{count} frames: {time.perf_counter() - started:.1f} s to list and to pair")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rgb", type=Path)
    parser.add_argument("--depth", type=Path)
    parser.add_argument("--ratio", type=int, default=4, choices=(1, 2, 4, 8), help="of the rendered pair's sizes")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--method", default="facets")
    parser.add_argument("--only", default="", help="parts to write; everything by default")
    parser.add_argument("--device", default="cpu", help="of the networks; one GPU is shared by the workers")
    parser.add_argument("--profile", action="store_true", help="only say where the time goes")
    parser.add_argument("--list", type=int, metavar="N", help="only list N small files")
    options = parser.parse_args()
    if options.frames < 12:
        parser.error("--frames: expected 12 or more, so that a sixth of them keeps two workers busy")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if options.list:
            measure_listing(folder, options.list)
            return
        pair = (options.rgb, options.depth) if options.rgb and options.depth else render(folder, options.ratio)
        for name, count in (("many", options.frames), ("few", 6)):
            for number in range(count):
                for kind, path in zip(("rgb", "depth"), pair, strict=True):
                    target = folder / name / kind / f"{number:05}{path.suffix}"
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(path, target)
        given = ["--method", options.method, "--device", options.device]
        given += ["--only", options.only] if options.only else []
        if options.profile:
            profile(folder, folder / "few", given, 6)
        else:
            measure(folder, folder / "many", options.frames, options.rounds, given)


if __name__ == "__main__":
    main()
