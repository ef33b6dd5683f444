"""Upsampling by anisotropic total generalised variation, without training.

Ferstl, Reinbacher, Ranftl, Rüther and Bischof, *Image Guided Depth Upsampling using Anisotropic Total Generalized
Variation*, ICCV 2013: of all high-resolution maps u and slopes v, the pair that minimises

    E(u, v) = alpha_1 * sum |G (grad u - v)| + alpha_0 * sum |grad v| + data_weight / 2 * sum w (mean u - d)^2,
    G = exp(-sharpness |grad I|^exponent) n n^T + t t^T,    n = grad I / |grad I|,    t perpendicular to n,

their eq. 6 and 5, with the grey image I, across whose edges the map may jump. E is minimised by the primal-dual method
of Chambolle and Pock (2011), with the diagonal step sizes of Pock and Chambolle (ICCV 2011, eq. 10 with alpha = 1),
over-relaxed (Condat 2013, algorithm 3.1).

What differs: a low-resolution pixel d is the mean of u over its block of w pixels, not the value of one high-resolution
pixel. It works on disparity, normalised by its range. Differences beyond the border are left out; the original sets
them to 0, which bends planes. It starts from the bicubic map and its gradient, one with holes from its own solution at
the low resolution. alpha_0 is 2.4 instead of 17.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import from_range
from dsr.methods.base import Abilities, Cost, Method, whole_scale
from dsr.methods.images import (
    box_mean,
    estimate_sensor_noise,
    grey,
    inpaint,
    normalise,
    repeat_blocks,
    upsample_linear_border,
)
from dsr.sample import DepthSample
from dsr.utils.guards import expect_positive
from dsr.utils.progress import Steps, ignore

_CHECK_EVERY = 50  # iterations between two checks of how far the map has moved
_RELAXATION = 1.9  # over-relaxation factor; the iteration converges below 2
_SLOPE = 0.3  # scale of slopes relative to the map, per pixel, for step sizes
_NOISE_WEIGHT = 0.6  # the weight of the data term, times the noise of a normalised map and the scale
_LARGEST_WEIGHT = 1000.0


class Tensors(NamedTuple):
    """Symmetric 2 x 2 matrices, one per pixel: [[uu, uv], [uv, vv]], each (B, 1, H, W)."""

    uu: Tensor
    uv: Tensor
    vv: Tensor

    def times(self, p: Tensor) -> Tensor:
        """Return the products with vectors, (B, 2, 1, H, W)."""
        return torch.stack((self.uu * p[:, 0] + self.uv * p[:, 1], self.uv * p[:, 0] + self.vv * p[:, 1]), dim=1)


class Solution(NamedTuple):
    """The minimiser: u and v are the means of the iterates since the last check, because the iterates oscillate."""

    values: Tensor  # u, (B, 1, H, W)
    slopes: Tensor  # v, (B, 2, H, W)
    iterations: int
    moved: list[float]  # RMS movement of u between two checks


@dataclass(eq=False)
class TotalGeneralisedVariation(Method):
    """TGV-guided upsampling of block means of disparity whose holes are inpainted."""

    abilities = Abilities(ratios="whole", cost=Cost(800, 60))

    iterations: int = 1000
    tolerance: float = 1e-4
    first: float = 1.2
    second: float = 2.4
    data_weight: float | Literal["auto"] | None = None
    sharpness: float = 9.0
    exponent: float = 0.85
    step_ratio: float = 1e4

    def __post_init__(self) -> None:
        expect_positive(iterations=self.iterations, first=self.first, second=self.second)
        expect_positive(exponent=self.exponent, step_ratio=self.step_ratio)
        expect_positive(or_zero=True, tolerance=self.tolerance, sharpness=self.sharpness)
        if self.data_weight not in (None, "auto"):
            if isinstance(self.data_weight, str):
                raise ValueError(f"data_weight: expected a number, auto or None, got {self.data_weight!r}")
            expect_positive(data_weight=self.data_weight)

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return high-resolution depth without holes, (1, H, W) in metres; NaN where it is at or beyond infinity."""
        lr = sample.disparity_lr(torch.float64)[None]
        scaled = normalise(lr)
        values = torch.where(lr.isfinite(), scaled.values, torch.nan)
        found = self.minimise(sample.rgb[None].double(), values, whole_scale(sample), progress)
        moved = enumerate(found.moved, start=1)
        self.history = [{"iteration": float(_CHECK_EVERY * check), "moved": value} for check, value in moved]
        hr = found.values * scaled.value_range + scaled.minimum
        return from_range(hr[0], sample.camera, "disparity").to(sample.depth_lr.dtype)

    def minimise(self, rgb: Tensor, lr: Tensor, scale: int, progress: Steps | None = None) -> Solution:
        """Return the minimiser of E for normalised maps, (B, 1, h, w), NaN in holes; scale 1 only inpaints these."""
        report = progress or ignore
        start, valid = inpaint(lr), lr.isfinite()
        if scale > 1 and not bool(valid.all()):
            start = self.minimise(box_mean(rgb, scale), lr, 1).values
        u = upsample_linear_border(start, scale)
        v = gradient(u)[:, :, 0]  # in the last column and row as in the one before
        if u.shape[-1] > 1:
            v[:, 0, :, -1] = v[:, 0, :, -2]
        if u.shape[-2] > 1:
            v[:, 1, -1] = v[:, 1, -2]
        p, q = torch.zeros_like(v)[:, :, None], torch.zeros_like(gradient(v))
        g = self.diffusion_tensors(rgb)
        step_u, step_v, step_p, step_q = self._step_sizes(g)

        # The proximal map moves the pixels of a block by -step_u * weight * (mean - lr). Averaging this over the block
        # gives an equation for the mean; as the weight goes to infinity, it becomes the projection onto mean = lr.
        weight, mean_step = self.choose_weight(lr, scale), box_mean(step_u, scale)
        gain = 1 / mean_step if weight is None else weight / (1 + weight * mean_step)
        gain = step_u * repeat_blocks(torch.where(valid, gain, 0), scale)
        target = torch.where(valid, lr, 0)

        mean_u, mean_v = torch.zeros_like(u), torch.zeros_like(v)
        previous, moved, done = u, [], 0
        for done in range(1, self.iterations + 1):
            gp = _zero_border(g.times(p))
            prox_u = u + step_u * divergence(gp)
            prox_u = prox_u - gain * repeat_blocks(box_mean(prox_u, scale) - target, scale)
            prox_v = v + step_v * (gp[:, :, 0] + divergence(q))
            ahead_u, ahead_v = 2 * prox_u - u, 2 * prox_v - v
            bent = g.times(_zero_border(gradient(ahead_u) - ahead_v[:, :, None]))
            prox_p = _project_ball(p + step_p * bent, self.first)
            prox_q = _project_ball(q + step_q * gradient(ahead_v), self.second)
            u, v = u.lerp(prox_u, _RELAXATION), v.lerp(prox_v, _RELAXATION)
            p, q = p.lerp(prox_p, _RELAXATION), q.lerp(prox_q, _RELAXATION)
            since = (done - 1) % _CHECK_EVERY + 1
            mean_u, mean_v = mean_u.lerp(prox_u, 1 / since), mean_v.lerp(prox_v, 1 / since)
            if since == _CHECK_EVERY:
                moved.append(float((mean_u - previous).square().mean(dim=(-2, -1)).max().sqrt()))
                previous = mean_u
                report(done, self.iterations)
                if moved[-1] < self.tolerance:
                    break
        report(self.iterations, self.iterations)
        return Solution(mean_u, mean_v, done, moved)

    def choose_weight(self, lr: Tensor, scale: int) -> float | None:
        """Return the weight of the data term for a normalised map, (B, 1, h, w), NaN in holes.

        With ``auto``, it is 0.6 / (s scale) for noise of the standard deviation s: the data term and the regulariser
        change alike if everything is scaled. It is None above 1000, where the block means are nearly the input.
        """
        if self.data_weight != "auto":
            return self.data_weight
        noise = estimate_sensor_noise(lr)
        weight = _NOISE_WEIGHT / (noise * scale) if noise > 0 else math.inf
        return None if weight > _LARGEST_WEIGHT else weight

    def diffusion_tensors(self, rgb: Tensor) -> Tensors:
        """Return G for (B, 3, H, W) images; the identity where an image is constant."""
        slope = gradient(grey(rgb))
        size = slope.square().sum(dim=1).sqrt()
        normal = slope / torch.where(size > 0, size, 1)[:, None]  # 0 where there is none
        less = 1 - torch.exp(-self.sharpness * size.pow(self.exponent))
        x, y = normal[:, 0], normal[:, 1]
        return Tensors(1 - less * x * x, -less * x * y, 1 - less * y * y)

    def _step_sizes(self, g: Tensors) -> tuple[Tensor, Tensor, Tensor, float]:
        """Return step sizes of u (B, 1, H, W), v (B, 2, H, W), p (B, 1, 1, H, W) and q."""
        # inverse absolute column and row sums of the operator on (u, v / _SLOPE), and the root of the ratio
        root = self.step_ratio**0.5
        along_u, along_v = g.uu + g.uv.abs(), g.vv + g.uv.abs()
        inside = _zero_border(torch.stack((along_u, along_v), dim=1))
        step_u = 1 / (root * divergence(inside, sign=1).clamp(min=1e-6))
        step_v = _SLOPE / (inside[:, :, 0] + 4) / root
        step_p = 1 / ((2 + _SLOPE) * torch.maximum(along_u, along_v))[:, None] * root
        return step_u, step_v, step_p, root / (2 * _SLOPE)


