"""PDN: a convolutional network and an unrolled primal-dual iteration, trained as one.

Riegler, Ferstl, Rüther and Bischof, *A Deep Primal-Dual Network for Guided Depth Super-Resolution*, BMVC 2016, with the
sizes of the authors' code (github.com/griegler/primal-dual-networks, gdsr). Convolutions predict a residual, with which
the upsampled map becomes f, and weights w. A fixed number of steps of Chambolle and Pock (2011, algorithm 3) minimises

    E(u) = sum over pairs (i, i + d) of h(u[i + d] - u[i], w[i, d]) + data / 2 * sum (u - f)^2,

with d half of the offsets of a square window and h(x, w) = x^2 / (2 huber) where |x| <= huber w, else
w |x| - huber / 2 w^2. What differs is in docs/measurements/methods.md; the unit of the residual is the *bend* of
:mod:`dsr.methods.networks.facets_planes`.
"""

import itertools
import math
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.images import exporting, extend_linearly, upsample_linear_border
from dsr.methods.networks.facets_planes import stencil
from dsr.methods.networks.network import NormalisedNetwork

_FAINT = 1e-3  # a difference of normalised disparity that becomes about 1 in the network's input
_INPUTS = 9
_TINY = 1e-12


def half_window(window: int) -> list[tuple[int, int]]:
    """Return one (row, column) offset of each two opposite ones in a square window of odd size, at least 3."""
    if window < 3 or window % 2 == 0:
        raise ValueError(f"window: expected an odd number of at least 3, got {window}")
    radius = window // 2
    side = range(-radius, radius + 1)
    return [(v, u) for v in range(-radius, 1) for u in side if (v, u) < (0, 0)]


def pair_differences(x: Tensor, window: int) -> Tensor:
    """Return x[i + d] - x[i] for each pixel i whose pair may touch the image, and each offset d of :func:`half_window`.

    With the window's radius r, ``x`` is (B, 1, H + 2 r, W + 4 r), the result (B, N, H + r, W + 2 r).
    """
    r = window // 2
    height, width = x.shape[-2] - r, x.shape[-1] - 2 * r
    here = x[..., r:, r : r + width]
    return torch.cat(
        [x[..., r + v : r + v + height, r + u : r + u + width] - here for v, u in half_window(window)], dim=1
    )


def pair_sums(p: Tensor, window: int) -> Tensor:
    """Return the adjoint of :func:`pair_differences` on the image: the sum of p[i - d] - p[i], (B, 1, H, W)."""
    r = window // 2
    height, width = p.shape[-2] - r, p.shape[-1] - 2 * r
    total = -p[..., :height, r : r + width].sum(dim=1)
    for k, (v, u) in enumerate(half_window(window)):
        total += p[:, k, -v : height - v, r - u : r - u + width]
    return total[:, None]


