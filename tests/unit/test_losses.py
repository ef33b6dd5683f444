"""Training losses, against a pyramid in plain numpy, closed forms, finite differences and the metrics' kernels."""

import math
from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
import torch
from small_lpips import random_lpips
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.networks.network import Answer
from dsr.metrics.functional import SurfacePair, dssim_v, mse_v
from dsr.metrics.losses import VisualLoss, VisualLossName, l1, lap1, make_visual_loss, match_weight, mse
from dsr.metrics.lpips import lpips_v
from dsr.sample import Scene
from dsr.training.degradation import to_tensors
from dsr.training.objective import DepthObjective, balance_weight

Loss = Callable[..., Tensor]
LOSSES = {"l1": l1, "mse": mse, "lap1": lap1}
TAPS = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


pytestmark = pytest.mark.usefixtures("one_thread")


def _map(seed, height=13, width=18, batch=1):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(batch, 1, height, width)))


def _with_holes(values, seed, share=0.2):
    holes = torch.from_numpy(np.random.default_rng(seed).random(tuple(values.shape)) < share)
    return values.masked_fill(holes, torch.nan)


def _slow_reduce(x):
    """Blur and keep every second pixel; beyond the border the edge pixel repeats."""
    height, width = x.shape
    coarse = np.zeros((math.ceil(height / 2), math.ceil(width / 2)))
    for i, j in np.ndindex(*coarse.shape):
        for p, q in np.ndindex(5, 5):
            row, column = min(max(2 * i + p - 2, 0), height - 1), min(max(2 * j + q - 2, 0), width - 1)
            coarse[i, j] += TAPS[p] * TAPS[q] * x[row, column]
    return coarse


def _slow_expand(coarse, shape):
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


def _slow_lap1(x, y, levels):
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
def test_lap1_equals_a_plain_pyramid(size, levels):
    x, y = _map(0, *size), _map(1, *size)
    expected = _slow_lap1(x[0, 0].numpy(), y[0, 0].numpy(), levels)
    assert lap1(x, y, levels=levels).item() == pytest.approx(expected, rel=1e-12)


def test_lap1_with_holes_weights_pixels_by_their_valid_fraction():
    x, y = _with_holes(_map(0), 2), _with_holes(_map(1), 3)
    expected = _slow_lap1(x[0, 0].numpy(), y[0, 0].numpy(), 3)
    assert lap1(x, y).item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_l1_and_mse_are_means_over_valid_pixels(holes):
    x, y = _with_holes(_map(0), 2, holes), _map(1)
    difference = (x - y).numpy()
    assert l1(x, y).item() == pytest.approx(np.nanmean(np.abs(difference)), rel=1e-13)
    assert mse(x, y).item() == pytest.approx(np.nanmean(difference**2), rel=1e-13)


@pytest.mark.parametrize("c", [-2.5, 0.1, 3.0])
@pytest.mark.parametrize("size", [(12, 12), (17, 14)])
def test_constant_offset_gives_its_absolute_value(size, c):
    x = _map(0, *size)
    assert lap1(x + c, x).item() == pytest.approx(abs(c), rel=1e-13)
    assert l1(x + c, x).item() == pytest.approx(abs(c), rel=1e-13)
    assert mse(x + c, x).item() == pytest.approx(c**2, rel=1e-13)


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_symmetric_zero_at_the_target_and_positive_elsewhere(name):
    x, y = _with_holes(_map(0), 2), _with_holes(_map(1), 3)
    loss = LOSSES[name]
    assert loss(x, y).item() == pytest.approx(loss(y, x).item(), rel=1e-14)
    assert loss(x, x).item() == 0
    assert loss(x, y).item() > 0


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("garbage", [1e30, -7.0, math.inf, math.nan])
def test_pixels_under_holes_do_not_matter(name, garbage):
    x, y = _map(0), _map(1)
    holes = torch.from_numpy(np.random.default_rng(4).random((1, 1, 13, 18)) > 0.7)
    expected = LOSSES[name](x, y.masked_fill(holes, torch.nan)).item()
    assert expected != LOSSES[name](x, y).item()
    assert LOSSES[name](x.masked_fill(holes, garbage), y.masked_fill(holes, torch.nan)).item() == expected
    assert LOSSES[name](x, y).item() == LOSSES[name](x, y, complete=True).item() == LOSSES[name](x, y, complete=False)


@pytest.mark.parametrize("name", LOSSES)
def test_image_without_a_valid_pixel_has_loss_nan_and_leaves_the_others_unchanged(name):
    x, y = _with_holes(_map(0, batch=2), 2), _map(1, batch=2)
    y[0] = torch.nan
    values = LOSSES[name](x, y)
    assert values.shape == (2,)
    assert values[0].isnan()
    assert values[1].item() == pytest.approx(LOSSES[name](x[1:], y[1:]).item(), rel=1e-14)


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_are_finite_and_zero_in_holes(name):
    x, y = _map(0, batch=2).requires_grad_(), _with_holes(_map(1, batch=2), 3)
    y[0] = torch.nan
    LOSSES[name](x, y).nanmean().backward()
    assert bool(x.grad.isfinite().all())
    assert bool((x.grad[y.isnan()] == 0).all())
    assert bool(x.grad[1].any())


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("holes", [0.0, 0.25])
def test_gradient_of_a_loss_is_that_of_its_value(name, holes):
    size = (12, 13) if name == "lap1" else (3, 4)
    x, y = _map(0, *size), _with_holes(_map(1, *size), 3, holes)
    assert torch.autograd.gradcheck(lambda x: LOSSES[name](x, y), x.requires_grad_())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", LOSSES)
