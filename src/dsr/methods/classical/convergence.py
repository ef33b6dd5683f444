"""When an iteration on a map has converged: what TGV and anisotropic diffusion share."""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.utils.progress import Steps

CHECK_EVERY = 50
"""Iterations between two checks of how far the map has moved."""


class Movement:
    """The movement of an iterated map between two checks, and whether it is below a tolerance.

    Args:
        start: (B, 1, H, W) the map before the first iteration.
        iterations: maximum number of iterations.
        tolerance: RMS movement between two checks, relative to the range, below which the iteration has converged.
        progress: is called with the iterations done and their maximum.
        value_range: (B, 1, 1, 1) range of each map; None for maps in [0, 1].

    Attributes:
        moved: RMS movement at each check, relative to the range; the maximum over the batch.

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
