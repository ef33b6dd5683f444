"""Visual losses: the metrics' kernels, averaged over the lights, with gradients and automatic weights."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
import torch
from small_lpips import random_lpips
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.networks.network import Answer
from dsr.metrics.functional import SurfacePair, dssim_v, mse_v
from dsr.metrics.losses import MSE_V, VisualLoss, VisualLossName, make_visual_loss, match_weight
from dsr.metrics.lpips import LPIPS, lpips_v
from dsr.sample import DepthSample, Scene
from dsr.training.degradation import Batch, to_tensors
from dsr.training.objective import DepthObjective, balance_weight

SIZE = 32
CAMERA = Camera(SIZE, SIZE, 40.0, 40.0, 15.5, 15.5)
NAMES: tuple[VisualLossName, ...] = get_args(VisualLossName)


@pytest.fixture(scope="module")
def network() -> LPIPS:
    return random_lpips()


def _loss(name: VisualLossName, network: LPIPS) -> VisualLoss:
    return VisualLoss(name, network if name == "lpips" else None)


def _surface(seed: int, size: int = SIZE) -> Tensor:
    """Return a wavy surface, (1, 1, size, size) float64."""
    random = torch.Generator().manual_seed(seed)
    x = torch.arange(size, dtype=torch.float64)
    frequency, phase = torch.rand(2, 2, generator=random, dtype=torch.float64)
    waves = torch.sin((0.3 + 0.3 * frequency[0]) * x + 6 * phase[0]) * torch.cos((0.3 + frequency[1]) * x[:, None])
    return 2 + 0.02 * waves[None, None]


def _sample(size: int = SIZE, scale: int = 2) -> DepthSample:
    camera = Camera(size, size, 1.2 * size, 1.2 * size, (size - 1) / 2, (size - 1) / 2)
    scene = Scene("set", "waves", torch.full((3, size, size), 0.5), camera, _surface(3, size)[0])
    return make_sample(scene, scale, Downsampling("box"), "disparity")


def test_a_visual_loss_is_the_metric_averaged_over_the_lights(network: LPIPS) -> None:
    pair = SurfacePair(
        torch.cat((_surface(0), _surface(1))), torch.cat((_surface(2), _surface(3))), CAMERA.rays()[None]
    )
    assert torch.equal(VisualLoss()(pair), mse_v(pair))
    torch.testing.assert_close(VisualLoss("dssim")(pair), dssim_v(pair).mean(dim=1), rtol=0, atol=0)
    torch.testing.assert_close(VisualLoss("lpips", network)(pair), lpips_v(pair, network).mean(dim=1), rtol=0, atol=0)


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_gradient_of_a_visual_loss_is_that_of_its_value(name: VisualLossName, holes: bool, network: LPIPS) -> None:
    loss, target, rays = _loss(name, network), _surface(2), CAMERA.rays()[None]
    if holes:
        target[..., 5:9, 20:23] = torch.nan
    if loss.network is not None:
        loss.network.double()
    start = _surface(0)

    def value(surface: Tensor) -> Tensor:
        return loss(SurfacePair(surface, target, rays)).sum()

    surface = start.clone().requires_grad_()
    value(surface).backward()
    assert surface.grad is not None
    for seed in range(3):  # along random directions
        random = torch.Generator().manual_seed(seed)
        step = 1e-9 * torch.randn(start.shape, generator=random, dtype=torch.float64)
        numeric = (value(start + step) - value(start - step)) / 2
        analytic = (surface.grad * step).sum()
        assert numeric.item() == pytest.approx(analytic.item(), rel=1e-4, abs=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_image_without_a_valid_pixel_has_no_loss_and_no_gradient(name: VisualLossName, network: LPIPS) -> None:
    prediction = torch.cat((_surface(0), _surface(1))).float().requires_grad_()
    target = torch.cat((_surface(2), torch.full_like(_surface(2), torch.nan))).float()
    loss = _loss(name, network.float())(SurfacePair(prediction, target, CAMERA.rays(dtype=torch.float32)[None]))
    assert loss.isfinite().tolist() == [True, False]
    loss.nanmean().backward()
    assert prediction.grad is not None
    assert bool(prediction.grad.isfinite().all())
    assert float(prediction.grad[0].abs().max()) > 0
    assert float(prediction.grad[1].abs().max()) == 0


@pytest.mark.parametrize("name", NAMES)
def test_objectives_have_the_visual_loss_as_a_term(name: VisualLossName, network: LPIPS) -> None:
    loss, sample = _loss(name, network.float()), _sample(64)
    batch: Batch = {key: value[None] for key, value in to_tensors(sample).items()}
    disparity = 1.02 * batch["bf"] / batch["depth"] + 0.02 * torch.sin(torch.arange(64.0))
    terms = DepthObjective("l1", 0.3, visual=loss)(Answer(disparity), batch)
    assert terms.keys() == {"loss", "l1", name}
    assert terms["loss"].item() == pytest.approx((terms["l1"] + 0.3 * terms[name]).item(), rel=1e-6)
    expected = loss(SurfacePair(batch["bf"] / disparity, batch["depth"], batch["rays"]))
    assert terms[name].item() == pytest.approx(expected.item(), rel=1e-6)


def test_automatic_weight_makes_a_loss_as_large_as_mse_v_for_interpolation() -> None:
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
    assert balance_weight(patches, MSE_V) == w


def test_weight_without_a_typical_error_is_one() -> None:
    pair = SurfacePair(_surface(0), _surface(0), CAMERA.rays()[None])
    assert match_weight(VisualLoss("dssim"), [pair]) == 1
    assert match_weight(VisualLoss("dssim"), []) == 1


def test_lpips_without_its_weights_is_one_line_that_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"set metrics\.lpips_trunk=FILE or") as caught:
        make_visual_loss("lpips", tmp_path / "none.pth")
    assert "\n" not in str(caught.value)
    damaged = tmp_path / "damaged.pth"
    damaged.write_bytes(b"not weights")
    with pytest.raises(ValueError, match=r"^visual: lpips needs AlexNet's weights: .*damaged\.pth"):
        make_visual_loss("lpips", damaged)
    with pytest.raises(ValueError, match=r"^visual: expected one of mse_v, dssim, lpips, got 'ssim'$"):
        make_visual_loss("ssim")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^visual: expected a network for lpips, got none$"):
        VisualLoss("lpips")
