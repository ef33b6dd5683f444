"""The base of the field's published networks, and how their authors' weights are read, from which no code is executed.

Such a network maps a photo and an enlarged map in 0..1 to a refined map in 0..1. Its authors trained it on depth or on
disparity of one data set, normalised; most of them normalise by the minimum and the maximum of the *true* map, which no
method can know. :class:`PeerUpsampler` takes those of the low-resolution map, and the true ones only on request, to
reproduce the authors' figures.
"""

from __future__ import annotations

import abc
import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.camera import RANGE_TYPES, RangeType, from_range, to_range
from dsr.methods.base import Abilities, Cost, Method
from dsr.methods.images import LUMA, compute_min_max, inpaint, normalise, resize_bicubic
from dsr.methods.networks.network import DTYPES, Precision, blend_tiles, split_image
from dsr.methods.networks.weight_files import load_parameters
from dsr.sample import DepthSample
from dsr.utils import torch_files
from dsr.utils.guards import expect_one_of
from dsr.utils.progress import Steps

Range = Literal["measured", "truth"]
SWAPPED_LUMA = LUMA[::-1]  # weights of red, green and blue, as some authors' code applies the luma's to RGB
_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
_OVERLAP = 16  # of neighbouring tiles in pixels


def load_peer(path: Path, network: type[PeerNetwork], scale: float) -> PeerNetwork:
    """Load a network, whose weights were trained for a factor, of its authors' file, in float32 on the CPU."""
    tensors = network.convert(read_tensors(path))
    with torch.device("meta"):  # without memory and random numbers
        net = network(scale)
    load_parameters(net, tensors, path, network.title)
    return net


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read the tensors of an authors' file by name, without the prefix of networks trained on several GPUs."""
    return {name.removeprefix("module."): value for name, value in torch_files.read_tensors(path).items()}


def fold_batch_norm(tensors: dict[str, Tensor], conv: str, norm: str, eps: float = 1e-5) -> None:
    """Merge a batch normalisation, as evaluation runs it, into the convolution with a bias before it, in place.

    Nothing happens if a tensor is missing or of another shape.
    """
    names = [f"{conv}.weight", f"{conv}.bias", *(f"{norm}.{part}" for part in _NORM_PARTS)]
    if any(name not in tensors for name in names):
        return
    weight, bias, *parts = (tensors[name] for name in names)
    if weight.dim() != 4 or any(part.shape != weight.shape[:1] for part in (bias, *parts)):
        return
    gain, shift, mean, variance = (part.double() for part in parts)
    factor = gain / (variance + eps).sqrt()
    tensors[f"{conv}.weight"] = (weight * factor[:, None, None, None]).float()
    tensors[f"{conv}.bias"] = ((bias - mean) * factor + shift).float()
    for part in (*_NORM_PARTS, "num_batches_tracked"):
        tensors.pop(f"{norm}.{part}", None)


class PeerNetwork(nn.Module, abc.ABC):
    """A published network that refines an enlarged depth map, guided by a photo; ``scale`` is that of its weights."""

    title: ClassVar[str]  # in messages
    checksums: ClassVar[Mapping[str, float]]  # factors of its authors' files by the first 16 digits of their SHA-256
    multiple: ClassVar[int] = 1  # divides the sizes of its images
    receptive_field_radius: ClassVar[int | None] = None  # in pixels of the photo; None if it needs the whole image
    depth_range: tuple[float, float] | None = None  # in metres, that became 0..1 in the training; None: each map's own
    cost: ClassVar[Cost]

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale

    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge a map without holes, (B, 1, h, w), to (B, 1, *size) as the authors do: by Pillow's bicubic filter."""
        return resize_bicubic(values_lr, size)

    @abc.abstractmethod
    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map, (B, 1, H, W), of which 0..1 is the range, with a photo (B, 3, H, W) in 0..1."""

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the network's parameters by their names here, of those of any file by the authors' names.

        Names that the authors' files do not have are kept, so that another network's file is recognised.
        """
        return tensors


def conv3x3(before: int, after: int, bias: bool = True) -> nn.Conv2d:
    """Make a 3 x 3 convolution that keeps the size."""
    return nn.Conv2d(before, after, 3, padding=1, bias=bias)


