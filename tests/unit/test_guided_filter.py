"""The guided filter, against a plain loop over windows and a regression by numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.methods.classical.guided_filter import GuidedFilter, guided_filter


def _noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(size=shape))


def _by_loops(guide: Tensor, values: Tensor, radius: int, epsilon: float, weight: Tensor) -> np.ndarray:
    """Fit each window by weighted ridge regression (numpy's lstsq), then average the fits."""
    colours, p, w = guide.numpy(), values.numpy(), weight.numpy()
    height, width = p.shape
    total, counted = np.zeros((height, width)), np.zeros((height, width))
    for i in range(height):
        for j in range(width):
            rows, columns = slice(max(i - radius, 0), i + radius + 1), slice(max(j - radius, 0), j + radius + 1)
            share, target = w[rows, columns].ravel(), p[rows, columns].ravel()
            samples = colours[:, rows, columns].reshape(3, -1).T
            if share.sum() == 0:
                continue
            root = np.sqrt(share)[:, None]
            ridge = np.sqrt(epsilon * share.sum()) * np.eye(3, 4)
            design = np.vstack((root * np.column_stack((samples, np.ones(len(share)))), ridge))
            fit = np.linalg.lstsq(design, np.concatenate((root[:, 0] * target, np.zeros(3))), rcond=None)[0]
            answer = np.tensordot(fit[:3], colours[:, rows, columns], 1) + fit[3]
            total[rows, columns] += share.mean() * answer
            counted[rows, columns] += share.mean()
    return np.where(counted > 0, total / np.where(counted > 0, counted, 1), p)


@pytest.mark.parametrize("radius", [1, 3])
@pytest.mark.parametrize("holes", [False, True])
def test_guided_filter_is_the_mean_of_each_windows_ridge_regression(radius: int, holes: bool) -> None:
    guide, values, weight = _noise(3, 16, 16), _noise(16, 16, seed=1), torch.ones(16, 16).double()
    if holes:
        weight = _noise(16, 16, seed=2)
        weight[3:12, 4:14] = 0
    result = guided_filter(guide, values[None], radius, 1e-3, weight)[0]
    np.testing.assert_allclose(result, _by_loops(guide, values, radius, 1e-3, weight), rtol=0, atol=1e-9)


def test_guided_filter_under_a_constant_photo_is_the_box_filter_twice() -> None:
    impulse = torch.zeros(1, 15, 15).double()
    impulse[0, 7, 7] = 1
    tent = torch.tensor([1.0, 2.0, 3.0, 2.0, 1.0]).double() / 9
    result = guided_filter(torch.full((3, 15, 15), 0.4).double(), impulse, 1, 1e-3)[0]
    torch.testing.assert_close(result[5:10, 5:10], tent[:, None] * tent, rtol=0, atol=1e-15)


def test_blurred_step_along_a_photo_edge_becomes_sharp() -> None:
    """Half of it, as the windows that straddle the edge disagree."""
    columns = torch.arange(64).double().expand(64, 64)
    rgb = torch.where(columns < 32, 0.2, 0.8).expand(3, 64, 64).contiguous()
    blurred = ((columns - 27.5) / 8).clamp(0, 1)
    sharp = guided_filter(rgb, blurred[None], 8, 1e-4)[0]
    before, after = ((each[:, 32] - each[:, 31]) for each in (blurred, sharp))
    torch.testing.assert_close(before, torch.full_like(before, 1 / 8))
    assert float(after.min()) > 0.5


@pytest.mark.parametrize("name", ["radius", "epsilon"])
def test_parameter_that_is_not_positive_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: expected a positive number for the guided filter, got 0"):
        GuidedFilter(**{name: 0})
