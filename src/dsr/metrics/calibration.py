"""Comparison of the errors that a method expects of its result with the measured ones.

Expected errors are calibrated if they are right on average both where they are small and where they are large, see
:func:`error_ratios`. They are informative if they are largest where the result is worst, see
:func:`squared_error_share`. Both functions take the pixels of one image or of many.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.surface import angle_between, depth_to_normals


def measured_errors(prediction: Tensor, target: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the absolute errors of depth and normals.

    Args:
        prediction: (B, 1, H, W) orthogonal depth in metres, NaN in holes; H and W at least 2.
        target: true depth, likewise.
        rays: (B or 1, 3, H, W) rays with z = 1, see :meth:`dsr.geometry.camera.Camera.rays`.

    Returns:
        Two maps (B, 1, H, W): the absolute difference of the depths in metres, NaN where one is missing, and the angle
        between the normals in degrees, NaN where one is undefined.

    Raises:
        ValueError: the maps are less than 2 pixels high or wide.

    """
    first, second = (depth_to_normals(depth, rays) for depth in (prediction, target))
    return (prediction - target).abs(), angle_between(first, second)


def error_ratios(expected: Tensor, measured: Tensor, parts: int = 10) -> Tensor:
    """Return the mean measured error over the mean expected error for equal parts of the pixels.

    The pixels are sorted by expected error, those of equal expected error as they come.

    Args:
        expected: expected absolute errors, of any shape and unit; NaN where there is none.
        measured: measured absolute errors of the same pixels in the same unit; NaN where there is none.
        parts: number of parts, 10 for deciles; their sizes differ by one pixel at most.

    Returns:
        (parts,) float64, from the pixels with the smallest expected errors to those with the largest. 1 is as expected,
        more means larger errors than expected. NaN for a part without pixels, infinite for one whose expected errors
        are all 0 and the measured ones are not.

    Raises:
        ValueError: the shapes differ.

    """
    expected, measured = _ordered(expected, measured)
    pairs = zip(expected.tensor_split(parts), measured.tensor_split(parts), strict=True)
    return torch.stack([theirs.mean() / own.mean() for own, theirs in pairs])


def squared_error_share(expected: Tensor, measured: Tensor, kept: float = 0.8) -> Tensor:
    """Return the fraction of the sum of squared errors that lies in the pixels with the smallest expected errors.

    Args:
        expected: expected absolute errors, of any shape and unit; NaN where there is none.
        measured: measured absolute errors of the same pixels in any unit; NaN where there is none.
        kept: the fraction of pixels.

    Returns:
        () float64. Expected errors that have nothing to do with the measured ones give ``kept`` on average; the least
        possible value is that of ``squared_error_share(measured, measured)``. NaN if all errors are 0, or without
        pixels.

    Raises:
        ValueError: the shapes differ.

    """
    _, measured = _ordered(expected, measured)
    squares = measured.square()
    return squares[: round(kept * len(squares))].sum() / squares.sum()


def _ordered(expected: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Return the errors of pixels that have both, in the order of the expected ones, (N,) float64 each."""
    if expected.shape != measured.shape:
        came = f"{tuple(expected.shape)} and {tuple(measured.shape)}"
        raise ValueError(f"expected, measured: expected errors of the same pixels, got shapes {came}")
    valid = expected.isfinite() & measured.isfinite()
    expected = expected[valid].double()
    order = _stable_order(expected)
    return expected[order], measured[valid].double()[order]


def _stable_order(values: Tensor) -> Tensor:
    """Return the indices that sort (N,) values; equal ones keep their order.

    Non-negative values of half precision, as expected errors are stored in, are sorted by radix, which takes a tenth
    of the time.
    """
    halves = values.half()
    if values.device.type == "cpu" and torch.equal(halves.double(), values) and bool((values >= 0).all()):
        bits = halves.abs().view(torch.int16)  # ordered as the numbers are
        return torch.from_numpy(np.argsort(bits.numpy(), kind="stable"))
    return values.argsort(stable=True)
