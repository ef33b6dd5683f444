"""The tensors of one image that the optimisation uses, and its loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, downsample_depth
from dsr.geometry.camera import Camera, RangeType
from dsr.methods.base import whole_scale
from dsr.methods.classical.finite_differences import grey
from dsr.methods.networks.normalisation import compute_min_max, mean3x3
from dsr.metrics import losses
from dsr.metrics.functional import SurfacePair
from dsr.metrics.visual_loss import MSE_V, VisualLoss, match_weight
from dsr.sample import DepthSample, Unit

DataLoss = Literal["lap1", "mse"]
_MIN_RANGE = 1e-3
_MAX_LEVELS = 3


@dataclass(frozen=True)
class ImageProblem:
    """One image's tensors in float32 on the device of the optimisation.

    Args:
        rgb: (1, 3, H, W) RGB image in [0, 1].
        grey: (1, 1, H, W) luminance of the image.
        depth_lr: (1, 1, h, w) low-resolution depth in metres, NaN in holes.
        rays, rays_lr: (1, 3, H, W) and (1, 3, h, w), rays of the cameras.
        camera: camera of the image.
        scale: upsampling factor.
        downsampling: assumed model from high- to low-resolution depth.
        range_type: range type that the model averages, unless it has one of its own.
        unit: unit of the benchmark, for validation.
        min_depth, depth_range: minimum and range (maximum less minimum) of the valid low-resolution depth in metres.

    """

    rgb: Tensor
    grey: Tensor
    depth_lr: Tensor
    rays: Tensor
    rays_lr: Tensor
    camera: Camera
    scale: int
    downsampling: Downsampling
    range_type: RangeType
    unit: Unit
    min_depth: float
    depth_range: float

    @classmethod
    def of(cls, sample: DepthSample, downsampling: Downsampling, range_type: RangeType, device: torch.device) -> Self:
        """Return the problem of a sample; its true depth is not used."""
        min_depth, max_depth = compute_min_max(sample.depth_lr[None]).flatten().tolist()
        rgb = sample.rgb[None].to(device, torch.float32)
        return cls(
            rgb=rgb,
            grey=grey(rgb),
            depth_lr=sample.depth_lr[None].to(device, torch.float32),
            rays=sample.camera.rays(dtype=torch.float32, device=device)[None],
            rays_lr=sample.camera_lr.rays(dtype=torch.float32, device=device)[None],
            camera=sample.camera,
            scale=whole_scale(sample),
            downsampling=downsampling,
            range_type=range_type,
            unit=sample.unit,
            min_depth=min_depth,
            depth_range=max(max_depth - min_depth, _MIN_RANGE * max_depth),
        )

    def downsample(self, depth: Tensor) -> Tensor:
        """Downsample depth in metres by the assumed model, (1, 1, H, W) to (1, 1, h, w)."""
        return downsample_depth(depth, self.camera, self.scale, self.downsampling, self.range_type)[0]

    def balance_weight(self, visual: VisualLoss) -> float:
        """Return the weight with which a visual loss is as large as MSE_v with 1 for a smoothed low-resolution map."""
        if visual.name == "mse_v":
            return 1.0
        return match_weight(visual, [SurfacePair(mean3x3(self.depth_lr), self.depth_lr, self.rays_lr)])

    def residual(self, depth: Tensor) -> Tensor:
        """Return the RMS of D(depth) / depth_lr - 1 over the valid low-resolution pixels, a scalar."""
        ratio = self.downsample(depth) / self.depth_lr - 1
        valid = ratio.isfinite()
        return (torch.where(valid, ratio, 0).square().sum() / valid.sum()).sqrt()


@dataclass(frozen=True)
class PriorObjective:
    """The loss of Voynov et al. 2019 for image priors: a data term on LR depth, and the photo's reconstruction.

    L = c * data(D d / r, d_LR / r) + w * visual(D d, d_LR) + w_I * Lap_1(intensity, photo), where r is the range of the
    low-resolution depth, and visual is MSE_v in the paper. Holes of the low-resolution map have no data term.

    Args:
        data_loss: ``mse`` for DIP, ``lap1`` for DIP-V.
        data_weight: c.
        w: weight of the visual loss, whose normals are taken with the low-resolution camera; 0 for DIP.
        w_intensity: w_I.
        visual: the visual loss.

    Raises:
        ValueError: an unknown name or a negative weight.

    """

    data_loss: DataLoss = "lap1"
    data_weight: float = 1.0
    w: float = 1.0
    w_intensity: float = 0.01
    visual: VisualLoss = MSE_V

    def __post_init__(self) -> None:
        """Check the values."""
        if self.data_loss not in ("lap1", "mse"):
            raise ValueError(f"data_loss: expected lap1 or mse, got {self.data_loss!r}")
        for name in ("data_weight", "w", "w_intensity"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name}: expected 0 or a positive number, got {getattr(self, name)}")

    def __call__(self, depth: Tensor, intensity: Tensor, problem: ImageProblem) -> dict[str, Tensor]:
        """Return ``loss`` and its terms, scalars.

        Args:
            depth: (1, 1, H, W) in metres.
            intensity: (1, 1, H, W) in [0, 1].

        """
        depth_lr, depth_range = problem.downsample(depth), problem.depth_range
        if self.data_loss == "mse":
            data = losses.mse(depth_lr / depth_range, problem.depth_lr / depth_range).mean()
        else:
            data = losses.lap1(depth_lr / depth_range, problem.depth_lr / depth_range, levels=_levels(depth_lr)).mean()
        terms = {f"data_{self.data_loss}": data}
        loss = self.data_weight * data
        if self.w:
            pair = SurfacePair(depth_lr, problem.depth_lr, problem.rays_lr)
            terms[self.visual.name] = self.visual(pair).nansum()  # none between holes
            loss = loss + self.w * terms[self.visual.name]
        if self.w_intensity:
            terms["intensity"] = losses.lap1(intensity, problem.grey, levels=_levels(intensity)).mean()
            loss = loss + self.w_intensity * terms["intensity"]
        return {"loss": loss, **terms}


def _levels(x: Tensor) -> int:
    """Return the number of levels of a Laplacian pyramid that a map has room for."""
    side, levels = min(x.shape[-2:]), 1
    while levels < _MAX_LEVELS and side >= 3 * 2**levels:
        levels += 1
    return levels
