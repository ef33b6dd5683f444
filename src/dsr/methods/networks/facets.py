"""Facets: guided super-resolution by a mixture of planes, dsr's own network.

Renderings are most sensitive to errors of normals on smooth surfaces, where convolutions that predict disparity pixel
by pixel leave a faint texture. The disparity of a plane is linear in the pixel, so this network predicts planes
instead. Each low-resolution pixel proposes a few planes ("facets"), built from the differences to its neighbours. Each
high-resolution pixel mixes the planes of the 3 x 3 low-resolution pixels around it, extended to its position, with
weights predicted from the colour image; at an edge the network switches from one plane to another. Three properties
hold for any weights: planes are reproduced exactly, the network commutes with an affine map of the disparity, and the
result does not overshoot the extended planes.

The planes of a low-resolution pixel differ from the differences that they are built from by at most a multiple of the
local *bend* (the largest second difference around it). The bend is 0 on planes, and large beside a depth step, where
the low-resolution value mixes both sides.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.classical.finite_differences import extend_linearly
from dsr.methods.networks.base import NormalisedNetwork, expect_rgb_size

_NEIGHBOURS = 9
_FULL, _HALF = 16, 32
"""Channels of the image's features at the full and at half the resolution."""
_HEAD = 24
_FAINT, _STRONG = 1e-3, 0.25
"""Differences of normalised disparity that become about 1 in the network's compressed and linear inputs."""


class Stencil(NamedTuple):
    """Differences of a low-resolution map to its neighbours, per low-resolution pixel.

    ``value`` (B, 1, h, w); ``along_u`` and ``along_v`` (B, 3, h, w): backward, central and forward difference; ``bend``
    (B, 1, h, w): the largest absolute second difference within 3 x 3 pixels; ``mean`` (B, 1, h, w) of 3 x 3.
    """

    value: Tensor
    along_u: Tensor
    along_v: Tensor
    bend: Tensor
    mean: Tensor


def stencil(values: Tensor) -> Stencil:
    """Return the differences of (B, 1, h, w) maps, which are extrapolated linearly beyond the border."""
    padded = extend_linearly(values, 1)  # (B, 1, h + 2, w + 2)
    left, here, right = padded[..., 1:-1, :-2], padded[..., 1:-1, 1:-1], padded[..., 1:-1, 2:]
    above, below = padded[..., :-2, 1:-1], padded[..., 2:, 1:-1]
    along_u = torch.cat((here - left, (right - left) / 2, right - here), dim=1)
    along_v = torch.cat((here - above, (below - above) / 2, below - here), dim=1)
    corners = padded[..., 2:, 2:] - padded[..., 2:, :-2] - padded[..., :-2, 2:] + padded[..., :-2, :-2]
    second = torch.cat((along_u[:, 2:] - along_u[:, :1], along_v[:, 2:] - along_v[:, :1], corners / 4), dim=1)
    bend = functional.max_pool2d(second.abs().amax(dim=1, keepdim=True), 3, stride=1, padding=1)
    return Stencil(here, along_u, along_v, bend, functional.avg_pool2d(padded, 3, stride=1))


