"""What the optimisation of one image works on, and the loss that it lowers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, downsample_depth
from dsr.geometry.camera import Camera, RangeType
from dsr.methods.classical.finite_differences import grey
from dsr.metrics import losses
from dsr.metrics.functional import SurfacePair, mse_v
from dsr.sample import DepthSample

DataLoss = Literal["lap1", "mse"]
_LEAST_SPAN = 1e-3
_MOST_LEVELS = 3


@dataclass(frozen=True)
class ImageProblem:
    """One image's tensors in float32 on the device of the optimisation.

    Args:
        rgb: (1, 3, H, W) the photo in [0, 1].
        grey: (1, 1, H, W) its luminance.
        coarse: (1, 1, h, w) the coarse depth in metres, NaN in holes.
        rays, rays_lr: (1, 3, H, W) and (1, 3, h, w), of the cameras.
        camera: of the photo.
        scale: the upsampling factor.
        downsampling: the model that leads from fine to low-resolution depth, as far as one knows.
        range_type: the type that the model averages unless it says one itself.
        low, span: the least known low-resolution depth, and how far the largest is from it; metres.

    """

    rgb: Tensor
    grey: Tensor
    coarse: Tensor
    rays: Tensor
    rays_lr: Tensor
    camera: Camera
    scale: int
    downsampling: Downsampling
    range_type: RangeType
    low: float
    span: float

    @classmethod
    def of(cls, sample: DepthSample, downsampling: Downsampling, range_type: RangeType, device: torch.device) -> Self:
        """Return the problem that a sample poses; its true depth is not looked at."""
        known = sample.depth_lr[sample.mask_lr]
        low, high = float(known.min()), float(known.max())
        rgb = sample.rgb[None].to(device, torch.float32)
        return cls(
            rgb=rgb,
            grey=grey(rgb),
            coarse=sample.depth_lr[None].to(device, torch.float32),
            rays=sample.camera.rays(dtype=torch.float32, device=device)[None],
            rays_lr=sample.camera_lr.rays(dtype=torch.float32, device=device)[None],
            camera=sample.camera,
            scale=sample.scale,
            downsampling=downsampling,
            range_type=range_type,
            low=low,
            span=max(high - low, _LEAST_SPAN * high),
        )

    def downsample(self, depth: Tensor) -> Tensor:
        """Return what the model makes of high-resolution depth, (1, 1, H, W) to (1, 1, h, w), both in metres."""
        return downsample_depth(depth, self.camera, self.scale, self.downsampling, self.range_type)[0]

    def residual(self, depth: Tensor) -> Tensor:
        """Return the root mean square of D(depth) / coarse - 1 over the known low-resolution pixels, a scalar."""
        share = self.downsample(depth) / self.coarse - 1
        known = share.isfinite()
        return (torch.where(known, share, 0).square().sum() / known.sum()).sqrt()


@dataclass(frozen=True)
class PriorObjective:
    """The loss of Voynov et al. 2019 for image priors: a data term on LR depth, and the photo's reconstruction.

    L = c * data(D d / r, d_LR / r) + w * MSE_v(D d, d_LR) + w_I * Lap_1(intensity, photo), where r is the range of the
    low-resolution depth. In holes of the low-resolution map nothing is asked of the depth.

    Args:
        data_loss: ``mse`` for DIP, ``lap1`` for DIP-V.
        data_weight: c.
        w: weight of MSE_v, whose normals are taken with the low-resolution camera; 0 for DIP.
        w_intensity: w_I.

    Raises:
        ValueError: an unknown name or a negative weight.

    """

    data_loss: DataLoss = "lap1"
    data_weight: float = 1.0
    w: float = 1.0
    w_intensity: float = 0.01

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
            problem: the image.

        """
        coarse, span = problem.downsample(depth), problem.span
        if self.data_loss == "mse":
            data = losses.mse(coarse / span, problem.coarse / span).mean()
        else:
            data = losses.lap1(coarse / span, problem.coarse / span, levels=_levels(coarse)).mean()
        terms = {f"data_{self.data_loss}": data}
        loss = self.data_weight * data
        if self.w:
            terms["mse_v"] = mse_v(SurfacePair(coarse, problem.coarse, problem.rays_lr)).nansum()  # none between holes
            loss = loss + self.w * terms["mse_v"]
        if self.w_intensity:
            terms["intensity"] = losses.lap1(intensity, problem.grey, levels=_levels(intensity)).mean()
            loss = loss + self.w_intensity * terms["intensity"]
        return {"loss": loss, **terms}


def _levels(x: Tensor) -> int:
    """Return as many levels of a Laplacian pyramid as a map has room for."""
    side, levels = min(x.shape[-2:]), 1
    while levels < _MOST_LEVELS and side >= 3 * 2**levels:
        levels += 1
    return levels
