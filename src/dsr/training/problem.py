"""What a network is trained on: the problem that a scene poses, and its tensors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.noise import Noise
from dsr.geometry.camera import baseline_times_focal, to_range
from dsr.sample import DepthSample, Scene

Batch = dict[str, Tensor]
_LEAST_SPAN = 1e-3
"""Of the bounds of a flat map, as a share of its disparity."""


@dataclass(frozen=True)
class Degradation:
    """What is to be undone: how low-resolution maps come from high-resolution ones.

    Args:
        scale, downsampling, noise: as for :func:`dsr.degradation.downsampling.make_sample`.

    """

    scale: int
    downsampling: Downsampling
    noise: Noise | None = None

    def sample(self, scene: Scene, generator: torch.Generator | int = 0, *, clean: bool = False) -> DepthSample:
        """Return the problem that a scene poses, its low-resolution map made of disparity."""
        noise = None if clean else self.noise
        return make_sample(scene, self.scale, self.downsampling, "disparity", noise, generator)


def tensors_of(sample: DepthSample, dtype: torch.dtype = torch.float32) -> Batch:
    """Return a sample as the tensors that a network on disparities trains on.

    Args:
        sample: with a true depth.
        dtype: of all but the photo and the bounds.

    Returns:
        ``rgb`` (3, H, W) and ``bounds`` (2, 1, 1), lowest and highest low-resolution disparity, in float32; in
        ``dtype`` ``disparity_lr`` (1, h, w) in pixels of the photo's camera, ``depth`` (1, H, W) metres, ``rays`` (3,
        H, W), ``stereo`` (1, 1, 1) baseline times fx and ``doffs`` (1, 1, 1).

    """
    if sample.depth is None:
        raise ValueError(f"{sample.scene}: expected a true depth to train with, there is none")
    camera = sample.camera
    disparity = sample.scale * to_range(sample.depth_lr, sample.camera_lr, "disparity")
    return {
        "rgb": sample.rgb.float(),
        "disparity_lr": disparity.to(dtype),
        "depth": sample.depth.to(dtype),
        "rays": camera.rays(dtype=dtype),
        "stereo": torch.full((1, 1, 1), baseline_times_focal(camera), dtype=dtype),
        "doffs": torch.full((1, 1, 1), camera.doffs, dtype=dtype),
        "bounds": _bounds(disparity).float(),
    }


def _bounds(disparity: Tensor) -> Tensor:
    """Return the lowest and the highest known value, (2, 1, 1), some way apart."""
    known = disparity[disparity.isfinite()]
    low, high = known.min(), known.max()
    return torch.stack((low, torch.maximum(high, low + _LEAST_SPAN * high.abs().clamp(min=_LEAST_SPAN)))).view(2, 1, 1)
