"""The degradation that a network learns to undo, and the tensors of a sample that it trains on."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.noise import Noise
from dsr.geometry.camera import baseline_times_focal
from dsr.methods.images import compute_min_max
from dsr.sample import DepthSample, Scene

Batch = dict[str, Any]  # tensors by name; whole scenes also have ``unit``, the benchmark's as plain values


@dataclass(frozen=True)
class Degradation:
    """How low-resolution maps are made; arguments as for :func:`dsr.degradation.downsampling.make_sample`."""

    scale: int
    downsampling: Downsampling
    noise: Noise | None = None

    def sample(self, scene: Scene, generator: torch.Generator | int = 0, *, clean: bool = False) -> DepthSample:
        """Return a scene with its low-resolution map, which is made from disparity; without noise if ``clean``."""
        noise = None if clean else self.noise
        return make_sample(scene, self.scale, self.downsampling, "disparity", noise, generator)


def to_tensors(sample: DepthSample, dtype: torch.dtype = torch.float32) -> Batch:
    """Return a sample with a true depth as the tensors on which a network of disparities is trained.

    ``rgb`` (3, H, W) and ``min_max`` (2, 1, 1), the lowest and highest low-resolution disparity, in float32; in
    ``dtype`` ``disparity_lr`` (1, h, w) in pixels of the high-resolution camera, ``depth`` (1, H, W) in metres,
    ``rays`` (3, H, W), ``bf`` (1, 1, 1), the baseline times the focal length, and ``doffs`` (1, 1, 1).
    """
    if sample.depth is None:
        raise ValueError(f"{sample.scene}: expected a true depth to train with, there is none")
    camera, disparity = sample.camera, sample.disparity_lr()
    low, high = compute_min_max(disparity[None]).flatten()
    return {
        "rgb": sample.rgb.float(),
        "disparity_lr": disparity.to(dtype),
        "depth": sample.depth.to(dtype),
        "rays": camera.rays(dtype=dtype),
        "bf": torch.full((1, 1, 1), baseline_times_focal(camera), dtype=dtype),
        "doffs": torch.full((1, 1, 1), camera.doffs, dtype=dtype),
        "min_max": torch.stack((low, torch.maximum(high, low + least_range(high)))).view(2, 1, 1).float(),
    }


def least_range(highest: Tensor) -> Tensor:
    """Return the least range of disparities that a network's input is divided by, that of a map without relief."""
    return 1e-3 * highest.abs().clamp(min=1e-3)