class Facets(NormalisedNetwork):
    """The network.

    Args:
        scale: upsampling factor, 2, 4, 8 or 16.
        width: channels at the low resolution.
        blocks: residual blocks there.
        facets: number of planes that each low-resolution pixel proposes.
        slopes: whether planes have slopes; if not, each is a constant, and the network predicts an interpolation kernel
            for each pixel (an ablation).

    Raises:
        ValueError: a value is out of range.

    """

    prior: Tensor
    offsets: Tensor

    def __init__(self, scale: int, width: int = 96, blocks: int = 6, facets: int = 2, *, slopes: bool = True) -> None:
        super().__init__()
        check_scale(scale)
        if min(width, facets) < 1 or blocks < 0:
            raise ValueError(
                f"model: expected width and facets of at least 1, blocks of at least 0; got {width}, {facets}, {blocks}"
            )
        self.scale, self.width, self.blocks, self.facets, self.slopes = scale, width, blocks, facets, slopes
        levels = scale.bit_length() - 1
        channels = [*[_FULL, _HALF, width, width][:levels], width]
        self.photo = nn.Conv2d(4, channels[0], 5, padding=2)
        self.down = nn.ModuleList(
            nn.Conv2d(before, after, 4, stride=2, padding=1) for before, after in itertools.pairwise(channels)
        )
        self.coarse = nn.Conv2d(10, width, 3, padding=1)
        self.trunk = nn.Sequential(*(_Residual(width) for _ in range(blocks)))
        self.planes = _scale_down(nn.Conv2d(width, 3 * facets + 6, 3, padding=1))
        outputs = [_HEAD, *channels[1:-1]]
        self.up = nn.ModuleList(nn.Conv2d(channels[i + 1], 4 * outputs[i], 1) for i in reversed(range(levels)))
        self.join = nn.ModuleList(
            nn.Conv2d(outputs[i] + channels[i], outputs[i], 3, padding=1) for i in reversed(range(levels))
        )
        self.choice = _scale_down(nn.Conv2d(_HEAD, _NEIGHBOURS * facets, 3, padding=1))
        # of the high-resolution pixels from the centre of their low-resolution pixel, in low-resolution pixels
        offsets = (torch.arange(scale) + 0.5) / scale - 0.5
        self.register_buffer("offsets", offsets, persistent=False)
        self.register_buffer("prior", _spline_logits(offsets), persistent=False)

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        sizes = {"scale": self.scale, "width": self.width, "blocks": self.blocks, "facets": self.facets}
        return {**sizes, "slopes": self.slopes}

    @property
    def receptive_field_radius(self) -> int:
        """Receptive-field radius in low-resolution pixels.

        The sum of one pixel for the neighbours' planes and the layers after the trunk, two for each residual block, one
        for each convolution of the planes and of the low-resolution map, and two for the differences. The image's
        features have a smaller receptive field.
        """
        return 2 * self.blocks + 6

    def context(self, rgb: Tensor) -> tuple[Tensor, ...]:
        """Return the mean colour of the image, (B, 3, 1, 1)."""
        return (_mean(rgb),)

    def forward(self, rgb: Tensor, values: Tensor, mean: Tensor | None = None) -> Tensor:
        """Map an image and normalised low-resolution disparity to high-resolution disparity.

        Args:
            rgb: (B, 3, H, W).
            values: (B, 1, h, w).
            mean: (B, 3, 1, 1) mean colour of the image that ``rgb`` is a window of; None for that of ``rgb``.

        Returns:
            (B, 1, H, W).

        """
        expect_rgb_size(rgb, values, self.scale)
        around = stencil(values)
        dtype = self.photo.weight.dtype
        pyramid = [functional.relu(self.photo(_rgb_input(rgb, mean).to(dtype)))]
        for layer in self.down:
            pyramid.append(functional.relu(layer(pyramid[-1])))
        x = self.trunk(functional.relu(pyramid[-1] + self.coarse(_lr_input(around).to(dtype))))
        planes = self._propose_planes(self.planes(x), around)
        for up, join, features in zip(self.up, self.join, reversed(pyramid[:-1]), strict=True):
            x = functional.relu(join(torch.cat((functional.pixel_shuffle(up(x), 2), features), dim=1)))
        return self._mix_planes(planes, self.choice(x))

    def _propose_planes(self, output: Tensor, around: Stencil) -> Tensor:
        """Return the planes of each low-resolution pixel, (B, facets, 3, h, w): value at its centre and slopes."""
        output = output.to(torch.promote_types(around.value.dtype, torch.float32))
        batch, _, height, width = output.shape
        moves, picks = output.split((3 * self.facets, 6), dim=1)
        picks = picks.unflatten(1, (2, 3))
        first = picks.new_tensor([0.0, 2.0, 0.0])[:, None, None]  # mostly the central difference at first
        picks = (picks + first).softmax(dim=2)
        differences = torch.stack((around.along_u, around.along_v), dim=1)  # (B, 2, 3, h, w)
        slopes = (picks * differences).sum(dim=2)  # (B, 2, h, w)
        base = torch.cat((around.value, slopes), dim=1)[:, None]
        planes = base + moves.view(batch, self.facets, 3, height, width) * around.bend[:, None]
        return planes if self.slopes else torch.cat((planes[:, :, :1], torch.zeros_like(planes[:, :, 1:])), dim=2)

    def _mix_planes(self, planes: Tensor, choice: Tensor) -> Tensor:
        """Return the mixture of the planes around each high-resolution pixel, (B, 1, H, W).

        Args:
            planes: (B, facets, 3, h, w).
            choice: (B, 9 * facets, H, W) logits, to which those of a quadratic B-spline are added.

        """
        batch, facets, _, height, width = planes.shape
        s, count = self.scale, _NEIGHBOURS * facets
        logits = choice.to(planes.dtype).view(batch, _NEIGHBOURS, facets, height, s, width, s)
        logits = logits + self.prior.to(planes.dtype).view(_NEIGHBOURS, 1, 1, s, 1, s)
        weights = logits.reshape(batch, count, height, s, width, s).softmax(dim=1)
        near = _gather_neighbours(planes).reshape(batch, count, 3, height, 1, width, 1)
        value, slope_u, slope_v = ((weights * near[:, :, i]).sum(dim=1) for i in range(3))  # (B, h, s, w, s)
        offsets = self.offsets.to(planes.dtype)
        hr = value + slope_u * offsets + slope_v * offsets[:, None, None]
        return hr.reshape(batch, 1, height * s, width * s)


