"""Layers of the networks of planes: residual blocks, a U-net at the low resolution, the pyramid of the photo."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from dsr.methods.exportable import exporting, pad_to_multiple

FULL, HALF = 16, 32  # channels of the photo's features at the full and at half the resolution
HEAD = 24  # channels of the layers that choose the planes, at the full resolution


@functools.lru_cache(64)
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return numbers as a tensor, (n,), which is made once, so that no step waits for its copy to a GPU."""
    with torch.inference_mode(mode=False):  # it may later be used with gradients
        return torch.tensor(values, dtype=dtype, device=device)


class Pyramid(NamedTuple):
    """Layers from the photo's resolution to the map's, ``photo`` and ``down``, and back, ``up`` and ``join``."""

    photo: nn.Conv2d
    down: nn.ModuleList
    up: nn.ModuleList
    join: nn.ModuleList


def make_pyramid(levels: int, width: int, inputs: int = 4) -> Pyramid:
    """Return the layers between the photo's resolution and the map's.

    The resolution is halved ``levels`` times, down to ``width`` channels.
    """
    channels = [*[FULL, HALF, width, width][:levels], width]
    outputs = [HEAD, *channels[1:-1]]
    return Pyramid(
        nn.Conv2d(inputs, channels[0], 5, padding=2),
        nn.ModuleList(nn.Conv2d(a, b, 4, stride=2, padding=1) for a, b in itertools.pairwise(channels)),
        nn.ModuleList(nn.Conv2d(channels[i + 1], 4 * outputs[i], 1) for i in reversed(range(levels))),
        nn.ModuleList(nn.Conv2d(outputs[i] + channels[i], outputs[i], 3, padding=1) for i in reversed(range(levels))),
    )


class Residual(nn.Module):
    """x + conv(relu(conv(x))), initialised close to the identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        with torch.no_grad():
            self.second.weight.mul_(0.3)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, h, w) to the same shape."""
        found: Tensor = self.second(functional.relu(self.first(x), inplace=True)).add_(x)
        return found


class MixedResidual(nn.Module):
    """A residual block whose weights are a mixture of two sets, scaled and shifted; another one for each image."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.ways = nn.ModuleList(Residual(width) for _ in range(2))
        self.ways[1].load_state_dict(self.ways[0].state_dict())

    def forward(self, x: Tensor, shares: Tensor, gains: Tensor, shifts: Tensor) -> Tensor:
        """Map (B, C, h, w) to the same shape.

        ``shares`` (B,) are those of the second set; the features after the first convolution are multiplied by 1 +
        ``gains`` (B, C), and ``shifts`` (B, C) are added. On a GPU, which is slow at convolutions of many groups, the
        results of both sets are mixed instead of the weights.
        """
        first, second = cast(list[Residual], self.ways)
        if x.is_cuda and len(x) > 1:
            share, gain, shift = (each[..., None, None] for each in (shares[:, None], 1 + gains, shifts))
            hidden = torch.lerp(one := first.first(x), second.first(x), share.to(one))
            hidden = functional.relu(torch.addcmul(shift.to(one), hidden, gain.to(one)), inplace=True)
            return torch.lerp(one := first.second(hidden), second.second(hidden), share.to(one)).add_(x)
        batch = 1 if exporting() else len(x)  # a graph has to know the shapes of its weights
        share, shift = shares.reshape(batch).float(), shifts.reshape(batch, self.width).float()
        gain = (1 + gains.float()).reshape(batch, self.width)
        weight, bias, last, last_bias = (
            torch.lerp(one.float()[None], other.float()[None], share.view(-1, *[1] * one.dim()))
            for one, other in zip(first.parameters(), second.parameters(), strict=True)
        )
        weights = (weight * gain[..., None, None, None], torch.addcmul(shift, bias, gain), last, last_bias)
        weight, bias, last, last_bias = (each.to(x.dtype).flatten(0, 1) for each in weights)
        images = x.reshape(1, -1, *x.shape[-2:]) if batch > 1 else x  # each image is a group of channels
        hidden = functional.relu(functional.conv2d(images, weight, bias, padding=1, groups=batch), inplace=True)
        found = functional.conv2d(hidden, last, last_bias, padding=1, groups=batch)
        return (found.view(x.shape) if batch > 1 else found).add_(x)


class Context(nn.Module):
    """What a U-net adds to the trunk, nothing at first; its coarsest level is an eighth, and knows its mean."""

    def __init__(self, width: int, deep: int) -> None:
        super().__init__()
        widths = (width, deep, deep, deep)
        self.shrink = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))
        self.encoder = nn.ModuleList(nn.Sequential(Residual(deep), Residual(deep)) for _ in widths[1:])
        self.overall = silence(nn.Linear(deep, deep))
        self.grow = nn.ModuleList(nn.Conv2d(deep, 4 * a, 1) for a in widths[:-1])
        self.decoder = nn.ModuleList(Residual(deep) for _ in widths[1:-1])
        silence(self.grow[0])

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, h, w) to the same shape; the sizes are padded to multiples of eight."""
        height, width = x.shape[-2:]
        x = pad_to_multiple(x, 8)
        kept = []
        for shrink, encode in zip(self.shrink, self.encoder, strict=True):
            x = encode(functional.relu(shrink(x), inplace=True))
            kept.append(x)
        x = x + self.overall(x.mean(dim=(-2, -1)))[..., None, None]
        for i in (2, 1):
            x = self.decoder[i - 1](functional.relu(kept[i - 1] + enlarge(self.grow[i], x), inplace=True))
        return enlarge(self.grow[0], x)[..., :height, :width]


