"""ZipDepth: relative inverse depth of a photo by a small convolutional network, fitted to the low-resolution map.

Tosi, Bartolomei, Poggi, Mattoccia, *ZipDepth: Bringing Lightweight Zero-Shot Monocular Depth Anywhere, on Any Device*,
ECCV 2026. Four stages of re-parameterisable blocks, pooled context, and a decoder whose last enlargement is a convex
combination of neighbours. The layers, and the parameters' names, are those of fabiotosi92/ZipDepth (MIT),
zipdepth/model/architecture.py, with its default ``balanced`` context; the photo's size is that of its
zipdepth/inference/predictor.py. The weights are its authors'.

The network sees no depth: the result is one of a photo, brought to the map's scale and shift by a robust line. It says
what a depth sensor adds.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Abilities, Cost, Method, NoSolutionError
from dsr.methods.external import INVERSE, Fit, describe_fit, fit_to_map, to_depth, within_limits
from dsr.methods.networks.weight_files import load_parameters
from dsr.sample import DepthSample
from dsr.utils.guards import refusing
from dsr.utils.progress import Steps
from dsr.utils.torch_files import read_torch_file

SIZE = 384
"""Shorter side, in pixels, of the photos that the network was trained on."""
MULTIPLE = 32
_FIT: Fit = "affine"
_PREFIXES = ("module.", "_orig_mod.")
"""Beginnings of names in files of networks that were compiled or trained on several GPUs."""
_CROSS = 0.3
"""Weight of what a stage gets of the next one, and the other way round."""


class Sizes(NamedTuple):
    """Sizes of a network: channels and numbers of blocks of its stages, channels of its decoder.

    ``half``: channels at half the photo's size. ``unfold``: whether its last step is a convex combination of
    neighbours, as in ``zipdepth_base.pth``, or a mixture of two interpolations, as in ``zipdepth_base_npu.pth``.
    """

    channels: tuple[int, int, int, int]
    blocks: tuple[int, int, int, int]
    decoder: int
    half: int
    unfold: bool = True

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor]) -> Sizes:
        """Return those of the network with these parameters.

        Raises:
            KeyError: one that it must have is missing.

        """
        firsts = ("stem_quarter.conv", *(f"down{stage}.branch_3x3.0" for stage in (2, 3, 4)))
        channels = [len(tensors[f"encoder.{each}.weight"]) for each in firsts]
        blocks = [sum(f"encoder.stage{i}.{k}.branch_3x3.0.weight" in tensors for k in range(99)) for i in range(1, 5)]
        decoder, half = (len(tensors[f"decoder.{each}.proj_high.weight"]) for each in ("fuse1", "fuse_half"))
        unfold = "decoder.convex_up.mask_pred.0.weight" in tensors
        return cls(tuple(channels), tuple(blocks), decoder, half, unfold)  # type: ignore[arg-type]  # four of each


class Norm(nn.Module):
    """Batch normalisation with the statistics of the training."""

    def __init__(self, channels: int) -> None:
        """Make the parameters."""
        super().__init__()
        for name in ("weight", "bias", "running_mean", "running_var"):
            self.register_buffer(name, torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        mean, variance, gain, shift = map(self.get_buffer, ("running_mean", "running_var", "weight", "bias"))
        return functional.batch_norm(x, mean, variance, gain, shift)


class ConvNorm(nn.Module):
    """A convolution, its normalisation, and a ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> None:
        """Make the layers."""
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
        self.bn = Norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        return self.bn(self.conv(x)).relu_()


