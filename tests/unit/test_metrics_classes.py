"""The torchmetrics classes: means over images of the pure functions' values, and nothing of LPIPS in checkpoints."""

import copy
import math
import pickle
from functools import partial

import numpy as np
import pytest
import torch
from small_lpips import random_lpips
from torch import nn

from dsr.geometry.camera import Camera
from dsr.metrics import functional
from dsr.metrics.classes import (
    DSSIMv,
    LPIPSv,
    PerImageMean,
    RMSEd,
    compute_means,
    visual_metrics,
)
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS
from dsr.sample import Unit

CAMERA = Camera(width=40, height=36, fx=40.0, fy=40.0, cx=20.0, cy=18.0)


@pytest.fixture(scope="module")
def network():
    return random_lpips()


def _pair(seed, batch=1):
    """Return maps whose error is 0.002 ... 0.5 m, so that every threshold splits their pixels."""
    random = np.random.default_rng(seed)
    ramp = np.linspace(0.002, 0.5, 40)[None, None, None]
    target = 2 + 0.004 * random.random((batch, 1, 36, 40))
    prediction = target + ramp * (1 + 0.02 * random.random((batch, 1, 36, 40)))
    return SurfacePair(torch.from_numpy(prediction), torch.from_numpy(target), CAMERA.rays()[None])


def _maps(pair):
    """Return what users of torchmetrics have."""
    return pair.prediction, pair.target, CAMERA


def _unknown():
    hole = torch.full((1, 1, 36, 40), torch.nan, dtype=torch.float64)
    return SurfacePair(hole, hole, CAMERA.rays()[None])


FUNCTIONS = {
    "RMSE_d": functional.rmse_d,
    "BadPix_d_5cm": partial(functional.bad_pix_d, threshold=0.05),
    "BadPix_d_10cm": partial(functional.bad_pix_d, threshold=0.1),
    "BadPix_d_1pct": partial(functional.bad_pix_d, threshold=0.01, relative=True),
    "RMSE_v": functional.rmse_v,
    "Bumpiness_d": functional.bumpiness_d,
    "BadPix_v_5": partial(functional.bad_pix_v, threshold=5),
    "DSSIM_v": functional.dssim_v,
    "RMSE_v1": functional.rmse_v1,
}
exactly = partial(torch.testing.assert_close, rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_metric_is_the_mean_over_images_not_over_batches_of_the_worst_light(name):
    metric, worst = PerImageMean(name), []
    for pair in (_pair(0, batch=3), _pair(1)):
        worst.append(FUNCTIONS[name](pair).view(len(pair.target), -1).amax(dim=1))
        exactly(metric(*_maps(pair)), worst[-1].mean())
    assert bool((torch.cat(worst) > 0).all())
    exactly(metric.compute(), torch.cat(worst).mean())


@pytest.mark.parametrize("variant", ["e1", "e2", "e3", "e4", "max", "avg"])
def test_variants_choose_among_the_lights_image_by_image(variant):
    metric, pairs = DSSIMv(variant=variant), [_pair(0, batch=2), _pair(1)]
    for pair in pairs:
        metric.update(pair)
    values = torch.cat([functional.dssim_v(pair) for pair in pairs])
    chosen = dict(zip(("e1", "e2", "e3", "e4"), values.unbind(1), strict=True))
    chosen |= {"max": values.amax(dim=1), "avg": values.mean(dim=1)}
    exactly(metric.compute(), chosen[variant].mean())


def test_images_that_cannot_be_scored_are_left_out():
    for make in (RMSEd, DSSIMv):
        metric, alone = make(), make()
        alone.update(_pair(0))
        metric.update(_unknown())
        metric.update(_pair(0))
        assert metric.compute().item() == pytest.approx(alone.compute().item(), rel=1e-12)


def test_states_of_two_processes_add_up_and_one_that_a_metric_is_for_suffices():
    here, there = (visual_metrics(protocols=("paper", "field")) for _ in range(2))
    levels = SurfacePair(*_pair(1).given, _pair(1).rays, unit=Unit("levels", inverse=True, factor=8.0))
    here(_pair(0, batch=2))
    there(levels)
    for metric, other in zip(here.values(), there.values(), strict=True):
        metric.merge_state(other)
    means = compute_means(here)
    assert {"RMSE_cm", "RMSE_levels"} < set(means)
    both = torch.cat([functional.rmse_d(pair) for pair in (_pair(0, batch=2), levels)])
    torch.testing.assert_close(means["RMSE_d"], both.mean(), rtol=1e-12, atol=0)
    here.reset()
    here(_pair(0))
    assert "RMSE_levels" not in compute_means(here)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda metrics: pickle.loads(pickle.dumps(metrics))])
def test_copies_go_on_from_the_state(copied, network):
    metrics = visual_metrics(network)
    metrics.update(_pair(0))
    other = copied(metrics)
    for each in (metrics, other):
        each.update(_pair(1))
    assert other.compute() == metrics.compute()


def test_the_perceptual_network_moves_along(network):
    metric = copy.deepcopy(LPIPSv(network)).to("meta")
    value = metric(*(each.to("meta") for each in _maps(_pair(0))[:2]), CAMERA)
    assert value.device.type == metric.applied.device.type == "meta"
    assert not metric.state_dict()
    assert all(each.device.type == "cpu" for each in network.parameters())


def test_metrics_that_agree_on_the_first_image_stay_separate():
    metrics, pair = visual_metrics(), _pair(0)
    metrics.update(SurfacePair(pair.target, pair.target, pair.rays))  # all of them 0
    metrics.update(pair)
    values = metrics.compute()
    for percent in (1, 5, 10):
        assert values[f"BadPix_d_{percent}cm"].item() == functional.bad_pix_d(pair, percent / 100).item() / 2
        assert values[f"BadPix_v_{percent}"].item() == functional.bad_pix_v(pair, percent).max().item() / 2
    for name, function in FUNCTIONS.items():
        assert values[name].item() == pytest.approx(function(pair).max().item() / 2, rel=1e-9, abs=1e-9)


def test_a_model_with_metrics_has_nothing_of_the_perceptual_network(network):
    model = nn.Sequential(nn.Linear(2, 1))
    model.metrics = visual_metrics(network)
    model.single = model.metrics["LPIPS_v"]
    model.metrics.update(_pair(0))
    assert set(model.state_dict()) == {name for name, _ in model.named_parameters()} == {"0.weight", "0.bias"}
    assert not any(isinstance(module, LPIPS) for module in model.modules())


def test_mean_is_nan_where_a_prediction_leaves_nothing_to_score():
    metric = RMSEd()
    metric.update(_pair(0))
    target = torch.full((1, 1, 36, 40), 2.0, dtype=torch.float64)
    metric.update(SurfacePair(-target, target, CAMERA.rays()[None]))
    assert math.isnan(metric.compute())


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: RMSEd().update(_pair(0).prediction), "target: expected preds, target and camera"),
        (lambda: SurfacePair.of(_pair(0), mask=_pair(0).target > 2), "preds: expected a SurfacePair alone"),
        (lambda: DSSIMv(variant="e5"), "variant: expected .*got 'e5'"),
        (lambda: PerImageMean("RMSEd"), "metric: expected .*RMSE_d.*got 'RMSEd'"),
    ],
)
def test_metrics_of_something_else_are_refused(act, message):
    with pytest.raises(ValueError, match=message):
        act()
