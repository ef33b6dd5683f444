"""The paper's metrics against plain numpy and scikit-image code, and the torchmetrics classes: means over images."""

import copy
import math
import pickle
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from reference_metrics import Intrinsics, reference_scores
from scipy import ndimage
from small_lpips import random_lpips

from dsr.geometry.camera import Camera
from dsr.metrics import functional
from dsr.metrics.catalogue import catalogue
from dsr.metrics.classes import DSSIMv, LPIPSv, PerImageMean, RMSEd, compute_means, visual_metrics
from dsr.metrics.functional import SurfacePair, dssim_v, masked_median, mse_v, rmse_d, rmse_v
from dsr.sample import Unit


class Maps(NamedTuple):
    """A predicted and a true depth map, (H, W), and their camera."""

    prediction: np.ndarray
    target: np.ndarray
    camera: Camera


def _maps(size=(32, 48), seed=0, *, holes=False):
    """Return two smooth surfaces with a depth step, that differ by a few centimetres."""
    height, width = size
    random = np.random.default_rng(seed)
    smooth = [ndimage.gaussian_filter(random.normal(size=size), 3, mode="nearest") for _ in range(2)]
    target = 2 + 0.5 * smooth[0] + 0.4 * (np.arange(width) > 0.6 * width)
    prediction = target + 0.4 * smooth[1] + 0.0005 * random.normal(size=size)
    prediction[20:23, 2:5] += 0.4  # more than 10 % of the depth
    if holes:
        target[random.random(size) < 0.01] = np.nan
        target[5:13, 7:15] = np.nan
        target[-1, -4:] = np.nan
        prediction[random.random(size) < 0.01] = np.nan
        prediction[0, :3] = np.nan
    return Maps(prediction, target, Camera(width, height, 60.0, 63.0, 0.45 * width, 0.55 * height))


def _pair(maps, mask=None, dtype=torch.float64):
    prediction, target = (torch.from_numpy(values)[None, None].to(dtype) for values in maps[:2])
    torch_mask = None if mask is None else torch.from_numpy(mask)[None, None]
    return SurfacePair(prediction, target, maps.camera.rays()[None], torch_mask)


def _reference(maps, mask=True):
    intrinsics = Intrinsics(maps.camera.fx, maps.camera.fy, maps.camera.cx, maps.camera.cy)
    return reference_scores(maps.prediction, maps.target, intrinsics, mask)


METRICS = {metric.name: metric.function for metric in catalogue()}
every_metric = pytest.mark.parametrize("name", METRICS)


@every_metric
def test_metric_equals_the_protocol_in_plain_numpy(name):
    for size in ((32, 48), (41, 29)):
        maps = _maps(size)
        value = METRICS[name](_pair(maps))[0].numpy()
        assert (value > 0.001).all()  # the maps do differ in the metric's eyes
        np.testing.assert_allclose(value, _reference(maps)[name], rtol=1e-6)


@every_metric
@pytest.mark.parametrize("masked", [False, True])
def test_metric_with_holes_equals_that_of_the_valid_pixels(name, masked):
    maps = _maps((41, 29), holes=True)
    mask = np.random.default_rng(5).random((41, 29)) < 0.98 if masked else None
    expected = _reference(maps, mask if masked else True)[name]
    np.testing.assert_allclose(METRICS[name](_pair(maps, mask))[0].numpy(), expected, rtol=1e-6)


def test_wall_offset_is_measured_along_the_rays():
    camera = Camera(5, 4, 5.0, 5.0, 1.5, 1.5)
    pair = _pair(Maps(np.full((4, 5), 2.1), np.full((4, 5), 2.0), camera))
    expected = 0.1 * np.sqrt((np.linalg.norm(camera.rays().numpy(), axis=0) ** 2).mean())
    assert rmse_d(pair).item() == pytest.approx(expected, rel=1e-12)
    assert rmse_v(pair).item() == pytest.approx(0, abs=1e-12)
    torch.testing.assert_close(mse_v(_pair(_maps())), rmse_v(_pair(_maps())) ** 2)