class _Differences(torch.autograd.Function):
    """:func:`pair_differences` of an image with zeros beyond its border; the derivative is the adjoint."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, window: int) -> Tensor:
        ctx.window, r = window, window // 2
        return pair_differences(functional.pad(x, (2 * r, 2 * r, r, r)), window)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _Sums.apply(gradients[0], ctx.window), None


class _Sums(torch.autograd.Function):
    """:func:`pair_sums`, likewise."""

    @staticmethod
    def forward(ctx: Any, p: Tensor, window: int) -> Tensor:
        ctx.window = window
        return pair_sums(p, window)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _Differences.apply(gradients[0], ctx.window), None


class _DualStep(torch.autograd.Function):
    """clip((p + sigma x) / (1 + sigma huber), -w, w); an explicit derivative is several times faster."""

    @staticmethod
    def forward(ctx: Any, p: Tensor, x: Tensor, sigma: Tensor, huber: Tensor, w: Tensor) -> Tensor:
        fractions = torch.addcmul(p, x, sigma).div_(1 + sigma * huber).div_(w).clamp_(-1, 1)
        ctx.save_for_backward(p, x, sigma, huber, fractions)
        return fractions * w

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, ...]:
        # to p and x where nothing is clipped, and to w elsewhere
        p, x, sigma, huber, fractions = ctx.saved_tensors
        keep = 1 / (1 + sigma * huber)
        within = torch.ops.aten.hardtanh_backward(gradients[0], fractions, -1.0, 1.0)
        of_w = (gradients[0] - within).mul_(fractions)
        of_p, of_x = (torch.dot(within.flatten(), each.flatten()) for each in (p, x))
        numerator = of_p + sigma * of_x
        of_sigma = keep * of_x - keep.square() * huber * numerator
        within *= keep
        return within, within * sigma, of_sigma, -keep.square() * sigma * numerator, of_w


def _apply(function: type[torch.autograd.Function], *arguments: Any) -> Tensor:
    """Apply a function that has a derivative of its own; a graph gets its operations, without the derivative."""
    if exporting():
        return function.forward(SimpleNamespace(save_for_backward=lambda *_: None), *arguments)
    return function.apply(*arguments)


class UnrolledHuber(nn.Module):
    """A fixed number of iterations with learned parameters, stored as logarithms so that they are positive.

    The first step sizes are those with which the iteration converges (Chambolle and Pock 2011, algorithm 3).
    """

    def __init__(self, window: int = 5, iterations: int = 10, data: float = 10.0, huber: float = 1.0) -> None:
        super().__init__()
        norm = 2 * math.sqrt(len(half_window(window)))  # of the differences, at most: 2 along each offset
        if iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")
        self.window = window
        self.log_data = nn.Parameter(torch.tensor(math.log(data)))
        self.log_huber = nn.Parameter(torch.tensor(math.log(huber)))
        mu = 2 * math.sqrt(data * huber) / norm
        first = torch.tensor([mu / (2 * huber), mu / (2 * data), 1 / (1 + mu)]).log()
        self.log_steps = nn.Parameter(first.repeat(iterations, 1))  # (iterations, 3): sigma, tau, theta

    def forward(self, first: Tensor, weights: Tensor) -> Tensor:
        """Map f, as :func:`pair_differences` takes it, and positive weights, (B, N, H, W), to u - f, (B, 1, H, W)."""
        r, dtype = self.window // 2, weights.dtype
        slopes = pair_differences(first, self.window).to(dtype)
        data, huber = self.log_data.to(dtype).exp(), self.log_huber.to(dtype).exp()
        most = functional.pad(weights, (r, r, 0, r), mode="replicate")
        p = (slopes / (huber * most)).clamp(-1, 1) * most
        moved = ahead = slopes.new_zeros(weights.shape[0], 1, *weights.shape[-2:])
        for k, step in enumerate(self.log_steps.to(dtype).exp().unbind()):
            sigma, tau, theta = step.unbind()
            now = slopes if k == 0 else slopes + _apply(_Differences, ahead, self.window)
            p = _apply(_DualStep, p, now, sigma, huber, most)
            before, moved = moved, (moved - tau * _apply(_Sums, p, self.window)) / (1 + tau * data)
            ahead = moved + theta * (moved - before)
        return moved


class PrimalDualNetwork(NormalisedNetwork):
    """The network."""

    def __init__(self, scale: int, width: int = 64, layers: int = 10, window: int = 5, iterations: int = 10) -> None:
        super().__init__()
        check_scale(scale)
        if width < 1 or layers < 2:
            raise ValueError(f"model: expected a width of at least 1 and at least 2 layers, got {width} and {layers}")
        self.scale, self.width, self.layers = scale, width, layers
        self.window, self.iterations = window, iterations
        self.stage = UnrolledHuber(window, iterations)
        self.trunk = nn.Sequential()
        for before, after in itertools.pairwise([_INPUTS] + [width] * (layers - 1)):
            self.trunk.extend([nn.Conv2d(before, after, 3, padding=1), nn.ReLU()])
        for layer in self.trunk:
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.get_parameter("bias"))
        self.head = nn.Conv2d(width, 1 + len(half_window(window)), 3, padding=1)
        self.head.weight.data[:1].zero_()  # no residual at first
        nn.init.zeros_(self.head.get_parameter("bias"))
        self.log_strength = nn.Parameter(torch.zeros(()))
        # of convolutions and iterations in high-resolution pixels; 4 of the upsampling and the differences
        self.receptive_field_radius = -(-(layers + iterations * (window // 2)) // scale) + 4

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Return normalised disparity (B, 1, H, W) for (B, 3, H, W) and (B, 1, h, w); see the base class."""
        hr, around = upsample_linear_border(values, self.scale), stencil(values)
        slopes_lr = torch.cat((around.slopes[:, :, 1], around.value - around.mean), dim=1)
        size = tuple(hr.shape[-2:])
        bend = functional.interpolate(around.bend.float(), size=size, mode="bilinear")
        slopes = functional.interpolate(slopes_lr.float(), size=size, mode="bilinear")
        detail = (hr - upsample_linear_border(around.mean, self.scale)).float()
        relative = detail / bend.clamp(min=torch.finfo(torch.float32).tiny)
        depth = torch.asinh(torch.cat((slopes, detail, bend), dim=1) / _FAINT) / 3  # enlarges small values
        inputs = torch.cat((rgb.float() - 0.5, depth, relative.clamp(-2, 2)), dim=1)  # (B, 9, H, W)
        output = self.head(self.trunk(inputs.to(self.head.weight.dtype)))
        with torch.autocast(rgb.device.type, enabled=False):
            output = output.to(torch.float32 if output.dtype == torch.bfloat16 else output.dtype)
            residual = (output[:, :1] * bend).to(hr.dtype)
            strength = self.log_strength.to(output.dtype).exp()
            weights = (-strength * output[:, 1:].abs()).softmax(dim=1) + _TINY
            r = self.window // 2
            first = extend_linearly(hr, 2 * r) + functional.pad(residual, (2 * r,) * 4, mode="replicate")
            moved = self.stage(first[..., r:-r, :], weights)
            return hr + residual + moved.to(hr.dtype)
