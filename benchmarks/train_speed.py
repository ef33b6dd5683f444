"""How much faster a training step of MSG-V is than in a plain float32 loop, data included.

    python benchmarks/train_speed.py [--patch 96] [--batch 5] [--steps 9]

The plain way is what a tutorial would write: float32, PyTorch's default memory layout, its own PReLU. Both take turns
within the run on the same patches; the ratio of the medians is the result.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time

import torch
from torch import nn

from dsr.data.simgeo import SimGeo
from dsr.degradation.downsampling import Downsampling
from dsr.methods.networks.msg_net import MSGNet
from dsr.training.degradation import Batch, Degradation
from dsr.training.objective import Objective
from dsr.training.patches import Patches
from dsr.training.settings import PatchSettings

SCALE = 4


class PlainPReLU(nn.PReLU):
    """The library's own, which MSG-Net would replace on the CPU."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return prelu(x) by way of a slope per channel."""
        return nn.functional.prelu(x, self.weight.expand(x.shape[1]))


def plain(net: MSGNet) -> MSGNet:
    """Return a copy without any measure for speed."""
    net = copy.deepcopy(net).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    for layer in net.modules():
        if hasattr(layer, "activation") and isinstance(layer.activation, nn.PReLU):
            layer.activation = nn.Sequential(PlainPReLU())
    return net


def step(net: MSGNet, objective: Objective, batch: Batch, *, mixed: bool) -> float:
    """Do forward, loss and backward; return the seconds."""
    start = time.perf_counter()
    with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
        disparity = net.upsample(batch["rgb"], batch["disparity_lr"], batch["min_max"])
    objective(disparity.float(), batch)["loss"].backward()
    net.zero_grad(set_to_none=True)
    return time.perf_counter() - start


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--patch", type=int, default=96)
    parser.add_argument("--batch", type=int, default=5)
    parser.add_argument("--steps", type=int, default=9)
    arguments = parser.parse_args()
    source = SimGeo(size=256)
    scenes = [source.load(name) for name in source.scenes()]
    settings = PatchSettings(patch=arguments.patch, batch=arguments.batch)
    patches = Patches([scenes], settings, Degradation(SCALE, Downsampling("box")), count=arguments.batch)
    start = time.perf_counter()
    batch = torch.utils.data.default_collate([patches[i] for i in range(arguments.batch)])
    loading = time.perf_counter() - start
    net, objective = MSGNet(SCALE, "dsr"), Objective("lap1", 0.1)
    slow = plain(net)
    fast = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    ways = {
        "plain float32 loop": lambda: step(slow, objective, batch, mixed=False),
        "float32": lambda: step(fast, objective, batch, mixed=False),
        "bfloat16": lambda: step(fast, objective, batch, mixed=True),
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(arguments.steps + 1):
        for name, way in ways.items():
            seconds[name].append(way())
    medians = {name: statistics.median(each[1:]) + loading for name, each in seconds.items()}
    for name, each in medians.items():
        print(f"{name:<20} {each:.3f} s a step   {medians['plain float32 loop'] / each:.2f} times as fast")


if __name__ == "__main__":
    main()
