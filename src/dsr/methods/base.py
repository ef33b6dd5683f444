"""What every super-resolution method is: a callable from a sample to fine depth."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from dsr.geometry.camera import RangeType
from dsr.sample import DepthSample


class Upsampler(Protocol):
    """A depth super-resolution method: a network, a per-image optimisation or a classical filter alike.

    Attributes:
        range_type: the range type that it works on. Unless told otherwise the downsampling model is applied to that
            type too, as in the paper, which evaluates every method on the type that it was designed for.

    """

    range_type: RangeType

    def __call__(self, sample: DepthSample) -> Tensor:
        """Return the fine orthogonal depth, (1, H, W) in metres on the sample's device, NaN where there is none.

        A method never reads ``sample.depth``.
        """
        ...
