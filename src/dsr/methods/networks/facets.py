"""Facets: guided super-resolution by a mixture of planes, dsr's own network.

The disparity of a plane is linear in the pixel, so this network predicts planes. Each low-resolution pixel proposes a
few ("facets"), built from the differences to its neighbours. Each high-resolution pixel mixes the planes of the 3 x 3
low-resolution pixels around it, extended to its position, with weights predicted from the colour image. Whatever the
weights are, planes are reproduced exactly, the network commutes with an affine map of the disparity, and the result
does not overshoot the extended planes.

Below it are the layers that it shares with :mod:`dsr.methods.networks.facets_unet`, which can start from its weights.
"""

import itertools
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.images import exporting, pad_to_multiple
from dsr.methods.networks.facets_planes import NEIGHBOURS, Stencil, mix_planes, stencil
from dsr.methods.networks.network import NormalisedNetwork
from dsr.utils.compute_device import constant
from dsr.utils.guards import expect_positive

FULL, HALF = 16, 32  # channels of the photo's features at the full and at half the resolution
HEAD = 24  # channels of the layers that choose the planes, at the full resolution
# differences of normalised disparity that become about 1 in the network's compressed and linear inputs
_FAINT, _STRONG = 1e-3, 0.25
_RARE = -5.0  # logit of what is added to the choices of Facets
_WIDENED = ("photo.weight", "coarse.weight")  # may have more inputs, after those of the other network


class Facets(NormalisedNetwork):
    """The network."""

    def __init__(self, scale: int, width: int = 96, blocks: int = 6, facets: int = 2, *, slopes: bool = True) -> None:
        super().__init__()
        check_scale(scale)
        expect_positive(width=width, facets=facets)
        expect_positive(or_zero=True, blocks=blocks)
        self.scale, self.width, self.blocks, self.facets, self.slopes = scale, width, blocks, facets, slopes
        # of each residual block 2; 1 of the neighbours' planes, 3 convolutions, 2 of the differences
        self.receptive_field_radius = 2 * blocks + 6
        levels = scale.bit_length() - 1
        self.photo, self.down, up, join = make_pyramid(levels, width)
        self.coarse = nn.Conv2d(10, width, 3, padding=1)
        self.trunk = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.planes = scale_down(nn.Conv2d(width, 3 * facets + 6, 3, padding=1))
        self.up, self.join = up, join
        self.choice = scale_down(nn.Conv2d(HEAD, NEIGHBOURS * facets, 3, padding=1))

    def context(self, rgb: Tensor, disparity: Tensor) -> tuple[Tensor | None, ...]:
        """Return the range and the mean colour of the image, (B, 3, 1, 1)."""
        return (*super().context(rgb, disparity), rgb.mean(dim=(-2, -1), keepdim=True))

    def forward(self, rgb: Tensor, values: Tensor, mean: Tensor | None = None) -> Tensor:
        """Return normalised disparity; ``mean`` is the mean colour of the image that ``rgb`` is a window of."""
        around = stencil(values)
        dtype = self.photo.weight.dtype
        pyramid = look(self.photo, self.down, photo_input(rgb, mean).to(dtype))
        # (B, 10, h, w): compressed differences, so that small ones count, linear ones, and directions
        differences = torch.cat((around.value - around.mean, around.slopes[:, :, 1], around.bend), dim=1).float()
        turns = around.turns.float() / around.bend.float().clamp(min=torch.finfo(torch.float32).tiny)
        lr_input = torch.cat((torch.asinh(differences / _FAINT) / 3, differences / _STRONG, turns), dim=1)
        x = self.trunk(functional.relu(pyramid[-1] + self.coarse(lr_input.to(dtype))))
        planes = self._propose_planes(self.planes(x), around)
        return mix_planes(planes, self.choice(rise(self.up, self.join, x, pyramid)), self.scale)[0]

    def _propose_planes(self, output: Tensor, around: Stencil) -> Tensor:
        """Return the planes of each low-resolution pixel, (B, facets, 3, h, w): value at its centre and slopes."""
        output = output.to(torch.promote_types(around.value.dtype, torch.float32))
        batch, _, height, width = output.shape
        moves, picks = output.split((3 * self.facets, 6), dim=1)
        picks = picks.unflatten(1, (2, 3))
        central = constant((0.0, 2.0, 0.0), picks.dtype, picks.device)  # mostly this difference at first
        picks = (picks + central[:, None, None]).softmax(dim=2)
        slopes = (picks * around.slopes).sum(dim=2)  # (B, 2, h, w)
        base = torch.cat((around.value, slopes), dim=1)[:, None]
        planes = base + moves.view(batch, self.facets, 3, height, width) * around.bend[:, None]
        return planes if self.slopes else torch.cat((planes[:, :, :1], torch.zeros_like(planes[:, :, 1:])), dim=2)