@every_metric
def test_metric_of_float32_renderings_equals_float64_to_a_ten_thousandth(name):
    maps = _maps(holes=True)
    wide = _pair(maps)
    narrow = SurfacePair(wide.prediction, wide.target, wide.rays, wide.depth_mask, image_dtype=torch.float32)
    assert narrow.normals[0].dtype == torch.float32
    torch.testing.assert_close(METRICS[name](narrow).double(), METRICS[name](wide), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("name", [name for name in METRICS if not name.startswith("BadPix")])
@pytest.mark.parametrize("holes", [False, True])
def test_gradients_are_finite_and_zero_at_holes(name, holes):
    maps = _maps(holes=holes)
    depth = torch.from_numpy(maps.prediction)[None, None].requires_grad_()
    pair = SurfacePair(depth, torch.from_numpy(maps.target)[None, None], maps.camera.rays()[None])
    METRICS[name](pair).sum().backward()
    assert bool(depth.grad.isfinite().all())
    assert bool(depth.grad.any())
    if holes:
        assert not bool(depth.grad[~pair.depth_mask].any())


@pytest.mark.parametrize("size", [(6, 20), (20, 6)])
def test_dssim_of_a_map_smaller_than_the_window_is_refused(size):
    maps = _maps((20, 20))
    small = Maps(*(z[: size[0], : size[1]] for z in maps[:2]), maps.camera.crop(0, 0, *size))
    with pytest.raises(ValueError, match="DSSIM_v: expected"):
        dssim_v(_pair(small))


def test_inputs_that_do_not_fit_together_are_refused():
    depth, rays = torch.ones(2, 1, 4, 5), torch.ones(1, 3, 4, 5)
    for first, second in ((depth[0], depth[0]), (depth, depth[:1]), (depth.expand(2, 3, 4, 5),) * 2):
        with pytest.raises(ValueError, match=r"^prediction, target: expected"):
            SurfacePair(first, second, rays)
    for wrong in (rays[0], rays[:, :2], rays[..., :4]):
        with pytest.raises(ValueError, match=r"^rays: expected shape \(B or 1, 3, 4, 5\), got"):
            SurfacePair(depth, depth, wrong)
    for mask in (depth, depth[:1] > 0):
        with pytest.raises(ValueError, match=r"^mask: expected bool of shape \(2, 1, 4, 5\), got"):
            SurfacePair(depth, depth, rays, mask)


@every_metric
def test_non_positive_depth_is_a_hole(name):
    maps = _maps()
    values = []
    for wrong in (np.nan, 0.0, -3.0):
        prediction = maps.prediction.copy()
        prediction[3:9, 4:20] = wrong
        values.append(METRICS[name](_pair(maps._replace(prediction=prediction))))
    assert torch.equal(values[0], values[1])
    assert torch.equal(values[0], values[2])


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8])
def test_masked_median_is_numpys(count):
    values = torch.randn(1, 1, 2, 4, generator=torch.Generator().manual_seed(count), dtype=torch.float64)
    mask = torch.zeros(8, dtype=torch.bool)
    mask[:count] = True
    mask = mask.flip(0).view(1, 1, 2, 4)
    found = masked_median(values, mask)
    expected = np.median(values[mask].numpy()) if count else np.nan
    assert found.shape == (1, 1, 1, 1)
    assert found.item() == pytest.approx(expected, nan_ok=True)


CAMERA = Camera(width=40, height=36, fx=40.0, fy=40.0, cx=20.0, cy=18.0)


@pytest.fixture(scope="module")
def network():
    return random_lpips()


def _ramp(seed, batch=1):
    """Return maps whose error is 0.002 ... 0.5 m, so that every threshold splits their pixels."""
    random = np.random.default_rng(seed)
    ramp = np.linspace(0.002, 0.5, 40)[None, None, None]
    target = 2 + 0.004 * random.random((batch, 1, 36, 40))
    prediction = target + ramp * (1 + 0.02 * random.random((batch, 1, 36, 40)))
    return SurfacePair(torch.from_numpy(prediction), torch.from_numpy(target), CAMERA.rays()[None])


def _given(pair):
    """Return what users of torchmetrics have."""
    return pair.prediction, pair.target, CAMERA


