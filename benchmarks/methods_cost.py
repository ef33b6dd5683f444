"""Measure what each method costs on one scene: CPU seconds on one thread, memory beyond the problem's own, parameters.

    python benchmarks/methods_cost.py --scenes DIR [--methods tgv,eg] [--scale 4,8] [--weights DIR] [--device cpu]

Every figure is of a process of its own. Seconds are the smallest of ``--repeats`` calls, so that a library's first
initialisation does not count; memory is how much the process's peak grew. Networks of other authors are measured if
``--weights`` has their files; their own images are not augmented, while packaged networks average four turns, which
``--ensemble 1`` switches off. Prints a Markdown table; "-" is a method that does not have that scale.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from torch import nn

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.recipe import Run, read_recipe

METHODS = (
    "bicubic,bilateral,guided_filter,joint_bilateral,fast_global_smoother,tgv,srfs,eg,"
    "pdn,dg,sparse_to_dense,ddrnet,msg_v,facets"
)


def peak() -> float:
    """Return the most memory that this process has held, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def cpu_seconds() -> float:
    """Return the CPU time of all threads of this process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def parameters(method: Any) -> int:
    """Return the number of parameters of the networks that a method holds."""
    modules = [value for value in vars(method).values() if isinstance(value, nn.Module)]
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def measured(options: argparse.Namespace) -> dict[str, float]:
    """Return the seconds and the megabytes of one call, and the method's parameters."""
    torch.set_num_threads(options.threads)
    name, scale = options.methods, int(options.scale)
    device = torch.device(options.device)
    recipe = read_recipe(name)
    if options.ensemble is not None and "ensemble" in recipe.at():
        recipe = read_recipe(name, {"ensemble": options.ensemble})
    if not recipe.at().get("weights", {}).get("packaged"):
        recipe = recipe.with_weights(options.weights)
    method = recipe.build(scale, Run(device=device))
    scene = Folder(str(options.scenes), [options.scene]).load(options.scene)
    sample = make_sample(scene, scale, Downsampling("box"), method.range_type)
    before, seconds = peak(), []
    for _ in range(options.repeats):
        start = cpu_seconds()
        method(sample)
        seconds.append(cpu_seconds() - start)
    return {"seconds": min(seconds), "megabytes": peak() - before, "parameters": parameters(method)}


def measure_apart(name: str, scale: str, arguments: list[str], threads: int) -> dict[str, float] | None:
    """Return what a process of its own measures; None if the method does not have the scale or its weights."""
    command = [sys.executable, __file__, *arguments, "--one", "--methods", name, "--scale", scale]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)  # noqa: S603
    return dict(json.loads(done.stdout.splitlines()[-1])) if done.returncode == 0 else None


def main() -> None:
    """Measure each method in a process of its own, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True, help="a folder of scenes, as dataset=folder reads it")
    parser.add_argument("--scene", default="plant")
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--scale", default="4,8")
    parser.add_argument("--weights", type=Path, help="a directory with the files of published networks")
    parser.add_argument("--ensemble", type=int, help="test-time augmentations of the packaged networks")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(options)))
        return
    scales = options.scale.split(",")
    print(f"| method | parameters | {' | '.join(f'x{scale}, CPU s | x{scale}, MB' for scale in scales)} |")
    print("| --- | ---: |" + " ---: | ---: |" * len(scales))
    for name in options.methods.split(","):
        found = [measure_apart(name, scale, sys.argv[1:], options.threads) for scale in scales]
        counts = {f"{each['parameters'] / 1e6:.2f} M" for each in found if each and each["parameters"]}
        cells = [f"{each['seconds']:.2f} | {each['megabytes']:.0f}" if each else "- | -" for each in found]
        print(f"| `{name}` | {', '.join(sorted(counts)) or '-'} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