def make_pyramid(
    levels: int, width: int, inputs: int = 4
) -> tuple[nn.Conv2d, nn.ModuleList, nn.ModuleList, nn.ModuleList]:
    """Return layers that halve a resolution ``levels`` times, and back: ``photo``, ``down``, ``up`` and ``join``."""
    channels = [*[FULL, HALF, width, width][:levels], width]
    outputs = [HEAD, *channels[1:-1]]
    return (
        nn.Conv2d(inputs, channels[0], 5, padding=2),
        nn.ModuleList(nn.Conv2d(a, b, 4, stride=2, padding=1) for a, b in itertools.pairwise(channels)),
        nn.ModuleList(nn.Conv2d(channels[i + 1], 4 * outputs[i], 1) for i in reversed(range(levels))),
        nn.ModuleList(nn.Conv2d(outputs[i] + channels[i], outputs[i], 3, padding=1) for i in reversed(range(levels))),
    )


def look(first: nn.Conv2d, down: nn.ModuleList, photo: Tensor) -> list[Tensor]:
    """Return a photo's features by layers of :func:`make_pyramid`, from the full to the low resolution."""
    pyramid = [functional.relu(first(photo), inplace=True)]
    for layer in down:
        pyramid.append(functional.relu(layer(pyramid[-1]), inplace=True))
    return pyramid


def rise(up: nn.ModuleList, join: nn.ModuleList, x: Tensor, pyramid: list[Tensor]) -> Tensor:
    """Return features at the full resolution of those at the low resolution and of the photo's."""
    layers = cast(list[nn.Conv2d], up), cast(list[nn.Conv2d], join)
    for grow, merge, features in zip(*layers, reversed(pyramid[:-1]), strict=True):
        x = functional.relu(enlarge_and_join(grow, merge, x, features), inplace=True)
    return x


