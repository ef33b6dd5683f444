"""Base classes of the networks, which map low-resolution disparity and an RGB image to high-resolution disparity."""

from __future__ import annotations

import abc
import copy
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.camera import from_range, to_range
from dsr.methods.base import Abilities, Cost, InverseSample, InverseSurface, Method
from dsr.methods.inpainting import inpaint
from dsr.methods.networks.normalisation import compute_min_max, normalise
from dsr.methods.tiling import TILE, UNTILED, AxisTile, blend_tiles, split_axis
from dsr.sample import DepthSample
from dsr.utils.compute_device import widened
from dsr.utils.progress import Steps

Precision = Literal["float32", "bfloat16"]
ENSEMBLES = (1, 4, 8)
DTYPES = MappingProxyType({"float32": torch.float32, "bfloat16": torch.bfloat16})
_OVERLAP = 4
_UNKNOWN = torch.tensor(math.nan)


@dataclass(frozen=True)
class Answer:
    """The outputs of a network for a batch of images, all (B, 1, H, W).

    Args:
        disparity: in the unit of the input.
        spread: expected absolute error of the logarithm of disparity; NaN of a network that states no errors.
        angle: expected error of the normal in radians; NaN likewise.
        stages: disparities of the network's intermediate stages, if any, which a training compares with the truth, too.

    """

    disparity: Tensor
    spread: Tensor = _UNKNOWN
    angle: Tensor = _UNKNOWN
    stages: tuple[Tensor, ...] = ()

    def __post_init__(self) -> None:
        """Take outputs of 16 bits as float32, which losses are computed in."""
        vars(self).update(widened(vars(self)), stages=tuple(map(widened, self.stages)))


@dataclass(frozen=True)
class GlobalContext:
    """The values of a whole image that a network needs to process windows of it as it processes the image.

    Args:
        disparity: (B, 1, h, w) low-resolution disparity, inpainted if the network inpaints holes.
        upsample_window: function from a window of the RGB image, (B, 3, scale * n, scale * m), and one of
            ``disparity``, (B, 1, n, m), to high-resolution disparity. The result is valid except within the network's
            receptive-field radius of a window border inside the image.

    """

    disparity: Tensor
    upsample_window: Callable[[Tensor, Tensor], Tensor]


