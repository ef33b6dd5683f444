"""Rules for when to stop the optimisation of one image, and which iterate to keep.

An untrained network fits the image first and its noise last, so early stopping helps if the input is noisy. Every rule
sees the depth map of each step and the running average, which is the result. Only :class:`Oracle` uses the true depth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import torch
from torch import Tensor

from dsr.methods.noise_level import estimate_noise

StoppingName = Literal["fixed", "variance", "residual", "oracle"]
_EVERY = 20
"""Steps between reads of a value from the device, each of which synchronises."""
_RATE = 0.1
_SETTLED = 50


class Stopping(Protocol):
    """A rule; its tensors live on the device of the optimisation."""

    def observe(self, step: int, depth: Tensor, average: Tensor) -> bool:
        """Take note of a step, counted from 1; return whether to stop after it.

        Args:
            depth: (1, 1, H, W) the network's answer at this step.
            average: (1, 1, H, W) the running average of the answers, this one included.

        """
        ...

    def judge(self, score: float, average: Tensor) -> None:
        """Take note of how far the average is from the truth; lower is better."""
        ...

    def result(self, average: Tensor) -> Tensor:
        """Return the resulting map, given the running average at the end."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint."""
        ...

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from the state of a checkpoint."""
        ...


class Fixed:
    """Never stop before the last step."""

    def observe(self, step: int, depth: Tensor, average: Tensor) -> bool:
        """Continue."""
        return False

    def judge(self, score: float, average: Tensor) -> None:
        """Ignore the score."""

    def result(self, average: Tensor) -> Tensor:
        """Return the average at the end."""
        return average

    def state(self) -> dict[str, Tensor]:
        """Return nothing."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Do nothing."""


class Variance(Fixed):
    """Stop at the minimum of the exponential moving variance of the iterates (ES-EMV).

    Wang et al., *Early Stopping for Deep Image Prior*, TMLR 2023, algorithm 2, with the network's depth maps as the
    iterates. Keeps the average at the minimum.

    Args:
        like: (1, 1, H, W) any map of the image's size, on the device.
        patience: steps without a new minimum until it stops.

    """

    def __init__(self, like: Tensor, patience: int) -> None:
        self._patience = patience
        self._mean, self._best = torch.zeros_like(like), torch.zeros_like(like)
        self._variance = like.new_zeros(())
        self._lowest, self._found = like.new_full((), torch.inf), like.new_zeros(())

    def observe(self, step: int, depth: Tensor, average: Tensor) -> bool:
        """Move mean and variance on; keep the average if the variance is the lowest so far."""
        if step == 1:
            self._mean.copy_(depth)
        deviation = (depth - self._mean).square().mean()
        self._variance = (1 - _RATE) * (self._variance + _RATE * deviation)
        self._mean.lerp_(depth, _RATE)
        if step <= _SETTLED:
            return False
        lower = self._variance < self._lowest
        self._lowest = torch.where(lower, self._variance, self._lowest)
        self._found = torch.where(lower, step, self._found)
        self._best = torch.where(lower, average, self._best)
        return step % _EVERY == 0 and step - float(self._found) >= self._patience

    def result(self, average: Tensor) -> Tensor:
        """Return the average at the minimum of the variance."""
        return torch.where(self._found > 0, self._best, average)

    def state(self) -> dict[str, Tensor]:
        """Return mean, variance, minimum and the average there."""
        names = ("mean", "best", "variance", "lowest", "found")
        return {name: getattr(self, f"_{name}").clone() for name in names}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from the state of a checkpoint."""
        for name, value in state.items():
            setattr(self, f"_{name}", value.clone().to(self._mean.device))


class Residual(Fixed):
    """Stop when the residual of the average reaches the noise level: Morozov's discrepancy principle.

    Args:
        depth_lr: (1, 1, h, w) low-resolution depth in metres, NaN in holes; its noise is estimated.
        residual: from a map (1, 1, H, W) to the root mean square of its low-resolution version's relative error, a
            scalar.

    """

    def __init__(self, depth_lr: Tensor, residual: Callable[[Tensor], Tensor]) -> None:
        self.noise = estimate_noise(depth_lr)
        self._residual = residual

    def observe(self, step: int, depth: Tensor, average: Tensor) -> bool:
        """Compare the residual with the noise."""
        return step % _EVERY == 0 and step > _SETTLED and float(self._residual(average)) <= self.noise


class Oracle(Fixed):
    """Keep the average closest to the true depth: an upper bound for stopping rules, not a method."""

    def __init__(self) -> None:
        self._lowest, self._best = torch.inf, torch.zeros(())

    def judge(self, score: float, average: Tensor) -> None:
        """Keep the average if its score is the lowest so far."""
        if score < self._lowest:
            self._lowest, self._best = score, average.clone()

    def result(self, average: Tensor) -> Tensor:
        """Return the best."""
        return self._best if self._lowest < torch.inf else average

    def state(self) -> dict[str, Tensor]:
        """Return the best and its score."""
        return {"lowest": torch.tensor(self._lowest, dtype=torch.float64), "best": self._best.clone()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from the state of a checkpoint."""
        self._lowest, self._best = float(state["lowest"]), state["best"].clone()
