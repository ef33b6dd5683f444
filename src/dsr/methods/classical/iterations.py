"""Iterative solvers: conjugate gradients, and when an iteration has converged."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from dsr.utils.progress import Steps

CHECK_EVERY = 50  # iterations between two checks of how far the map has moved


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


class Movement:
    """The movement of an iterated map, (B, 1, H, W), between two checks, and whether it is below a tolerance.

    ``moved`` is the RMS movement at each check, the maximum over the batch, relative to the range, 1 or (B, 1, 1, 1).
    """

    def __init__(
        self,
        start: Tensor,
        iterations: int,
        tolerance: float,
        progress: Steps | None,
        value_range: Tensor | None = None,
    ) -> None:
        self._previous, self._range = start.clone(), torch.ones_like(start[:1, :1, :1, :1])
        if value_range is not None:
            self._range = value_range
        self._iterations, self._tolerance, self._progress = iterations, tolerance, progress
        self.moved: list[float] = []

    def converged(self, values: Tensor) -> bool:
        """Record a check of the map, (B, 1, H, W), and return whether it has stopped moving."""
        self.moved.append(float(((values - self._previous) / self._range).square().mean(dim=(-2, -1)).max().sqrt()))
        self._previous.copy_(values)
        self._report(CHECK_EVERY * len(self.moved))
        return self.moved[-1] < self._tolerance

    def finish(self) -> None:
        """Report that the iteration is over, at whatever iteration it has stopped."""
        self._report(self._iterations)

    def _report(self, done: int) -> None:
        if self._progress is not None:
            self._progress(done, self._iterations)


def history_of(moved: list[float]) -> list[dict[str, float]]:
    """Return the history of an iteration, one entry for each check, from :attr:`Movement.moved`."""
    return [{"iteration": float(CHECK_EVERY * (check + 1)), "moved": value} for check, value in enumerate(moved)]
