"""All scores of one image: their names, their values, and the share of pixels that each rests on."""

import math

import numpy as np
import pytest
import torch
from depth_steps import holed, pair_of, steps
from small_lpips import random_lpips
from small_scenes import grid

from dsr.geometry.camera import Camera
from dsr.metrics import functional
from dsr.metrics.catalogue import PROTOCOLS, catalogue, score_image
from dsr.metrics.functional import SurfacePair

CAMERA = Camera(width=48, height=40, fx=50.0, fy=50.0, cx=24.0, cy=20.0)
WITHOUT_LIGHTS = {
    "RMSE_d",
    *(f"BadPix_d_{percent}cm" for percent in (1, 5, 10)),
    *(f"BadPix_d_{percent}pct" for percent in (1, 5, 10)),
    *("RMSE_v", "Bumpiness_d"),
}
WITH_LIGHTS = {*(f"BadPix_v_{level}" for level in (1, 5, 10)), "DSSIM_v", "LPIPS_v", "RMSE_v1"}


@pytest.fixture(scope="module")
def network():
    return random_lpips()


def _maps(seed=0):
    random = np.random.default_rng(seed)
    target = 2 + 0.01 * random.random((1, 40, 48))
    prediction = target + np.linspace(0.002, 0.5, 48) * (1 + 0.02 * random.random((1, 40, 48)))
    return torch.from_numpy(prediction), torch.from_numpy(target)


def _scores(prediction, target, network=None):
    scores = list(score_image(prediction, target, CAMERA.rays(), catalogue(network)))
    rows = {(score.metric, score.variant): score for score in scores}
    assert len(rows) == len(scores)
    return rows


def test_metrics_and_variants_are_those_of_the_paper(network):
    variants = {"e1", "e2", "e3", "e4", "max", "avg"}
    expected = {(name, "") for name in WITHOUT_LIGHTS} | {(name, v) for name in WITH_LIGHTS for v in variants}
    assert set(_scores(*_maps(), network)) == expected
    assert {metric.name for metric in catalogue()} == WITHOUT_LIGHTS | WITH_LIGHTS - {"LPIPS_v"}


@pytest.mark.parametrize(
    "cut", [(slice(0, 39), slice(0, 47)), (slice(2, 40), slice(0, 48)), (slice(1, 38), slice(5, 44))]
)
def test_pixels_outside_the_predictions_window_are_cropped_first(cut):
    prediction, target = _maps()
    partial = torch.full_like(prediction, torch.nan)
    partial[(..., *cut)] = prediction[(..., *cut)]
    rows = _scores(partial, target)
    window = CAMERA.crop(cut[0].start, cut[1].start, cut[0].stop - cut[0].start, cut[1].stop - cut[1].start)
    metrics = catalogue()
    expected = list(score_image(prediction[(..., *cut)], target[(..., *cut)], window.rays(), metrics))
    assert len(rows) == len(expected)
    for score in expected:
        row = rows[score.metric, score.variant]
        assert row.value == pytest.approx(score.value, rel=1e-5)
        assert row.valid_share == pytest.approx(window.height * window.width / (40 * 48), rel=1e-12)


def test_inner_hole_is_left_out_and_each_metric_reports_its_valid_fraction():
    prediction, target = _maps()
    prediction[0, 10, 20] = torch.nan
    target[0, 30, 40] = torch.nan
    rows = _scores(prediction, target)
    pixels = 40 * 48
    assert rows["RMSE_d", ""].valid_share == pytest.approx(1 - 2 / pixels, rel=1e-12)
    assert rows["BadPix_d_5pct", ""].valid_share == pytest.approx(1 - 2 / pixels, rel=1e-12)
    for name in ("BadPix_v_5", "RMSE_v1"):  # a normal needs its right and its lower neighbour
        assert rows[name, "max"].valid_share == pytest.approx(1 - 6 / pixels, rel=1e-12)
    assert rows["RMSE_v", ""].valid_share == pytest.approx(1 - 6 / pixels, rel=1e-12)
    assert rows["DSSIM_v", "e1"].valid_share == pytest.approx(1 - 6 / (34 * 42), rel=1e-12)
    assert rows["Bumpiness_d", ""].valid_share == pytest.approx(1 - 2 * 25 / pixels, rel=1e-12)
    pair = SurfacePair(prediction[None], target[None], CAMERA.rays()[None])
    assert rows["RMSE_d", ""].value == pytest.approx(functional.rmse_d(pair).item(), rel=1e-12)
    assert rows["DSSIM_v", "e1"].value == pytest.approx(functional.dssim_v(pair)[0, 0].item(), rel=1e-4)


def test_holes_of_the_truth_do_not_shrink_the_window():
    prediction, target = _maps()
    target[:, :4] = torch.nan
    rows = _scores(prediction, target)
    assert rows["RMSE_d", ""].valid_share == pytest.approx(36 / 40, rel=1e-12)
    assert rows["RMSE_v", ""].valid_share == pytest.approx(36 / 40, rel=1e-12)
    assert rows["DSSIM_v", "max"].valid_share == pytest.approx(33 / 34, rel=1e-12)  # of the rows 3 ... 36, but row 3


every_protocol = pytest.mark.parametrize("protocol", PROTOCOLS)