def concatenate(parts: Sequence[Tensor], dim: int = 0) -> Tensor:
    """Return the concatenation of tensors, a single one as it is."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts), dim=dim)


def convolve_together(convs: Sequence[nn.Conv2d], x: Tensor) -> Tensor:
    """Return the results of convolutions of the same input and of one kind, one behind the other, computed as one."""
    weight = torch.cat([conv.weight for conv in convs])
    bias = torch.cat([conv.bias for conv in convs if conv.bias is not None])
    return functional.conv2d(x, weight, bias, padding=convs[0].padding)


def enlarge(conv: nn.Module, x: Tensor, *features: Tensor) -> Tensor:
    """Return the sub-pixel shuffle of a 1 x 1 convolution's results, with the features behind them.

    The 1 x 1 convolution has a bias and maps (B, channels, h, w) to 4 C channels; with features (B, n, 2 h, 2 w) the
    result is (B, C + n, 2 h, 2 w), the channels of a pixel side by side in memory.
    """
    if exporting():
        return torch.cat((functional.pixel_shuffle(conv(x), 2), *features), dim=1)
    x = functional.conv2d(x, *(_BySubPixel.apply(each) for each in (conv.weight, conv.bias)))
    enlarged: Tensor = _Interleave.apply(x, *features)
    return enlarged


def enlarge_and_join(up: nn.Module, join: nn.Module, x: Tensor, features: Tensor) -> Tensor:
    """Return a 3 x 3 convolution of the sub-pixel shuffle of a 1 x 1 convolution's results, with features behind them.

    Both convolutions are linear: in float32 and above, their effect on ``x`` is computed as one transposed convolution,
    without the arrays between them. The bias of the first becomes the weight of a channel of ones, which, like all
    others, has no effect beyond the border. In lower precisions, whose matrix products prefer even numbers of channels,
    that would be slower and less exact.
    """
    if exporting() or x.dtype.itemsize < torch.float32.itemsize:  # a graph has to know the weights of a convolution
        return cast(Tensor, join(enlarge(up, x, features)))
    weight, bias = (_BySubPixel.apply(each) for each in (up.weight, up.bias))
    own, others = join.get_parameter("weight").split((len(bias) // 4, features.shape[1]), dim=1)
    first = torch.cat((weight.flatten(1), bias[:, None]), dim=1)  # (4 C, channels + 1)
    shuffled = first.T.unflatten(1, (2, 2, -1)).permute(0, 3, 1, 2)  # (channels + 1, C, 2, 2)
    whole = functional.conv2d(shuffled, own, padding=2)  # (channels + 1, D, 4, 4)
    extended = torch.cat((x, torch.ones_like(x[:, :1])), dim=1)
    enlarged = functional.conv_transpose2d(extended, whole, stride=2, padding=1)
    return functional.conv2d(features, others, join.get_parameter("bias"), padding=1).add_(enlarged)


class _BySubPixel(torch.autograd.Function):
    """The order in which the 4 C outputs of a convolution are C of each sub-pixel, not four of each channel."""

    @staticmethod
    def forward(ctx: Any, weight: Tensor) -> Tensor:
        ctx.save_for_backward(weight)
        return weight.unflatten(0, (-1, 4)).transpose(0, 1).flatten(0, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (weight,) = ctx.saved_tensors
        ordered = gradient.unflatten(0, (4, -1)).transpose(0, 1).flatten(0, 1)
        return torch.empty_like(weight).copy_(ordered)  # in the layout of the weight, as several devices expect it


class _Interleave(torch.autograd.Function):
    """Sub-pixels side by side, (B, 4 C, h, w), as (B, C, 2 h, 2 w), with features behind them, in one copy."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, *features: Tensor) -> Tensor:
        batch, channels, height, width = x.shape
        ctx.counts = [channels // 4, *(each.shape[1] for each in features)]
        size = (batch, sum(ctx.counts), 2 * height, 2 * width)
        found = torch.empty(size, dtype=x.dtype, device=x.device, memory_format=torch.channels_last)
        own, *others = found.split(ctx.counts, dim=1)
        _sub_pixels(own).copy_(x.unflatten(1, (2, 2, -1)))
        for other, each in zip(others, features, strict=True):
            other.copy_(each)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        own, *others = gradient.split(ctx.counts, dim=1)
        batch, count, height, width = own.shape
        of_x = own.new_empty(batch, height // 2, width // 2, 4 * count).permute(0, 3, 1, 2)
        of_x.unflatten(1, (2, 2, -1)).copy_(_sub_pixels(own))
        return of_x, *others


def _sub_pixels(values: Tensor) -> Tensor:
    """Return a view of (B, C, 2 h, 2 w) maps as (B, 2, 2, C, h, w)."""
    return values.unflatten(3, (-1, 2)).unflatten(2, (-1, 2)).permute(0, 3, 5, 1, 2, 4)


def scale_down(conv: nn.Conv2d) -> nn.Conv2d:
    """Return the convolution with small initial weights."""
    with torch.no_grad():
        conv.weight.mul_(0.1)
    if conv.bias is not None:
        nn.init.zeros_(conv.bias)
    return conv


def silence(layer: nn.Module) -> Any:
    """Return a layer whose results are 0 at first."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def mean_colour(rgb: Tensor) -> Tensor:
    """Return the mean colour of images, (B, 3, 1, 1)."""
    return rgb.mean(dim=(-2, -1), keepdim=True)


def photo_input(rgb: Tensor, mean: Tensor | None = None) -> Tensor:
    """Return (B, 4, H, W): the colours, and the brightness relative to the image's mean."""
    brightness = (rgb - (mean_colour(rgb) if mean is None else mean)).mean(dim=1, keepdim=True)
    return torch.cat((rgb - 0.5, 2 * brightness), dim=1)
