"""Losses of trainings, against plain computations, closed forms, finite differences and the metrics' kernels."""

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from scipy import ndimage, sparse
from scipy.sparse import linalg
from small_lpips import random_lpips
from small_scenes import grid

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.network import Answer
from dsr.metrics.functional import SurfacePair, dssim_v, mse_v
from dsr.metrics.losses import VisualLoss, VisualLossName, l1, lap1, make_visual_loss, match_weight, mse
from dsr.metrics.lpips import lpips_v
from dsr.sample import Scene
from dsr.training.degradation import Degradation, to_tensors
from dsr.training.module import SuperResolution
from dsr.training.objective import (
    DepthObjective,
    SurfaceObjective,
    balance_weight,
    estimate_albedo,
    estimate_light,
    harmonics,
    integrate,
    shading_loss,
)

LOSSES = {"l1": l1, "mse": mse, "lap1": lap1}
TAPS = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


pytestmark = pytest.mark.usefixtures("one_thread")


def _map(seed, height=13, width=18, batch=1):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(batch, 1, height, width)))


def _with_holes(values, seed, share=0.2):
    holes = torch.from_numpy(np.random.default_rng(seed).random(tuple(values.shape)) < share)
    return values.masked_fill(holes, torch.nan)


def _blur(x, mode):
    return ndimage.correlate1d(ndimage.correlate1d(x, TAPS, 0, mode=mode), TAPS, 1, mode=mode)


def _reduce(x):
    """Blur and keep every second pixel; beyond the border the edge pixel repeats."""
    return _blur(x, "nearest")[::2, ::2]


def _expand(coarse, shape):
    """Interpolate: low-resolution pixel (i, j) sits at high-resolution pixel (2 i, 2 j); weights are normalised."""
    spread, known = np.zeros(shape), np.zeros(shape)
    spread[::2, ::2], known[::2, ::2] = coarse, 1
    return _blur(spread, "constant") / _blur(known, "constant")


