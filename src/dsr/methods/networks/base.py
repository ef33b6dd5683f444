"""What the project's networks have in common: they map LR disparity and a photo to HR disparity."""

from __future__ import annotations

import abc
import copy
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.camera import RangeType, from_range, to_range
from dsr.methods.networks.inpainting import inpaint
from dsr.methods.networks.maps import min_max, normalise
from dsr.methods.tiling import Span, blended, spans
from dsr.sample import DepthSample
from dsr.utils.progress import Steps

Precision = Literal["float32", "bfloat16"]
ENSEMBLES = (1, 4, 8)
DTYPES = MappingProxyType({"float32": torch.float32, "bfloat16": torch.bfloat16})
TILE = 1024
"""Side of a tile in pixels of the photo."""
UNTILED = 2**21
"""Photos of up to so many pixels are answered in one piece."""
_OVERLAP = 4


@dataclass(frozen=True)
class GlobalContext:
    """What a network found in a whole image, with which it answers windows as it would have answered the image.

    Args:
        disparity: (B, 1, h, w) the low-resolution disparity, its holes filled if the network fills them.
        answer: from a window of the photo, (B, 3, scale * n, scale * m), and one of ``disparity``, (B, 1, n, m), to
            high-resolution disparity, right for pixels at least the network's reach away from the window's borders
            within the image.

    """

    disparity: Tensor
    answer: Callable[[Tensor, Tensor], Tensor]


class DisparityNetwork(nn.Module, abc.ABC):
    """A network that upsamples disparity under a photo's guidance.

    Attributes:
        scale: the upsampling factor.
        covers: whether the output has all of the photo's pixels; some published networks leave out a row and a column.

    """

    scale: int
    covers: bool = True

    @abc.abstractmethod
    def arguments(self) -> dict[str, Any]:
        """Return what the constructor was given, as plain values; a file of weights keeps it."""

    @abc.abstractmethod
    def upsample(self, rgb: Tensor, disparity: Tensor, bounds: Tensor | None = None) -> Tensor:
        """Return high-resolution disparity.

        Args:
            rgb: (B, 3, H, W) in [0, 1], H = scale * h and W = scale * w.
            disparity: (B, 1, h, w) in pixels of the photo's camera; non-finite values are holes.
            bounds: (B, 2, 1, 1) lowest and highest low-resolution disparity of the image that this is a window of,
                which normalise it; None for those of ``disparity`` itself.

        Returns:
            (B, 1, H, W) in the dtype of ``disparity``; NaN for an image without a known pixel.

        """


class WindowedNetwork(DisparityNetwork):
    """A network whose outputs depend on what is near them alone, beside a few values of the whole image.

    So it answers large images window by window; another :class:`DisparityNetwork` answers them in one piece.
    """

    @property
    @abc.abstractmethod
    def reach(self) -> int:
        """How many low-resolution pixels around its own an output depends on."""

    @abc.abstractmethod
    def global_context(self, rgb: Tensor, disparity: Tensor) -> GlobalContext:
        """Return what answers windows of an image; see :meth:`upsample` for the arguments."""


class NormalisedNetwork(WindowedNetwork):
    """A network on a photo and low-resolution disparity that is brought to 0..1 and has its holes filled.

    So the disparity's unit and offset come out as they went in. Called with (B, 3, H, W) and (B, 1, h, w), and the
    whole photo's :meth:`context` where these are a window, it returns (B, 1, H, W).
    """

    def upsample(self, rgb: Tensor, disparity: Tensor, bounds: Tensor | None = None) -> Tensor:
        """Return high-resolution disparity; see :meth:`DisparityNetwork.upsample`."""
        return self._over_range(rgb, disparity, bounds, ())

    def global_context(self, rgb: Tensor, disparity: Tensor) -> GlobalContext:
        """Return what answers windows: the disparity's range and the context are the whole image's."""
        bounds, context = min_max(disparity), self.context(rgb)
        return GlobalContext(inpaint(disparity), lambda photo, window: self._over_range(photo, window, bounds, context))

    def context(self, rgb: Tensor) -> tuple[Tensor, ...]:
        """Return what the network takes from the whole photo, (B, 3, H, W)."""
        return ()

    def _over_range(self, rgb: Tensor, disparity: Tensor, bounds: Tensor | None, context: tuple[Tensor, ...]) -> Tensor:
        known = normalise(disparity, bounds)
        span = torch.where(known.span > 0, known.span, 1)
        values = (inpaint(disparity) - known.minimum) / span
        return self(rgb, values, *context) * span + known.minimum


def expect_photo(rgb: Tensor, coarse: Tensor, scale: int) -> None:
    """Check a photo's size, (..., H, W), against a low-resolution map's, (..., h, w).

    Raises:
        ValueError: it is not scale times the map's.

    """
    expected, came = tuple(scale * n for n in coarse.shape[-2:]), tuple(rgb.shape[-2:])
    if came != expected:
        size = tuple(coarse.shape[-2:])
        raise ValueError(
            f"rgb: expected {expected} pixels for a low-resolution map of {size} at scale {scale}, got {came}"
        )