def gradient(x: Tensor) -> Tensor:
    """Return forward differences along u and v, (B, C, H, W) -> (B, 2, C, H, W); 0 in the last column and row."""
    along_u, along_v = functional.pad(x.diff(dim=-1), (0, 1)), functional.pad(x.diff(dim=-2), (0, 0, 0, 1))
    return torch.stack((along_u, along_v), dim=1)


def divergence(p: Tensor, sign: int = -1) -> Tensor:
    """Return minus the adjoint of :func:`gradient`, (B, 2, C, H, W) -> (B, C, H, W).

    With ``sign`` 1 it is the adjoint of the gradient's absolute coefficients, of which step sizes are made.
    """
    total = torch.zeros_like(p[:, 0])
    for direction, dim in ((0, -1), (1, -2)):
        count = p.shape[dim] - 1
        values = p[:, direction].narrow(dim, 0, count)
        total.narrow(dim, 0, count).add_(values)
        total.narrow(dim, 1, count).add_(values, alpha=sign)
    return total


def _zero_border(p: Tensor) -> Tensor:
    """Set the entries of (B, 2, C, H, W) for differences beyond the border to 0, in place."""
    p[:, 0, ..., -1] = 0
    p[:, 1, ..., -1, :] = 0
    return p


def _project_ball(p: Tensor, radius: float) -> Tensor:
    """Project each pixel's vector or matrix of (B, 2, C, H, W) onto the ball of a radius."""
    lengths = p.square().sum(dim=(1, 2), keepdim=True).sqrt()
    return p / (lengths / radius).clamp(min=1)
