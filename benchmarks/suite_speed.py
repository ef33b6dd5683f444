"""The whole suite for one 640 x 480 pair on one thread: CPU seconds of each family of metrics, and the peak of memory.

    python benchmarks/suite_speed.py [--repeats 3]

The pair is a room of planes and balls, and its x4 bicubic interpolation. LPIPS_v has a trunk of random weights. The
first call of each family, which compiles or imports something, is listed beside the median of the others.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time

import torch
from metrics_speed import random_trunk

from dsr.data.rendered import SimGeo
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.classical.interpolation import Interpolation
from dsr.metrics.catalogue import PROTOCOLS, catalogue, score_image
from dsr.metrics.lpips import LPIPS

SIZE = (480, 640)
LEFT_OUT = ("field", "sensor", "plane")


def pair() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return a prediction, a truth and the rays of a 640 x 480 picture."""
    scene = SimGeo(None, ["statue"], 640).load("statue").crop(80, 0, *SIZE)
    sample = make_sample(scene, 4, Downsampling("box"), "perspective")
    assert sample.depth is not None  # noqa: S101 - for the type checker
    camera: Camera = sample.camera
    return Interpolation("bicubic")(sample).double(), sample.depth.double(), camera.rays()


def main() -> None:
    """Measure, and print a line a family."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    repeats = parser.parse_args().repeats
    torch.set_num_threads(1)
    maps, network, total = pair(), LPIPS(random_trunk()), 0.0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name in (each for each in PROTOCOLS if each not in LEFT_OUT):
        metrics, seconds = catalogue(network, protocols=[name]), []
        for _ in range(repeats + 1):
            start = time.process_time()
            list(score_image(*maps, metrics))
            seconds.append(time.process_time() - start)
        median = statistics.median(seconds[1:])
        total += median
        print(f"{name:<12}{median:7.2f} s, the first {seconds[0]:.2f} s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{'together':<12}{total:7.2f} s; memory at most {peak / 1024:.0f} MB, {before / 1024:.0f} MB before")


if __name__ == "__main__":
    main()