def _slow_lap1(x, y, levels):
    """Bojanowski et al. 2018, eq. 2, of two pyramids, over the number of pixels; a level's norm is a weighted mean."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y, weight = np.where(known, x, 0), np.where(known, y, 0), known.astype(float)
    total = 0.0
    for _ in range(levels - 1):
        coarse_x, coarse_y = _reduce(x), _reduce(y)
        detail = (x - _expand(coarse_x, x.shape)) - (y - _expand(coarse_y, y.shape))
        total += (weight * np.abs(detail)).sum() / weight.sum()
        x, y, weight = coarse_x, coarse_y, _reduce(weight)
    return total + (weight * np.abs(x - y)).sum() / weight.sum()


@pytest.mark.parametrize("levels", [1, 2, 3])
@pytest.mark.parametrize("size", [(12, 12), (13, 18), (16, 15)])
@pytest.mark.parametrize("holes", [0.0, 0.2])
def test_lap1_equals_a_plain_pyramid_that_weights_pixels_by_their_valid_fraction(size, levels, holes):
    x, y = _with_holes(_map(0, *size), 2, holes), _with_holes(_map(1, *size), 3, holes)
    expected = _slow_lap1(x[0, 0].numpy(), y[0, 0].numpy(), levels)
    assert lap1(x, y, levels=levels).item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_l1_and_mse_are_means_over_valid_pixels(holes):
    x, y = _with_holes(_map(0), 2, holes), _map(1)
    difference = (x - y).numpy()
    assert l1(x, y).item() == pytest.approx(np.nanmean(np.abs(difference)), rel=1e-13)
    assert mse(x, y).item() == pytest.approx(np.nanmean(difference**2), rel=1e-13)


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
def test_image_without_a_valid_pixel_has_loss_nan_and_gradients_are_finite_and_zero_in_holes(name):
    x, y = _map(0, batch=2).requires_grad_(), _with_holes(_map(1, batch=2), 3)
    y[0] = torch.nan
    values = LOSSES[name](x, y)
    assert values.isnan().tolist() == [True, False]
    assert values[1].item() == pytest.approx(LOSSES[name](x[1:], y[1:]).item(), rel=1e-14)
    assert LOSSES[name](x.float(), y.float()).dtype == torch.float32
    values.nanmean().backward()
    assert bool(x.grad.isfinite().all())
    assert bool((x.grad[y.isnan()] == 0).all())
    assert bool(x.grad[1].any())


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("holes", [0.0, 0.25])
def test_gradient_of_a_loss_is_that_of_its_value(name, holes):
    size = (12, 13) if name == "lap1" else (3, 4)
    x, y = _map(0, *size), _with_holes(_map(1, *size), 3, holes)
    assert torch.autograd.gradcheck(lambda x: LOSSES[name](x, y), x.requires_grad_())


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


def _truth(batch):
    """Return the true disparities, 1 where they are unknown."""
    return (batch["bf"] / batch["depth"] - batch["doffs"]).nan_to_num(1.0)


@pytest.mark.parametrize("holes", [0.0, 0.15])
def test_objective_of_a_batch_is_the_mean_of_its_samples(holes):
    batch, objective = _batch(holes=holes), DepthObjective("lap1", 0.7)
    guess = _truth(batch) + 0.05 * _map(7, 12, 14, batch=2)
    singles = [
        objective(Answer(guess[i : i + 1]), {name: value[i : i + 1] for name, value in batch.items()})["loss"]
        for i in range(2)
    ]
    assert singles[0].item() != pytest.approx(singles[1].item(), rel=0.01)
    assert objective(Answer(guess), batch)["loss"].item() == pytest.approx(sum(singles).item() / 2, rel=1e-13)


def test_objective_has_finite_gradients_at_the_truth_and_beyond_infinity():
    batch = _batch(holes=0.15)
    truth = _truth(batch)
    behind = truth.clone()
    behind[1] = -5  # nothing of that surface can be seen
    for start in (truth, behind, torch.full_like(truth, -5)):
        guess = start.clone().requires_grad_()
        DepthObjective("lap1", 0.7)(Answer(guess), batch)["loss"].backward()
        assert bool(guess.grad.isfinite().all())


SIZE = 32
WINDOW = Camera(SIZE, SIZE, 40.0, 40.0, 15.5, 15.5)
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


def _sample(size):
    camera = Camera(size, size, 1.2 * size, 1.2 * size, (size - 1) / 2, (size - 1) / 2)
    scene = Scene("set", "waves", torch.full((3, size, size), 0.5), camera, _surface(3, size)[0])
    return make_sample(scene, 2, Downsampling("box"), "disparity")


def test_a_visual_loss_is_the_metric_averaged_over_the_lights(network):
    pair = SurfacePair(
        torch.cat((_surface(0), _surface(1))), torch.cat((_surface(2), _surface(3))), WINDOW.rays()[None]
    )
    assert torch.equal(VisualLoss()(pair), mse_v(pair))
    torch.testing.assert_close(VisualLoss("dssim")(pair), dssim_v(pair).mean(dim=1), rtol=0, atol=0)
    torch.testing.assert_close(VisualLoss("lpips", network)(pair), lpips_v(pair, network).mean(dim=1), rtol=0, atol=0)


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("name", VISUAL)
def test_gradient_of_a_visual_loss_is_that_of_its_value(name, holes, network):
    loss, target, rays = _loss(name, network), _surface(2), WINDOW.rays()[None]
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
    loss = _loss(name, network.float())(SurfacePair(prediction, target, WINDOW.rays(dtype=torch.float32)[None]))
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
    pair = SurfacePair(_surface(0), _surface(0), WINDOW.rays()[None])
    assert match_weight(VisualLoss("dssim"), [pair]) == match_weight(VisualLoss("dssim"), []) == 1


def test_lpips_without_its_weights_is_one_line_that_says_what_to_do(tmp_path):
    damaged = tmp_path / "damaged.pth"
    damaged.write_bytes(b"not weights")
    for path, message in ((tmp_path / "none.pth", r"set metrics\.lpips_trunk=FILE"), (damaged, r"damaged\.pth")):
        with pytest.raises(ValueError, match=message) as caught:
            make_visual_loss("lpips", path)
        assert "\n" not in str(caught.value)
    for act, got in ((lambda: make_visual_loss("ssim"), "'ssim'"), (lambda: VisualLoss("lpips"), "none")):
        with pytest.raises(ValueError, match=f"^visual: expected .*, got {got}"):
            act()


BENT = Camera(width=18, height=16, fx=20.0, fy=22.0, cx=8.0, cy=7.0)
LIGHT = torch.tensor([0.5, -0.1, -0.2, 0.1, 0.03, 0.02, 0.01, -0.03, 0.02], dtype=torch.float64)


def _bumps(phase=0.0):
    """Return a bumpy surface, (1, 1, 16, 18)."""
    v, u = grid(16, 18)
    return (2 + 0.1 * torch.sin(0.4 * u + phase) * torch.cos(0.3 * v))[None, None]


def _normals(depth):
    return depth_to_normals(depth, BENT.rays()[None])


def _photo(depth):
    """Return the grey photo of a surface with albedo 1 under ``LIGHT``."""
    return torch.einsum("b,nbhw->nhw", LIGHT, harmonics(_normals(depth)))[:, None].expand(-1, 3, -1, -1)


def test_light_is_the_least_squares_solution_over_valid_pixels():
    random = np.random.default_rng(1)
    normals = _normals(_bumps())
    intensity, albedo = (torch.from_numpy(random.uniform(0.2, 1, (1, 1, 16, 18))) for _ in range(2))
    valid = torch.from_numpy(random.uniform(size=(1, 1, 16, 18)) > 0.3)
    x, y, z = (each.numpy() for each in normals[0])
    basis = np.stack((np.ones_like(x), y, z, x, x * y, y * z, 2 * z**2 - x**2 - y**2, z * x, x**2 - y**2), axis=-1)
    kept = valid[0, 0].numpy()
    rows = np.vstack((albedo[0, 0].numpy()[kept][:, None] * basis[kept], 1e-2 * np.eye(9)))
    values = np.concatenate((intensity[0, 0].numpy()[kept], np.zeros(9)))
    expected = np.linalg.lstsq(rows, values, rcond=None)[0]
    found = estimate_light(normals, intensity, albedo, valid)[0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6, atol=1e-7)


def test_loss_is_zero_for_the_surface_and_light_of_the_photo():
    truth, rays = _bumps(), BENT.rays()[None]
    photo = _photo(truth)
    assert 0 < float(photo.min()) < float(photo.max()) < 1
    assert float(photo.std()) > 0.02
    assert float(shading_loss(SurfacePair(truth, truth, rays), photo)) < 1e-7
    assert float(shading_loss(SurfacePair(_bumps(phase=2), truth, rays), photo)) > 1e-3


def test_loss_leaves_out_holes_and_is_nan_without_a_valid_normal():
    truth, rays = _bumps(), BENT.rays()[None]
    photo, pierced = _photo(truth), truth.clone()
    pierced[..., 5:8, 3:9] = torch.nan
    assert float(shading_loss(SurfacePair(truth, pierced, rays), photo)) < 1e-7
    assert bool(shading_loss(SurfacePair(truth, torch.full_like(truth, torch.nan), rays), photo).isnan())


def test_gradient_agrees_with_finite_differences():
    camera = Camera(width=5, height=4, fx=6.0, fy=6.0, cx=2.0, cy=1.5)
    generator = torch.Generator().manual_seed(2)
    truth, depth = (2 + 0.2 * torch.rand((1, 1, 4, 5), generator=generator, dtype=torch.float64) for _ in range(2))
    photo = 0.3 + 0.4 * torch.rand((1, 3, 4, 5), generator=generator, dtype=torch.float64)
    depth.requires_grad_()

    def loss(depth):
        return shading_loss(SurfacePair(depth, truth, camera.rays()[None]), photo)

    assert torch.autograd.gradcheck(loss, (depth,), eps=1e-7, atol=1e-5)


def test_integration_of_contradicting_differences_is_the_least_squares_solution():
    height, width = 4, 5
    random = np.random.default_rng(4)
    along_u, along_v = random.normal(size=(height, width - 1)), random.normal(size=(height - 1, width))
    d_u, d_v = (sparse.diags([-1.0, 1.0], [0, 1], shape=(n - 1, n)) for n in (width, height))
    differences = sparse.vstack((sparse.kron(sparse.eye(height), d_u), sparse.kron(d_v, sparse.eye(width))))
    expected = linalg.lsqr(differences, np.concatenate((along_u.ravel(), along_v.ravel())), atol=1e-14, btol=1e-14)[0]
    found = integrate(torch.from_numpy(along_u)[None, None], torch.from_numpy(along_v)[None, None])
    np.testing.assert_allclose(found[0, 0].numpy(), (expected - expected.mean()).reshape(height, width), atol=1e-9)


@pytest.mark.parametrize("colour", [(0.4, 0.4, 0.4), (0.8, 0.5, 0.2)])
def test_albedo_has_the_edges_of_the_photo_and_none_of_its_slopes(colour):
    paint = torch.ones(1, 3, 24, 24, dtype=torch.float64)
    paint[..., 6:18, 8:20] = torch.tensor(colour, dtype=torch.float64).view(3, 1, 1)
    shading = torch.linspace(0.3, 0.9, 24, dtype=torch.float64)
    albedo = estimate_albedo(paint * shading)
    inside, outside = albedo[..., 7:17, 9:19], albedo[..., :5, :]
    luma = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
    assert float(inside.mean() / outside.mean()) == pytest.approx(luma, rel=0.1)
    assert float(inside.std() / inside.mean()) < 0.05
    assert float(albedo.mean()) == pytest.approx(1, rel=1e-6)


SLOPE = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=7.5, cy=5.5, baseline=0.2)


def _slope_batch(camera=SLOPE, *, soft=0.0):
    """Return a slope, downsampled by 4, without hints."""
    across = torch.linspace(2, 3, camera.width, dtype=torch.float64)
    depth = across.expand(1, camera.height, camera.width).contiguous()
    rgb = torch.rand((3, camera.height, camera.width), generator=torch.Generator().manual_seed(0))
    tensors = to_tensors(Degradation(4, Downsampling("box")).sample(Scene("set", "slope", rgb, camera, depth)))
    hints = {"noise": torch.zeros_like(tensors["disparity_lr"]), "facts": torch.zeros(8), "soft": torch.tensor(soft)}
    return {name: value[None] for name, value in (tensors | hints).items()}


def _sure(batch, disparity, spread=0.1, angle=0.1):
    return Answer(disparity, torch.full_like(disparity, spread), torch.full_like(disparity, angle))


def _inverse(batch):
    return batch["bf"] / batch["depth"]


def test_the_terms_are_added_with_their_weights():
    batch = _slope_batch(soft=1.0)
    objective = SurfaceObjective(depth=3.0, soft=5.0, sharp=1.5, errors=0.1)
    terms = objective(_sure(batch, 1.02 * _inverse(batch)), batch)
    others = 3 * terms["lap1"] + terms["rmse_v"] + 0.1 * (terms["spread"] + terms["angle"])
    torch.testing.assert_close(terms["loss"], others + 5 * terms["rmse_soft"])
    unit = _inverse(batch).flatten().median()
    missed = (0.02 * _inverse(batch) / unit).square().mean().sqrt()
    torch.testing.assert_close(terms["rmse_soft"], missed, rtol=1e-3, atol=0)
    sharp = objective(_sure(batch, 1.02 * _inverse(batch)), _slope_batch())
    assert float(sharp["rmse_soft"]) == float(terms["rmse_sharp"]) == 0
    torch.testing.assert_close(sharp["rmse_sharp"], terms["rmse_soft"])
    torch.testing.assert_close(sharp["loss"], others + 1.5 * sharp["rmse_sharp"])


def test_the_likelihood_is_best_where_the_expected_error_is_the_mean_error():
    batch = _slope_batch()
    ripple = 1 + 0.01 * torch.sin(torch.arange(16.0, dtype=torch.float64))
    disparity = _inverse(batch) * ripple
    off = ripple.log().abs().mean()
    pair = SurfacePair(batch["bf"] / disparity, batch["depth"], batch["rays"])
    chord = (pair.normals[0] - pair.normals[1]).square().sum(dim=1).sqrt()
    tilt = (2 * (chord / 2).asin()).mean()
    for name, truth in (("spread", off), ("angle", tilt)):
        found = []
        for factor in (0.8, 1.0, 1.25):
            reported = {"spread": 0.1, "angle": 0.1} | {name: factor * float(truth)}
            found.append(float(SurfaceObjective()(_sure(batch, disparity, **reported), batch)[name]))
        assert found[1] < min(found[0], found[2]), name


def test_holes_of_the_truth_and_results_behind_infinity_count_for_nothing():
    batch = _slope_batch(soft=1.0)
    disparity = (1.01 * _inverse(batch)).requires_grad_()
    holes = {**batch, "depth": batch["depth"].clone()}
    holes["depth"][..., 4:8, 4:8] = torch.nan
    with torch.no_grad():
        disparity[..., 0, 0] = -1.0
    terms = SurfaceObjective()(_sure(holes, disparity), holes)
    assert all(bool(value.isfinite()) for value in terms.values())
    terms["loss"].backward()
    gradient = disparity.grad
    assert bool(gradient.isfinite().all())
    assert not bool(gradient[..., 5:7, 5:7].any())


class Remembering(FacetsUNet):
    """A small network that remembers the maps that it got."""

    def answer(self, rgb, disparity, *arguments, **others):
        self.seen = disparity
        return super().answer(rgb, disparity, *arguments, **others)


@pytest.mark.parametrize("doffs", [0.0, 3.0])
def test_networks_of_inverse_depth_get_it_where_disparity_has_an_offset(doffs):
    torch.manual_seed(0)
    batch = _slope_batch(replace(SLOPE, doffs=doffs))
    net = Remembering(4, 8, 8, 3)
    module = SuperResolution(net, SurfaceObjective())
    expected = (batch["bf"] * Downsampling("box")(batch["depth"][0].reciprocal(), 4)[None]).to(torch.float32)
    terms = module.loss_terms(batch)
    torch.testing.assert_close(net.seen.float(), expected, rtol=1e-5, atol=0)
    plain = module.loss_terms(_slope_batch())
    torch.testing.assert_close(terms["loss"], plain["loss"], rtol=1e-4, atol=1e-4)
