"""RelNormal and SAWA-H: the values that EvalMDE's own code gives, and that no hole pays."""

import math

import numpy as np
import pytest
from depth_steps import CAMERA, holed, pair_of, steps

from dsr.geometry.camera import Camera
from dsr.metrics import evalmde
from dsr.metrics.catalogue import catalogue

METRICS = catalogue(protocols=("evalmde",))

pytestmark = pytest.mark.usefixtures("one_thread")


def _scores(pair):
    return {metric.name.removeprefix("EvalMDE_"): metric.function(pair).item() for metric in METRICS}


def test_scores_of_their_example_are_those_of_their_code(shared):
    folder = shared / "expected" / "evalmde"
    stored, prediction = (np.load(folder / name) for name in ("gt_depth.npz", "depthpro_gt_focal.npz"))
    truth = np.where(stored["valid"], stored["depth"], np.nan)
    camera = Camera(truth.shape[1], truth.shape[0], *map(float, stored["intr"]))
    found = _scores(pair_of(prediction["depth"], truth, camera))
    assert found["RelNormal"] == pytest.approx(0.3900358, abs=2e-6)
    assert 1 - found["WKDR"] == pytest.approx(0.935941, abs=1e-6)
    assert 1 - found["beyond_disparity"] == pytest.approx(0.0821814, abs=1e-6)
    assert 1 - found["beyond_depth"] == pytest.approx(0.0192955, abs=1e-6)
    assert 1 - found["boundary"] == pytest.approx(0.4865937, abs=1e-6)
    assert found["SAWA_H"] == pytest.approx(1.26818, abs=5e-6)
    assert found["SAWA_H"] == pytest.approx(1.2682612, abs=1e-3)  # of one draw of their random pairs


def test_scores_of_a_map_with_unknown_truth_are_those_of_their_code():
    """Executed: princeton-vl/EvalMDE ea9e21c, with the truth's mask; WKDR by its formula for all pairs."""
    found = _scores(pair_of(*holed()))
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
    full = _scores(pair_of(prediction, truth))
    prediction[30:60, 30:90] = np.nan
    part = _scores(pair_of(prediction, truth))
    assert all(part[name] > value for name, value in full.items() if name != "covered")
    assert part["covered"] == pytest.approx(1 - 30 * 60 / truth.size)


def test_affine_maps_of_depth_and_of_disparity_are_fitted():
    _, truth = steps()
    truth = 3 * truth.astype(float) - 5
    of_depth, of_disparity = pair_of(0.3 * truth + 0.7, truth), pair_of(1 / (0.4 / truth + 0.1), truth)
    depth, disparity = _scores(of_depth), _scores(of_disparity)
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


def test_prediction_of_holes_alone_has_the_largest_errors():
    prediction, truth = steps()
    found = _scores(pair_of(np.full_like(prediction, np.nan), truth))
    assert found.pop("SAWA_H") == pytest.approx(3.65 + 0.18 + 0.01 + 0.2 + 1.94 * math.pi)
    assert found == {
        **dict.fromkeys(("WKDR", "beyond_disparity", "beyond_depth", "boundary"), 1),
        "RelNormal": pytest.approx(math.pi),
        "covered": 0,
    }