def enlarge_and_join(up: nn.Conv2d, join: nn.Conv2d, x: Tensor, features: Tensor) -> Tensor:
    """Return a 3 x 3 convolution of the sub-pixel shuffle of a 1 x 1 convolution's results, with features behind them.

    Both convolutions are linear: in float32 and above, their effect on ``x`` is computed as one transposed convolution,
    in which the bias of the first is the weight of a channel of ones. In lower precisions that would be slower and less
    exact.
    """
    if exporting() or x.dtype.itemsize < torch.float32.itemsize:  # a graph has to know the weights of a convolution
        enlarged: Tensor = functional.pixel_shuffle(up(x), 2)
        return functional.conv2d(torch.cat((enlarged, features), dim=1), join.weight, join.bias, padding=1)
    own, others = join.weight.split((up.out_channels // 4, features.shape[1]), dim=1)
    first = torch.cat((up.weight.flatten(1), up.get_parameter("bias")[:, None]), dim=1)  # (4 C, channels + 1)
    shuffled = first.T.unflatten(1, (-1, 2, 2))  # (channels + 1, C, 2, 2)
    whole = functional.conv2d(shuffled, own, padding=2)  # (channels + 1, D, 4, 4)
    extended = torch.cat((x, torch.ones_like(x[:, :1])), dim=1)
    enlarged = functional.conv_transpose2d(extended, whole, stride=2, padding=1)
    return functional.conv2d(features, others, join.bias, padding=1).add_(enlarged)


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
        """Map (B, C, h, w) to the same shape; ``shares`` (B,) are those of the second set.

        The features after the first convolution are multiplied by 1 + ``gains`` (B, C), and ``shifts`` (B, C) are
        added. On a GPU, which is slow at convolutions of many groups, results are mixed instead of weights.
        """
        first, second = cast(list[Residual], self.ways)
        if x.is_cuda and len(x) > 1:
            share, gain, shift = (each[..., None, None] for each in (shares[:, None], 1 + gains, shifts))
            hidden = torch.lerp(one := first.first(x), second.first(x), share.to(one))
            hidden = functional.relu(torch.addcmul(shift.to(one), hidden, gain.to(one)), inplace=True)
            return torch.lerp(one := first.second(hidden), second.second(hidden), share.to(one)).add_(x)
        batch = 1 if exporting() else len(x)  # a graph has to know the shapes of its weights
        width, square = self.width, (batch, self.width, 3, 3, self.width)
        gain, shift = (1 + gains.float()).reshape(batch, width), shifts.reshape(batch, width).float()
        own, other = (  # weights of the sets, (n,) in float32, with the channels of an input pixel side by side
            [(each.permute(0, 2, 3, 1) if each.dim() > 1 else each).flatten() for each in way.parameters()]
            for way in (first, second)
        )
        mixed = torch.lerp(torch.cat(own).float(), torch.cat(other).float(), shares.reshape(batch, 1).float())
        weight, bias, last, last_bias = mixed.split((9 * width**2, width) * 2, dim=1)
        weight = weight.view(square) * gain[..., None, None, None]
        bias = torch.addcmul(shift, bias, gain)
        weight, last = (each.to(x.dtype).flatten(0, 1).permute(0, 3, 1, 2) for each in (weight, last.view(square)))
        bias, last_bias = (each.to(x.dtype).flatten() for each in (bias, last_bias))
        images = x.reshape(1, -1, *x.shape[-2:]) if batch > 1 else x  # each image is a group of channels
        hidden = functional.relu(functional.conv2d(images, weight, bias, padding=1, groups=batch), inplace=True)
        return functional.conv2d(hidden, last, last_bias, padding=1, groups=batch).add_(images).view(x.shape)


class CoarseUNet(nn.Module):
    """A U-net below the low resolution, which adds nothing at first; its coarsest level, an eighth, knows its mean."""

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
            grown = functional.pixel_shuffle(self.grow[i](x), 2)
            x = self.decoder[i - 1](functional.relu(kept[i - 1] + grown, inplace=True))
        return functional.pixel_shuffle(self.grow[0](x), 2)[..., :height, :width]


def scale_down(conv: nn.Conv2d) -> nn.Conv2d:
    """Return the convolution with small initial weights."""
    with torch.no_grad():
        conv.weight.mul_(0.1)
    nn.init.zeros_(conv.get_parameter("bias"))
    return conv


def silence(layer: nn.Module) -> Any:
    """Return a layer whose results are 0 at first."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def photo_input(rgb: Tensor, mean: Tensor | None = None) -> Tensor:
    """Return (B, 4, H, W): the colours, and the brightness relative to the image's mean colour, (B, 3, 1, 1)."""
    mean = rgb.mean(dim=(-2, -1), keepdim=True) if mean is None else mean
    brightness = (rgb - mean).mean(dim=1, keepdim=True)
    return torch.cat((rgb - 0.5, 2 * brightness), dim=1)


def start_from_facets(net: Any, first: Facets, levels: int) -> None:
    """Let a FacetsUNet of ``levels`` smoothed maps take over the weights of Facets, in both sets of a block."""
    theirs = first.state_dict()
    taken: dict[str, Tensor] = {}
    for name, value in theirs.items():
        kind, number, *rest = name.split(".")
        if kind == "trunk":
            taken |= {".".join((kind, number, "ways", way, *rest)): value for way in "01"}
        elif kind != "planes":
            taken[name] = value
    _copy(net, first, taken)
    own = net.state_dict()
    for name in ("planes.weight", "planes.bias"):
        moves, picks = theirs[name].split((3 * first.facets, 6))
        new = own[name].unflatten(0, (first.facets, -1)).zero_()
        new[:, -3:] = moves.unflatten(0, (first.facets, 3))
        slopes = new[:, 1 + levels : -3].unflatten(1, (2, -1))
        slopes[:, :, :3] = picks.unflatten(0, (2, 3))
        if name.endswith("bias"):
            new[:, 1 : 1 + levels] = _RARE
            slopes[:, :, 3:] = _RARE


def start_from_another_factor(net: Any, first: Any) -> None:
    """Take over a FacetsUNet's weights: layers between resolutions that it lacks begin as means and repetitions."""
    theirs, own = first.state_dict(), net.state_dict()
    # the channels of the U-net, ``wide``, may differ
    whole = all(own[name].shape == value.shape for name, value in theirs.items() if name.startswith("wide."))
    _copy(net, first, {name: value for name, value in theirs.items() if whole or not name.startswith("wide.")})
    for level in range(len(net.up) - len(first.up)):
        weight = silence(net.down[-1 - level]).weight
        for channel in range(min(weight.shape[:2])):  # means of 2 x 2 pixels
            weight[channel, channel, 1:3, 1:3] = 0.25
        weight = silence(net.up[level]).weight
        for channel in range(min(weight.shape[0] // 4, weight.shape[1])):  # each pixel four times
            weight[4 * channel : 4 * channel + 4, channel] = 1
        join = net.join[level]
        join.weight.mul_(0.1)
        join.bias.mul_(0.1)
        for channel in range(min(join.weight.shape[:2])):  # and little else
            join.weight[channel, channel, 1, 1] += 1


def _copy(net: Any, first: Any, named: dict[str, Tensor]) -> None:
    """Copy weights of the same shape, and into layers that have more inputs, which count nothing at first."""
    own = net.state_dict()
    for theirs, value in named.items():
        kind, number, *rest = theirs.split(".")
        numbered = kind in ("up", "join")  # one for each resolution, of which other factors have more or fewer
        name = ".".join((kind, str(int(number) + len(net.up) - len(first.up)), *rest)) if numbered else theirs
        if name not in own:
            continue
        if own[name].shape == value.shape:
            own[name].copy_(value)
        elif name in _WIDENED and own[name].shape[1] > value.shape[1]:
            own[name].zero_()[:, : value.shape[1]] = value