exactly = partial(torch.testing.assert_close, rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", METRICS)
def test_metric_is_the_mean_over_images_not_over_batches_of_the_worst_light(name):
    metric, worst = PerImageMean(name), []
    for pair in (_ramp(0, batch=3), _ramp(1)):
        worst.append(METRICS[name](pair).view(len(pair.target), -1).amax(dim=1))
        exactly(metric(*_given(pair)), worst[-1].mean())
    assert bool((torch.cat(worst) > 0).all())
    exactly(metric.compute(), torch.cat(worst).mean())


@pytest.mark.parametrize("variant", ["e1", "e2", "e3", "e4", "max", "avg"])
def test_variants_choose_among_the_lights_image_by_image(variant):
    metric, pairs = DSSIMv(variant=variant), [_ramp(0, batch=2), _ramp(1)]
    for pair in pairs:
        metric.update(pair)
    values = torch.cat([functional.dssim_v(pair) for pair in pairs])
    chosen = dict(zip(("e1", "e2", "e3", "e4"), values.unbind(1), strict=True))
    chosen |= {"max": values.amax(dim=1), "avg": values.mean(dim=1)}
    exactly(metric.compute(), chosen[variant].mean())


def test_masked_pixels_do_not_count_and_rays_of_one_camera_serve_a_batch():
    pair = _ramp(0, batch=2)
    mask = torch.rand(pair.target.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    expected = functional.rmse_d(SurfacePair(*pair.given, pair.rays, mask)).mean()
    for camera in (CAMERA, CAMERA.rays()):
        exactly(RMSEd()(pair.prediction, pair.target, camera, mask), expected)
    assert not torch.allclose(expected, functional.rmse_d(pair).mean(), rtol=1e-3)


def test_images_that_cannot_be_scored_are_left_out():
    hole = torch.full((1, 1, 36, 40), torch.nan, dtype=torch.float64)
    for make in (RMSEd, DSSIMv):
        metric, alone = make(), make()
        alone.update(_ramp(0))
        metric.update(SurfacePair(hole, hole, CAMERA.rays()[None]))
        metric.update(_ramp(0))
        assert metric.compute().item() == pytest.approx(alone.compute().item(), rel=1e-12)


def test_states_of_two_processes_add_up_and_one_that_a_metric_is_for_suffices(network):
    here, there = (visual_metrics(network, protocols=("paper", "field")) for _ in range(2))
    levels = SurfacePair(*_ramp(1).given, _ramp(1).rays, unit=Unit("levels", inverse=True, factor=8.0))
    here(_ramp(0, batch=2))
    there(levels)
    there = pickle.loads(pickle.dumps(there))
    for metric, other in zip(here.values(), there.values(), strict=True):
        metric.merge_state(other)
    means = compute_means(here)
    assert {"RMSE_cm", "RMSE_levels"} < set(means)
    both = torch.cat([functional.rmse_d(pair) for pair in (_ramp(0, batch=2), levels)])
    torch.testing.assert_close(means["RMSE_d"], both.mean(), rtol=1e-12, atol=0)
    here.reset()
    here(_ramp(0))
    assert "RMSE_levels" not in compute_means(here)


def test_the_perceptual_network_moves_along(network):
    metric = copy.deepcopy(LPIPSv(network)).to("meta")
    value = metric(*(each.to("meta") for each in _given(_ramp(0))[:2]), CAMERA)
    assert value.device.type == metric.applied.device.type == "meta"
    assert not metric.state_dict()
    assert all(each.device.type == "cpu" for each in network.parameters())


def test_metrics_that_agree_on_the_first_image_stay_separate():
    metrics, pair = visual_metrics(), _ramp(0)
    metrics.update(SurfacePair(pair.target, pair.target, pair.rays))  # all of them 0
    metrics.update(pair)
    values = metrics.compute()
    for percent in (1, 5, 10):
        assert values[f"BadPix_d_{percent}cm"].item() == functional.bad_pix_d(pair, percent / 100).item() / 2
        assert values[f"BadPix_v_{percent}"].item() == functional.bad_pix_v(pair, percent).max().item() / 2
    for name, function in METRICS.items():
        assert values[name].item() == pytest.approx(function(pair).max().item() / 2, rel=1e-9, abs=1e-9)


def test_mean_is_nan_where_a_prediction_leaves_nothing_to_score():
    metric = RMSEd()
    metric.update(_ramp(0))
    target = torch.full((1, 1, 36, 40), 2.0, dtype=torch.float64)
    metric.update(SurfacePair(-target, target, CAMERA.rays()[None]))
    assert math.isnan(metric.compute())


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: RMSEd().update(_ramp(0).prediction), "target: expected preds, target and camera"),
        (lambda: SurfacePair.of(_ramp(0), mask=_ramp(0).target > 2), "preds: expected a SurfacePair alone"),
        (lambda: DSSIMv(variant="e5"), "variant: expected .*got 'e5'"),
        (lambda: PerImageMean("RMSEd"), "metric: expected .*RMSE_d.*got 'RMSEd'"),
    ],
)
def test_metrics_of_something_else_are_refused(act, message):
    with pytest.raises(ValueError, match=message):
        act()
