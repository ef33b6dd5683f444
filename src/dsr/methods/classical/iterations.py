"""Conjugate gradients for batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Solution(NamedTuple):
    """The solution ``values`` (B, ...), the number of steps, and the largest |b - A x| / |b| in the batch."""

    values: Tensor
    iterations: int
    residual: float


def conjugate_gradients(
    operator: Callable[[Tensor], Tensor], right: Tensor, start: Tensor, *, iterations: int, tolerance: float
) -> Solution:
    """Solve A x = b for each element of a batch, (B, ...), from a start.

    The operator x -> A x is symmetric positive definite for each element, on the subspace that b - A start lies in, and
    does not mix elements. It stops at the relative residual ``tolerance`` in all elements.
    """
    x, residual = start, right - operator(start)
    direction = residual
    size, goal = _dot(residual, residual), tolerance**2 * _dot(right, right)
    done = 0
    while done < iterations and bool((size > goal).any()):
        image = operator(direction)
        step = _ratio(size, _dot(direction, image))
        x = x + step * direction
        residual = residual - step * image
        before, size = size, _dot(residual, residual)
        direction = residual + _ratio(size, before) * direction
        done += 1
    return Solution(x, done, float(_ratio(size, _dot(right, right)).max().sqrt()))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the inner products, (B, 1, ...)."""
    return (a * b).sum(dim=tuple(range(1, a.ndim)), keepdim=True)


def _ratio(above: Tensor, below: Tensor) -> Tensor:
    """Return above / below, 0 where ``below`` is 0, so that a solved element stays unchanged."""
    return torch.where(below > 0, above / torch.where(below > 0, below, 1), 0)
