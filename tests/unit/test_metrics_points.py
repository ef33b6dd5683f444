"""Flying pixels, Chamfer distance and F-score, against all pairs of points."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from dsr.geometry.camera import Camera
from dsr.metrics.catalogue import catalogue, score_image

CAMERA = Camera(width=48, height=40, fx=60.0, fy=60.0, cx=23.5, cy=19.5)
RAYS = CAMERA.rays()[None]
V, U = np.mgrid[:40, :48].astype(float)
STEP = np.where(U < 24, 1.0, 2.0)
METRICS = catalogue(protocols=("points",))


def _scores(prediction, truth):
    maps = (torch.as_tensor(each, dtype=torch.float64)[None] for each in (prediction, truth))
    return {row.metric: row.value for row in score_image(*maps, RAYS[0], METRICS)}


def _holed(seed):
    """Return a prediction with errors from millimetres to decimetres, and a truth with a step; both have holes."""
    phase = np.sin(0.9 * U + 1.7 * V + seed)
    truth = STEP + 0.1 * np.sin(0.3 * V)
    prediction = truth * (1 + 0.02 * phase**3) + np.where(np.abs(U - 24) < 3, 0.4, 0)
    prediction[5:9, 3:9], truth[20:24, 30:33] = np.nan, np.nan
    return prediction, truth


def _naive(prediction, truth):
    rays = RAYS[0].permute(1, 2, 0).numpy()
    true, both = np.isfinite(truth), np.isfinite(truth) & np.isfinite(prediction)
    apart = cdist((prediction[..., None] * rays)[both], (truth[..., None] * rays)[true])
    there, back = apart.min(axis=1), apart.min(axis=0)
    apart_map = np.zeros(truth.shape)
    apart_map[both] = there
    edges = [  # row, column, front, back
        (*place, *sorted(depths))
        for v, u in np.ndindex(truth.shape)
        for v2, u2 in ((v, u + 1), (v + 1, u))
        if v2 < 40 and u2 < 48 and max(depths := (truth[v, u], truth[v2, u2])) / min(depths) > 1.05
        for place in ((v, u), (v2, u2))
    ]
    row, column, front, back_side = np.array(edges).T
    fly = 0
    for v, u in np.argwhere(both):
        near = np.maximum(abs(row - v), abs(column - u)) <= 16
        z = prediction[v, u]
        fly += near.any() and front[near].min() < z < back_side[near].max() and apart_map[v, u] > 0.01 * z
    f = {}
    for limit in (1, 5):
        precision, recall = (there < limit / 100).mean(), (back < limit / 100).mean()
        f[f"Points_F_{limit}cm"] = 2 * precision * recall / (precision + recall)
    return {
        "Points_flying": fly / both.sum(),
        "Points_chamfer": (there.mean() + back.mean()) / 2,
        **f,
        "Points_covered": both.sum() / true.sum(),
    }


@pytest.mark.parametrize("seed", [0, 1])
def test_scores_are_those_of_all_pairs_of_points(seed):
    prediction, truth = _holed(seed)
    found = _scores(prediction, truth)
    assert found == pytest.approx(_naive(prediction, truth), rel=1e-10)
    assert 0 < found["Points_flying"] < 0.3
    assert 0.1 < found["Points_F_1cm"] < found["Points_F_5cm"] < 1


def test_only_points_in_the_void_between_surfaces_fly():
    between = np.where(U == 24, 1.5, STEP)  # a column in the middle of the step
    assert _scores(between, STEP)["Points_flying"] == pytest.approx(1 / 48)
    assert _scores(np.where(np.abs(U - 24) < 4, np.where(U < 24, 2, 1), STEP), STEP)["Points_flying"] == 0  # moved edge
    assert _scores(np.where(U == 24, 2.5, STEP), STEP)["Points_flying"] == 0  # behind both
    assert _scores(np.where(U == 24, 0.5, STEP), STEP)["Points_flying"] == 0  # before both
    assert _scores(np.where(U == 45, 1.5, STEP), STEP)["Points_flying"] == 0  # far from the edge
    assert _scores(np.where(U == 24, 1.04, STEP), np.where(U < 24, 1.0, 1.045))["Points_flying"] == 0  # no edge


def test_hole_does_not_win():
    prediction = np.where(U == 24, 1.5, STEP)
    without = np.where(np.abs(U - 24) < 4, np.nan, STEP)
    found, holed = _scores(prediction, STEP), _scores(without, STEP)
    assert holed["Points_flying"] == 0
    assert holed["Points_covered"] == pytest.approx(41 / 48)
    assert holed["Points_F_1cm"] < found["Points_F_1cm"]
    nothing = _scores(np.full_like(U, np.nan), STEP)
    assert nothing.pop("Points_covered") == 0
    assert all(math.isnan(value) for value in nothing.values())
