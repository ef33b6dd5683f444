"""Training losses, against a pyramid written in plain numpy, closed forms and finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.methods.networks.network import Answer
from dsr.metrics.losses import l1, lap1, mse
from dsr.training.degradation import Batch
from dsr.training.objective import DepthLoss, DepthObjective

Loss = Callable[..., Tensor]
LOSSES: dict[str, Loss] = {"l1": l1, "mse": mse, "lap1": lap1}
TAPS = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


pytestmark = pytest.mark.usefixtures("one_thread")


def _map(seed: int, height: int = 13, width: int = 18, batch: int = 1) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(batch, 1, height, width)))


def _with_holes(values: Tensor, seed: int, share: float = 0.2) -> Tensor:
    holes = torch.from_numpy(np.random.default_rng(seed).random(tuple(values.shape)) < share)
    return values.masked_fill(holes, torch.nan)


def _slow_reduce(x: np.ndarray) -> np.ndarray:
    """Blur and keep every second pixel; beyond the border the edge pixel repeats."""
    height, width = x.shape
    coarse = np.zeros((math.ceil(height / 2), math.ceil(width / 2)))
    for i, j in np.ndindex(*coarse.shape):
        for p, q in np.ndindex(5, 5):
            row, column = min(max(2 * i + p - 2, 0), height - 1), min(max(2 * j + q - 2, 0), width - 1)
            coarse[i, j] += TAPS[p] * TAPS[q] * x[row, column]
    return coarse


def _slow_expand(coarse: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Interpolate: low-resolution pixel (i, j) sits at high-resolution pixel (2 i, 2 j); weights are normalised."""
    fine = np.zeros(shape)
    for row, column in np.ndindex(*shape):
        total = 0.0
        for i, j in np.ndindex(*coarse.shape):
            if abs(row - 2 * i) <= 2 and abs(column - 2 * j) <= 2:
                weight = TAPS[row - 2 * i + 2] * TAPS[column - 2 * j + 2]
                fine[row, column] += weight * coarse[i, j]
                total += weight
        fine[row, column] /= total
    return fine


