"""The interface of super-resolution methods: from a sample to high-resolution depth, and what a method can do."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from torch import Tensor

from dsr.geometry.camera import Camera, RangeType
from dsr.methods.images import inpaint
from dsr.sample import DepthSample
from dsr.utils.configuration import Node
from dsr.utils.progress import Steps
from dsr.utils.ratios import SCALES, round_ratio

TILE = 1024  # side in high-resolution pixels of the tiles in which networks compute large images
UNTILED = 2**21  # number of high-resolution pixels up to which an image is computed without tiles
WORKSPACE = "optimisation"  # folder in which a method that optimises keeps what it needs after an interruption
_HALF = float(np.finfo(np.float16).max)  # largest number of half precision
# Ratios of the photo's size to the map's: 2, 4, 8 and 16; these and any whole one from 1; any from 1. At 1 the map has
# the photo's size: a filter smooths it, and a method that reproduces block means only fills its holes.
Ratios = Literal["factors", "whole", "any"]
NoiseLaw = tuple[float, float]  # deviation of a map in metres at 1 m, and the power of the distance with which it grows


class NoSolutionError(ValueError):
    """A method has no solution for a valid image, which is reported as a result, as papers do."""


@dataclass(frozen=True)
class Cost:
    """The rough cost of a method, measured on two CPU cores."""

    memory: float  # bytes for each pixel that it computes
    seconds: float | None = None  # for a million of these pixels, if known
    photo: float = 0  # bytes for each pixel of the photo
    tile: float = 0  # bytes for each pixel of a tile, of a method that computes large pictures in tiles
    program: float = 4e8  # bytes of the program itself

    def bytes_for(self, photo: int, computed: int) -> float:
        """Return the memory in bytes for a photo, and a computed picture, of so many pixels."""
        window = computed if computed <= UNTILED else (TILE + 160) ** 2
        return self.program + self.photo * photo + self.memory * computed + self.tile * window


@dataclass(frozen=True, kw_only=True)
class Abilities:
    """What a method can do; its class states it as ``abilities``."""

    ratios: Ratios = "factors"  # of the samples that it takes
    own_size: bool = False  # whether it takes a map of the photo's own size as it is
    repeats: bool = False  # whether its result may be its input once more, for larger factors
    needs: Literal["weights", "network"] | None = None  # a file of weights, or one from which dsr loads a network
    optimises: bool = False  # whether it optimises a network for each picture
    tolerant: bool = False  # whether convolutions in bfloat16 change its scores in the fourth digit only
    assumes_downsampling: bool = False  # whether it takes the downsampling model, as its argument ``downsampling``
    fast_on: Literal["any", "cpu"] = "any"  # where ``device=auto`` runs it; ``cpu`` if a GPU slows it down
    cost: Cost = Cost(1000)

    @property
    def at_ratio(self) -> bool:
        """Whether it computes at any ratio; one whose file of weights is for a factor runs at that."""
        return self.ratios == "any" and self.needs != "weights"

    def takes(self, ratio: float) -> bool:
        """Return whether it takes samples of a ratio itself."""
        return ratio in SCALES or self.ratios == "any" or (self.ratios == "whole" and isinstance(ratio, int))


class MapNoise(NamedTuple):
    """Estimated noise of a low-resolution map."""

    deviation: float  # standard deviation in metres, at ``distance`` metres
    extent: float  # full width at half maximum of its autocorrelation in low-resolution pixels; 1 for white noise
    distance: float
    reduced: int = 1  # by what the size of the map was divided because of the extent


class Outliers(NamedTuple):
    """Pixels of a low-resolution map that were treated as holes, and the number of patches that they form."""

    pixels: int
    patches: int


class Surface(NamedTuple):
    """A result with its expected errors, (1, H, W), also where a method leaves out depth; None if not predicted."""

    depth: Tensor  # orthogonal, in metres, NaN where missing
    depth_error: Tensor | None = None  # expected absolute error in metres
    angle_error: Tensor | None = None  # expected error of the normal in degrees
    noise: MapNoise | None = None  # of the low-resolution map, if it is estimated
    outliers: Outliers | None = None  # what was treated as holes before the method saw the map
    filled: Tensor | None = None  # bool: depth whose nearest pixel of the map is a hole or an outlier, if known
    glass: float | None = None  # share of pixels that probably show glass, mirrors or gloss; None if not looked for

    def map(self, function: Callable[[Tensor], Tensor]) -> Surface:
        """Return the surface with a function applied to each of its maps."""
        others = (self.depth_error, self.angle_error, self.filled)
        depth_error, angle_error, filled = (None if each is None else function(each) for each in others)
        return Surface(function(self.depth), depth_error, angle_error, self.noise, self.outliers, filled, self.glass)

    def without_dubious(self, limit: float) -> Surface:
        """Return the surface with holes where the depth is expected to be off by more than this share of it."""
        if self.depth_error is None:
            return self
        dubious = self.depth_error > limit * self.depth
        filled = None if self.filled is None else self.filled & ~dubious
        return self._replace(depth=self.depth.masked_fill(dubious, float("nan")), filled=filled)

    def shares(self, limit: float) -> dict[str, float]:
        """Return the shares of the pixels that are ``measured``, ``filled`` and ``open``, which have no depth.

        With expected errors also that of ``dubious`` depth, see :meth:`without_dubious`, and of ``glass``, if known.
        """
        known = self.depth.isfinite()
        filled = known & self.filled if self.filled is not None else known & False
        masks = {"measured": known & ~filled, "filled": filled, "open": ~known}
        if self.depth_error is not None:
            masks["dubious"] = known & (self.depth_error > limit * self.depth)
        found = {name: float(mask.double().mean()) for name, mask in masks.items()}
        return found if self.glass is None else {**found, "glass": self.glass}

    def error_arrays(self) -> dict[str, np.ndarray]:
        """Return the expected errors by name, (H, W), in half precision, or single if one is beyond 65 km."""
        found = {}
        for name, error in (("depth_error", self.depth_error), ("angle_error", self.angle_error)):
            if error is not None:
                values = error[0].cpu().numpy()
                found[name] = values.astype(np.float16 if np.nanmax(values, initial=0) <= _HALF else np.float32)
        return found


class InverseSample(NamedTuple):
    """A problem in inverse depth, whose values are not checked: they may be a method's own."""

    rgb: Tensor  # (3, H, W) in [0, 1]
    inverse: Tensor  # (1, h, w) in 1/m, NaN in holes
    camera: Camera
    camera_lr: Camera
    ratio: float
    noise: NoiseLaw | None = None  # of the map, if it is known

    def in_depth(self) -> DepthSample:
        """Return the same as a sample."""
        depth = self.inverse.reciprocal()
        return DepthSample("upsample", "depth", self.rgb, depth, self.camera, self.camera_lr, self.ratio)