@every_protocol
def test_scores_of_a_batch_are_those_of_its_images(protocol, network, one_thread):
    maps = [holed(), steps(1)]
    maps[1][0][5:9, 10:50] = np.nan

    def pair(*given):
        found = pair_of(*given)
        errors = 0.1 * found.given[0], 10 * found.given[0]
        regions = {"planes": torch.ones_like(found.target, dtype=torch.uint8)}
        stated = {"depth_error": errors[0], "angle_error": errors[1], "measured": 1.01 * found.target}
        return found.replaced(regions=regions, **stated)

    batch, singles = pair(*(np.stack(each) for each in zip(*maps, strict=True))), [pair(*each) for each in maps]
    for metric in catalogue(network, protocols=(protocol,)):
        if metric.applies(batch):
            for variant, values in metric.variants(batch).items():
                expected = torch.cat([metric.variants(each)[variant] for each in singles])
                torch.testing.assert_close(values, expected, rtol=1e-5, atol=1e-6, msg=metric.name)


@every_protocol
def test_images_without_truth_or_prediction_have_no_score(protocol, network):
    depth, nothing = torch.full((1, 40, 48), 2.0), torch.full((1, 40, 48), torch.nan)
    metrics, errors = catalogue(network, protocols=(protocol,)), (depth, depth)
    rows = list(score_image(depth, nothing, CAMERA.rays(), metrics, errors=errors))
    assert rows
    assert all(math.isnan(row.value) for row in rows)
    if protocol not in ("evalmde", "boundaries"):
        rows = list(score_image(nothing, depth, CAMERA.rays(), metrics, errors=errors))
        assert all(row.value == 0 if row.metric.endswith("covered") else math.isnan(row.value) for row in rows)
        assert protocol != "paper" or all(row.valid_share == 0 for row in rows)


@pytest.mark.parametrize(
    ("size", "scored"),
    [
        ((24, 30), {"RMSE_d", "BadPix_d_5cm", "BadPix_v_5", "RMSE_v", "RMSE_v1", "Bumpiness_d", "DSSIM_v"}),
        ((6, 30), {"RMSE_d", "BadPix_d_5cm", "BadPix_v_5", "RMSE_v", "RMSE_v1", "Bumpiness_d"}),
    ],
)
def test_window_too_small_for_one_metric_is_scored_by_the_others(network, size, scored):
    prediction, target = _maps()
    patch = torch.full_like(prediction, torch.nan)
    window = (..., slice(5, 5 + size[0]), slice(8, 8 + size[1]))
    patch[window] = prediction[window]
    for score in _scores(patch, target, network).values():
        if score.metric in scored:
            assert math.isfinite(score.value)
            assert score.valid_share == pytest.approx(size[0] * size[1] / (40 * 48), rel=1e-12)
        if score.metric == "LPIPS_v" or (score.metric == "DSSIM_v" and "DSSIM_v" not in scored):
            assert math.isnan(score.value)
            assert score.valid_share == 0


def test_metrics_of_a_region_are_those_of_its_pixels_alone():
    target = torch.full((1, 40, 48), 2.0, dtype=torch.float64)
    prediction = target.clone()
    prediction[:, 10:20, 5:30] += 0.1
    glass = torch.zeros((1, 40, 48), dtype=torch.uint8)
    glass[:, 10:20, 5:30] = 1
    regions = {"glass": glass, "outside": 1 - glass}
    metrics = catalogue(protocols=["sensor", "depth", "paper"], regions=["glass", "outside", "edges"])
    rows = {row.metric: row for row in score_image(prediction, target, CAMERA.rays(), metrics, regions=regions)}
    assert rows["Depth_AbsRel@glass"].value == pytest.approx(0.05)
    assert rows["Depth_AbsRel@glass"].valid_share == pytest.approx(250 / 1920)
    assert rows["Depth_AbsRel@outside"].value == 0
    assert rows["Depth_AbsRel"].value == pytest.approx(0.05 * 250 / 1920)
    assert "RMSE_v@glass" in rows
    assert not any(name.endswith("@edges") or name.startswith(("DSSIM_v@", "Sensor_RMSE_v@")) for name in rows)
    assert metrics[-1].format.unit.startswith("edges")


def _half_planes():
    """Return a wall that recedes to the right, and its upper and lower half as planes 1 and 2."""
    v, u = grid(40, 48)
    return 1 / (0.5 + 0.002 * (u - CAMERA.cx))[None], (1 + (v >= 20))[None].to(torch.uint8), u.remainder(2) - 0.5


def test_holes_neither_hide_a_bad_plane_nor_a_bad_region():
    target, planes, wave = _half_planes()
    prediction = target * (1 + 0.02 * (planes == 2) * wave)
    holed = prediction.masked_fill(planes == 2, torch.nan)
    glass = (planes == 2).to(torch.uint8)
    metrics = catalogue(protocols=["boundaries", "depth", "normals"], regions=["glass"])
    regions = {"planes": planes, "glass": glass}
    whole, less = (
        {row.metric: row.value for row in score_image(maps, target, CAMERA.rays(), metrics, regions=regions)}
        for maps in (prediction, holed)
    )
    assert whole["PE_flatness"] > 1e-3
    assert math.isnan(less["PE_flatness"])
    assert (whole["PE_covered"], less["PE_covered"]) == (1, 0.5)
    assert (whole["Depth_covered@glass"], less["Depth_covered@glass"]) == (1, 0)
    assert less["Normal_covered@glass"] == 0