def test_losses_keep_the_precision(name, dtype):
    assert LOSSES[name](_map(0).to(dtype), _with_holes(_map(1), 2).to(dtype)).dtype == dtype


# The objective, with a camera per sample

CAMERAS = (
    Camera(width=14, height=12, fx=15.0, fy=14.0, cx=6.1, cy=5.8, baseline=0.12, doffs=0.7),
    Camera(width=14, height=12, fx=22.0, fy=23.0, cx=3.0, cy=9.2, baseline=0.3, doffs=-0.4),
)


def _batch(*, holes=0.0):
    depth = 2 + 0.3 * torch.tanh(_map(5, 12, 14, batch=2))
    depth = _with_holes(depth, 6, holes)
    stereo = torch.tensor([[c.fx * (c.baseline or 0)] for c in CAMERAS], dtype=torch.float64)[:, :, None, None]
    doffs = torch.tensor([[c.doffs] for c in CAMERAS], dtype=torch.float64)[:, :, None, None]
    fine = stereo / depth - doffs
    coarse = fine.reshape(2, 1, 6, 2, 7, 2).nanmean(dim=(3, 5))
    rays = torch.stack([camera.rays() for camera in CAMERAS])
    return {"depth": depth, "rays": rays, "bf": stereo, "doffs": doffs, "disparity_lr": coarse}


def _guess(batch):
    """Return disparities near the true ones, and finite."""
    truth = (batch["bf"] / batch["depth"] - batch["doffs"]).nan_to_num(1.0)
    return truth + 0.05 * _map(7, 12, 14, batch=2)


@pytest.mark.slow
@pytest.mark.parametrize("holes", [0.0, 0.15])
@pytest.mark.parametrize("depth_loss", LOSSES)
def test_gradient_of_the_objective_is_that_of_its_value(depth_loss, holes):
    batch, objective = _batch(holes=holes), DepthObjective(depth_loss, 0.7)
    assert torch.autograd.gradcheck(
        lambda guess: objective(Answer(guess), batch)["loss"], _guess(batch).requires_grad_()
    )


@pytest.mark.parametrize("holes", [0.0, 0.15])
def test_objective_of_a_batch_is_the_mean_of_its_samples(holes):
    batch, objective = _batch(holes=holes), DepthObjective("lap1", 0.7)
    guess = _guess(batch)
    singles = [
        objective(Answer(guess[i : i + 1]), {name: value[i : i + 1] for name, value in batch.items()})["loss"]
        for i in range(2)
    ]
    assert singles[0].item() != pytest.approx(singles[1].item(), rel=0.01)
    assert objective(Answer(guess), batch)["loss"].item() == pytest.approx(sum(singles).item() / 2, rel=1e-13)


def test_objective_has_finite_gradients_at_the_truth_and_beyond_infinity():
    batch = _batch(holes=0.15)
    truth = (batch["bf"] / batch["depth"] - batch["doffs"]).nan_to_num(1.0)
    behind = truth.clone()
    behind[1] = -5  # nothing of that surface can be seen
    for start in (truth, behind, torch.full_like(truth, -5)):
        guess = start.clone().requires_grad_()
        DepthObjective("lap1", 0.7)(Answer(guess), batch)["loss"].backward()
        assert bool(guess.grad.isfinite().all())


# Losses of renderings

SIZE = 32
CAMERA = Camera(SIZE, SIZE, 40.0, 40.0, 15.5, 15.5)
VISUAL = get_args(VisualLossName)


@pytest.fixture(scope="module")
def network():
    return random_lpips()


def _loss(name, network):
    return VisualLoss(name, network if name == "lpips" else None)


def _surface(seed, size=SIZE):
    """Return a wavy surface, (1, 1, size, size) float64."""
    random = torch.Generator().manual_seed(seed)
    x = torch.arange(size, dtype=torch.float64)
    frequency, phase = torch.rand(2, 2, generator=random, dtype=torch.float64)
    waves = torch.sin((0.3 + 0.3 * frequency[0]) * x + 6 * phase[0]) * torch.cos((0.3 + frequency[1]) * x[:, None])
    return 2 + 0.02 * waves[None, None]


def _sample(size=SIZE, scale=2):
    camera = Camera(size, size, 1.2 * size, 1.2 * size, (size - 1) / 2, (size - 1) / 2)
    scene = Scene("set", "waves", torch.full((3, size, size), 0.5), camera, _surface(3, size)[0])
    return make_sample(scene, scale, Downsampling("box"), "disparity")