class Block(nn.Module):
    """The sum of a 3 x 3 and a 1 x 1 convolution, and of the input where it has the same shape (RepVGG)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        """Make the branches."""
        super().__init__()
        self.identity = inputs == outputs and stride == 1
        self.branch_3x3 = nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), Norm(outputs))
        self.branch_1x1 = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), Norm(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        both = self.branch_3x3(x) + self.branch_1x1(x)
        return (both + x if self.identity else both).relu_()


class Surroundings(nn.Module):
    """What 3 x 3 kernels of two widths see around each pixel, channel by channel, is added to it."""

    def __init__(self, channels: int) -> None:
        """Make the layers."""
        super().__init__()
        self.branch1 = nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)
        self.branch2 = nn.Conv2d(channels, channels, 3, padding=2, dilation=2, groups=channels, bias=False)
        self.bn = Norm(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        return x + self.bn(self.branch1(x) + self.branch2(x))


class StripGate(nn.Module):
    """Features are weighted by the sum of the means of their row and their column."""

    def __init__(self, channels: int) -> None:
        """Make the layers."""
        super().__init__()
        conv = nn.Conv2d(channels, channels, 1, groups=channels, bias=False)
        self.gate_conv = nn.Sequential(conv, Norm(channels), nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        return x * self.gate_conv(x.mean(dim=3, keepdim=True) + x.mean(dim=2, keepdim=True))


class ChannelGate(nn.Module):
    """Features are weighted by factors of the whole image."""

    def __init__(self, channels: int) -> None:
        """Make the layers."""
        super().__init__()
        inner = max(channels // 8, 4)
        layers = (nn.Conv2d(channels, inner, 1, bias=False), nn.ReLU(), nn.Conv2d(inner, channels, 1, bias=False))
        self.fc = nn.Sequential(*layers, nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        return x * self.fc(x.mean(dim=(2, 3), keepdim=True))


class GlobalContext(nn.Module):
    """A weighted mean of the whole image is added to each pixel."""

    def __init__(self, channels: int) -> None:
        """Make the layers."""
        super().__init__()
        inner = max(channels // 4, 8)
        self.context_weight = nn.Conv2d(channels, 1, 1)
        self.transform = nn.Sequential(
            nn.Conv2d(channels, inner, 1), Norm(inner), nn.ReLU(), nn.Conv2d(inner, channels, 1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        weight = self.context_weight(x).flatten(2).softmax(dim=2)
        return x + self.transform((x.flatten(2) @ weight.transpose(1, 2))[..., None])


class PooledPyramid(nn.Module):
    """Maxima over windows of 1, 5, 9 and 13 pixels, merged."""

    def __init__(self, channels: int) -> None:
        """Make the layers."""
        super().__init__()
        inner = channels // 4
        self.cv1, self.cv2 = ConvNorm(channels, inner, 1), ConvNorm(4 * inner, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        found = [self.cv1(x)]
        for _ in range(3):
            found.append(functional.max_pool2d(found[-1], 5, 1, 2))
        return self.cv2(torch.cat(found, dim=1))


class Exchange(nn.Module):
    """Two stages get some of each other."""

    def __init__(self, fine: int, coarse: int) -> None:
        """Make the layers."""
        super().__init__()
        self.low_to_high, self.high_to_low = _mix(coarse, fine), _mix(fine, coarse)

    def forward(self, fine: Tensor, coarse: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, fine, H, W) and (B, coarse, h, w) to the same shapes."""
        up = functional.interpolate(self.low_to_high(coarse), fine.shape[2:], mode="nearest")
        down = functional.adaptive_avg_pool2d(self.high_to_low(fine), (coarse.shape[2], coarse.shape[3]))
        return fine + _CROSS * up, coarse + _CROSS * down


class Fusion(nn.Module):
    """A stage and an enlarged coarser one, merged."""

    def __init__(self, fine: int, coarse: int, outputs: int) -> None:
        """Make the layers."""
        super().__init__()
        self.proj_high, self.proj_low, self.bn = _mix(fine, outputs), _mix(coarse, outputs), Norm(outputs)

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """Map (B, fine, H, W) and (B, coarse, h, w) to (B, outputs, H, W)."""
        coarse = functional.interpolate(coarse, fine.shape[2:], mode="bilinear", align_corners=False)
        return self.bn(self.proj_high(fine) + self.proj_low(coarse)).relu_()


