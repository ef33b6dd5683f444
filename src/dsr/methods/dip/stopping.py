"""When to stop optimising one image, and which of the iterates to keep.

An untrained network fits what is natural first and noise last. Where the input is noisy a good moment lies in between;
where it is clean there may be none. Every rule sees a step's depth map and the running average of them all, which is
the answer, and none but :class:`Oracle` ever sees the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import torch
from torch import Tensor

from dsr.methods.dip.noise import estimate_noise

StoppingName = Literal["fixed", "variance", "residual", "oracle"]
_EVERY = 20
"""Steps between looks at a value on the device, each of which waits for it."""
_RATE = 0.1
_SETTLED = 50


class Stopping(Protocol):
    """A rule; its tensors live on the device of the optimisation."""

    def observe(self, step: int, depth: Tensor, average: Tensor) -> bool:
        """Take note of a step, counted from 1; return whether to stop after it.

        Args:
            step: the step.
            depth: (1, 1, H, W) the network's answer at this step.
            average: (1, 1, H, W) the running average of the answers, this one included.

        """
        ...

    def judge(self, score: float, average: Tensor) -> None:
        """Take note of how far the average is from the truth; lower is better."""
        ...

    def result(self, average: Tensor) -> Tensor:
        """Return the map to answer with, given the running average at the end."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Return what a checkpoint has to keep."""
        ...

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's state."""
        ...


class Fixed:
    """Never stops before the last step."""

    def observe(self, step: int, depth: Tensor, average: Tensor) -> bool:
        """Go on."""
        return False

    def judge(self, score: float, average: Tensor) -> None:
        """Look away."""

    def result(self, average: Tensor) -> Tensor:
        """Return the average at the end."""
        return average

    def state(self) -> dict[str, Tensor]:
        """Return nothing."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Do nothing."""


class Variance(Fixed):
    """Stops when the exponential moving variance of the iterates has had its minimum: ES-EMV.

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
        """Go on from such a state."""
        for name, value in state.items():
            setattr(self, f"_{name}", value.clone().to(self._mean.device))


class Residual(Fixed):
    """Stops when the average explains the LR map as well as its noise allows: Morozov's discrepancy principle.

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
    """Keeps the average that is nearest to the truth. No method: it shows what the best moment would be worth."""

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
        """Go on from such a state."""
        self._lowest, self._best = float(state["lowest"]), state["best"].clone()