class DisparityNetwork(nn.Module, abc.ABC):
    """A network that upsamples disparity, guided by an RGB image.

    Attributes:
        scale: upsampling factor.
        of_inverse_depth: whether it takes inverse depth in place of disparity, which may have an offset.
        states_errors: whether its answers have expected errors, and it is given what is known of the maps.
        covers: whether the output covers the whole image; some published networks leave out a row and a column.
        method: target and arguments of the method that runs it as validations do: one pass, with what is known of maps.

    """

    scale: int
    covers: bool = True
    of_inverse_depth: bool = False
    states_errors: bool = False
    method: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"_target_": "dsr.methods.networks.trained.TrainedNetwork", "ensemble": 1}
    )

    @classmethod
    def serves(cls, trained: int, scale: int) -> bool:
        """Return whether weights trained for a factor are for another one, too."""
        return trained == scale

    def start_from(self, first: DisparityNetwork) -> None:
        """Take over the weights of a trained network, perhaps for another factor.

        Raises:
            ValueError: it is another kind of network, of another size, or for a factor with other parameters.

        """
        if type(first) is not type(self) or {**first.arguments(), "scale": self.scale} != self.arguments():
            raise ValueError(
                f"expected weights of {type(self).__name__} {self.arguments()}, got those of {type(first).__name__} "
                f"{first.arguments()}"
            )
        shapes = [{name: value.shape for name, value in net.state_dict().items()} for net in (self, first)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"weights are for scale {first.scale}, the run is at scale {self.scale}, where {type(self).__name__} "
                "has other parameters"
            )
        self.load_state_dict(first.state_dict())

    def share(self, first: DisparityNetwork) -> None:
        """Take over layers that do not depend on the factor from a trained network, and do not train them.

        Raises:
            ValueError: there are no such layers, or ``first`` has others.

        """
        raise ValueError(f"{type(self).__name__} has no layers that do not depend on the factor")

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments, attributes of these names, as plain values; weights files store them."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    @abc.abstractmethod
    def upsample(self, rgb: Tensor, disparity: Tensor, min_max: Tensor | None = None) -> Tensor:
        """Return high-resolution disparity.

        Args:
            rgb: (B, 3, H, W) in [0, 1], H = scale * h and W = scale * w.
            disparity: (B, 1, h, w) in pixels of the high-resolution camera; non-finite values are holes.
            min_max: (B, 2, 1, 1) minimum and maximum low-resolution disparity of the image that this is a window of,
                for the normalisation; None for those of ``disparity``.

        Returns:
            (B, 1, H, W) in the dtype of ``disparity``; NaN for an image without a valid pixel.

        """

    @staticmethod
    def prepare(batch: Mapping[str, Any]) -> dict[str, Any]:
        """Prepare patches in a training's loader: precompute values for which a step would have to wait for the GPU."""
        return dict(batch)

    def answer_patches(self, batch: Mapping[str, Any]) -> Answer:
        """Return the outputs that a training compares with the truth, in float32.

        Args:
            batch: patches as of :func:`dsr.training.degradation.to_tensors`, with a batch axis, perhaps prepared.

        """
        return Answer(self.upsample(batch["rgb"], batch["disparity_lr"], batch["min_max"]).float())

    def answer_scene(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return high-resolution disparity to be scored by a validation, (B, 1, H, W).

        Args:
            batch: a scene as of :class:`dsr.training.data_module.WholeScenes`, with a batch axis.

        """
        return self.upsample(batch["rgb"], batch["disparity_lr"])


class WindowedNetwork(DisparityNetwork):
    """A network whose outputs depend on a neighbourhood and a few global values only.

    Large images can therefore be processed in tiles; other networks process them without tiles.
    """

    @property
    @abc.abstractmethod
    def receptive_field_radius(self) -> int:
        """Receptive-field radius in low-resolution pixels."""

    @abc.abstractmethod
    def global_context(self, rgb: Tensor, disparity: Tensor) -> GlobalContext:
        """Return the context of an image, to upsample windows of it; see :meth:`upsample` for the arguments."""


class RangeNetwork(DisparityNetwork):
    """A network whose input is an RGB image and inpainted low-resolution disparity, normalised to 0..1.

    The output is rescaled to the range of the input, so the network commutes with affine maps of the disparity, and a
    constant map stays constant. The module maps (B, 3, H, W) and (B, 1, h, w) to (B, 1, H, W).
    """

    def upsample(self, rgb: Tensor, disparity: Tensor, min_max: Tensor | None = None) -> Tensor:
        """Return high-resolution disparity; see :meth:`DisparityNetwork.upsample`."""
        min_max = compute_min_max(disparity) if min_max is None else min_max
        return self.in_range(inpaint(disparity), min_max, lambda values: (self(rgb, values),))[0]

    @staticmethod
    def prepare(batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return patches with ``filled``, the inpainted low-resolution disparity."""
        return dict(batch) if "filled" in batch else {**batch, "filled": inpaint(batch["disparity_lr"])}

    def answer_patches(self, batch: Mapping[str, Any]) -> Answer:
        """Return the outputs that a training compares with the truth, in float32."""
        filled = self.prepare(batch)["filled"]
        stages = self.in_range(filled, batch["min_max"], lambda values: self.compute_stages(batch["rgb"], values))
        return Answer(stages[-1].float(), stages=tuple(each.float() for each in stages[:-1]))

    def compute_stages(self, rgb: Tensor, values: Tensor) -> tuple[Tensor, ...]:
        """Return the maps of the network's stages, which a training compares with the truth; the result last."""
        return (self(rgb, values),)

    @staticmethod
    def in_range(
        filled: Tensor, min_max: Tensor, compute: Callable[[Tensor], tuple[Tensor, ...]]
    ) -> tuple[Tensor, ...]:
        """Return the maps that ``compute`` makes of normalised disparity without holes, in the disparity's unit."""
        _, minimum, value_range = normalise(filled, min_max)
        varies = value_range > 0
        value_range = torch.where(varies, value_range, 1)
        values = (filled - minimum) / value_range
        return tuple(torch.where(varies, values * value_range, 0) + minimum for values in compute(values))


class NormalisedNetwork(RangeNetwork, WindowedNetwork):
    """A :class:`RangeNetwork` whose outputs depend on a neighbourhood and a few global values only.

    For a window, the :meth:`context` of the whole image is passed to the module as further arguments.
    """

    def global_context(self, rgb: Tensor, disparity: Tensor) -> GlobalContext:
        """Return a context with the disparity's range and the :meth:`context` of the whole image."""
        min_max, context = compute_min_max(disparity), self.context(rgb)
        return GlobalContext(
            inpaint(disparity),
            lambda rgb, window: self.in_range(window, min_max, lambda values: (self(rgb, values, *context),))[0],
        )

    def context(self, rgb: Tensor) -> tuple[Tensor, ...]:
        """Return the global values that the network computes from the whole image, (B, 3, H, W)."""
        return ()


def expect_rgb_size(rgb: Tensor, values_lr: Tensor, scale: int) -> None:
    """Check that an RGB image, (..., H, W), is ``scale`` times the size of a low-resolution map, (..., h, w).

    Raises:
        ValueError: it is not.

    """
    expected, came = tuple(scale * n for n in values_lr.shape[-2:]), tuple(rgb.shape[-2:])
    if came != expected:
        size = tuple(values_lr.shape[-2:])
        raise ValueError(
            f"rgb: expected {expected} pixels for a low-resolution map of {size} at scale {scale}, got {came}"
        )


class NetworkUpsampler(Method):
    """A method that is a trained network.

    Images of more than ``UNTILED`` pixels are processed in tiles, see :mod:`dsr.methods.tiling`. This bounds the memory
    to about 40 bytes per pixel of the image, and 700 to 1300 bytes per pixel of a window (a tile and the network's
    receptive-field radius on each side), depending on the network and the depth's precision. Global values, such as
    the range of the disparity, are computed from the whole image, so tiles change the result by rounding errors only.

    Args:
        net: the network; it is copied.
        precision: dtype of the convolutions; all other computations use the depth's dtype.
        device: device of the computations.
        ensemble: number of test-time augmentations: 1 for none, 4 for the rotations by multiples of 90 degrees, 8 for
            these and their mirror images. Each transformed image is upsampled, the results are transformed back and
            averaged, which takes 4 or 8 times as long. Errors that depend on the orientation partly cancel. This is the
            geometric self-ensemble of Timofte, Rothe, Van Gool, *Seven Ways to Improve Example-Based Single Image
            Super Resolution*, CVPR 2016, section 3.6.
        tile: side of a tile in high-resolution pixels; None for ``TILE``, and no tiles up to ``UNTILED`` pixels.

    Raises:
        ValueError: the precision or the ensemble is not supported, the ensemble is larger than 1 for a network that
            leaves out pixels, or a tile is smaller than a low-resolution pixel.

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
        if precision not in DTYPES:
            raise ValueError(f"precision: expected one of {', '.join(DTYPES)}, got {precision!r}")
        if ensemble not in ENSEMBLES:
            raise ValueError(f"ensemble: expected one of {', '.join(map(str, ENSEMBLES))}, got {ensemble!r}")
        if ensemble > 1 and not net.covers:
            raise ValueError(f"ensemble: expected 1 for a network that leaves out pixels, got {ensemble}")
        if tile is not None and tile < net.scale:
            raise ValueError(f"tile: expected at least {net.scale} pixels, the scale, got {tile}")
        self.ensemble = ensemble
        self.tile = tile
        self.device = torch.device(device)
        net = copy.deepcopy(net).eval().requires_grad_(False).to(self.device, DTYPES[precision])
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres on the sample's device.

        It is NaN where the disparity corresponds to a depth at or beyond infinity, and in the last row and column if
        the network does not cover them.
        """
        if sample.scale != self.net.scale:
            raise ValueError(f"{sample.scene}: expected scale {self.net.scale}, the network's, got {sample.scale}")
        # in pixels of sample.camera
        offset = sample.camera.doffs if self.net.of_inverse_depth else 0.0  # such a network gets inverse depth
        disparity_lr = to_range(sample.depth_lr, sample.camera_lr, "disparity") * sample.scale + offset
        rgb = sample.rgb.to(self.device)[None]
        disparity = self.upsample_disparity(rgb, disparity_lr.to(self.device)[None], progress)[0] - offset
        missing = (sample.camera.width - disparity.shape[-1], sample.camera.height - disparity.shape[-2])
        if any(missing):
            disparity = functional.pad(disparity, (0, missing[0], 0, missing[1]), value=torch.nan)
        return from_range(disparity, sample.camera, "disparity").to(sample.depth_lr.device)

    def upsample_inverse(self, problem: InverseSample, progress: Steps | None = None) -> InverseSurface:
        """Return the network's upsampled inverse depth."""
        rgb, inverse = (each.to(self.device)[None] for each in (problem.rgb, problem.inverse))
        return InverseSurface(self.upsample_disparity(rgb, inverse, progress)[0])

    def upsample_disparity(self, rgb: Tensor, disparity_lr: Tensor, progress: Steps | None = None) -> Tensor:
        """Return high-resolution disparity, averaged over the test-time augmentations, (B, 1, H, W).

        Args:
            rgb: (B, 3, H, W) in [0, 1].
            disparity_lr: (B, 1, h, w) in pixels of the high-resolution camera; non-finite values are holes.
            progress: called after each augmentation, or each augmentation of each tile.

        """
        net = self._tiled_network(rgb.shape[-2], rgb.shape[-1])
        if net is None:
            return self._average_transforms(
                lambda index: self.net.upsample(apply_dihedral(rgb, index), apply_dihedral(disparity_lr, index)),
                progress,
            )
        rows, columns = (self._split_axis(n, net) for n in disparity_lr.shape[-2:])
        contexts = [
            net.global_context(apply_dihedral(rgb, index), apply_dihedral(disparity_lr, index))
            for index in range(self.ensemble)
        ]
        total, done, scale = len(rows) * len(columns) * self.ensemble, 0, self.net.scale

        def count(part: int, parts: int) -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(done, total)

        def compute(row: slice, column: slice) -> Tensor:
            window = rgb[..., scale * row.start : scale * row.stop, scale * column.start : scale * column.stop]
            window_lr = contexts[0].disparity[..., row, column]
            return self._average_transforms(
                lambda index: contexts[index].upsample_window(
                    apply_dihedral(window, index), apply_dihedral(window_lr, index)
                ),
                count,
            )

        return blend_tiles(compute, rows, columns, scale)

    def count_steps(self, height: int, width: int) -> int:
        """Return the total that ``progress`` receives for an image of height x width pixels."""
        net = self._tiled_network(height, width)
        if net is None:
            return self.ensemble
        tiles = [len(self._split_axis(n // net.scale, net)) for n in (height, width)]
        return tiles[0] * tiles[1] * self.ensemble

    def _tiled_network(self, height: int, width: int) -> WindowedNetwork | None:
        """Return the network if it processes images of height x width pixels in tiles, else None."""
        large = self.tile is not None or height * width > UNTILED
        return self.net if large and isinstance(self.net, WindowedNetwork) else None

    def _split_axis(self, size: int, net: WindowedNetwork) -> list[AxisTile]:
        """Return the tiles along an axis of ``size`` low-resolution pixels."""
        return split_axis(size, (self.tile or TILE) // net.scale, net.receptive_field_radius, _OVERLAP)

    def _average_transforms(self, compute: Callable[[int], Tensor], progress: Steps | None) -> Tensor:
        """Return the mean of ``compute`` over the dihedral transforms, each result transformed back."""
        total = compute(0)
        for index in range(1, self.ensemble):
            if progress is not None:
                progress(index, self.ensemble)
            total += undo_dihedral(compute(index), index)
        if progress is not None:
            progress(self.ensemble, self.ensemble)
        return total / self.ensemble


def apply_dihedral(x: Tensor, index: int) -> Tensor:
    """Mirror (B, C, H, W) if ``index`` is 4 or more, then rotate it by ``index`` % 4 quarter turns."""
    return torch.rot90(x.flip(-1) if index >= 4 else x, index % 4, (-2, -1)).contiguous()


def undo_dihedral(x: Tensor, index: int) -> Tensor:
    """Undo :func:`apply_dihedral`."""
    x = torch.rot90(x, -(index % 4), (-2, -1))
    return x.flip(-1) if index >= 4 else x
