"""What every super-resolution method is: a callable from a sample to high-resolution depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

from dsr.geometry.camera import RangeType
from dsr.sample import DepthSample
from dsr.utils.progress import Steps


class NoSolutionError(ValueError):
    """A method has no answer for an image, through no fault of the image's: a result to report, as papers do."""


@dataclass(frozen=True)
class Cost:
    """What a method costs, roughly, as measured on two CPU cores; a class says it as its attribute ``cost``.

    Args:
        memory: bytes for each pixel of the guide image.
        seconds: for a million of these pixels.

    """

    memory: float
    seconds: float


class Upsampler(Protocol):
    """A depth super-resolution method: a network, a per-image optimisation or a classical filter alike.

    Attributes:
        range_type: the range type that it works on. Unless told otherwise the downsampling model is applied to that
            type too, as in the paper, which evaluates every method on the type that it was designed for.

    """

    range_type: RangeType

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the HR orthogonal depth, (1, H, W) in metres on the sample's device, NaN where there is none.

        A method never reads ``sample.depth``.

        Args:
            sample: the problem.
            progress: is called with the steps done and their total, by methods that take more than one.

        Raises:
            NoSolutionError: it has none for this image.

        """
        ...


@runtime_checkable
class Iterative(Protocol):
    """An :class:`Upsampler` that iterates, and records how it went.

    Attributes:
        history: of the last call, one entry for each look at the iterates: ``iteration`` first, then what the method
            watches, such as ``objective`` and ``moved``, in an order of its own.

    """

    history: list[dict[str, float]]


def expect_limits(tolerance: float, **counts: int) -> None:
    """Check when an iteration ends.

    Args:
        tolerance: how little has to change.
        **counts: the most steps that it may take, by the parameter's name.

    Raises:
        ValueError: the tolerance is negative, or a count less than 1.

    """
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name}: expected at least 1, got {count}")
    if not tolerance >= 0:
        raise ValueError(f"tolerance: expected 0 or more, got {tolerance}")