class NetworkUpsampler:
    """An :class:`~dsr.methods.base.Upsampler` around a trained network.

    A photo of more than ``UNTILED`` pixels is answered in tiles, see :mod:`dsr.methods.tiling`, which bounds the
    memory: about 40 bytes for each pixel of the photo, and for each pixel of a window (a tile, and the network's reach
    on each side) 700 to 1000 bytes, by network and by the depth's precision. Whatever a network takes from the whole
    image, such as the range of the disparity, it takes from the whole image, so the answer is the same to rounding.

    Args:
        net: the network; a copy is taken.
        precision: of the convolutions; everything around them stays in the depth's dtype.
        device: where to compute.
        ensemble: 1 for the network's answer; 4 for the mean of its answers to the image in four quarter turns, 8 to
            these and their mirror images, each turned back, in as many times the time: the geometric self-ensemble of
            Timofte, Rothe, Van Gool, *Seven Ways to Improve Example-Based Single Image Super Resolution*, CVPR 2016,
            section 3.6. What is right agrees in all of them, and much of what is wrong doesn't.
        tile: side of a tile in pixels of the photo; None for ``TILE``, and no tiles up to ``UNTILED`` pixels.

    Raises:
        ValueError: there is no such precision or ensemble, the network leaves out pixels and can't be averaged, or a
            tile is smaller than a low-resolution pixel.

    """

    range_type: RangeType = "disparity"

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

        NaN where the network's disparity lies at or beyond infinity, and in the last row and column where the network
        does not cover them.
        """
        if sample.scale != self.net.scale:
            raise ValueError(f"{sample.scene}: expected scale {self.net.scale}, the network's, got {sample.scale}")
        coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity") * sample.scale  # in pixels of sample.camera
        fine = self.fine_disparity(sample.rgb.to(self.device)[None], coarse.to(self.device)[None], progress)[0]
        missing = (sample.camera.width - fine.shape[-1], sample.camera.height - fine.shape[-2])
        if any(missing):
            fine = functional.pad(fine, (0, missing[0], 0, missing[1]), value=torch.nan)
        return from_range(fine, sample.camera, "disparity").to(sample.depth_lr.device)

    def fine_disparity(self, rgb: Tensor, coarse: Tensor, progress: Steps | None = None) -> Tensor:
        """Return the mean of the ensemble's high-resolution disparities, (B, 1, H, W).

        Args:
            rgb: (B, 3, H, W) in [0, 1].
            coarse: (B, 1, h, w) disparity in pixels of the photo's camera; non-finite values are holes.
            progress: is told after each of the ensemble's answers, and each tile of it.

        """
        net = self._windowed(rgb.shape[-2], rgb.shape[-1])
        if net is None:
            return self._mean_of_poses(
                lambda pose: self.net.upsample(apply_dihedral(rgb, pose), apply_dihedral(coarse, pose)), progress
            )
        rows, columns = (self._spans(n, net) for n in coarse.shape[-2:])
        wholes = [
            net.global_context(apply_dihedral(rgb, pose), apply_dihedral(coarse, pose)) for pose in range(self.ensemble)
        ]
        tiles, done, scale = len(rows) * len(columns), 0, self.net.scale

        def told(part: int, parts: int) -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(done, tiles * self.ensemble)

        def answer(high: slice, wide: slice) -> Tensor:
            photo = rgb[..., scale * high.start : scale * high.stop, scale * wide.start : scale * wide.stop]
            known = wholes[0].disparity[..., high, wide]
            return self._mean_of_poses(
                lambda pose: wholes[pose].answer(apply_dihedral(photo, pose), apply_dihedral(known, pose)), told
            )

        return blended(answer, rows, columns, scale)

    def parts(self, height: int, width: int) -> int:
        """Return how many parts ``progress`` counts for a photo of that size."""
        net = self._windowed(height, width)
        if net is None:
            return self.ensemble
        tiles = [len(self._spans(n // net.scale, net)) for n in (height, width)]
        return tiles[0] * tiles[1] * self.ensemble

    def _windowed(self, height: int, width: int) -> WindowedNetwork | None:
        """Return the network if a photo of that size is to be answered in tiles, and can be."""
        large = self.tile is not None or height * width > UNTILED
        return self.net if large and isinstance(self.net, WindowedNetwork) else None

    def _spans(self, size: int, net: WindowedNetwork) -> list[Span]:
        """Return the tiles along an axis of so many low-resolution pixels."""
        return spans(size, (self.tile or TILE) // net.scale, net.reach, _OVERLAP)

    def _mean_of_poses(self, answer: Callable[[int], Tensor], progress: Steps | None) -> Tensor:
        """Return the mean of what ``answer`` says for each pose, turned back."""
        total = answer(0)
        for pose in range(1, self.ensemble):
            if progress is not None:
                progress(pose, self.ensemble)
            total += undo_dihedral(answer(pose), pose)
        if progress is not None:
            progress(self.ensemble, self.ensemble)
        return total / self.ensemble


def apply_dihedral(x: Tensor, pose: int) -> Tensor:
    """Return (B, C, H, W) after ``pose`` % 4 quarter turns, mirrored first if ``pose`` is 4 or more."""
    return torch.rot90(x.flip(-1) if pose >= 4 else x, pose % 4, (-2, -1)).contiguous()


def undo_dihedral(x: Tensor, pose: int) -> Tensor:
    """Undo :func:`apply_dihedral`."""
    x = torch.rot90(x, -(pose % 4), (-2, -1))
    return x.flip(-1) if pose >= 4 else x
