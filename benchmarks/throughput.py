"""Frames a second of ``dsr upsample`` per core, with one and with two workers, and where the time goes.

    python benchmarks/throughput.py [--frames 24] [--rounds 3] [--rgb PHOTO --depth MAP] [--method facets]
    python benchmarks/throughput.py --list 100000

Frames are a photo of 640 x 480 and a noisy map of 160 x 120 in millimetres, rendered unless a pair is given, each under
a name of its own; what is written is ``--only depth`` and, in a second row, everything. One worker runs on one core,
two on two, in turns, and the fastest round of each counts; the time to start is that of a sixth of the frames and is
taken off. The profile is of one worker, with everything written. ``--list`` measures nothing else but the seconds to
list small files, to write a manifest of them for 16 shards and to read one shard of it.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

PARTS = {"depth alone": ("--only", "depth"), "everything": ()}
STEPS = (
    ("read the pair", "inputs.py", "read_picture"),
    ("hash the files", "request.py", "inputs_with_neighbours"),
    ("find the displacement", "alignment.py", "align"),
    ("upsample", "frame.py", "_upsample"),
    ("write all parts", "outputs.py", "write_parts"),
)
"""What a frame's time is spent with: a name, and the function with its file."""


def render(folder: Path) -> tuple[Path, Path]:
    """Write a photo of 640 x 480 and a noisy map of 160 x 120."""
    import torch  # noqa: PLC0415

    from dsr.degradation.downsampling import Downsampling, make_sample  # noqa: PLC0415 - seconds to import
    from dsr.degradation.noise import Kinect  # noqa: PLC0415
    from dsr.sample import Scene  # noqa: PLC0415
    from dsr.synthetic.procedural.scenes import make_camera, random_scene  # noqa: PLC0415
    from dsr.synthetic.procedural.scenes import render as render_scene  # noqa: PLC0415

    scene = random_scene(np.random.default_rng(5))
    made = render_scene(scene, 640)
    camera = make_camera(scene.viewpoint, 640).crop(0, 80, 480, 640)
    rgb, depth = made.rgb[80:560], made.depth[80:560]
    photo = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1).float() / 255
    sample = make_sample(
        Scene("throughput", "frame", photo, camera, torch.from_numpy(depth.copy())[None]),
        4, Downsampling("box"), "disparity", Kinect(),
    )  # fmt: skip
    cv2.imwrite(str(folder / "photo.jpg"), rgb[..., ::-1])
    millimetres = (1e3 * sample.depth_lr[0].nan_to_num(0)).round().clamp(0, 65535).numpy().astype(np.uint16)
    cv2.imwrite(str(folder / "map.png"), millimetres)
    return folder / "photo.jpg", folder / "map.png"


def upsample(arguments: list[str], cores: set[int]) -> float:
    """Run the command on some cores with one thread each, and return the seconds it takes."""
    started = time.perf_counter()
    subprocess.run(  # noqa: S603 - this project's command
        [sys.executable, "-m", "dsr.cli", "upsample", *arguments],
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )
    return time.perf_counter() - started


def measure(folder: Path, source: Path, frames: int, rounds: int, method: str) -> None:
    """Print the rates."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    for name, parts in PARTS.items():
        seconds: dict[tuple[str, int], list[float]] = {}
        options = [str(source), "--method", method, *parts, "--fov", "60"]
        for _ in range(rounds):
            for workers in (1, 2):
                used = set(cores[:workers])
                work = ["--workers", str(workers), "-o", str(folder / f"out{workers}")]
                seconds.setdefault(("some", workers), []).append(upsample([*options, *work, "--shard", "1/6"], used))
                shutil.rmtree(folder / f"out{workers}")
                seconds.setdefault(("all", workers), []).append(upsample([*options, *work], used))
                if workers == 1:
                    seconds.setdefault(("again", 1), []).append(upsample([*options, *work], used))
                    seconds.setdefault(("some again", 1), []).append(
                        upsample([*options, *work, "--shard", "1/6"], used)
                    )
                shutil.rmtree(folder / f"out{workers}")
        best = {key: min(values) for key, values in seconds.items()}
        more = frames - frames // 6
        rates = {workers: more / (best["all", workers] - best["some", workers]) for workers in (1, 2)}
        again = (best["again", 1] - best["some again", 1]) / more
        print(
            f"{name}: {rates[1]:.2f} frames/s with one worker on one core, {rates[2]:.2f} with two on two "
            f"({rates[2] / rates[1]:.2f} times); {1e3 * again:.0f} ms a frame that is complete already",
            flush=True,
        )


def profile(folder: Path, source: Path, method: str) -> None:
    """Print where one worker's time goes, in milliseconds a frame."""
    import torch  # noqa: PLC0415

    from dsr.cli import main as dsr  # noqa: PLC0415

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    options = ["upsample", str(source), "--method", method, "--fov", "60", "-o"]
    dsr([*options, str(folder / "warm")])
    watch = cProfile.Profile()
    watch.enable()
    dsr([*options, str(folder / "profile")])
    watch.disable()
    entries = pstats.Stats(watch).stats  # type: ignore[attr-defined]
    found = {(Path(file).name, function): value for (file, _, function), value in entries.items()}
    calls, _, _, total, _ = found["frame.py", "__call__"]
    print(f"profile, everything written: {1e3 * total / calls:.0f} ms a frame")
    rest = total
    for name, file, function in STEPS:
        spent = found[file, function][3]
        rest -= spent
        print(f"  {name:24s} {1e3 * spent / calls:7.1f} ms  {spent / total:4.0%}")
    print(f"  {'other':24s} {1e3 * rest / calls:7.1f} ms  {rest / total:4.0%}")


def measure_listing(folder: Path, count: int) -> None:
    """Print the seconds to list frames, to write their manifest and to read a shard of it."""
    from dsr.io.layouts import find_pairs_of_folder  # noqa: PLC0415
    from dsr.io.manifest import Manifest, write_manifest  # noqa: PLC0415
    from dsr.io.shards import Shard  # noqa: PLC0415

    for kind in ("rgb", "depth"):
        (folder / kind).mkdir()
        for number in range(count):
            (folder / kind / f"{number:07}.png").write_bytes(b"x")
    times = {}
    started = time.perf_counter()
    found = find_pairs_of_folder(folder)
    times["list"] = time.perf_counter() - started
    started = time.perf_counter()
    write_manifest(folder / "manifest", found, 16)
    times["write"] = time.perf_counter() - started
    started = time.perf_counter()
    Manifest(folder / "manifest").read(Shard(8, 16))
    times["shard"] = time.perf_counter() - started
    print(
        f"{count} frames: {times['list']:.1f} s to list and to pair, {times['write']:.1f} s to write a manifest of "
        f"{(folder / 'manifest').stat().st_size / 2**20:.0f} MiB, {times['shard']:.2f} s to read one of 16 shards"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rgb", type=Path)
    parser.add_argument("--depth", type=Path)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--method", default="facets")
    parser.add_argument("--list", type=int, metavar="N", help="only list N small files")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if options.list:
            measure_listing(folder, options.list)
            return
        pair = (options.rgb, options.depth) if options.rgb and options.depth else render(folder)
        for name, count in (("many", options.frames), ("few", 6)):
            for number in range(count):
                for kind, path in zip(("rgb", "depth"), pair, strict=True):
                    target = folder / name / kind / f"{number:05}{path.suffix}"
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(path, target)
        profile(folder, folder / "few", options.method)
        measure(folder, folder / "many", options.frames, options.rounds, options.method)


if __name__ == "__main__":
    main()
