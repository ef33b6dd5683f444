"""Conjugate gradients, against a direct solver."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dsr.methods.classical.iterations import conjugate_gradients


def _systems(batch: int, size: int) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(0)
    root = torch.from_numpy(rng.normal(size=(batch, size, size)))
    return root @ root.mT + torch.eye(size).double(), torch.from_numpy(rng.normal(size=(batch, size)))


def _times(matrices: Tensor, x: Tensor) -> Tensor:
    return (matrices @ x[..., None])[..., 0]


def test_conjugate_gradients_equal_a_direct_solver_for_each_element_of_a_batch() -> None:
    matrices, right = _systems(3, 12)
    found = conjugate_gradients(
        lambda x: _times(matrices, x), right, torch.zeros_like(right), iterations=100, tolerance=1e-12
    )
    torch.testing.assert_close(found.values, torch.linalg.solve(matrices, right))
    assert found.residual <= 1e-12


def test_conjugate_gradients_need_at_most_one_step_per_distinct_eigenvalue() -> None:
    diagonal = torch.tensor([1.0, 1, 4, 4, 9, 9]).double()
    right = torch.arange(1.0, 7.0).double()[None]
    found = conjugate_gradients(lambda x: diagonal * x, right, torch.zeros_like(right), iterations=100, tolerance=1e-10)
    assert found.iterations == 3
    torch.testing.assert_close(found.values, right / diagonal)


def test_solved_element_is_unchanged_while_another_goes_on() -> None:
    matrices, right = _systems(2, 8)
    right[0] = 0
    found = conjugate_gradients(
        lambda x: _times(matrices, x), right, torch.zeros_like(right), iterations=50, tolerance=1e-12
    )
    assert torch.equal(found.values[0], torch.zeros(8).double())
    torch.testing.assert_close(found.values[1], torch.linalg.solve(matrices[1], right[1]))
