"""Training patches that are made on the device of the training, a whole batch at a time.

The scenes are stored there, colours in 8 bits. The CPU draws numbers alone: a window, how it is mirrored, turned and
changed, a kernel, seeds. Fields of random numbers are functions of their seeds, so patch number i is a function of
(seed, i), here as well. They are distributed as those of :class:`~dsr.training.patches.Patches`, and the same ones if
no photo, noise or kernel is drawn. Sensors, holes, folds, soft steps, levels of disparity and JPEG are not made here,
and scenes have no holes.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.downsampling import KERNELS, Downsampling, encode_facts, kernel_matrix, known_kernels, local_noise
from dsr.degradation.noise import GaussianMultiplicative, draw_white_strength
from dsr.degradation.random_degradation import GRAIN, ROUNDED, STEPS, Everything, draw_grain_width
from dsr.degradation.random_fields import chance, draw, integer, normal, power
from dsr.geometry.camera import baseline_times_focal
from dsr.methods.images import compute_min_max
from dsr.sample import FARTHEST, NEAREST
from dsr.training.degradation import Batch, Degradation, least_range
from dsr.training.patches import Patches, draw_changes, mirror_camera
from dsr.utils.compute_device import made_once

_UNMADE = ("folds", "displaced", "rounded", "soft", "photo", "textured", "clear")  # of Everything, by workers alone
_RADIUS = 6  # pixels: of the widest Gaussian
_STRONGEST = 0.16  # standard deviation of noise that turns no disparity, which would be a hole
_MIXED = (-0x61C8864680B583EB, -0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15)  # of SplitMix64 (Steele et al. 2014)


def made_by_workers(degradation: Degradation, everything: Everything | None) -> str:
    """Return the first key of a configuration that only workers can make; empty if a device can make all of it."""
    if everything is None:
        if degradation.downsampling.range_type not in (None, "disparity"):
            return "downsampling.range_type"
        noise = degradation.noise
        weak = noise is None or (isinstance(noise, GaussianMultiplicative) and noise.std <= _STRONGEST)
        return "" if weak else "noise"
    for name in _UNMADE:
        if getattr(everything, name):
            return f"degradation.{name}"
    if any(str(scale) == "1" for scale in everything.scales or ()):
        return "degradation.scales"
    for key, made in (("kernels", KERNELS), ("noises", ("none", "white")), ("holes", ("none",))):
        if any(share for name, share in getattr(everything, key).items() if name not in made):
            return f"degradation.{key}"
    return ""


class DevicePatches(Patches):
    """The random patches of a run: items are their random numbers, of which :meth:`make` makes a batch of patches."""

    def __getitem__(self, number: int) -> Batch:
        """Return the numbers of a patch, on the CPU."""
        random, settings = np.random.default_rng([self._seed, number]), self._settings
        group, everything = self._draw_group(random), self._everything
        index, top, left = self._window(group, random, settings.patch)
        scene = self._groups[group][index]
        changes = draw_changes(settings, random)
        camera = scene.camera.crop(top, left, settings.patch, settings.patch)
        for vertical, mirrored in enumerate(changes.mirrored):
            camera = mirror_camera(camera, vertical=bool(vertical)) if mirrored else camera
        camera = camera.rotate90(changes.turns)
        generator = torch.Generator().manual_seed(int(random.integers(2**63)))
        exponent, sigma, spread, _ = changes.photo or (1.0, 0.0, 0.0, None)
        start, width = self._starts[group][index], scene.rgb.shape[-1]
        batch = {
            "places": torch.tensor([start, width, top, left, *changes.mirrored, changes.turns]),
            "camera": torch.tensor(
                [camera.fx, camera.fy, camera.cx, camera.cy, baseline_times_focal(camera), camera.doffs],
                dtype=torch.float64,
            ),
            "gain": torch.as_tensor(changes.gain, dtype=torch.float32),
            "photo": torch.tensor([exponent, sigma, spread]),
            "factor": torch.tensor(changes.factor),
            "seeds": torch.randint(2**62, (3,), generator=generator),
        }
        if everything is None:
            low, high, weight = self._draw_extent(group, index, changes.factor, camera, random)
            return {**batch, "extent": torch.tensor([low, high, weight])}
        relief = torch.zeros(3)  # of grain its amount and width; the step of a file's levels in metres
        if chance(everything.relief, generator):
            if chance(ROUNDED, generator):
                relief[2] = STEPS[integer(0, 3, generator)]
            else:
                relief[1] = draw_grain_width(generator)
                relief[0] = power(*GRAIN, generator)
        kernel, noise = draw(everything.kernels, generator), draw(everything.noises, generator)
        strength = draw_white_strength(generator) if noise == "white" else 0.0
        told = [chance(everything.told, generator) for _ in range(3)]
        facts = encode_facts(kernel if told[0] else None, False if told[1] else None, noise=told[2])
        known = told[2] * math.exp(0.15 * normal(generator))
        drawn = [strength, known, float(chance(0.15, generator))]
        numbers = {"relief": relief, "noise": torch.tensor(drawn), "kernel": torch.tensor(KERNELS.index(kernel))}
        return {**batch, **numbers, "facts": facts, "scale": self._draw_scale(number)}

    def collate(self, items: Sequence[Batch]) -> Batch:
        """Return the numbers of a batch, and of hints the kernels, which a step has to know without asking a device."""
        batch: Batch = {name: torch.stack([each[name] for each in items]) for name in items[0] if name != "scale"}
        if "facts" in batch:
            batch |= {"scale": items[0]["scale"], "kernels": known_kernels(batch["facts"])}
        return batch

    def store(self, device: torch.device) -> None:
        """Put the scenes on a device."""
        colours, inverse, end = [], [], 0
        self._starts: list[list[int]] = []  # of each scene of a group, in pixels
        for group in self._groups:
            self._starts.append([])
            for scene in group:
                self._starts[-1].append(end)
                colours.append((255 * scene.rgb).round().byte().flatten(1))
                inverse.append(scene.true_depth.reciprocal().float().flatten())
                end += inverse[-1].numel()
        self._colours, self._inverse = torch.cat(colours, dim=1).to(device), torch.cat(inverse).to(device)

    @torch.no_grad()
    def make(self, batch: Batch) -> Batch:
        """Return the patches of numbers that have been moved to the device of the scenes."""
        start, width, top, left, across, down, turns = batch["places"].view(-1, 7, 1, 1).unbind(1)
        size, device = self._settings.patch, start.device
        steps = torch.arange(size, device=device)
        v, u = steps[:, None], steps
        back_v, back_u = size - 1 - v, size - 1 - u
        odd = turns % 2 == 1
        rows = torch.where(odd, torch.where(turns == 1, u, back_u), torch.where(turns == 0, v, back_v))
        columns = torch.where(odd, torch.where(turns == 1, back_v, v), torch.where(turns == 0, u, back_u))
        rows = top + torch.where(down == 1, size - 1 - rows, rows)
        columns = left + torch.where(across == 1, size - 1 - columns, columns)
        index = start + rows * width + columns
        rgb = self._take_photos(self._colours[:, index].movedim(1, 0).float() / 255, batch)
        inverse = self._inverse[index][:, None] / batch["factor"].view(-1, 1, 1, 1)
        fx, fy, cx, cy, bf, doffs = batch["camera"].view(-1, 6, 1, 1, 1).unbind(1)
        rays = torch.stack(torch.broadcast_tensors((u - cx) / fx, (v - cy) / fy, torch.ones_like(cx)), dim=2)[:, 0]
        bf, doffs = bf.float(), doffs.float()
        if self._everything is None:
            degradation = self._degradation
            models: tuple[Downsampling, ...] = (degradation.downsampling,)
            disparity = _downsample(bf * inverse - doffs, models, degradation.scale)
            if degradation.noise is not None:
                assert isinstance(degradation.noise, GaussianMultiplicative)  # noqa: S101 - see made_by_workers
                draws = normal_field(batch["seeds"][:, 1], disparity.shape)
                disparity = disparity * (1 + degradation.noise.std * draws)
            made: Batch = {"kernels": None}
        else:
            inverse = self._add_relief(inverse, batch)
            models = tuple(Downsampling(kernel) for kernel in KERNELS)
            kernel, of_depth = batch["kernel"], batch["noise"][:, 2].view(-1, 1, 1, 1) > 0
            averaged = torch.where(of_depth, inverse.reciprocal(), inverse)
            clean = _downsample(averaged, models, batch["scale"], kernel)
            clean = torch.where(of_depth, clean.reciprocal(), clean)
            strength, known, _ = batch["noise"].view(-1, 3, 1, 1, 1).unbind(1)
            low = (clean * (1 + strength * normal_field(batch["seeds"][:, 1], clean.shape))).clamp(min=1 / FARTHEST)
            disparity = bf * low - doffs
            made = {name: batch[name] for name in ("facts", "kernels")}
            made |= {"noise": known * local_noise(low, clean), "soft": torch.zeros_like(known.flatten())}
        disparity = (disparity + doffs).clamp(bf / FARTHEST, bf / NEAREST) - doffs
        patches = {
            "rgb": rgb, "disparity_lr": disparity, "depth": inverse.reciprocal(), "rays": rays.float(), "bf": bf,
            "doffs": doffs,
        }  # fmt: skip
        low, high = compute_min_max(disparity).split(1, dim=1)
        own = torch.cat((low, torch.maximum(high, low + least_range(high))), dim=1)
        if self._everything is None:
            near, far, weight = batch["extent"].view(-1, 3, 1, 1).split(1, dim=1)
            extent = torch.cat((torch.minimum(near, own[:, :1]), torch.maximum(far, own[:, 1:])), dim=1)
            own = own + weight * (extent - own)
        return {**patches, "min_max": own, **made}

    def _take_photos(self, rgb: Tensor, batch: Batch) -> Tensor:
        """Change the colours, gamma and blur of photos (B, 3, H, W), and add noise."""
        rgb = (rgb * batch["gain"]).clamp(0, 1)
        if not self._settings.photo:
            return rgb
        exponent, sigma, spread = batch["photo"].view(-1, 3, 1, 1, 1).unbind(1)
        reach = (4 * sigma + 0.5).floor()  # as scipy's
        rgb = blur(rgb**exponent, sigma.flatten(), reach.flatten())
        return (rgb + spread * normal_field(batch["seeds"][:, 0], rgb.shape)).clamp(0, 1)

    def _add_relief(self, inverse: Tensor, batch: Batch) -> Tensor:
        amount, sigma, step = batch["relief"].view(-1, 3, 1, 1, 1).unbind(1)
        grain = normal_field(batch["seeds"][:, 2], inverse.shape)
        grain = blur(grain, sigma.flatten(), (3.5 * sigma).ceil().clamp(min=1).flatten(), power=2)
        rounded = ((inverse.reciprocal() / step).round() * step).maximum(step).reciprocal()
        return torch.where(step > 0, rounded, inverse * (1 + amount * grain))


def blur(images: Tensor, sigma: Tensor, reach: Tensor, power: int = 1) -> Tensor:
    """Blur images (B, C, H, W) by Gaussians of ``sigma`` (B,) pixels up to ``reach`` (B,), at most 6; 0 for none.

    The powers of the weights along an axis add up to 1: with 2, noise keeps its variance.
    """
    x = torch.arange(-_RADIUS, _RADIUS + 1, device=images.device, dtype=images.dtype)
    weights = torch.exp(-0.5 * (x / sigma.clamp(min=1e-3)[:, None]).square()) * (x.abs() <= reach[:, None])
    weights = weights / weights.pow(power).sum(dim=1, keepdim=True).pow(1 / power)
    batch, channels = images.shape[:2]
    weights = weights.repeat_interleave(channels, dim=0)[:, None, :, None]
    padded = functional.pad(images, (_RADIUS,) * 4, mode="replicate").flatten(0, 1)[None]
    found = functional.conv2d(padded, weights, groups=batch * channels)
    return functional.conv2d(found, weights.transpose(2, 3), groups=batch * channels).view_as(images)


def normal_field(seeds: Tensor, shape: torch.Size) -> Tensor:
    """Return normal noise, (B, ...) in float32, a function of each image's seed, (B,): the same on every device."""
    count = math.prod(shape[1:])
    numbers = torch.arange(2 * count, device=seeds.device) + 1
    mixed = seeds[:, None] + numbers * _MIXED[0]  # 64-bit numbers overflow, as they have to
    for shift, factor in ((30, _MIXED[1]), (27, _MIXED[2]), (31, 1)):
        mixed = (mixed ^ ((mixed >> shift) & ((1 << (64 - shift)) - 1))) * factor
    chances = ((mixed >> 40) & 0xFFFFFF).float().add_(0.5).mul_(2.0**-24)
    radius, angle = chances.split(count, dim=1)
    return ((-2 * radius.log()).sqrt() * (2 * math.pi * angle).cos()).view(shape)


def _downsample(values: Tensor, models: tuple[Downsampling, ...], scale: int, kind: Tensor | None = None) -> Tensor:
    """Downsample maps without holes, (B, 1, H, W), each by its kind of the models, (B,)."""
    matrices = _matrices(models, values.shape[-1], scale, values.device)
    chosen = matrices[:1] if kind is None else matrices[kind]
    return (chosen @ values[:, 0] @ chosen.transpose(1, 2))[:, None]


@made_once
def _matrices(models: tuple[Downsampling, ...], size: int, scale: int, device: torch.device) -> Tensor:
    return torch.stack([kernel_matrix(model, size, scale, torch.float32, device) for model in models])