class _Residual(nn.Module):
    """x + conv(relu(conv(x))), initialised close to the identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        with torch.no_grad():
            self.second.weight.mul_(0.3)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, h, w) to the same shape."""
        return x + self.second(functional.relu(self.first(x)))


def _scale_down(conv: nn.Conv2d) -> nn.Conv2d:
    """Return the convolution with small initial weights."""
    with torch.no_grad():
        conv.weight.mul_(0.1)
    if conv.bias is not None:
        nn.init.zeros_(conv.bias)
    return conv


def _mean(rgb: Tensor) -> Tensor:
    """Return the mean colour of images, (B, 3, 1, 1)."""
    return rgb.mean(dim=(-2, -1), keepdim=True)


def _rgb_input(rgb: Tensor, mean: Tensor | None = None) -> Tensor:
    """Return (B, 4, H, W): the colours, and the brightness relative to the image's mean."""
    brightness = (rgb - (_mean(rgb) if mean is None else mean)).mean(dim=1, keepdim=True)
    return torch.cat((rgb - 0.5, 2 * brightness), dim=1)


def _lr_input(around: Stencil) -> Tensor:
    """Return (B, 10, h, w): differences compressed so that small ones count, linear differences, and directions."""
    differences = torch.cat(
        (around.value - around.mean, around.along_u[:, 1:2], around.along_v[:, 1:2], around.bend), dim=1
    ).float()
    tiny = torch.finfo(torch.float32).tiny
    bent = around.bend.float().clamp(min=tiny)
    turns = [(along[:, 2:] - along[:, :1]).float() / bent for along in (around.along_u, around.along_v)]
    return torch.cat((torch.asinh(differences / _FAINT) / 3, differences / _STRONG, *turns), dim=1)


def _gather_neighbours(planes: Tensor) -> Tensor:
    """Return the planes of the 3 x 3 low-resolution pixels around each, extended to its centre.

    Args:
        planes: (B, facets, 3, h, w).

    Returns:
        (B, 9, facets, 3, h, w), row by row; a pixel's own planes in place of those beyond the border.

    """
    value, slope_u, slope_v = planes.unbind(dim=2)  # (B, facets, h, w)
    height, width = value.shape[-2:]
    padded = [functional.pad(each, (1, 1, 1, 1), mode="replicate") for each in (value, slope_u, slope_v)]
    around = []
    for i in range(3):
        for j in range(3):
            v, u_slope, v_slope = (each[..., i : i + height, j : j + width] for each in padded)
            # how far this pixel's centre is from the neighbour's; 0 where the neighbour is the pixel itself, repeated
            rows = _steps(height, i - 1, value)[:, None]
            columns = _steps(width, j - 1, value)
            around.append(torch.stack((v - columns * u_slope - rows * v_slope, u_slope, v_slope), dim=2))
    return torch.stack(around, dim=1)


def _steps(size: int, step: int, like: Tensor) -> Tensor:
    """Return ``step`` for every index whose neighbour lies inside, else 0, (size,)."""
    steps = torch.full((size,), float(step), dtype=like.dtype, device=like.device)
    if step:
        steps[0 if step < 0 else -1] = 0
    return steps


def _spline_logits(offsets: Tensor) -> Tensor:
    """Return the logarithm of the quadratic B-spline's weights of the 3 x 3 neighbours, (9, scale, scale).

    A small constant is added to each weight, so that no neighbour is excluded.
    """
    one = torch.stack((0.5 * (0.5 - offsets) ** 2, 0.75 - offsets**2, 0.5 * (0.5 + offsets) ** 2))  # (3, scale)
    both = one[:, None, :, None] * one[None, :, None, :]
    return (both + 1e-4).log().flatten(0, 1)