def _slow_lap1(x: np.ndarray, y: np.ndarray, levels: int) -> float:
    """Bojanowski et al. 2018, eq. 2, of two pyramids, over the number of pixels; a level's norm is a weighted mean."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y, weight = np.where(known, x, 0), np.where(known, y, 0), known.astype(float)
    total = 0.0
    for _ in range(levels - 1):
        coarse_x, coarse_y = _slow_reduce(x), _slow_reduce(y)
        detail = (x - _slow_expand(coarse_x, x.shape)) - (y - _slow_expand(coarse_y, y.shape))
        total += (weight * np.abs(detail)).sum() / weight.sum()
        x, y, weight = coarse_x, coarse_y, _slow_reduce(weight)
    return total + (weight * np.abs(x - y)).sum() / weight.sum()


@pytest.mark.parametrize("levels", [1, 2, 3])
@pytest.mark.parametrize("size", [(12, 12), (13, 18), (16, 15)])
def test_lap1_equals_a_plain_pyramid(size: tuple[int, int], levels: int) -> None:
    x, y = _map(0, *size), _map(1, *size)
    expected = _slow_lap1(x[0, 0].numpy(), y[0, 0].numpy(), levels)
    assert lap1(x, y, levels=levels).item() == pytest.approx(expected, rel=1e-12)


def test_lap1_with_holes_weights_pixels_by_their_valid_fraction() -> None:
    x, y = _with_holes(_map(0), 2), _with_holes(_map(1), 3)
    expected = _slow_lap1(x[0, 0].numpy(), y[0, 0].numpy(), 3)
    assert lap1(x, y).item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_l1_and_mse_are_means_over_valid_pixels(holes: float) -> None:
    x, y = _with_holes(_map(0), 2, holes), _map(1)
    difference = (x - y).numpy()
    assert l1(x, y).item() == pytest.approx(np.nanmean(np.abs(difference)), rel=1e-13)
    assert mse(x, y).item() == pytest.approx(np.nanmean(difference**2), rel=1e-13)


@pytest.mark.parametrize("c", [-2.5, 0.1, 3.0])
@pytest.mark.parametrize("size", [(12, 12), (17, 14)])
def test_constant_offset_gives_its_absolute_value(size: tuple[int, int], c: float) -> None:
    x = _map(0, *size)
    assert lap1(x + c, x).item() == pytest.approx(abs(c), rel=1e-13)
    assert l1(x + c, x).item() == pytest.approx(abs(c), rel=1e-13)
    assert mse(x + c, x).item() == pytest.approx(c**2, rel=1e-13)


def test_lap1_with_one_level_is_l1() -> None:
    x, y = _with_holes(_map(0), 2), _map(1)
    assert lap1(x, y, levels=1).item() == pytest.approx(l1(x, y).item(), rel=1e-14)


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_symmetric_zero_at_the_target_and_positive_elsewhere(name: str) -> None:
    x, y = _with_holes(_map(0), 2), _with_holes(_map(1), 3)
    loss = LOSSES[name]
    assert loss(x, y).item() == pytest.approx(loss(y, x).item(), rel=1e-14)
    assert loss(x, x).item() == 0
    assert loss(x, y).item() > 0


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("garbage", [1e30, -7.0, math.inf, math.nan])
def test_pixels_under_holes_do_not_matter(name: str, garbage: float) -> None:
    x, y = _map(0), _map(1)
    holes = torch.from_numpy(np.random.default_rng(4).random((1, 1, 13, 18)) > 0.7)
    expected = LOSSES[name](x, y.masked_fill(holes, torch.nan)).item()
    assert expected != LOSSES[name](x, y).item()
    assert LOSSES[name](x.masked_fill(holes, garbage), y.masked_fill(holes, torch.nan)).item() == expected
    assert LOSSES[name](x, y).item() == LOSSES[name](x, y, complete=True).item() == LOSSES[name](x, y, complete=False)


@pytest.mark.parametrize("name", LOSSES)
def test_image_without_a_valid_pixel_has_loss_nan_and_leaves_the_others_unchanged(name: str) -> None:
    x, y = _map(0, batch=2), _map(1, batch=2)
    y[0] = torch.nan
    values = LOSSES[name](x, y)
    assert values.shape == (2,)
    assert values[0].isnan()
    assert values[1].item() == pytest.approx(LOSSES[name](x[1:], y[1:]).item(), rel=1e-14)


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_are_finite_and_zero_in_holes(name: str) -> None:
    x, y = _map(0, batch=2).requires_grad_(), _with_holes(_map(1, batch=2), 3)
    y[0] = torch.nan
    LOSSES[name](x, y).nanmean().backward()
    assert x.grad is not None
    assert bool(x.grad.isfinite().all())
    assert bool((x.grad[y.isnan()] == 0).all())
    assert bool(x.grad[1].any())


@pytest.mark.parametrize("name", LOSSES)
def test_batch_of_two_equals_two_single_images(name: str) -> None:
    x, y = _with_holes(_map(0, batch=2), 2), _map(1, batch=2)
    singles = [LOSSES[name](x[i : i + 1], y[i : i + 1]) for i in range(2)]
    torch.testing.assert_close(LOSSES[name](x, y), torch.cat(singles), rtol=1e-14, atol=0)


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("holes", [0.0, 0.25])
def test_gradient_of_a_loss_is_that_of_its_value(name: str, holes: float) -> None:
    size = (12, 13) if name == "lap1" else (3, 4)
    x, y = _map(0, *size), _with_holes(_map(1, *size), 3, holes)
    assert torch.autograd.gradcheck(lambda x: LOSSES[name](x, y), x.requires_grad_())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", LOSSES)
def test_losses_keep_the_precision(name: str, dtype: torch.dtype) -> None:
    assert LOSSES[name](_map(0).to(dtype), _with_holes(_map(1), 2).to(dtype)).dtype == dtype


# The objective, with a camera per sample

CAMERAS = (
    Camera(width=14, height=12, fx=15.0, fy=14.0, cx=6.1, cy=5.8, baseline=0.12, doffs=0.7),
    Camera(width=14, height=12, fx=22.0, fy=23.0, cx=3.0, cy=9.2, baseline=0.3, doffs=-0.4),
)


def _batch(*, holes: float = 0.0) -> Batch:
    depth = 2 + 0.3 * torch.tanh(_map(5, 12, 14, batch=2))
    depth = _with_holes(depth, 6, holes)
    stereo = torch.tensor([[c.fx * (c.baseline or 0)] for c in CAMERAS], dtype=torch.float64)[:, :, None, None]
    doffs = torch.tensor([[c.doffs] for c in CAMERAS], dtype=torch.float64)[:, :, None, None]
    fine = stereo / depth - doffs
    coarse = fine.reshape(2, 1, 6, 2, 7, 2).nanmean(dim=(3, 5))
    rays = torch.stack([camera.rays() for camera in CAMERAS])
    return {"depth": depth, "rays": rays, "bf": stereo, "doffs": doffs, "disparity_lr": coarse}


def _guess(batch: Batch) -> Tensor:
    """Return disparities near the true ones, and finite."""
    truth = (batch["bf"] / batch["depth"] - batch["doffs"]).nan_to_num(1.0)
    return truth + 0.05 * _map(7, 12, 14, batch=2)


@pytest.mark.slow
@pytest.mark.parametrize("holes", [0.0, 0.15])
@pytest.mark.parametrize("depth_loss", LOSSES)
def test_gradient_of_the_objective_is_that_of_its_value(depth_loss: DepthLoss, holes: float) -> None:
    batch, objective = _batch(holes=holes), DepthObjective(depth_loss, 0.7)
    assert torch.autograd.gradcheck(
        lambda guess: objective(Answer(guess), batch)["loss"], _guess(batch).requires_grad_()
    )


@pytest.mark.parametrize("holes", [0.0, 0.15])
def test_objective_of_a_batch_is_the_mean_of_its_samples(holes: float) -> None:
    batch, objective = _batch(holes=holes), DepthObjective("lap1", 0.7)
    guess = _guess(batch)
    singles = [
        objective(Answer(guess[i : i + 1]), {name: value[i : i + 1] for name, value in batch.items()})["loss"]
        for i in range(2)
    ]
    assert singles[0].item() != pytest.approx(singles[1].item(), rel=0.01)
    assert objective(Answer(guess), batch)["loss"].item() == pytest.approx(sum(singles).item() / 2, rel=1e-13)


def test_objective_has_finite_gradients_at_the_truth_and_beyond_infinity() -> None:
    batch = _batch(holes=0.15)
    truth = (batch["bf"] / batch["depth"] - batch["doffs"]).nan_to_num(1.0)
    behind = truth.clone()
    behind[1] = -5  # nothing of that surface can be seen
    for start in (truth, behind, torch.full_like(truth, -5)):
        guess = start.clone().requires_grad_()
        DepthObjective("lap1", 0.7)(Answer(guess), batch)["loss"].backward()
        assert guess.grad is not None
        assert bool(guess.grad.isfinite().all())
