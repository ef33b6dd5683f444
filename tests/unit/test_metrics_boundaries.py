"""Edges, planes, points and relative depth, by their authors' codes and against all pairs; what holes do to them."""

import math

import numpy as np
import pytest
import torch
from depth_steps import CAMERA, UNKNOWN, holed, pair_of, steps
from scipy.spatial.distance import cdist

from dsr.geometry.camera import Camera
from dsr.metrics import boundaries, evalmde
from dsr.metrics.catalogue import catalogue, score_image

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


EVALMDE = catalogue(protocols=("evalmde",))


def _evalmde(pair):
    return {metric.name.removeprefix("EvalMDE_"): metric.function(pair).item() for metric in EVALMDE}


def test_scores_of_their_example_are_those_of_their_code(shared):
    folder = shared / "expected" / "evalmde"
    stored, prediction = (np.load(folder / name) for name in ("gt_depth.npz", "depthpro_gt_focal.npz"))
    truth = np.where(stored["valid"], stored["depth"], np.nan)
    camera = Camera(truth.shape[1], truth.shape[0], *map(float, stored["intr"]))
    found = _evalmde(pair_of(prediction["depth"], truth, camera))
    assert found["RelNormal"] == pytest.approx(0.3900358, abs=2e-6)
    assert 1 - found["WKDR"] == pytest.approx(0.935941, abs=1e-6)
    assert 1 - found["beyond_disparity"] == pytest.approx(0.0821814, abs=1e-6)
    assert 1 - found["beyond_depth"] == pytest.approx(0.0192955, abs=1e-6)
    assert 1 - found["boundary"] == pytest.approx(0.4865937, abs=1e-6)
    assert found["SAWA_H"] == pytest.approx(1.26818, abs=5e-6)
    assert found["SAWA_H"] == pytest.approx(1.2682612, abs=1e-3)  # of one draw of their random pairs


def test_scores_of_a_map_with_unknown_truth_are_those_of_their_code():
    """Executed: princeton-vl/EvalMDE ea9e21c, with the truth's mask; WKDR by its formula for all pairs."""
    found = _evalmde(pair_of(*holed()))
    expected = {
        "RelNormal": 0.2733864,
        "WKDR": 0.0234771497,
        "beyond_disparity": 0.0446922,
        "beyond_depth": 0.0447452,
        "boundary": 0.0589925013,
        "covered": 1,
    }
    weights = {"WKDR": 3.65, "beyond_disparity": 0.18, "beyond_depth": 0.01, "boundary": 0.2, "RelNormal": 1.94}
    expected["SAWA_H"] = sum(weight * expected[name] for name, weight in weights.items())
    assert found == pytest.approx(expected, abs=5e-6)


def test_missing_normals_are_errors_of_pi_as_in_their_code():
    prediction, truth = holed()
    prediction[20:30, 90:120] = np.nan
    assert evalmde.rel_normal(pair_of(prediction, truth)).item() == pytest.approx(0.4731059, abs=5e-6)


def test_no_part_gains_by_leaving_pixels_out():
    prediction, truth = steps()
    full = _evalmde(pair_of(prediction, truth))
    prediction[30:60, 30:90] = np.nan
    part = _evalmde(pair_of(prediction, truth))
    assert all(part[name] > value for name, value in full.items() if name != "covered")
    assert part["covered"] == pytest.approx(1 - 30 * 60 / truth.size)


def test_affine_maps_of_depth_and_of_disparity_are_fitted():
    _, truth = steps()
    truth = 3 * truth.astype(float) - 5
    of_depth, of_disparity = pair_of(0.3 * truth + 0.7, truth), pair_of(1 / (0.4 / truth + 0.1), truth)
    depth, disparity = _evalmde(of_depth), _evalmde(of_disparity)
    assert depth["beyond_depth"] == disparity["beyond_disparity"] == 0
    assert depth["beyond_disparity"] > 0
    assert disparity["beyond_depth"] > 0


@pytest.mark.parametrize("ties", [False, True])
def test_order_of_pairs_is_counted_one_by_one(ties):
    random = np.random.default_rng(0)
    prediction, truth = 1 + random.random((2, 18, 20))
    if ties:
        prediction, truth = prediction.round(1), truth.round(1)
    prediction[2, :5], truth[5:7, 3] = np.nan, np.nan
    known = np.isfinite(truth)
    p, t = prediction[known].astype("f"), truth[known].astype("f")
    wrong = ((p[:, None] < p) != (t[:, None] < t)) | np.isnan(p[:, None]) | np.isnan(p)
    found = evalmde.wkdr(pair_of(prediction, truth, CAMERA.crop(0, 0, 18, 20)))
    assert found.item() == pytest.approx(wrong.mean(), rel=1e-12)


NARROW = Camera(width=48, height=40, fx=60.0, fy=60.0, cx=23.5, cy=19.5)
RAYS = NARROW.rays()[None]
V, U = np.mgrid[:40, :48].astype(float)
STEP = np.where(U < 24, 1.0, 2.0)
POINTS = catalogue(protocols=("points",))


def _points(prediction, truth):
    maps = (torch.as_tensor(each, dtype=torch.float64)[None] for each in (prediction, truth))
    return {row.metric: row.value for row in score_image(*maps, RAYS[0], POINTS)}


def _pierced(seed):
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
    prediction, truth = _pierced(seed)
    found = _points(prediction, truth)
    assert found == pytest.approx(_naive(prediction, truth), rel=1e-10)
    assert 0 < found["Points_flying"] < 0.3
    assert 0.1 < found["Points_F_1cm"] < found["Points_F_5cm"] < 1


def test_only_points_in_the_void_between_surfaces_fly():
    between = np.where(U == 24, 1.5, STEP)  # a column in the middle of the step
    assert _points(between, STEP)["Points_flying"] == pytest.approx(1 / 48)
    assert _points(np.where(np.abs(U - 24) < 4, np.where(U < 24, 2, 1), STEP), STEP)["Points_flying"] == 0  # moved edge
    assert _points(np.where(U == 24, 2.5, STEP), STEP)["Points_flying"] == 0  # behind both
    assert _points(np.where(U == 24, 0.5, STEP), STEP)["Points_flying"] == 0  # before both
    assert _points(np.where(U == 45, 1.5, STEP), STEP)["Points_flying"] == 0  # far from the edge
    assert _points(np.where(U == 24, 1.04, STEP), np.where(U < 24, 1.0, 1.045))["Points_flying"] == 0  # no edge
