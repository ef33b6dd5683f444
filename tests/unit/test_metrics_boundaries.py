"""Boundary F1, boundary errors and planes: the values of their authors' code, closed forms, holes."""

import math

import numpy as np
import pytest
import torch
from depth_steps import CAMERA, UNKNOWN, holed, pair_of, steps

from dsr.geometry.camera import Camera
from dsr.metrics import boundaries
from dsr.metrics.catalogue import catalogue

METRICS = tuple(each for each in catalogue(protocols=("boundaries",)) if each.region is None)

pytestmark = pytest.mark.usefixtures("one_thread")


def _scores(pair):
    return {metric.name: metric.function(pair).item() for metric in METRICS}


def _flat(height, width, near=2.0):
    return np.full((height, width), near)


def _mask(array):
    return torch.from_numpy(array.astype(bool))[None, None]


def test_f1_is_that_of_the_authors_code():
    """Executed: apple/ml-depth-pro 9efe5c1, with NaN for unknown truth in both, and microsoft/MoGe 0744441, masked."""
    assert boundaries.depth_pro_scores(pair_of(*steps()))["F1"].item() == pytest.approx(0.9412966260255751, abs=1e-9)
    assert boundaries.depth_pro_scores(pair_of(*holed()))["F1"].item() == pytest.approx(0.9410074986768165, abs=1e-9)
    found = boundaries.moge_scores(pair_of(*holed()))
    assert [value.item() for value in found.values()] == pytest.approx(
        [0.9343173556422164, 0.9498005727791907, 0.9622220048683943], abs=1e-6
    )


def test_ceiling_is_the_truth_against_itself():
    _, truth = holed()
    few = _flat(8, 9)
    few[:, 4:], few[2:, 7:] = 2.3, 2.6
    for each, expected in ((truth, 1), (few, 0.21316425120772947)):
        pair = pair_of(each, each, CAMERA.crop(0, 0, *each.shape))
        assert boundaries.depth_pro_scores(pair)["F1"].item() == pytest.approx(expected)
        assert boundaries.depth_pro_scores(pair)["ceiling"].item() == pytest.approx(expected)
        assert boundaries.depth_pro_scores(pair_of(*steps()))["ceiling"].item() == 1


def test_boundary_error_is_that_of_the_authors_code():
    """Executed: Koch's v0.9 in bulatko/DepthART b2bc093, ``compute_depth_boundary_error``, 0 for holes."""
    prediction, truth = steps()
    edges = np.zeros_like(truth)
    edges[:, 24::24] = edges[18::18] = 1

    def errors(depth, true):
        found = boundaries.depth_boundaries(torch.from_numpy(depth)[None, None])
        return [each.item() for each in boundaries.depth_boundary_error(found, true)]

    assert errors(prediction, _mask(edges)) == pytest.approx([0.4078452444922085, 0.3103054352942402])
    prediction[30:40, 100:140] = np.nan
    assert errors(prediction, _mask(edges)) == pytest.approx([0.4120397428404442, 0.9073455151906227])
    assert errors(_flat(120, 160) + 1e-3 * np.arange(160), _mask(edges)) == [10, 10]
    assert errors(np.full_like(truth, np.nan), _mask(edges)) == [10, 10]
    assert all(map(math.isnan, errors(prediction, _mask(np.zeros_like(edges)))))
    prediction, truth = holed()
    prediction[UNKNOWN] = np.nan  # unknown truth is left out of both maps
    own = boundaries.depth_boundaries(torch.from_numpy(truth)[None, None])
    assert errors(prediction, own) == pytest.approx([0.2465675057208238, 0.3090241343126967])
    found = _scores(pair_of(*holed()))
    assert [found["DBE_accuracy"], found["DBE_completeness"]] == errors(prediction, own)


def test_directed_error_is_that_of_the_authors_code_from_a_metre_on():
    """Executed: the same file's ``compute_directed_depth_error`` of the pixels with a truth."""
    found = boundaries.directed_depth_error(pair_of(*holed()))
    assert list(found.values()) == pytest.approx([0.95440552, 0.00244161, 0.04315287], abs=1e-8)


def _planarity(prediction, truth, planes, camera=CAMERA):
    pair = pair_of(prediction, truth, camera)
    found = boundaries.planarity(pair.replaced(regions={"planes": torch.from_numpy(planes)[None, None]}))
    return found["flatness"].item(), found["orientation"].item()


def test_planarity_is_that_of_the_authors_code():
    """Executed: the same file's ``compute_planarity_error``, of a large plane; another is too small."""
    planes = np.ones((120, 160), np.uint8)
    planes[:10], planes[:4] = 0, 2
    assert _planarity(*holed(), planes)[0] == pytest.approx(0.3394655151, rel=1e-5)


def test_planarity_of_planes_is_exact():
    camera = Camera(80, 60, 70.0, 71.0, 40.0, 30.0)
    rays = camera.rays().numpy().astype(float)
    true, tilted = np.array((0.1, 0.2, 1.0)), np.array((0.1, 0.5, 1.0))
    planes = np.ones((60, 80), np.uint8)
    planes[30:] = 2
    maps = [2 / np.einsum("c,chw->hw", each, rays) for each in (true, tilted)]
    maps[1][:30] = 3 * maps[0][:30]  # a factor is no error
    maps[1][2, 3:9] = np.nan
    angle = math.degrees(math.acos(true @ tilted / np.linalg.norm(true) / np.linalg.norm(tilted)))
    assert _planarity(maps[1], maps[0], planes, camera) == pytest.approx((0, angle / 2), abs=1e-4)
    # a wave of amplitude 1 cm about a plane that faces the camera
    wave = 2 + 0.01 * np.where(np.indices((60, 80)).sum(axis=0) % 2, 1, -1)
    flatness, _ = _planarity(wave, np.full_like(wave, 2), np.ones_like(planes), camera)
    assert flatness == pytest.approx(0.01, rel=1e-2)


def test_holes_of_a_prediction_miss_the_edges_there_and_are_reported():
    _, truth = steps()
    prediction = truth.copy()
    full = _scores(pair_of(prediction, truth))
    prediction[30:60, 30:90] = np.nan
    part = _scores(pair_of(prediction, truth))
    assert all(
        part[name] < 0.95 and full[name] == pytest.approx(1)
        for name in ("DepthPro_F1", "MoGe_F1_1", "MoGe_F1_2", "MoGe_F1_3")
    )
    assert part["DBE_completeness"] > full["DBE_completeness"] == 0
    assert part["DepthPro_ceiling"] == full["DepthPro_ceiling"]
    assert part["Boundary_covered"] == pytest.approx(1 - 30 * 60 / truth.size)
