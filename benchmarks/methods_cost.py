"""Measure what each method costs on a photo of 512 x 512: seconds, and memory beyond the problem's own.

    OMP_NUM_THREADS=2 python benchmarks/methods_cost.py --scenes DIR [--methods tgv,eg] [--scale 4,8] [--device cpu]

Every figure is of a process of its own; seconds are of its one and only call, memory is how much its peak grew during
it. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import torch

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.registry import build_method, read_method

METHODS = (
    "bicubic,guided_filter,joint_bilateral,fast_global_smoother,anisotropic_diffusion,tgv,srfs,eg,pdn,dg,msg_v,facets"
)


def peak() -> float:
    """Return the most memory that this process has held, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def measured(scenes: Path, scene: str, name: str, scale: int, device: str) -> dict[str, float]:
    """Return the seconds and the megabytes of one call."""
    given = {"precision": "float32", "device": torch.device(device), "downsampling": Downsampling("box")}
    method = build_method(read_method(name, scale), scale, **given)
    sample = make_sample(Folder(str(scenes), [scene]).load(scene), scale, Downsampling("box"), method.range_type)
    before, start = peak(), time.perf_counter()
    method(sample)
    return {"seconds": time.perf_counter() - start, "megabytes": peak() - before}


def main() -> None:
    """Measure each method in a process of its own, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True, help="a folder of scenes, as dataset=folder reads it")
    parser.add_argument("--scene", default="plant")
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--scale", default="4,8")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    names, scales = options.methods.split(","), [int(scale) for scale in options.scale.split(",")]
    if options.one:
        print(json.dumps(measured(options.scenes, options.scene, names[0], scales[0], options.device)))
        return
    print(f"| method | {' | '.join(f'x{scale}, s | x{scale}, MB' for scale in scales)} |")
    print("| --- |" + " ---: | ---: |" * len(scales))
    for name in names:
        cells = []
        for scale in scales:
            command = [sys.executable, __file__, "--scenes", str(options.scenes), "--scene", options.scene, "--one"]
            command += ["--methods", name, "--scale", str(scale), "--device", options.device]
            done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - this very file
            found = json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else None
            cells += [f"{found['seconds']:.1f}", f"{found['megabytes']:.0f}"] if found else ["-", "-"]
        print(f"| `{name}` | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
