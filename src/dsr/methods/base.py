"""The interface of super-resolution methods: a callable from a sample to high-resolution depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from dsr.geometry.camera import RangeType
from dsr.sample import DepthSample
from dsr.utils.progress import Steps
from dsr.utils.ratios import round_ratio


class NoSolutionError(ValueError):
    """A method has no solution for a valid image, which is reported as a result, as papers do."""


@dataclass(frozen=True)
class Cost:
    """The rough cost of a method, measured on two CPU cores; a class states it as its attribute ``cost``.

    Args:
        memory: bytes for each pixel of the guide image.
        seconds: seconds for a million of these pixels.

    """

    memory: float
    seconds: float


Ratios = Literal["any", "whole"]
"""The scales that a method takes beyond 2, 4, 8 and 16: any of 1 or more, or whole ones of 1 or more. A class states it
as its attribute ``ratios``; one without it takes no other, see :mod:`dsr.inference.adapter`. At 1 the depth map has the
photo's size: a filter smooths it, and a method that reproduces block means only fills its holes."""


class Upsampler(Protocol):
    """A depth super-resolution method: a network, a per-image optimisation or a classical filter.

    Attributes:
        range_type: the range type that it works on. By default the downsampling model is applied to that
            type, too, as in the paper, which evaluates every method on the type that it was designed for.

    """

    range_type: RangeType

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the HR orthogonal depth, (1, H, W) in metres on the sample's device, NaN where missing.

        A method never reads ``sample.depth``.

        Args:
            sample: the guide image, the low-resolution depth and the cameras.
            progress: is called with the steps done and their total, by methods that take more than one.

        Raises:
            NoSolutionError: the method has no solution for this image.

        """
        ...


class MapNoise(NamedTuple):
    """Estimated noise of a low-resolution map.

    ``deviation``: its standard deviation in metres, at ``distance`` metres. ``extent``: over how many low-resolution
    pixels it is alike, the full width at half maximum of its autocorrelation; 1 for white noise. ``reduced``: by what
    the size of the map was divided because of that.
    """

    deviation: float
    extent: float
    distance: float
    reduced: int = 1


class Outliers(NamedTuple):
    """Pixels of a low-resolution map that were taken for holes, and the number of patches that they form."""

    pixels: int
    patches: int


class Surface(NamedTuple):
    """A result with its expected errors.

    ``depth`` (1, H, W): orthogonal depth in metres, NaN where missing. ``depth_error``, ``angle_error`` (1, H, W): the
    expected absolute error of the depth in metres and that of the normal in degrees; None for a method that does not
    say. Pixels that a method leaves out on purpose have errors and no depth. ``noise``: of the low-resolution map; None
    for a method that does not estimate it. ``outliers``: what was taken for holes before the method saw the map.
    """

    depth: Tensor
    depth_error: Tensor | None = None
    angle_error: Tensor | None = None
    noise: MapNoise | None = None
    outliers: Outliers | None = None

    def map(self, function: Callable[[Tensor], Tensor]) -> Surface:
        """Return the surface with a function applied to each of its maps."""
        depth_error, angle_error = (None if each is None else function(each) for each in self[1:3])
        return self._replace(depth=function(self.depth), depth_error=depth_error, angle_error=angle_error)

    def error_arrays(self) -> dict[str, np.ndarray]:
        """Return the expected errors by name, (H, W) in half precision, as they are stored; empty without them."""
        named = {"depth_error": self.depth_error, "angle_error": self.angle_error}
        return {name: each[0].cpu().numpy().astype(np.float16) for name, each in named.items() if each is not None}


@runtime_checkable
class Confident(Protocol):
    """An :class:`Upsampler` that says how far off its result may be."""

    def surface(self, sample: DepthSample, progress: Steps | None = None) -> Surface:
        """Return the result of a call with its expected errors."""
        ...


WORKSPACE = "optimisation"
"""Folder in which a method that optimises keeps what it needs to go on after an interruption."""


@runtime_checkable
class Iterative(Protocol):
    """An :class:`Upsampler` that iterates, and records its progress.

    Attributes:
        history: of the last call, one entry per recorded iteration: ``iteration`` first, then the method's own
            quantities, such as ``objective`` and ``moved``, in an order of its own.

    """

    history: list[dict[str, float]]


def expect_some_depth(depth: Tensor, name: str) -> None:
    """Check that a result has a depth; values that are not finite and positive are holes, as metrics and files have it.

    Args:
        depth: (1, H, W) in metres.
        name: of the method, for the message.

    Raises:
        ValueError: every pixel is a hole.

    """
    if not bool((depth.isfinite() & (depth > 0)).any()):
        raise ValueError(f"{name} gave no finite positive depth in any of the {depth.numel()} pixels")


def whole_scale(sample: DepthSample) -> int:
    """Return the scale of a sample for a method that needs a whole one.

    Raises:
        ValueError: it is not whole.

    """
    if not isinstance(sample.scale, int):
        raise ValueError(f"{sample.scene}: expected a whole scale for this method, got {round_ratio(sample.scale)}")
    return sample.scale


def expect_limits(tolerance: float, **counts: int) -> None:
    """Check the stopping criteria of an iteration.

    Args:
        tolerance: the change below which the iteration stops.
        **counts: maximum numbers of steps, by the parameter's name.

    Raises:
        ValueError: the tolerance is negative, or a count less than 1.

    """
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name}: expected at least 1, got {count}")
    if not tolerance >= 0:
        raise ValueError(f"tolerance: expected 0 or more, got {tolerance}")