class ConvexUpsampling(nn.Module):
    """Each pixel of the map of twice the size is a convex combination of 3 x 3 pixels."""

    def __init__(self, features: int) -> None:
        """Make the layers."""
        super().__init__()
        inner = max(features // 4, 8)
        first = nn.Conv2d(features, inner, 3, padding=1, bias=False)
        self.mask_pred = nn.Sequential(first, Norm(inner), nn.ReLU(), nn.Conv2d(inner, 9 * 4, 1))

    def forward(self, features: Tensor, values: Tensor) -> Tensor:
        """Map (B, features, H, W) and (B, 1, H, W) to (B, 1, 2 H, 2 W)."""
        weights = self.mask_pred(features).unflatten(1, (9, 4)).softmax(dim=1)
        around = functional.unfold(functional.pad(values, (1, 1, 1, 1), mode="replicate"), 3)
        around = around.unflatten(2, tuple(values.shape[2:]))[:, :, None]
        return functional.pixel_shuffle((weights * around).sum(dim=1), 2)


class MixedUpsampling(nn.Module):
    """Each pixel of the map of twice the size is a mixture of the nearest pixel and of bilinear interpolation."""

    def __init__(self, features: int) -> None:
        """Make the layers."""
        super().__init__()
        inner = max(features // 2, 8)
        self.where_conv = nn.Sequential(
            nn.Conv2d(features, inner, 1, bias=False),
            Norm(inner),
            nn.ReLU(),
            nn.Conv2d(inner, inner, 5, padding=2, groups=inner, bias=False),
            Norm(inner),
            nn.ReLU(),
            nn.Conv2d(inner, 1, 1, bias=False),
        )

    def forward(self, features: Tensor, values: Tensor) -> Tensor:
        """Map (B, features, H, W) and (B, 1, H, W) to (B, 1, 2 H, 2 W)."""
        share = _double(self.where_conv(features)).sigmoid()
        return share * functional.interpolate(values, scale_factor=2, mode="nearest") + (1 - share) * _double(values)


class Encoder(nn.Module):
    """Features of the photo at 1/2, 1/4, 1/8, 1/16 and 1/32 of its size."""

    def __init__(self, sizes: Sizes) -> None:
        """Make the layers."""
        super().__init__()
        one, two, three, four = sizes.channels
        stages = [[Block(n, n) for _ in range(count)] for n, count in zip(sizes.channels, sizes.blocks, strict=True)]
        self.stem_half, self.stem_quarter = ConvNorm(3, one // 2, 3, 2), ConvNorm(one // 2, one, 3, 2)
        self.stage1 = nn.Sequential(*stages[0])
        self.down2, self.stage2 = Block(one, two, 2), nn.Sequential(*stages[1], Surroundings(two), StripGate(two))
        self.down3 = Block(two, three, 2)
        self.stage3 = nn.Sequential(*stages[2], ChannelGate(three), GlobalContext(three))
        self.down4, self.stage4 = Block(three, four, 2), nn.Sequential(*stages[3])
        self.spp, self.cross_scale = PooledPyramid(four), Exchange(three, four)

    def forward(self, rgb: Tensor) -> list[Tensor]:
        """Map (B, 3, H, W) to the features, from fine to coarse."""
        half = self.stem_half(rgb)
        first = self.stage1(self.stem_quarter(half))
        second = self.stage2(self.down2(first))
        third = self.stage3(self.down3(second))
        return [half, first, second, *self.cross_scale(third, self.spp(self.stage4(self.down4(third))))]


class Decoder(nn.Module):
    """Inverse depth from the features."""

    def __init__(self, sizes: Sizes) -> None:
        """Make the layers."""
        super().__init__()
        one, two, three, four = sizes.channels
        finest, fine, coarse, coarsest = sizes.decoder, int(1.5 * sizes.decoder), 2 * sizes.decoder, 3 * sizes.decoder
        self.proj4 = ConvNorm(four, coarsest, 1)
        self.fuse3, self.fuse2 = Fusion(three, coarsest, coarse), Fusion(two, coarse, fine)
        self.fuse1, self.fuse_half = Fusion(one, fine, finest), Fusion(one // 2, finest, sizes.half)
        self.head_half = nn.Conv2d(sizes.half, 1, 3, padding=1)
        self.convex_up = (ConvexUpsampling if sizes.unfold else MixedUpsampling)(sizes.half)

    def forward(self, features: list[Tensor]) -> Tensor:
        """Map the encoder's features to (B, 1, H, W), not negative."""
        half, first, second, third, fourth = features
        merged = self.fuse2(second, self.fuse3(third, self.proj4(fourth)))
        merged = self.fuse_half(half, self.fuse1(first, merged))
        return self.convex_up(merged, self.head_half(merged)).relu()


class ZipDepth(nn.Module):
    """The network, for inference."""

    def __init__(self, sizes: Sizes) -> None:
        """Make the layers."""
        super().__init__()
        self.encoder, self.decoder = Encoder(sizes), Decoder(sizes)
        self.register_buffer("mean", torch.zeros(1, 3, 1, 1))
        self.register_buffer("std", torch.ones(1, 3, 1, 1))

    def forward(self, rgb: Tensor) -> Tensor:
        """Map photos in 0..1, (B, 3, H, W), to relative inverse depth, (B, 1, H, W); 32 divides H and W."""
        return self.decoder(self.encoder((rgb - self.get_buffer("mean")) / self.get_buffer("std")))

    @classmethod
    def load(cls, path: Path) -> ZipDepth:
        """Load the network of its authors' file; its sizes are those of the tensors.

        Tensors that only the training used are left out, as the authors' own code does.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is damaged, holds other Python objects, or is of another network.

        """
        content = read_torch_file(path)
        tensors = content.get("model_state_dict", content) if isinstance(content, Mapping) else {}
        if not isinstance(tensors, Mapping) or not all(isinstance(value, Tensor) for value in tensors.values()):
            raise ValueError(f"{path}: expected the tensors of {cls.__name__} by name, got something else")
        tensors = {_plain(str(name)): value for name, value in tensors.items()}
        with refusing(f"{path}: expected the tensors of {cls.__name__}, got those of another network", KeyError):
            sizes = Sizes.of(tensors)
        with torch.device("meta"):  # takes no memory
            net = cls(sizes)
        known = net.state_dict().keys()
        load_parameters(net, {name: tensors[name] for name in tensors if name in known}, path, cls.__name__)
        return net.eval().requires_grad_(requires_grad=False)


class ZipDepthMonocular(Method):
    """A method that is ZipDepth, fitted to the low-resolution map in inverse depth.

    The photo is resized bilinearly, the result bilinearly with its corner pixels on those of the photo, both as the
    authors do. Where the fitted inverse depth is not that of a distance in front of the camera, a hole stays.

    Args:
        weights: the authors' file, ``zipdepth_base.pth`` or ``zipdepth_base_npu.pth``.
        size: shorter side of the photo that the network gets; both sides are rounded to multiples of 32.
        device: where to compute.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or of another network, or ``size`` is less than 32.

    """

    abilities = Abilities(ratios="any", own_size=True, needs="weights", cost=Cost(60, program=1e9))

    def __init__(self, weights: Path, size: int = SIZE, device: torch.device | str = "cpu") -> None:
        if size < MULTIPLE:
            raise ValueError(f"size: expected {MULTIPLE} or more, got {size}")
        self._path, self._size, self.device = Path(weights), size, torch.device(device)
        self.net = ZipDepth.load(self._path).to(self.device)

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres on the sample's device.

        Raises:
            NoSolutionError: the result falls where the low-resolution map rises.

        """
        values = self.relative(sample.rgb.to(self.device, torch.float32)[None])[0]
        try:
            fitted = fit_to_map(values.cpu(), sample, INVERSE, _FIT, self._path)
        except ValueError as error:
            raise NoSolutionError(str(error)) from error
        if progress is not None:
            progress(1, 1)
        return within_limits(to_depth(fitted, sample.camera, INVERSE)).to(sample.depth_lr)

    def relative(self, rgb: Tensor) -> Tensor:
        """Return relative inverse depth, (B, 1, H, W), of photos in 0..1, (B, 3, H, W)."""
        size = rgb.shape[-2:]
        within = [max(MULTIPLE, round(n * self._size / min(size) / MULTIPLE) * MULTIPLE) for n in size]
        values = self.net(functional.interpolate(rgb, within, mode="bilinear", align_corners=False))
        return functional.interpolate(values, size, mode="bilinear", align_corners=True)

    def describe(self, sample: DepthSample) -> str:
        """Return how the result was fitted."""
        return describe_fit(_FIT)


def _mix(inputs: int, outputs: int) -> nn.Conv2d:
    """Return a 1 x 1 convolution of as many groups, up to 4, as divide both numbers of channels."""
    groups = next(each for each in (4, 2, 1) if inputs % each == 0 and outputs % each == 0)
    return nn.Conv2d(inputs, outputs, 1, groups=groups, bias=False)


def _double(x: Tensor) -> Tensor:
    """Return maps of twice the size, bilinearly interpolated."""
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def _plain(name: str) -> str:
    """Return a tensor's name without what a training puts before it."""
    while name.startswith(_PREFIXES):
        name = name.partition(".")[2]
    return name
