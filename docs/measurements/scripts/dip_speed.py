# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How much faster a step of DIP-V is than the plain way, and that nothing is lost by it.

    python docs/measurements/scripts/dip_speed.py [--size 256] [--steps 5] [--threads N] [--quality-steps 0] [--device cpu]

The plain way is that of the original's code: float32, PyTorch's default memory layout, the library's bilinear
upsampling, 128 channels in each level. ``same network`` is ours with these channels, ``default`` with ours.
All take turns within the run; ratios are those of the medians. ``--quality-steps N`` optimises the statue for N steps
in the plain way and in ours with the same network, and prints both scores.

``several images at once``: the default network for one image against grouped convolutions for two and four images with
weights of their own, per image.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.data.rendered import SimGeo
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.dip import upsampler
from dsr.methods.dip.upsampler import DeepImagePrior, PriorOptimisation
from dsr.metrics.classes import visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import DepthSample
from dsr.utils.compute_device import fast_precision

BOX = Downsampling("box")
WIDE = (128,) * 5


def library(x: Tensor) -> Tensor:
    """Return the library's bilinear upsampling by 2."""
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def module_of(
    sample: DepthSample, device: torch.device, *, plain: bool, widths: tuple[int, ...] | None = None
) -> PriorOptimisation:
    """Return an optimisation, in the plain way or ours."""
    given: dict[str, object] = {} if widths is None else {"widths": widths}
    precision = "float32" if plain else fast_precision(device)
    if plain:
        given |= {"border": 0}
    prior = DeepImagePrior(scale=4, downsampling=BOX, precision=precision, device=device, **given)  # type: ignore[arg-type]
    module = PriorOptimisation(prior, sample, visual=True)
    if plain:
        module.net.to(memory_format=torch.contiguous_format)
        module.forward = lambda: in_plain_layout(module)  # type: ignore[method-assign]
    return module


def in_plain_layout(module: PriorOptimisation) -> tuple[Tensor, Tensor]:
    """Return what :meth:`PriorOptimisation.forward` does, without a memory layout of its own."""
    draws = torch.randn(module.start.shape, generator=module.generator, device=module.start.device)
    before, upsampler.upsample_2x = upsampler.upsample_2x, library
    try:
        y = module.net(torch.addcmul(module.start, draws, module.spread).contiguous())
    finally:
        upsampler.upsample_2x = before
    return module.near + (module.far - module.near) * y[:, :1].sigmoid(), y[:, 1:].sigmoid()


def stepper(module: PriorOptimisation) -> Callable[[], Tensor]:
    """Return a function that does a step."""
    optimiser = module.configure_optimizers()

    def step() -> Tensor:
        depth, intensity = module()
        loss = module.loss_terms(depth, intensity)["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        return depth.detach()

    return step


def seconds(steps: dict[str, Callable[[], object]], count: int) -> dict[str, float]:
    """Return the median time of each, all taking turns."""
    taken: dict[str, list[float]] = {name: [] for name in steps}
    for turn in range(count + 1):
        for name, step in steps.items():
            start = time.perf_counter()
            step()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if turn:  # the first one warms up
                taken[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in taken.items()}


def grouped(net: nn.Module, images: int) -> nn.Module:
    """Return the network with every layer as wide as ``images`` of it, in as many groups; for its speed alone."""
    for name, layer in net.named_children():
        if isinstance(layer, nn.Conv2d):
            new: nn.Module = nn.Conv2d(
                layer.in_channels * images, layer.out_channels * images, layer.kernel_size, layer.stride,
                layer.padding, groups=images,
            )  # fmt: skip
            setattr(net, name, new)
        elif isinstance(layer, nn.BatchNorm2d):
            setattr(net, name, nn.BatchNorm2d(layer.num_features * images, track_running_stats=False))
        else:
            grouped(layer, images)
    return net


def network_step(images: int, size: int, device: torch.device) -> Callable[[], None]:
    """Return a function that goes forward and back through the network of several images."""
    settings = DeepImagePrior(scale=4, downsampling=BOX)
    net = grouped(upsampler.SkipNet(35, 2, settings.widths, settings.skips), images)
    net = net.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    x = torch.rand(1, 35 * images, size, size, device=device).to(memory_format=torch.channels_last)
    mixed = fast_precision(device) == "bfloat16"

    def step() -> None:
        with torch.autocast(device.type, torch.bfloat16, enabled=mixed):
            y = net(x)
        y.float().square().mean().backward()
        net.zero_grad(set_to_none=True)

    return step


def scores_after(module: PriorOptimisation, sample: DepthSample, steps: int) -> dict[str, float]:
    """Return the scores of the running average after some steps."""
    step = stepper(module)
    average = step()
    for count in range(2, steps + 1):
        average.lerp_(step(), 1 - min(0.99, (count - 1) / (count + 9)))
    metrics, truth, average = visual_metrics(), sample.depth, average.cpu()
    if truth is not None:
        metrics.update(SurfacePair(average.double(), truth[None].double(), sample.camera.rays()[None]))
    return {name: float(value) for name, value in metrics.compute().items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--quality-steps", type=int, default=0)
    parser.add_argument("--device", type=torch.device, default="cpu")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device: torch.device = options.device
    sample = make_sample(SimGeo(size=options.size).load("statue"), 4, BOX, "orthogonal")
    kinds = {
        "plain": {"plain": True, "widths": WIDE},
        "same network": {"plain": False, "widths": WIDE},
        "default": {"plain": False},
    }
    times = seconds({name: stepper(module_of(sample, device, **kind)) for name, kind in kinds.items()}, options.steps)  # type: ignore[arg-type]
    for name in ("same network", "default"):
        print(f"{name}: {times['plain'] / times[name]:.1f} times as fast as the plain way at {options.size} pixels")
    side = min(options.size, 128)
    groups = seconds({str(images): network_step(images, side, device) for images in (1, 2, 4)}, options.steps)
    for images in (2, 4):
        ratio = groups["1"] / (groups[str(images)] / images)
        print(f"{images} images at once: {ratio:.2f} times as fast per image as one at {side} pixels")
    if options.quality_steps:
        for name in ("plain", "same network"):
            found = scores_after(module_of(sample, device, **kinds[name]), sample, options.quality_steps)  # type: ignore[arg-type]
            text = "  ".join(f"{metric} {found[metric]:.4f}" for metric in ("RMSE_d", "DSSIM_v", "RMSE_v"))
            print(f"{name} after {options.quality_steps} steps: {text}")


if __name__ == "__main__":
    main()