class InverseSurface(NamedTuple):
    """A result in inverse depth, (1, H, W) each; the errors are None for a method that does not predict them."""

    inverse: Tensor  # in 1/m, NaN where a method leaves a hole
    spread: Tensor | None = None  # expected relative error of the depth
    angle: Tensor | None = None  # expected error of the normal in degrees
    noise: MapNoise | None = None  # of the low-resolution map, if the method estimates it

    @classmethod
    def of(cls, surface: Surface) -> InverseSurface:
        """Return a result as inverse depth; one without expected errors has no holes on purpose, they are inpainted."""
        inverse = surface.depth.reciprocal()
        if surface.depth_error is None:
            return cls(inpaint(inverse[None])[0], None, surface.angle_error, surface.noise)
        return cls(inverse, surface.depth_error / surface.depth, surface.angle_error, surface.noise)

    def map(self, function: Callable[[Tensor], Tensor]) -> InverseSurface:
        """Return the result with a function applied to each of its maps."""
        spread, angle = (None if each is None else function(each) for each in (self.spread, self.angle))
        return self._replace(inverse=function(self.inverse), spread=spread, angle=angle)


class Method(abc.ABC):
    """A depth super-resolution method: a network, a per-image optimisation or a classical filter."""

    abilities: ClassVar[Abilities] = Abilities()
    # The range type that it works on. By default the downsampling model is applied to that type, too, as in the paper,
    # which evaluates every method on the type that it was designed for.
    range_type: RangeType = "disparity"
    # Of the last call of a method that iterates, an entry per recorded iteration, ``iteration`` first; None for others
    history: list[dict[str, float]] | None = None
    name: str | None = None  # in tables, of a method that takes it from its input; None for that of its file

    @classmethod
    def abilities_of(cls, node: Node) -> Abilities:
        """Return the abilities of the method that a node of the configuration describes."""
        return cls.abilities

    @property
    def flag(self) -> str:
        """Mark for scores of a method that used the truth, else empty."""
        return ""

    @abc.abstractmethod
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the HR orthogonal depth, (1, H, W) in metres on the sample's device, NaN where missing.

        A method never reads ``sample.depth``. One that takes several steps calls ``progress`` with the steps done and
        their total.
        """

    def surface(self, sample: DepthSample, progress: Steps | None = None) -> Surface:
        """Return the result of a call, with the expected errors of a method that predicts them."""
        return Surface(self(sample, progress))

    def upsample_inverse(self, problem: InverseSample, progress: Steps | None = None) -> InverseSurface:
        """Return the high-resolution inverse depth of a problem in inverse depth."""
        return InverseSurface.of(self.surface(problem.in_depth(), progress))

    def describe(self, sample: DepthSample) -> str:
        """Return a note on how a sample is upsampled, shown beside its scores; empty by default."""
        return ""

    def content(self, dataset: str, scene: str, scale: float) -> str | None:
        """Return a hash of the inputs of a scene's result besides sample and settings; None for no others."""
        return None

    def remarks(self, dataset: str, scenes: Sequence[str], scale: float) -> list[str]:
        """Return notes to print before the scenes of a data set are upsampled, a line each; none by default."""
        return []

    def count_steps(self, height: int, width: int) -> int:
        """Return the total that ``progress`` receives for a photo of height x width pixels, if it is known before."""
        return 1


def expect_some_depth(depth: Tensor, name: str) -> None:
    """Raise a ValueError that names the method if no pixel of its result, (1, H, W), is finite and positive."""
    if not bool((depth.isfinite() & (depth > 0)).any()):
        raise ValueError(f"{name} gave no finite positive depth in any of the {depth.numel()} pixels")


def whole_scale(sample: DepthSample) -> int:
    """Return the scale of a sample for a method that needs a whole one, else raise a ValueError."""
    if not isinstance(sample.scale, int):
        raise ValueError(f"{sample.scene}: expected a whole scale for this method, got {round_ratio(sample.scale)}")
    return sample.scale
