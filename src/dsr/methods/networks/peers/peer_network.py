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
import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.camera import RANGE_TYPES, RangeType, from_range, to_range
from dsr.methods.base import Abilities, Cost, Method
from dsr.methods.classical.finite_differences import LUMA
from dsr.methods.inpainting import inpaint
from dsr.methods.networks.network import DTYPES, Precision
from dsr.methods.networks.normalisation import compute_min_max, normalise
from dsr.methods.networks.weight_files import load_parameters
from dsr.methods.tiling import TILE, UNTILED, AxisTile, blend_tiles, split_axis
from dsr.sample import DepthSample
from dsr.utils.guards import expect_one_of
from dsr.utils.progress import Steps
from dsr.utils.torch_files import read_torch_file

_PARALLEL = "module."
"""Prefix of the names in files of networks that were trained on several GPUs."""
_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")

Range = Literal["measured", "truth"]
SWAPPED_LUMA = LUMA[::-1]
"""Weights of red, green and blue: those of the luma in reverse, as some authors' code applies them to RGB."""
_OVERLAP = 16
"""Overlap of neighbouring tiles in pixels."""


def load_peer(path: Path, network: type[PeerNetwork], scale: float) -> PeerNetwork:
    """Load a network of its authors' file, in float32 on the CPU.

    Args:
        network: the network's class.
        scale: the factor that the weights were trained for.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, holds other Python objects than tensors, or is of another network.

    """
    tensors = network.convert(read_tensors(path))
    with torch.device("meta"):  # without memory and random numbers
        net = network(scale)
    load_parameters(net, tensors, path, network.title)
    return net


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read the tensors of an authors' file by name, without the prefix of networks trained on several GPUs.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or holds other Python objects than tensors.

    """
    content = read_torch_file(path)
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        keys = ", ".join(map(str, list(content)[:4])) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{path}: expected a network's tensors by name, got {keys}")
    return {str(name).removeprefix(_PARALLEL): value for name, value in content.items()}


def rename(tensors: Mapping[str, Tensor], names: Mapping[str, str]) -> dict[str, Tensor]:
    """Return tensors by new names.

    Args:
        tensors: tensors by name.
        names: replacements of regular expressions, applied one after the other to every name.

    """
    renamed = {}
    for name, value in tensors.items():
        for pattern, replacement in names.items():
            name = re.sub(pattern, replacement, name)  # noqa: PLW2901 - each replaces its part
        renamed[name] = value
    return renamed


def fold_batch_norm(tensors: dict[str, Tensor], conv: str, norm: str, eps: float = 1e-5) -> None:
    """Merge a batch normalisation, as evaluation runs it, into the convolution before it.

    Args:
        tensors: content of a file; the convolution's are replaced and the normalisation's removed, unless one is
            missing or of another shape.
        conv: name of the convolution, which has a bias.
        norm: name of the batch normalisation.
        eps: constant that the normalisation adds to the variance.

    """
    weight, bias = (tensors.get(f"{conv}.{part}") for part in ("weight", "bias"))
    parts = [tensors.get(f"{norm}.{part}") for part in _NORM_PARTS]
    if weight is None or bias is None or weight.dim() != 4:
        return
    known = [part for part in parts if part is not None and part.shape == bias.shape == weight.shape[:1]]
    if len(known) < len(_NORM_PARTS):
        return
    gain, shift, mean, variance = (part.double() for part in known)
    factor = gain / (variance + eps).sqrt()
    tensors[f"{conv}.weight"] = (weight * factor[:, None, None, None]).float()
    tensors[f"{conv}.bias"] = ((bias - mean) * factor + shift).float()
    for part in (*_NORM_PARTS, "num_batches_tracked"):
        tensors.pop(f"{norm}.{part}", None)


class PeerNetwork(nn.Module, abc.ABC):
    """A published network that refines an enlarged depth map, guided by a photo.

    Args:
        scale: the factor that its weights were trained for.

    Attributes:
        title: the name in messages.
        checksums: the factors of its authors' files by the first 16 digits of their SHA-256.
        multiple: the number that divides the sizes of its images.
        receptive_field_radius: in pixels of the photo; None where an output depends on the whole image. Large images
            are processed in tiles if there is one.
        cost: the rough cost.

    """

    title: ClassVar[str]
    checksums: ClassVar[Mapping[str, float]]
    multiple: ClassVar[int] = 1
    receptive_field_radius: ClassVar[int | None] = None
    cost: ClassVar[Cost]

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """Orthogonal depth in metres that became 0 and 1 in the training; None if each map's own range did."""
        return None

    @abc.abstractmethod
    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge a low-resolution map as the authors do.

        Args:
            values_lr: (B, 1, h, w) map without holes.
            size: height and width of the photo.

        Returns:
            (B, 1, *size).

        """

    @abc.abstractmethod
    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map.

        Args:
            rgb: (B, 3, H, W) photo in 0..1; ``multiple`` divides H and W.
            values: (B, 1, H, W) enlarged map, of which 0..1 is the range.

        Returns:
            (B, 1, H, W) in the same range.

        """

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the network's parameters by their names here.

        Args:
            tensors: content of any file, by the authors' names without ``module.``. Names that the authors' files do
                not have are kept, so that another network's file is recognised.

        """
        return tensors


class PeerUpsampler(Method):
    """A method that is a published network.

    It takes a low-resolution map of any ratio, as the network works at the photo's size. Images of more than
    ``UNTILED`` pixels are processed in tiles where the network's receptive field is limited.

    Args:
        net: the network; it is copied.
        range_type: the range type of the map that the network gets.
        value_range: the minimum and maximum that map to 0 and 1: ``measured`` for those of the low-resolution map,
            ``truth`` for those of the true one, which is how the authors get their figures. It is the one case besides
            the oracle of deep image priors in which a method reads ``sample.depth``; ``flag`` marks its scores. Weights
            with a ``depth_range`` of their own get orthogonal depth, normalised by it.
        precision: dtype of the convolutions.
        device: device of the computations.
        tile: side of a tile in pixels; None for ``TILE``, and no tiles up to ``UNTILED`` pixels.

    Raises:
        ValueError: a value is not supported.

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
        if tile is not None and tile < net.multiple:
            raise ValueError(f"tile: expected at least {net.multiple} pixels, got {tile}")
        if net.depth_range is not None and value_range == "truth":
            low, high = net.depth_range
            raise ValueError(
                f"range: expected measured for weights trained on depth of {low:g} to {high:g} m, got truth"
            )
        self.range_type = range_type if net.depth_range is None else "orthogonal"
        self.device = torch.device(device)
        self._uses_truth = value_range == "truth"
        self._dtype = DTYPES[precision]
        self._tile = tile
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

        It is NaN where the disparity corresponds to a depth at or beyond infinity.

        Raises:
            ValueError: the truth's range is needed, and there is no truth.

        """
        values_lr = self._convert(sample).to(self.device)[None]
        values = self.refine(sample.rgb.to(self.device)[None], values_lr, self._min_max(sample), progress)[0]
        return from_range(values, sample.camera, self.range_type).to(sample.depth_lr.device)

    def refine(
        self, rgb: Tensor, values_lr: Tensor, min_max: Tensor | None = None, progress: Steps | None = None
    ) -> Tensor:
        """Return the high-resolution map.

        Args:
            rgb: (B, 3, H, W) in 0..1.
            values_lr: (B, 1, h, w) low-resolution map; non-finite values are holes.
            min_max: (B, 2, 1, 1) values that map to 0 and 1; None for the map's minimum and maximum.

        Returns:
            (B, 1, H, W) in the dtype of ``values_lr``.

        """
        height, width = rgb.shape[-2:]
        normalised = normalise(inpaint(values_lr), min_max)
        values = self.net.enlarge(normalised.values.float(), (height, width))
        padding = (0, -width % self.net.multiple, 0, -height % self.net.multiple)
        rgb, values = (functional.pad(each.float(), padding, mode="replicate") for each in (rgb, values))
        refined = self._run(rgb, values, progress)[..., :height, :width].to(values_lr.dtype)
        return refined * normalised.value_range + normalised.minimum

    def _run(self, rgb: Tensor, values: Tensor, progress: Steps | None) -> Tensor:
        """Apply the network to maps whose sizes are multiples of its own, in tiles if they are large."""
        multiple, radius = self.net.multiple, self.net.receptive_field_radius
        height, width = rgb.shape[-2:]
        if radius is None or (self._tile is None and height * width <= UNTILED):
            refined = self._apply(rgb, values)
            if progress is not None:
                progress(1, 1)
            return refined

        def compute(row: slice, column: slice) -> Tensor:
            down, across = (slice(multiple * each.start, multiple * each.stop) for each in (row, column))
            return self._apply(rgb[..., down, across], values[..., down, across])

        rows, columns = (self._split_axis(n // multiple, radius) for n in (height, width))
        return blend_tiles(compute, rows, columns, multiple, progress)

    def _split_axis(self, size: int, radius: int) -> list[AxisTile]:
        """Return the tiles along an axis, in multiples of the network's."""
        multiple = self.net.multiple
        return split_axis(size, (self._tile or TILE) // multiple, -(-radius // multiple), max(_OVERLAP // multiple, 2))

    def _apply(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Apply the network, its convolutions in the precision."""
        with torch.autocast(self.device.type, self._dtype, enabled=self._dtype != torch.float32):
            return self.net(rgb, values).float()

    def _convert(self, sample: DepthSample) -> Tensor:
        """Return the low-resolution map in the range type, (1, h, w)."""
        if self.range_type == "disparity":
            return sample.disparity_lr()
        return to_range(sample.depth_lr, sample.camera_lr, self.range_type)

    def _min_max(self, sample: DepthSample) -> Tensor | None:
        """Return the values that map to 0 and 1, (1, 2, 1, 1); None for the low-resolution map's own."""
        if self.net.depth_range is not None:
            return torch.tensor(self.net.depth_range).view(1, 2, 1, 1)
        if not self._uses_truth:
            return None
        if sample.depth is None:
            raise ValueError(f"{sample.scene}: range=truth expects a scene with a true depth map, there is none")
        return compute_min_max(to_range(sample.depth, sample.camera, self.range_type)[None])
