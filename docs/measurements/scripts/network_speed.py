# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Where a network's answer spends its time: how near its convolutions are to the fastest matrix products.

    python docs/measurements/scripts/network_speed.py [--networks facets,facets_box,msg_v] [--scale 4] [--size 512] [--device cpu]

Each network answers for a random photo in the precision that is fast on the device. The time of every convolution is
measured apart, with an input of its size, and its floating-point operations are counted; the rest of the answer's time
is what else a network does. A convolution is compared with a matrix product of its own size, as if its windows had been
copied out (``im2col``), and with a large square one, the device's rate. What convolutions have to read and write, in
bytes, is compared with the bandwidth of a copy. Times are the smallest of ``--repeats``.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.recipe import Run, read_recipe
from dsr.sample import DepthSample, Scene
from dsr.utils.compute_device import fast_precision

_TYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
_SQUARE = 2048


@dataclass(frozen=True)
class Call:
    """A convolution that a network called: the shape, layout and type of its input, and its other arguments."""

    shape: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: torch.dtype
    weight: Tensor
    rest: tuple[Any, ...]

    @property
    def transposed(self) -> bool:
        """Whether it is a transposed convolution."""
        return bool(self.rest[4])

    @property
    def kind(self) -> tuple[Any, ...]:
        """What calls of the same cost have in common."""
        return self.shape, self.strides, self.dtype, tuple(self.weight.shape), str(self.rest[1:])

    def product(self, output: Tensor) -> tuple[int, int, int]:
        """Return the sizes m, k, n of the equivalent product of (m, k) with (k, n)."""
        if self.transposed:
            batch, channels, *size = self.shape
            return batch * math.prod(size), channels, self.weight[0].numel()
        return output.numel() // output.shape[1], self.weight[0].numel(), output.shape[1]


class Recorder(TorchDispatchMode):
    """Records the convolutions that are called."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Call] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Record a call, and carry it out."""
        if func.overloadpacket in (torch.ops.aten.conv2d, torch.ops.aten.conv_transpose2d):
            with self:  # a mode is off while it handles a call
                return func.decompose(*args, **(kwargs or {}))
        if func is torch.ops.aten.convolution.default:
            x, weight, *rest = args
            self.calls.append(Call(tuple(x.shape), x.stride(), x.dtype, weight, tuple(rest)))
        return func(*args, **(kwargs or {}))


def synchronise(device: torch.device) -> None:
    """Wait for the device."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def fastest(function: Callable[[], Any], repeats: int, device: torch.device) -> float:
    """Return the smallest of several times in seconds, after a call that warms up."""
    function()
    seconds = []
    for _ in range(repeats):
        synchronise(device)
        start = time.perf_counter()
        function()
        synchronise(device)
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def product_rate(m: int, k: int, n: int, dtype: torch.dtype, device: torch.device, repeats: int) -> float:
    """Return the rate of a matrix product in floating-point operations a second."""
    a, b = torch.rand(m, k, device=device).to(dtype), torch.rand(k, n, device=device).to(dtype)
    return 2 * m * k * n / fastest(lambda: a @ b, repeats, device)


def bandwidth(device: torch.device, repeats: int) -> float:
    """Return the bytes a second that a copy of 256 MB reads and writes."""
    source = torch.rand(64 * 1024 * 1024, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / fastest(lambda: target.copy_(source), repeats, device)


def random_sample(size: int, scale: int) -> DepthSample:
    """Return a problem of a wavy surface and a random photo."""
    v, u = torch.meshgrid(*2 * [torch.arange(size).double() / size], indexing="ij")
    depth = (3 + 0.2 * torch.sin(9 * u + 4 * v) + 0.5 * (u > 0.6))[None]
    camera = Camera(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2)
    rgb = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0))
    return make_sample(Scene("benchmark", "waves", rgb, camera, depth), scale, Downsampling("box"), "disparity")


@torch.inference_mode()
def measure(name: str, options: argparse.Namespace, device: torch.device, rate: float, copied: float) -> None:
    """Print the profile of a network's answer."""
    precision = fast_precision(device)
    settings = {"ensemble": 1} if "ensemble" in read_recipe(name).at() else {}
    method = read_recipe(name, settings).build(options.scale, Run(device=device, precision=precision))
    sample = random_sample(options.size, options.scale)
    with Recorder() as recorder:
        method(sample)
    answer = fastest(lambda: method(sample), options.repeats, device)
    alike: dict[tuple[Any, ...], list[Call]] = {}
    for call in recorder.calls:
        alike.setdefault(call.kind, []).append(call)
    rows = []
    for call, *more in alike.values():
        x = torch.empty_strided(call.shape, call.strides, dtype=call.dtype, device=device).fill_(0.5)
        output = torch.convolution(x, call.weight, *call.rest)
        seconds = fastest(partial(torch.convolution, x, call.weight, *call.rest), options.repeats, device)
        m, k, n = call.product(output)
        moved = (x.numel() + output.numel() + call.weight.numel()) * x.element_size()
        rows.append((call, 1 + len(more), seconds, 2 * m * k * n, moved, (m, k, n)))
    rate = max(rate, product_rate(*3 * [_SQUARE], _TYPES[precision], device, options.repeats))
    total = sum(count * seconds for _, count, seconds, *_ in rows)
    flops = sum(count * each for _, count, _, each, *_ in rows)
    least = sum(count * max(each / rate, moved / copied) for _, count, _, each, moved, _ in rows)
    print(
        f"\n{name} x{options.scale}, {precision}: {answer:.3f} s, of which {total:.3f} s are convolutions "
        f"({100 * total / answer:.0f} %), {flops / 1e9:.0f} GFLOP at {flops / total / 1e9:.0f} GFLOP/s"
    )
    print(
        f"{100 * flops / total / rate:.0f} % of the matrix product's {rate / 1e9:.0f} GFLOP/s; "
        f"{100 * least / total:.0f} % of what FLOPs and bytes allow"
    )
    print("| kernel | input | calls | ms | GFLOP/s | of the rate | of a product of its size |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for call, count, seconds, each, _, (m, k, n) in sorted(rows, key=lambda row: -row[1] * row[2])[: options.rows]:
        own = product_rate(min(m, 65536), k, n, call.dtype, device, options.repeats)
        shape, kernel = (" x ".join(map(str, each)) for each in (call.shape, call.weight.shape))
        print(
            f"| {kernel} | {shape} | {count} | {1e3 * count * seconds:.1f} | {each / seconds / 1e9:.0f} | "
            f"{100 * each / seconds / rate:.0f} % | {100 * each / seconds / own:.0f} % |",
            flush=True,
        )


def main() -> None:
    """Measure the limits, then each network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", default="facets,facets_box,msg_v")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rows", type=int, default=6, help="layers of each table, the slowest first")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    rates = {
        name: product_rate(_SQUARE, _SQUARE, _SQUARE, kind, device, options.repeats) for name, kind in _TYPES.items()
    }
    copied = bandwidth(device, options.repeats)
    print(
        ", ".join(f"{name}: {rate / 1e9:.0f} GFLOP/s" for name, rate in rates.items())
        + f", copy: {copied / 1e9:.1f} GB/s"
    )
    for name in options.networks.split(","):
        measure(name, options, device, rates[fast_precision(device)], copied)


if __name__ == "__main__":
    main()
