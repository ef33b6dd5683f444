"""The networks, which map low-resolution disparity and an RGB image to high-resolution disparity, and their method.

Large images are computed in tiles of low-resolution pixels, from windows with half of the overlap with the neighbours
and a margin of the receptive-field radius, and blended with linear ramps. Values of the whole image, such as the range
of the disparity, are computed before.
"""

from __future__ import annotations

import abc
import copy
import inspect
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.camera import from_range, to_range
from dsr.methods.base import TILE, UNTILED, Abilities, Cost, InverseSample, InverseSurface, Method
from dsr.methods.images import compute_min_max, inpaint
from dsr.sample import DepthSample
from dsr.utils.compute_device import widened
from dsr.utils.guards import expect_one_of
from dsr.utils.progress import Steps

Precision = Literal["float32", "tf32", "bfloat16"]
ENSEMBLES = (1, 4, 8)
DTYPES = MappingProxyType({"float32": torch.float32, "tf32": torch.float32, "bfloat16": torch.bfloat16})
_OVERLAP = 4
_UNKNOWN = torch.tensor(math.nan)


@dataclass(frozen=True)
class Answer:
    """The outputs of a network for a batch of images, all (B, 1, H, W); those of 16 bits become float32."""

    disparity: Tensor  # in the unit of the input; of Facets without the offset ``doffs``
    spread: Tensor = _UNKNOWN  # expected absolute error of the logarithm of disparity, if the network predicts it
    angle: Tensor = _UNKNOWN  # expected error of the normal in radians, likewise
    stages: tuple[Tensor, ...] = ()  # disparities of intermediate stages, which a training compares with the truth, too

    def __post_init__(self) -> None:
        vars(self).update(widened(vars(self)), stages=tuple(map(widened, self.stages)))


