"""Time of ``dsr upsample`` on a phone's frame, and how the rate of many frames grows with workers; peak memory.

    python benchmarks/upsample_speed.py --rgb PHOTO --depth MAP [--frames 20] [--method facets]
        [--device cpu]

Prints the seconds of one frame without the mesh, then those of a frame in a folder of copies: with one worker on one
core, and with two workers on two. Memory is the largest of a process.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def upsample(arguments: list[str], cores: set[int]) -> float:
    """Run the command on some cores, and return the seconds it takes."""
    environment = {**os.environ, **({"OMP_NUM_THREADS": "1"} if len(cores) == 1 else {})}
    started = time.perf_counter()
    subprocess.run(  # noqa: S603 - this project's command
        [sys.executable, "-m", "dsr", "upsample", *arguments, "--without", "mesh"],
        check=True,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )
    return time.perf_counter() - started


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rgb", type=Path, required=True)
    parser.add_argument("--depth", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--method", default="facets")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))[:2]
    method = ["--method", options.method, "--device", options.device]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for number in range(options.frames + 1):
            for kind, path in (("rgb", options.rgb), ("depth", options.depth)):
                target = folder / ("one" if number == options.frames else "many") / kind / f"{number:05}{path.suffix}"
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target)
        start = upsample([str(folder / "one"), "--dry-run", *method, "-o", str(folder / "out_start")], set(cores))
        single = upsample([str(folder / "one"), *method, "-o", str(folder / "out_one")], set(cores))
        print(f"one frame, two threads: {single - start:.1f} s, and {start:.1f} s to start")
        rates = {}
        for workers in (1, 2):
            output = folder / f"out{workers}"
            arguments = [str(folder / "many"), *method, "--workers", str(workers), "-o", str(output)]
            rates[workers] = (upsample(arguments, set(cores[:workers])) - start) / options.frames
            print(f"{options.frames} frames, workers: {workers}, cores: {workers}: {rates[workers]:.2f} s a frame")
            shutil.rmtree(output)
    print(f"two workers are {rates[1] / rates[2]:.2f} times as fast")
    print(f"memory of the largest process: {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20:.1f} GiB")


if __name__ == "__main__":
    main()