class ChannelAttention(nn.Module):
    """A residual block whose features are weighted by factors of the whole image (Zhang et al., *RCAN*, ECCV 2018)."""

    def __init__(self, width: int, inner: int, slope: float) -> None:
        super().__init__()
        factors = nn.Sequential(nn.Conv2d(width, inner, 1), nn.ReLU(), nn.Conv2d(inner, width, 1), nn.Sigmoid())
        self.body = nn.Sequential(
            conv3x3(width, width),
            nn.LeakyReLU(slope, inplace=True),
            conv3x3(width, width),
            nn.ModuleDict({"conv_du": factors}),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        y = self.body[:3](x)
        factors = self.body.get_submodule("3.conv_du")(y.mean(dim=(-2, -1), keepdim=True))
        return torch.addcmul(x, y, factors)


class ResidualGroup(nn.Module):
    """Two blocks with channel attention, a convolution, and a connection around all."""

    def __init__(self, width: int, inner: int, slope: float, bias: bool = True) -> None:
        super().__init__()
        blocks = [ChannelAttention(width, inner, slope) for _ in range(2)]
        self.body = nn.Sequential(*blocks, conv3x3(width, width, bias))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        return self.body(x).add_(x)


class PeerUpsampler(Method):
    """A method that is a published network; it takes maps of any ratio, as the network works at the photo's size.

    Args:
        net: the network; it is copied.
        range_type: the range type of the map that the network gets.
        value_range: the minimum and maximum that map to 0 and 1: ``measured`` for those of the low-resolution map,
            ``truth`` for those of the true one, which is how the authors get their figures. It is the one case besides
            the oracle of deep image priors in which a method reads ``sample.depth``; ``flag`` marks its scores. Weights
            with a ``depth_range`` of their own get orthogonal depth, normalised by it.
        precision: dtype of the convolutions.
        device: device of the computations.
        tile: as of :class:`~dsr.methods.networks.network.NetworkUpsampler`.

    """

    abilities = Abilities(ratios="any", needs="weights")

    def __init__(
        self,
        net: PeerNetwork,
        range_type: RangeType = "disparity",
        value_range: Range = "measured",
        precision: Precision = "float32",
        device: torch.device | str = "cpu",
        tile: int | None = None,
    ) -> None:
        expect_one_of("range_type", range_type, RANGE_TYPES)
        expect_one_of("range", value_range, get_args(Range))
        expect_one_of("precision", precision, tuple(DTYPES))
        if net.depth_range is not None and value_range == "truth":
            low, high = net.depth_range
            raise ValueError(
                f"range: expected measured for weights trained on depth of {low:g} to {high:g} m, got truth"
            )
        self.range_type = range_type if net.depth_range is None else "orthogonal"
        self.device, self._dtype, self._tile = torch.device(device), DTYPES[precision], tile
        self._uses_truth = value_range == "truth"
        net = copy.deepcopy(net).eval().requires_grad_(False).to(self.device)
        self.net: PeerNetwork = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs

    @property
    def flag(self) -> str:
        """Mark for scores: ``true-range`` if the true map's minimum and maximum were used, else empty."""
        return "true-range" if self._uses_truth else ""

    def describe(self, sample: DepthSample) -> str:
        """Return a note for the scores where the weights were trained for another factor, else an empty text."""
        trained = self.net.scale
        return "" if math.isclose(trained, sample.scale, rel_tol=0.01) else f"weights trained for x{trained:.3g}"

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres on the sample's device.

        It is NaN where the disparity corresponds to a depth at or beyond infinity. A ValueError if the truth's range is
        needed, and there is no truth.
        """
        if self.range_type == "disparity":
            values_lr = sample.disparity_lr()
        else:
            values_lr = to_range(sample.depth_lr, sample.camera_lr, self.range_type)
        min_max = None  # the low-resolution map's own
        if self.net.depth_range is not None:
            min_max = torch.tensor(self.net.depth_range).view(1, 2, 1, 1)
        elif self._uses_truth:
            if sample.depth is None:
                raise ValueError(f"{sample.scene}: range=truth expects a scene with a true depth map, there is none")
            min_max = compute_min_max(to_range(sample.depth, sample.camera, self.range_type)[None])
        values_lr, rgb = values_lr.to(self.device)[None], sample.rgb.to(self.device)[None]
        values, minimum, value_range = normalise(inpaint(values_lr), min_max)
        refined = self._refine(rgb, values, progress).to(values_lr.dtype) * value_range + minimum
        return from_range(refined[0], sample.camera, self.range_type).to(sample.depth_lr.device)

    def _refine(self, rgb: Tensor, values_lr: Tensor, progress: Steps | None) -> Tensor:
        """Return a map in 0..1, (B, 1, h, w), enlarged to the photo's size and refined, in tiles if that is large."""
        multiple, radius = self.net.multiple, self.net.receptive_field_radius
        height, width = rgb.shape[-2:]
        padding = (0, -width % multiple, 0, -height % multiple)
        enlarged = self.net.enlarge(values_lr.float(), (height, width))
        rgb, enlarged = (functional.pad(each.float(), padding, mode="replicate") for each in (rgb, enlarged))
        margin = None if radius is None else math.ceil(radius / multiple)
        size, overlap = (rgb.shape[-2], rgb.shape[-1]), max(_OVERLAP // multiple, 2)
        rows, columns = split_image(size, multiple, margin, self._tile, overlap)

        def compute(row: slice, column: slice) -> Tensor:
            down, across = (slice(multiple * each.start, multiple * each.stop) for each in (row, column))
            with torch.autocast(self.device.type, self._dtype, enabled=self._dtype != torch.float32):
                return self.net(rgb[..., down, across], enlarged[..., down, across]).float()

        return blend_tiles(compute, rows, columns, multiple, progress)[..., :height, :width]