def test_a_visual_loss_is_the_metric_averaged_over_the_lights(network):
    pair = SurfacePair(
        torch.cat((_surface(0), _surface(1))), torch.cat((_surface(2), _surface(3))), CAMERA.rays()[None]
    )
    assert torch.equal(VisualLoss()(pair), mse_v(pair))
    torch.testing.assert_close(VisualLoss("dssim")(pair), dssim_v(pair).mean(dim=1), rtol=0, atol=0)
    torch.testing.assert_close(VisualLoss("lpips", network)(pair), lpips_v(pair, network).mean(dim=1), rtol=0, atol=0)


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("name", VISUAL)
def test_gradient_of_a_visual_loss_is_that_of_its_value(name, holes, network):
    loss, target, rays = _loss(name, network), _surface(2), CAMERA.rays()[None]
    if holes:
        target[..., 5:9, 20:23] = torch.nan
    if loss.network is not None:
        loss.network.double()
    start = _surface(0)

    def value(surface):
        return loss(SurfacePair(surface, target, rays)).sum()

    surface = start.clone().requires_grad_()
    value(surface).backward()
    for seed in range(3):  # along random directions
        random = torch.Generator().manual_seed(seed)
        step = 1e-9 * torch.randn(start.shape, generator=random, dtype=torch.float64)
        numeric = (value(start + step) - value(start - step)) / 2
        analytic = (surface.grad * step).sum()
        assert numeric.item() == pytest.approx(analytic.item(), rel=1e-4, abs=1e-13)


@pytest.mark.parametrize("name", VISUAL)
def test_image_without_a_valid_pixel_has_no_loss_and_no_gradient(name, network):
    prediction = torch.cat((_surface(0), _surface(1))).float().requires_grad_()
    target = torch.cat((_surface(2), torch.full_like(_surface(2), torch.nan))).float()
    loss = _loss(name, network.float())(SurfacePair(prediction, target, CAMERA.rays(dtype=torch.float32)[None]))
    assert loss.isfinite().tolist() == [True, False]
    loss.nanmean().backward()
    assert bool(prediction.grad.isfinite().all())
    assert float(prediction.grad[0].abs().max()) > 0
    assert float(prediction.grad[1].abs().max()) == 0


@pytest.mark.parametrize("name", VISUAL)
def test_objectives_have_the_visual_loss_as_a_term(name, network):
    loss, sample = _loss(name, network.float()), _sample(64)
    batch = {key: value[None] for key, value in to_tensors(sample).items()}
    disparity = 1.02 * batch["bf"] / batch["depth"] + 0.02 * torch.sin(torch.arange(64.0))
    terms = DepthObjective("l1", 0.3, visual=loss)(Answer(disparity), batch)
    assert terms.keys() == {"loss", "l1", name}
    assert terms["loss"].item() == pytest.approx((terms["l1"] + 0.3 * terms[name]).item(), rel=1e-6)
    expected = loss(SurfacePair(batch["bf"] / disparity, batch["depth"], batch["rays"]))
    assert terms[name].item() == pytest.approx(expected.item(), rel=1e-6)


def test_automatic_weight_makes_a_loss_as_large_as_mse_v_for_interpolation():
    patches = [to_tensors(_sample(size)) for size in (32, 40, 48)]
    w, other = balance_weight(patches), balance_weight(patches, VisualLoss("dssim"))
    ratios = []
    for patch in patches:
        batch = {key: value[None] for key, value in patch.items()}
        enlarged = torch.nn.functional.interpolate(
            batch["disparity_lr"], scale_factor=2, mode="bicubic", antialias=True
        )
        pair = SurfacePair(batch["bf"] / enlarged, batch["depth"], batch["rays"])
        ratios.append((mse_v(pair) / dssim_v(pair).mean()).item())
    assert other == pytest.approx(w * sorted(ratios)[1], rel=1e-5)
    pair = SurfacePair(_surface(0), _surface(0), CAMERA.rays()[None])
    assert match_weight(VisualLoss("dssim"), [pair]) == match_weight(VisualLoss("dssim"), []) == 1


def test_lpips_without_its_weights_is_one_line_that_says_what_to_do(tmp_path):
    with pytest.raises(ValueError, match=r"set metrics\.lpips_trunk=FILE or") as caught:
        make_visual_loss("lpips", tmp_path / "none.pth")
    assert "\n" not in str(caught.value)
    damaged = tmp_path / "damaged.pth"
    damaged.write_bytes(b"not weights")
    with pytest.raises(ValueError, match=r"^visual: lpips needs AlexNet's weights: .*damaged\.pth"):
        make_visual_loss("lpips", damaged)
    with pytest.raises(ValueError, match=r"^visual: expected one of mse_v, dssim, lpips, got 'ssim'$"):
        make_visual_loss("ssim")
    with pytest.raises(ValueError, match=r"^visual: expected a network for lpips, got none$"):
        VisualLoss("lpips")