class DisparityNetwork(nn.Module, abc.ABC):
    """A network that upsamples disparity, guided by an RGB image."""

    scale: int
    # Low-resolution pixels around its own that an output depends on, beside a few values of the whole image; large
    # images are then computed in tiles. None for a network that needs the whole image.
    receptive_field_radius: int | None = None
    covers: bool = True  # the whole image; some published networks leave out a row and a column
    of_inverse_depth: bool = False  # takes inverse depth in place of disparity, which may have an offset
    states_errors: bool = False  # its answers have expected errors, and it is given what is known of the maps
    # target and arguments of the method that runs it as validations do: one pass, with what is known of maps
    method: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"_target_": "dsr.methods.networks.trained.TrainedNetwork", "ensemble": 1}
    )

    @classmethod
    def serves(cls, trained: int, scale: int) -> bool:
        """Return whether weights trained for a factor are for another one, too."""
        return trained == scale

    def start_from(self, first: DisparityNetwork) -> None:
        """Take over the weights of a trained network, perhaps for another factor; a ValueError if they do not fit."""
        if type(first) is not type(self) or {**first.arguments(), "scale": self.scale} != self.arguments():
            raise ValueError(
                f"expected weights of {type(self).__name__} {self.arguments()}, got those of {type(first).__name__} "
                f"{first.arguments()}"
            )
        shapes = [{name: value.shape for name, value in net.state_dict().items()} for net in (self, first)]
        if shapes[0] != shapes[1]:
            raise ValueError(f"weights are for scale {first.scale}, the run is at scale {self.scale}")
        self.load_state_dict(first.state_dict())

    def share(self, first: DisparityNetwork) -> None:
        """Take over layers that do not depend on the factor from a trained network, and do not train them."""
        raise ValueError(f"{type(self).__name__} has no layers that do not depend on the factor")

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments, attributes of these names, as plain values; weights files store them."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    @abc.abstractmethod
    def upsample(self, rgb: Tensor, disparity: Tensor, min_max: Tensor | None = None) -> Tensor:
        """Return high-resolution disparity, (B, 1, H, W) in the dtype of ``disparity``; NaN without a valid pixel.

        ``rgb`` is (B, 3, H, W) in [0, 1], ``disparity`` (B, 1, h, w) in pixels of the high-resolution camera with
        non-finite holes, ``min_max`` (B, 2, 1, 1) the range of the image that this is a window of. With a
        receptive-field radius, a network takes all of its :meth:`context` as further arguments.
        """

    def context(self, rgb: Tensor, disparity: Tensor) -> tuple[Tensor | None, ...]:
        """Return what windows need to know of the whole image, the range of disparity first."""
        return (compute_min_max(disparity),)

    def fill(self, disparity: Tensor) -> Tensor:
        """Return disparity as windows get it: without holes."""
        return inpaint(disparity)

    @staticmethod
    def prepare(batch: Mapping[str, Any]) -> dict[str, Any]:
        """Prepare patches in a training's loader: precompute values for which a step would have to wait for the GPU."""
        return dict(batch)

    def answer_patches(self, batch: Mapping[str, Any]) -> Answer:
        """Return what a training compares with the truth, in float32, for a batch of patches, which may be prepared."""
        return Answer(self.upsample(batch["rgb"], batch["disparity_lr"], batch["min_max"]).float())

    def answer_scene(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return high-resolution disparity, (B, 1, H, W), of a scene with a batch axis that a validation scores."""
        return self.upsample(batch["rgb"], batch["disparity_lr"])


class NormalisedNetwork(DisparityNetwork):
    """A network whose input is an RGB image and inpainted low-resolution disparity, normalised to 0..1.

    The output is rescaled to the range of the input. The module maps (B, 3, H, W) and (B, 1, h, w) to (B, 1, H, W); for
    a window it gets what :meth:`context` returns beside the range as further arguments.
    """

    def upsample(
        self, rgb: Tensor, disparity: Tensor, min_max: Tensor | None = None, *context: Tensor | None
    ) -> Tensor:
        """Return high-resolution disparity; see :meth:`DisparityNetwork.upsample`."""
        min_max = compute_min_max(disparity) if min_max is None else min_max
        return self._in_range(rgb, inpaint(disparity), min_max, *context)[-1]

    @staticmethod
    def prepare(batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return patches with ``filled``, the inpainted low-resolution disparity."""
        return dict(batch) if "filled" in batch else {**batch, "filled": inpaint(batch["disparity_lr"])}

    def answer_patches(self, batch: Mapping[str, Any]) -> Answer:
        """Return the maps of all stages; see :meth:`DisparityNetwork.answer_patches`."""
        maps = self._in_range(batch["rgb"], self.prepare(batch)["filled"], batch["min_max"])
        *stages, disparity = (each.float() for each in maps)
        return Answer(disparity, stages=tuple(stages))

    def compute_stages(self, rgb: Tensor, values: Tensor, *context: Tensor | None) -> tuple[Tensor, ...]:
        """Return the normalised maps of the network's stages, which a training compares with the truth; result last."""
        return (self(rgb, values, *context),)

    def _in_range(self, rgb: Tensor, filled: Tensor, min_max: Tensor, *context: Tensor | None) -> tuple[Tensor, ...]:
        """Return the maps of the stages in the unit of disparity without holes."""
        expect_rgb_size(rgb, filled, self.scale)
        low, high = min_max.to(filled).split(1, dim=1)
        extent = high - low  # -inf where nothing is finite
        low = torch.where(extent >= 0, low, torch.nan)
        varies = extent > 0
        extent = torch.where(varies, extent, 1)
        maps = self.compute_stages(rgb, (filled - low) / extent, *context)
        return tuple(torch.where(varies, each * extent, 0) + low for each in maps)


def expect_rgb_size(rgb: Tensor, values_lr: Tensor, scale: int) -> None:
    """Check that an RGB image, (..., H, W), is ``scale`` times the size of a low-resolution map, (..., h, w)."""
    size, came = tuple(values_lr.shape[-2:]), tuple(rgb.shape[-2:])
    expected = tuple(scale * n for n in size)
    if came != expected:
        raise ValueError(f"rgb: expected {expected} pixels for a map of {size} at scale {scale}, got {came}")


class NetworkUpsampler(Method):
    """A method that is a trained network, which is copied; ``precision`` is the dtype of its convolutions alone.

    An ``ensemble`` of 4 averages the results of the rotations by multiples of 90 degrees, one of 8 also those of their
    mirror images (Timofte, Rothe, Van Gool, *Seven Ways to Improve Example-Based Single Image Super Resolution*, CVPR
    2016). ``tile`` is the side of a tile in high-resolution pixels; None for ``TILE``, and no tiles up to ``UNTILED``.
    """

    abilities = Abilities(repeats=True, needs="network", cost=Cost(40, photo=40, tile=700))

    def __init__(
        self,
        net: DisparityNetwork,
        precision: Precision = "float32",
        device: torch.device | str = "cpu",
        ensemble: int = 1,
        tile: int | None = None,
    ) -> None:
        expect_one_of("precision", precision, tuple(DTYPES))
        if ensemble not in ENSEMBLES:
            raise ValueError(f"ensemble: expected one of {', '.join(map(str, ENSEMBLES))}, got {ensemble!r}")
        if ensemble > 1 and not net.covers:
            raise ValueError(f"ensemble: expected 1 for a network that leaves out pixels, got {ensemble}")
        self.ensemble, self.tile, self.device = ensemble, tile, torch.device(device)
        net = copy.deepcopy(net).eval().requires_grad_(False).to(self.device, DTYPES[precision])
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return orthogonal depth, (1, H, W) in metres; NaN at or beyond infinity and in pixels it does not cover."""
        if sample.scale != self.net.scale:
            raise ValueError(f"{sample.scene}: expected scale {self.net.scale}, the network's, got {sample.scale}")
        # in pixels of sample.camera
        offset = sample.camera.doffs if self.net.of_inverse_depth else 0.0  # such a network gets inverse depth
        disparity_lr = to_range(sample.depth_lr, sample.camera_lr, "disparity") * sample.scale + offset
        rgb = sample.rgb.to(self.device)[None]
        disparity = self.upsample_disparity(rgb, disparity_lr.to(self.device)[None], progress)[0] - offset
        missing = (sample.camera.width - disparity.shape[-1], sample.camera.height - disparity.shape[-2])
        disparity = functional.pad(disparity, (0, missing[0], 0, missing[1]), value=torch.nan)
        return from_range(disparity, sample.camera, "disparity").to(sample.depth_lr.device)

    def upsample_inverse(self, problem: InverseSample, progress: Steps | None = None) -> InverseSurface:
        """Return the network's upsampled inverse depth."""
        rgb, inverse = problem.rgb.to(self.device)[None], problem.inverse.to(self.device)[None]
        return InverseSurface(self.upsample_disparity(rgb, inverse, progress)[0])

    def upsample_disparity(self, rgb: Tensor, disparity_lr: Tensor, progress: Steps | None = None) -> Tensor:
        """Return high-resolution disparity, (B, 1, H, W); ``progress`` is called after each augmentation of a tile."""
        net, scale = self.net, self.net.scale
        rows, columns = self._tiles(*rgb.shape[-2:])
        count = len(rows) * len(columns)
        contexts: list[tuple[Tensor | None, ...]] = [()] * self.ensemble
        given = disparity_lr
        if count > 1:
            images = ([apply_dihedral(each, index) for each in (rgb, disparity_lr)] for index in range(self.ensemble))
            contexts = [net.context(*image) for image in images]
            given = net.fill(disparity_lr)
        done = itertools.count(1)

        def compute(row: slice, column: slice) -> Tensor:
            window = rgb[..., scale * row.start : scale * row.stop, scale * column.start : scale * column.stop]
            results = []
            for index, context in enumerate(contexts):
                turned = [apply_dihedral(each, index) for each in (window, given[..., row, column])]
                results.append(undo_dihedral(net.upsample(*turned, *context), index))
                if progress is not None:
                    progress(next(done), count * self.ensemble)
            return sum(results[1:], results[0]) / self.ensemble

        return blend_tiles(compute, rows, columns, scale)

    def count_steps(self, height: int, width: int) -> int:
        """Return the total that ``progress`` receives for an image of height x width pixels."""
        rows, columns = self._tiles(height, width)
        return len(rows) * len(columns) * self.ensemble

    def _tiles(self, height: int, width: int) -> tuple[list[AxisTile], list[AxisTile]]:
        return split_image((height, width), self.net.scale, self.net.receptive_field_radius, self.tile, _OVERLAP)


def apply_dihedral(x: Tensor, index: int) -> Tensor:
    """Mirror (B, C, H, W) if ``index`` is 4 or more, then rotate it by ``index`` % 4 quarter turns."""
    return torch.rot90(x.flip(-1) if index >= 4 else x, index % 4, (-2, -1)).contiguous()


def undo_dihedral(x: Tensor, index: int) -> Tensor:
    """Undo :func:`apply_dihedral`."""
    x = torch.rot90(x, -(index % 4), (-2, -1))
    return x.flip(-1) if index >= 4 else x


@dataclass(frozen=True)
class AxisTile:
    """A tile along one axis, in low-resolution pixels."""

    read: slice  # the window that the output is computed from
    kept: slice  # the part of the output that is used
    ramps: tuple[int, int]  # pixels that are blended with the previous and with the next tile, 0 at a border

    def weights(self, scale: int) -> Tensor:
        """Return the weight of each used high-resolution pixel, (scale * kept,) float32: 1, with ramps at the ends."""
        weights = torch.ones(scale * (self.kept.stop - self.kept.start))
        rising, falling = ((torch.arange(scale * ramp) + 0.5) / max(scale * ramp, 1) for ramp in self.ramps)
        weights[: len(rising)] = rising
        weights[len(weights) - len(falling) :] = 1 - falling
        return weights


def split_image(
    size: tuple[int, int], scale: int, radius: int | None, tile: int | None, overlap: int
) -> tuple[list[AxisTile], list[AxisTile]]:
    """Return the tiles along both axes of an image; one if it is small or needed whole; see :func:`split_axis`."""
    height, width = (n // scale for n in size)
    whole = radius is None or (tile is None and math.prod(size) <= UNTILED)
    longest = max(height, width) if whole else (tile or TILE) // scale
    return split_axis(height, longest, radius or 0, overlap), split_axis(width, longest, radius or 0, overlap)


def split_axis(size: int, tile: int, radius: int, overlap: int) -> list[AxisTile]:
    """Split low-resolution pixels into tiles of at most ``tile`` without the overlaps, sizes alike to one pixel."""
    count = max(1, min(math.ceil(size / tile), size // max(overlap, 1)))
    edges, half, found = [round(i * size / count) for i in range(count + 1)], overlap // 2, []
    for i in range(count):
        before, after = (half if i else 0), (half if i + 1 < count else 0)
        first, last = edges[i] - before, edges[i + 1] + after
        read = slice(max(first - radius, 0), min(last + radius, size))
        found.append(AxisTile(read, slice(first, last), (2 * before, 2 * after)))
    return found


def blend_tiles(
    compute: Callable[[slice, slice], Tensor],
    rows: list[AxisTile],
    columns: list[AxisTile],
    scale: int,
    progress: Steps | None = None,
) -> Tensor:
    """Compute an image, (B, C, scale * h, scale * w), in tiles of low-resolution rows and columns, and blend them."""
    total = torch.empty(0)
    for done, (row, column) in enumerate(itertools.product(rows, columns), 1):
        output = compute(row.read, column.read)
        if done == 1:
            lost_y = scale * (row.read.stop - row.read.start) - output.shape[-2]
            lost_x = scale * (column.read.stop - column.read.start) - output.shape[-1]
            size = (scale * rows[-1].kept.stop - lost_y, scale * columns[-1].kept.stop - lost_x)
            total = output.new_zeros((*output.shape[:-2], *size))
        top, left = scale * row.kept.start, scale * column.kept.start
        target = total[..., top : scale * row.kept.stop, left : scale * column.kept.stop]
        height, width = target.shape[-2:]
        y, x = top - scale * row.read.start, left - scale * column.read.start
        part = output[..., y : y + height, x : x + width] * row.weights(scale)[:height, None].to(total)
        target += part.mul_(column.weights(scale)[:width].to(total))
        if progress is not None:
            progress(done, len(rows) * len(columns))
    return total
