"""Small networks for the tests of what holds for any weights."""

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import nn

Net = TypeVar("Net", bound=nn.Module)


def with_any_weights(build: Callable[[], Net], noise: float = 0.1, seed: int = 0) -> Net:
    """Return a network whose weights are far from those that it starts with, without gradients."""
    torch.manual_seed(seed)
    net = build().requires_grad_(False)
    for parameter in net.parameters():
        parameter.add_(noise * torch.randn_like(parameter))
    return net
