"""Guided anisotropic diffusion whose block means are exactly the input, without training.

The untrained mode of Metzger, Daudt and Schindler, *Guided Depth Super-Resolution by Deep Anisotropic Diffusion*, CVPR
2023. Two steps alternate:

- diffusion (their eq. 1, Perona and Malik 1990): u += step * sum over the four neighbours n of c_n (u_n - u), with
  c = 1 / (1 + (x / edge)^2), where x is the mean absolute difference between the two pixels over the channels of the
  guide: the colour image and the interpolated map. c is computed once;
- adjustment (their eq. 3): each block is multiplied by the ratio of the low-resolution pixel to the block's mean.

What differs from the original:

- It works on inverse depth (disparity without its offset), which is always positive, as the multiplication requires,
  and linear on planes. In the guide, the colours are in [0, 1] and the map, normalised by its range, is multiplied by
  ``depth_weight``; the original standardises both with constants of each data set.
- The iteration stops when the map no longer moves, instead of always after 8000 steps.
- The map is extrapolated linearly by ``border`` low-resolution pixels, because diffusion flattens it along the border
  of the image: a plane is reproduced within 3e-4 of its range there, and exactly elsewhere.
- Holes of the low-resolution map have no adjustment, as in the original. The same iteration first inpaints them at the
  low resolution, because diffusion into a hole takes as many steps as the square of its width.
- The iteration runs in float32; the last adjustment is in float64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import from_range, to_range
from dsr.methods.base import Abilities, Cost, Method, expect_limits, whole_scale
from dsr.methods.classical.finite_differences import box_mean, extend_linearly, upsample_linear_border
from dsr.methods.classical.iterations import CHECK_EVERY, Movement, history_of
from dsr.methods.inpainting import inpaint
from dsr.methods.networks.normalisation import compute_min_max, normalise
from dsr.sample import DepthSample
from dsr.utils.progress import Steps

_LEAST = 0.5
"""Minimum of an extrapolated map as a fraction of its lowest value, and of its highest value over the maximum."""


class Diffusion(NamedTuple):
    """The map (B, 1, H, W), the number of steps, and the RMS movement between two checks."""

    values: Tensor
    steps: int
    moved: list[float]


class AnisotropicDiffusion(Method):
    """Guided anisotropic diffusion; the block means of its inverse depth equal the input.

    Holes of the input are inpainted. Memory: about 15 float64 maps of the image's size, 30 MB for 512 x 512. The
    low-resolution map is assumed to hold block means of disparity, whatever the downsampling model was.

    Args:
        steps: maximum number of steps.
        tolerance: RMS movement within 50 steps, relative to the map's range, below which it stops.
        step: size of a step; above 0.25 diffusion is unstable.
        edge: difference of the guide at which diffusion is halved (K).
        depth_weight: weight of the interpolated map, normalised by its range, in the guide; 0 for the colours alone.
        border: number of low-resolution pixels by which the map is extrapolated linearly.

    Raises:
        ValueError: a value is out of range.

    """

    abilities = Abilities(ratios="whole", cost=Cost(120, 2))

    def __init__(
        self,
        steps: int = 8000,
        tolerance: float = 1e-5,
        step: float = 0.24,
        edge: float = 0.01,
        depth_weight: float = 1.0,
        border: int = 4,
    ) -> None:
        expect_limits(tolerance, steps=steps)
        if not 0 < step <= 0.25:
            raise ValueError(f"step: expected more than 0 and at most 0.25, got {step}")
        if not edge > 0:
            raise ValueError(f"edge: expected more than 0, got {edge}")
        if not depth_weight >= 0:
            raise ValueError(f"depth_weight: expected 0 or more, got {depth_weight}")
        if border < 0:
            raise ValueError(f"border: expected 0 or more low-resolution pixels, got {border}")
        self.steps, self.tolerance, self.step = steps, tolerance, step
        self.edge, self.depth_weight, self.border = edge, depth_weight, border
        self.history: list[dict[str, float]] = []

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return high-resolution depth without holes, (1, H, W) in metres on the sample's device.

        Args:
            progress: is called with the steps done and their maximum.

        """
        lr = to_range(sample.depth_lr.double(), sample.camera_lr, "disparity") + sample.camera_lr.doffs
        inverse = (lr * sample.scale)[None]  # in pixels of the high-resolution camera
        result = self.diffuse(sample.rgb[None], inverse, whole_scale(sample), progress)
        self.history = history_of(result.moved)
        hr = result.values[0]
        return from_range(hr - sample.camera.doffs, sample.camera, "disparity").to(sample.depth_lr.dtype)

    def diffuse(self, rgb: Tensor, lr: Tensor, scale: int, progress: Steps | None = None) -> Diffusion:
        """Upsample positive maps.

        Args:
            rgb: (B, 3, H, W) in [0, 1].
            lr: (B, 1, H / scale, W / scale) float64, positive, NaN in holes.
            scale: upsampling factor; at 1, only holes are inpainted.

        """
        start = inpaint(lr)
        if scale > 1 and not bool(lr.isfinite().all()):
            start = self.diffuse(box_mean(rgb, scale), lr, 1).values
        low, high = compute_min_max(start).chunk(2, dim=1)
        lr_extended = extend_linearly(start, self.border).clamp(min=_LEAST * low, max=high / _LEAST)
        valid = functional.pad(lr.isfinite(), [self.border] * 4, value=True)
        edge = self.border * scale
        guide_rgb = functional.pad(rgb.float(), [edge] * 4, mode="replicate") if edge else rgb.float()
        start_hr = upsample_linear_border(lr_extended, scale).clamp(min=low / 2)
        weight = self.depth_weight if scale > 1 else 0.0  # an inpainted hole says nothing about edges
        conductances = self._conductances(guide_rgb, weight * normalise(start_hr).values)
        result = self._iterate(start_hr, lr_extended, valid, conductances, progress)
        inner = (slice(edge, edge + rgb.shape[-2]), slice(edge, edge + rgb.shape[-1]))
        exact = _adjust_copy(result.values[..., inner[0], inner[1]].double(), lr, lr.isfinite())
        return result._replace(values=exact)

    def _conductances(self, rgb: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Return step * c along u, (B, 1, H, W - 1), and along v, (B, 1, H - 1, W), of images and weighted maps."""
        guide = torch.cat((rgb, depth.to(rgb)), dim=1)
        along_u, along_v = (
            self.step / (1 + (guide.diff(dim=dim).abs().mean(dim=1, keepdim=True) / self.edge).square())
            for dim in (-1, -2)
        )
        return along_u, along_v

    def _iterate(
        self,
        start_hr: Tensor,
        lr: Tensor,
        valid: Tensor,
        conductances: tuple[Tensor, Tensor],
        progress: Steps | None,
    ) -> Diffusion:
        """Alternate diffusion and adjustment until the map stops moving."""
        mean = start_hr.mean(dim=(-2, -1), keepdim=True)
        x, target = (start_hr / mean).float(), (lr / mean).float()
        value_range = compute_min_max(target).diff(dim=1).clamp(min=1e-12)
        along_u, along_v = torch.empty_like(conductances[0]), torch.empty_like(conductances[1])
        movement, done = Movement(x, self.steps, self.tolerance, progress, value_range), 0
        for done in range(1, self.steps + 1):
            torch.sub(x[..., 1:], x[..., :-1], out=along_u).mul_(conductances[0])
            torch.sub(x[..., 1:, :], x[..., :-1, :], out=along_v).mul_(conductances[1])
            x[..., 1:] -= along_u
            x[..., :-1] += along_u
            x[..., 1:, :] -= along_v
            x[..., :-1, :] += along_v
            _adjust(x, target, valid)
            if done % CHECK_EVERY == 0 and movement.converged(x):
                break
        movement.finish()
        return Diffusion(x.double() * mean, done, movement.moved)


def _adjust(x: Tensor, lr: Tensor, valid: Tensor) -> None:
    """Multiply each valid block of x, (B, 1, H, W), in place, so that its mean is the low-resolution pixel."""
    scale = x.shape[-1] // lr.shape[-1]
    ratio = torch.where(valid, lr / box_mean(x, scale), 1)
    blocks = x.view(*lr.shape[:-1], scale, lr.shape[-1], scale)
    blocks *= ratio[..., :, None, :, None]


def _adjust_copy(x: Tensor, lr: Tensor, valid: Tensor) -> Tensor:
    x = x.clone(memory_format=torch.contiguous_format)
    _adjust(x, lr, valid)
    return x
