"""Facets with context: a network for low-resolution maps of any kernel and noise, which predicts its expected errors.

It extends :mod:`dsr.methods.networks.facets`, as docs/facets.md describes. A U-net (Ronneberger et al., MICCAI 2015)
sees the low-resolution grid down to an eighth of its size. Planes choose among the map and three smoothed copies of
it, and are averaged with those around them in five steps of 1 to 16 pixels. The roughness of the map and the hints
scale and shift the features of each block (Perez et al., *FiLM*, AAAI 2018), and mix its weights from two sets (Yang
et al., *CondConv*, NeurIPS 2019). Where the kernel is known, the residual is added back twice (Irani, Peleg, CVGIP
1991). Maps of the photo's own size have the weights of factor 2. Disparity is divided by its median.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import FACTS, KERNELS, Downsampling, known_kernels
from dsr.methods.images import exporting, inpaint, repeat_blocks, upsample_bicubic
from dsr.methods.networks.facets import (
    HEAD,
    CoarseUNet,
    Facets,
    MixedResidual,
    look,
    make_pyramid,
    photo_input,
    rise,
    scale_down,
    silence,
    start_from_another_factor,
    start_from_facets,
)
from dsr.methods.networks.facets_planes import NEIGHBOURS, Stencil, average_planes, mix_planes, smooth, stencil
from dsr.methods.networks.network import Answer, DisparityNetwork, expect_rgb_size
from dsr.utils.compute_device import constant
from dsr.utils.guards import expect_positive
from dsr.utils.progress import Steps

# layers at the low resolution
_SHARED = ("coarse", "hints", "modulation", "shares", "trunk", "wide", "planes", "blend")
_LEVELS = 3  # smoothed copies of the map
_LR_CHANNELS = 10 + 4 * _LEVELS + 3
_REACHES = (1, 2, 4, 8, 16)  # low-resolution pixels between the planes that are averaged, step by step
_OWN = 8.0  # what is added to the logit of a pixel's own plane
_PROJECTIONS = 2
_CLOSED = -3.0  # logit of the factor of the residual, at first
_BEFORE = 3  # residual blocks before the U-net
# relative differences of disparity that become about 1 in the compressed and in the linear inputs
_FAINT, _STRONG = 5e-4, 0.125
_KINDS = 32  # features of what is known of the whole map
# at first the share of a block's second weights is logistic in the roughness, and a half where it is the second
_SLOPE, _ROUGH = 6.0, 0.5
_QUANTILES = (0.1, 0.5)
_ROUGHNESS = len(_QUANTILES) * (1 + _LEVELS)
_SAMPLES = 2**16  # about how many low-resolution pixels the roughness of a map is measured at
_BAND = 2**20  # pixels of the photo that are processed at a time, beside the trunk, which sees the whole map
_MARGIN = 4  # low-resolution rows beyond a band that its result depends on


class FacetsUNet(DisparityNetwork):
    """The network; its weights at the factors 1 and 2 are the same."""

    of_inverse_depth = True
    states_errors = True
    method = MappingProxyType({"_target_": "dsr.methods.networks.facets_method.AnyMap"})

    def __init__(self, scale: int = 4, width: int = 96, deep: int = 88, blocks: int = 6, facets: int = 2) -> None:
        super().__init__()
        if scale not in (1, 2, 4, 8, 16):
            raise ValueError(f"scale: expected 1, 2, 4, 8 or 16, got {scale}")
        expect_positive(width=width, deep=deep, facets=facets)
        if blocks < _BEFORE:
            raise ValueError(f"blocks: expected at least {_BEFORE}, got {blocks}")
        self.scale, self.width, self.deep, self.blocks, self.facets = scale, width, deep, blocks, facets
        levels = max(scale, 2).bit_length() - 1
        inputs = 4 + 3 * (levels == 1)
        self.photo, self.down, up, join = make_pyramid(levels, width, inputs)
        self.coarse = nn.Conv2d(_LR_CHANNELS, width, 3, padding=1)
        self.hints = nn.Linear(FACTS + _ROUGHNESS, _KINDS)
        self.modulation = nn.ModuleList(silence(nn.Linear(_KINDS, 2 * width)) for _ in range(blocks))
        self.shares = silence(nn.Linear(FACTS + _ROUGHNESS, blocks))
        with torch.no_grad():  # at first by how rough the map is at its own resolution
            self.shares.weight[:, FACTS] = _SLOPE
            self.shares.bias.fill_(-_SLOPE * _ROUGH)
        self.trunk = nn.ModuleList(MixedResidual(width) for _ in range(blocks))
        self.wide = CoarseUNet(width, deep)
        self.planes = scale_down(nn.Conv2d(width, (1 + _LEVELS + 2 * (3 + _LEVELS) + 3) * facets, 3, padding=1))
        self.up, self.join = up, join
        self.choice = scale_down(nn.Conv2d(HEAD, NEIGHBOURS * facets, 3, padding=1))
        self.errors = scale_down(nn.Conv2d(HEAD, 2, 3, padding=1))
        self.blend = silence(nn.Conv2d(width, facets * len(_REACHES) * NEIGHBOURS, 3, padding=1))
        self.gate = silence(nn.Conv2d(HEAD, 1, 3, padding=1))
        self._project = _project

    def compile(self, *arguments: Any, **named: Any) -> None:
        """Let torch compile the network, but for the projection, whose indices differ from step to step."""
        self._project = torch.compiler.disable(_project)
        super().compile(*arguments, **named)

    @classmethod
    def serves(cls, trained: int, scale: int) -> bool:
        """Return whether weights trained for a factor are for another one, too."""
        return max(trained, 2) == max(scale, 2)

    @torch.no_grad()
    def start_from(self, first: DisparityNetwork) -> None:
        """Take over the weights of a trained network for the same or another factor, or of Facets."""
        self._expect(first, (Facets, FacetsUNet), ("width", "blocks", "facets"))
        if isinstance(first, Facets):
            start_from_facets(self, first, _LEVELS)
        else:
            start_from_another_factor(self, first)

    @torch.no_grad()
    def share(self, first: DisparityNetwork) -> None:
        """Take over the layers at the low resolution from a network for another factor, and do not train them."""
        self._expect(first, (FacetsUNet,), ("width", "deep", "blocks", "facets"))
        theirs = first.state_dict()
        for name, parameter in self.named_parameters():
            if name.split(".")[0] in _SHARED:
                parameter.copy_(theirs[name])
                parameter.requires_grad_(False)

    def _expect(self, first: DisparityNetwork, kinds: tuple[type, ...], sizes: Sequence[str]) -> None:
        own, theirs = ({key: net.arguments().get(key) for key in sizes} for net in (self, first))
        if not isinstance(first, kinds) or own != theirs:
            names = " or ".join(kind.__name__ for kind in kinds)
            name, came = type(first).__name__, first.arguments()
            raise ValueError(f"expected weights of {names} with {own}, got those of {name} {came}")

    def upsample(self, rgb: Tensor, disparity: Tensor, min_max: Tensor | None = None) -> Tensor:
        """Return high-resolution disparity; see :meth:`~dsr.methods.networks.network.DisparityNetwork.upsample`."""
        return self.answer(rgb, disparity).disparity

    @staticmethod
    def prepare(batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return patches with ``filled``, inverse depth without holes, and ``kernels``, those that are known."""
        if "filled" in batch:
            return dict(batch)
        kernels = known_kernels(batch["facts"]) if "facts" in batch else None
        return {**batch, "filled": inpaint(batch["disparity_lr"] + batch["doffs"], batch["rgb"]), "kernels": kernels}

    def answer_patches(self, batch: Mapping[str, Any]) -> Answer:
        """Return inverse depth, times baseline and focal length, and its expected errors, with the hints if any."""
        batch = self.prepare(batch)
        inverse, hints = batch["disparity_lr"] + batch["doffs"], (batch.get("noise"), batch.get("facts"))
        return self.answer(batch["rgb"], inverse, *hints, filled=batch["filled"], kernels=batch["kernels"])

    def answer_scene(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return high-resolution disparity, with the hints if any."""
        return self.answer_patches(batch).disparity - batch["doffs"]

    def answer(
        self,
        rgb: Tensor,
        disparity: Tensor,
        noise: Tensor | None = None,
        hints: Tensor | None = None,
        progress: Steps | None = None,
        *,
        filled: Tensor | None = None,
        kernels: Sequence[str | None] | None = None,
    ) -> Answer:
        """Return high-resolution disparity and its expected errors.

        ``rgb`` is (B, 3, H, W) in [0, 1], ``disparity`` (B, 1, h, w), positive, with non-finite holes, ``noise``
        (B, 1, h, w) the standard deviation of its logarithm and ``hints`` (B, ``FACTS``), if they are known; ``filled``
        and ``kernels`` are what :meth:`prepare` computes.
        """
        expect_rgb_size(rgb, disparity, 1 if self.scale < 4 and rgb.shape[-1] == disparity.shape[-1] else self.scale)
        known = disparity.isfinite()
        # the unit is the lower median of a map's known values, (B, 1, 1, 1)
        if exporting():
            ordered = torch.where(known, disparity, torch.inf).flatten(1).sort(dim=1).values
            middle = (known.flatten(1).sum(dim=1, keepdim=True) - 1).clamp(min=0) // 2
            unit = ordered.gather(1, middle)[..., None, None]
        else:
            unit = disparity.masked_fill(~known, torch.nan).flatten(1).nanmedian(dim=1).values.view(-1, 1, 1, 1)
        values = (inpaint(disparity, rgb) if filled is None else filled) / unit
        batch = disparity.shape[0]
        if hints is None:
            hints, kernels = disparity.new_zeros((batch, FACTS)), [None] * batch
        if kernels is None:
            kernels = known_kernels(hints)
        if noise is None:
            noise = torch.zeros_like(values)
        result, errors = self(rgb, values, known, noise, hints, kernels, progress)
        spread, angle = errors.clamp(-12, 4).exp().split(1, dim=1)
        return Answer(result * unit, spread, angle)

    def forward(
        self,
        rgb: Tensor,
        values: Tensor,
        known: Tensor,
        noise: Tensor,
        hints: Tensor,
        kernels: Sequence[str | None],
        progress: Steps | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return high-resolution values, (B, 1, H, W), and the logarithms of both expected errors, (B, 2, H, W).

        ``values`` (B, 1, h, w) are disparity over its median, ``known`` (B, 1, h, w) false where a hole was filled in.
        """
        scale, given = int(rgb.shape[-1] // values.shape[-1]), values
        dtype = self.photo.weight.dtype
        with torch.autocast(rgb.device.type, enabled=False):  # the map keeps its precision
            parts = [photo_input(rgb)]
            weight = known.to(values.dtype)
            if scale == 1:
                values, fine, weight, noise = _pair_up(values, weight, noise)
                scale = 2
                parts.append(fine)
            elif scale == 2:
                parts.append(torch.zeros_like(rgb[:, :3]))
            levels = torch.cat((values, *smooth(values, weight, _LEVELS)))
            around = Stencil(*(each.view(1 + _LEVELS, -1, *each.shape[1:]) for each in stencil(levels)))
            lr_input = _lr_input(around, weight, noise, hints)
            cues = torch.cat((hints.float(), _roughness(around.bend, weight)), dim=1)
        photo, bands = torch.cat(parts, dim=1).to(dtype), self._split(values.shape[-2], rgb.shape)
        windows = [photo[..., scale * rows.start : scale * rows.stop, :] for rows, _ in bands]
        kept = look(self.photo, self.down, photo) if len(bands) == 1 else None
        features = []
        for window, (_, inner) in zip(windows, bands, strict=True):
            features.append((kept or look(self.photo, self.down, window))[-1][..., inner, :])
        x = functional.relu(self.coarse(lr_input.to(dtype)).add_(_join(features)), inplace=True)
        kind, shares = functional.relu(self.hints(cues.to(dtype))), self.shares(cues.to(dtype)).sigmoid()
        for number, (block, modulate) in enumerate(zip(self.trunk, self.modulation, strict=True)):
            if number == _BEFORE:
                x = x + self.wide(x)
            x = block(x, shares[:, number], *modulate(kind).chunk(2, dim=1))
        planes = self._propose_planes(self.planes(x), self.blend(x), around)
        bits = []
        for number, (window, (rows, inner)) in enumerate(zip(windows, bands, strict=True), 1):
            high = rise(self.up, self.join, x[..., rows, :], kept or look(self.photo, self.down, window))
            found = self._choose(high, planes[..., rows, :], scale)
            inside = slice(scale * inner.start, scale * inner.stop)
            bits.append([each[..., inside, :] for each in found])
            if progress is not None:
                progress(number, len(bands))
        result, errors, gate = (_join(each) for each in zip(*bits, strict=True))
        if given.shape == values.shape:  # not for a map of the photo's own size
            with torch.autocast(rgb.device.type, enabled=False):
                result = self._project(result, given, known, gate, hints, kernels)
        return result, errors

    def _split(self, height: int, shape: torch.Size) -> list[tuple[slice, slice]]:
        """Return bands of low-resolution rows with their margins, and the rows of each that are kept."""
        if exporting() or self.training:
            return [(slice(0, height), slice(0, height))]
        count, bands = max(1, height * _BAND // (shape[0] * shape[-2] * shape[-1])), []
        for first in range(0, height, count):
            above, end = max(0, first - _MARGIN), min(first + count, height)
            bands.append((slice(above, min(end + _MARGIN, height)), slice(first - above, end - above)))
        return bands

    def _choose(self, x: Tensor, planes: Tensor, scale: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mixture of planes, logarithms of the expected errors, (B, 2, H, W), and the residual's factor."""
        layers = (self.choice, self.errors, self.gate)
        weight, bias = (torch.cat([each.get_parameter(name) for each in layers]) for name in ("weight", "bias"))
        mixed, others = mix_planes(planes, functional.conv2d(x, weight, bias, padding=1), scale)
        errors, gate = others.float().split((2, 1), dim=1)
        return mixed, errors - 5, torch.sigmoid(gate + _CLOSED)

    def _propose_planes(self, output: Tensor, blend: Tensor, around: Stencil) -> Tensor:
        """Return the planes of each low-resolution pixel, averaged with those around them, (B, facets, 3, h, w).

        They are the value at its centre and the slopes, and ``blend`` the logits of the averages' weights.
        """
        output = output.to(torch.promote_types(around.value.dtype, torch.float32))
        output = output.unflatten(1, (self.facets, -1))
        values, slopes, moves = output.split((1 + _LEVELS, 2 * (3 + _LEVELS), 3), dim=2)
        values = _favour(values, 0).softmax(dim=2)
        value = (values * around.value.permute(1, 2, 0, 3, 4)).sum(dim=2)
        slopes = _favour(slopes.unflatten(2, (2, -1)), 1).softmax(dim=3)  # (B, facets, 2, 3 + levels, h, w)
        central = around.slopes[1:, :, :, 1].permute(1, 2, 0, 3, 4)
        slope = (slopes * torch.cat((around.slopes[0], central), dim=2)[:, None]).sum(dim=3)
        planes = torch.cat((value[:, :, None], slope), dim=2) + moves * around.bend[0][:, None]
        logits = blend.to(planes.dtype).unflatten(1, (self.facets, len(_REACHES), NEIGHBOURS))
        before, own, after = logits.split((NEIGHBOURS // 2, 1, NEIGHBOURS // 2), dim=3)
        weights = torch.cat((before, own + _OWN, after), dim=3).softmax(dim=3)
        for step, reach in enumerate(_REACHES):
            planes = average_planes(planes, weights[:, :, step], reach)
        return planes


def _join(bands: Sequence[Tensor]) -> Tensor:
    """Return bands of rows as one map; a single one as it is."""
    return bands[0] if len(bands) == 1 else torch.cat(list(bands), dim=-2)


def _favour(logits: Tensor, index: int) -> Tensor:
    """Return logits of (B, facets, ..., n, h, w) with 2 added to one of the n."""
    added = tuple(2.0 * (i == index) for i in range(logits.shape[-3]))
    return logits + constant(added, logits.dtype, logits.device)[:, None, None]


def _pair_up(values: Tensor, weight: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the means of 2 x 2 pixels of a map, what they leave over, and the means of its weights and noise."""
    share = functional.avg_pool2d(weight, 2)
    mean = functional.avg_pool2d(values * weight, 2) / share.clamp(min=0.25)
    mean = torch.where(share > 0, mean, functional.avg_pool2d(values, 2))
    rest = (values - repeat_blocks(mean, 2)).float()
    fine = torch.cat((torch.asinh(rest / _FAINT) / 3, rest / _STRONG, weight.float() - 0.5), dim=1)
    return mean, fine, share, functional.avg_pool2d(noise, 2)


def _lr_input(around: Stencil, weight: Tensor, noise: Tensor, hints: Tensor) -> Tensor:
    """Return the trunk's input, (B, channels, h, w) in float32, of differences of (levels, B, ...) and hints."""
    value, central, bend = around.value, around.slopes[:, :, :, 1], around.bend
    differences = torch.cat((value[0] - around.mean[0], central[0], bend[0]), dim=1).float()
    turns = around.turns[0].float() / bend[0].float().clamp(min=torch.finfo(torch.float32).tiny)
    wide = torch.cat((value[0] - value[1:], central[1:], bend[1:]), dim=2).transpose(0, 1).flatten(1, 2).float()
    noise_known = hints[:, -1:, None, None].float().expand_as(weight)
    level = torch.where(noise_known > 0, torch.log10(noise.float().clamp(min=1e-5) / 1e-3), 0)
    compressed, coarser = (torch.asinh(each / _FAINT) / 3 for each in (differences, wide))
    parts = (compressed, differences / _STRONG, turns, coarser, weight.float() - 0.5, noise_known, level)
    return torch.cat(parts, dim=1)


def _project(
    result: Tensor, values: Tensor, known: Tensor, gate: Tensor, hints: Tensor, kernels: Sequence[str | None]
) -> Tensor:
    """Return results closer to what was measured, where the kernel is known."""
    scale = result.shape[-1] // values.shape[-1]
    places = {kernel: [i for i, each in enumerate(kernels) if each == kernel] for kernel in kernels if kernel}
    for _ in range(_PROJECTIONS if places else 0):
        seen = values  # so that nothing is left over where the kernel is not known
        for kernel, images in places.items():
            model = Downsampling(kernel)  # type: ignore[arg-type]
            if len(images) == len(kernels):
                seen = model(result, scale, complete=True)
            elif result.device.type == "cpu":
                index = torch.tensor(images)
                seen = seen.index_copy(0, index, model(result[index], scale, complete=True))
            else:  # which would wait for a copy of the indices
                of_kernel = hints[:, KERNELS.index(kernel), None, None, None] > 0
                seen = torch.where(of_kernel, model(result, scale, complete=True), seen)
        residual = torch.where(known, values - seen, 0)
        result = result + gate.to(result.dtype) * upsample_bicubic(residual, scale)
    return result


def _roughness(bend: Tensor, weight: Tensor) -> Tensor:
    """Return logarithms of quantiles of the bend, (levels, B, 1, h, w), where it is known, (B, channels)."""
    known = weight > 0.5
    if exporting():  # no size of a graph depends on values
        nth = (torch.ones_like(weight[0, 0]).sum() / _SAMPLES).sqrt().floor().clamp(min=1)
        rows, columns = (torch.arange(n, device=bend.device, dtype=torch.float32) for n in weight.shape[-2:])
        known = known & (torch.fmod(rows, nth) == 0)[:, None] & (torch.fmod(columns, nth) == 0)
    else:
        step = max(1, math.isqrt(weight.shape[-2] * weight.shape[-1] // _SAMPLES))
        bend, known = bend[..., ::step, ::step], known[..., ::step, ::step]
    values = bend.float().flatten(2).flatten(0, 1)  # of pixels, a row for each level and image
    known = known.flatten(1).repeat(1 + _LEVELS, 1)
    ordered, count = torch.where(known, values, torch.inf).sort(dim=1).values, known.sum(dim=1, keepdim=True)
    place = constant(_QUANTILES, torch.float32, bend.device) * (count - 1).clamp(min=0).to(values.dtype)
    below, above = place.floor().long(), place.ceil().long()
    quantiles = torch.lerp(ordered.gather(1, below), ordered.gather(1, above), place - below.to(values.dtype))
    quantiles = torch.where(count > 0, quantiles, torch.nan)
    quantiles = quantiles.unflatten(0, (1 + _LEVELS, -1)).transpose(0, 1).flatten(1)  # (B, levels * quantiles)
    return (torch.log10(quantiles.nan_to_num(0) + 1e-6) + 4) / 2
