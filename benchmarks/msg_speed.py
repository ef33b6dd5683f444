"""How much faster than plain code MSG-V runs, drift compensation included, and how far its output is from it.

The plain way runs the whole network twice, in float32 and PyTorch's default memory layout. Each line below it adds one
measure; all are timed in turns within the same run, so that only the ratios matter:

    python benchmarks/msg_speed.py [--device cuda]              # random weights
    python benchmarks/msg_speed.py --weights msg_v_x4_clean.pth
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.networks.trained import load_msg_weights

SCALE = 4
TARGETS = {"float32": 3.0, "bfloat16": 8.0}


def scene(size: int) -> tuple[Tensor, Tensor]:
    """Return a photo (1, 3, size, size) and LR disparity (1, 1, size / 4, size / 4): a disc before a wavy wall."""
    axis = torch.linspace(-1, 1, size, dtype=torch.float64)
    y, x = axis[:, None], axis[None, :]
    disc = x**2 + y**2 < 0.4
    disparity = 30 + 2 * torch.sin(9 * x + 4 * y) + 12 * disc
    noise = torch.rand((3, size, size), generator=torch.Generator().manual_seed(0))
    rgb = (0.5 + 0.2 * torch.sin(40 * x * y) + 0.2 * disc).float() + 0.1 * noise - 0.05
    return rgb[None], torch.nn.functional.avg_pool2d(disparity[None, None], SCALE)


def ways(net: MSGNet, size: int, device: torch.device) -> dict[str, Callable[[], Tensor]]:
    """Return the plain way first, then the measures one by one, each on top of those before."""
    rgb, disparity = (values.to(device) for values in scene(size))
    float32, bfloat16 = (NetworkUpsampler(net, each, device).net for each in ("float32", "bfloat16"))
    plain = copy.deepcopy(net).eval().to(device)

    def run(net: MSGNet, *, inference: bool) -> Callable[[], Tensor]:
        mode = torch.inference_mode if inference else torch.no_grad
        return mode()(lambda: net.upsample(rgb, disparity))

    return {
        "plain": run(plain, inference=False),
        "+ channels last": run(float32, inference=False),
        "+ activation in place (float32)": run(float32, inference=True),
        "+ bfloat16": run(bfloat16, inference=True),
    }


def measure(functions: dict[str, Callable[[], Tensor]], runs: int) -> dict[str, float]:
    """Return the median seconds of each function; they take turns, after one run to warm up."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for i in range(runs + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            if function().is_cuda:
                torch.cuda.synchronize()
            if i > 0:
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> None:
    """Print the table, and whether the targets are met."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--weights", type=Path, help="msg_v weights at scale 4; random ones without")
    parser.add_argument("--size", type=int, default=512, help="rows and columns of the output, a multiple of 4")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", type=torch.device, default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    net = MSGNet(SCALE) if arguments.weights is None else load_msg_weights(arguments.weights, SCALE, "voynov")

    functions = ways(net, arguments.size, arguments.device)
    seconds = measure(functions, arguments.runs)
    exact = functions["plain"]()
    least, most = scene(arguments.size)[1].aminmax()
    title = f"MSG-V x{SCALE}, {arguments.size} x {arguments.size}"
    print(f"{title:34} {'median':>9} {'ratio':>7}  max difference / range")
    for name, function in functions.items():
        difference = float((function() - exact).abs().max() / (most - least))
        print(f"{name:34} {seconds[name]:7.3f} s {seconds['plain'] / seconds[name]:6.1f}x  {difference:.1e}")
    for precision, target in TARGETS.items():
        name = next(name for name in functions if precision in name)
        print(f"{precision}: {seconds['plain'] / seconds[name]:.1f}x, target {target:.0f}x")


if __name__ == "__main__":
    main()
