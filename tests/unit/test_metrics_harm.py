"""What a method makes worse and better of a measurement, and distances of point pairs, against hand values."""

import math

import numpy as np
import pytest
import torch
from depth_steps import pair_of

from dsr.geometry.camera import Camera
from dsr.metrics.alignment import align_pair
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.harm import draw_pairs, enlarge, pair_errors

METRICS = catalogue(protocols=("harm",))
CAMERA = Camera.centred(6, 2, 5.0)
TRUTH = [[1.0, 1.1, 1.2, 1.3, 2.0, 2.1], [2.2, 2.3, 3.0, 3.1, 3.2, 3.3]]
BEFORE = [[4, -4, 4, -4, 10, -10], [-10, 10, 2, -2, 2, -2]]  # error of the measurement in mm
AFTER = [[0, -8, 4, 4, 16, 10], [2, 6.5, 5.1, -4.9, 0, 2]]  # and of the prediction


def scores(prediction, target, measured, camera=CAMERA):
    maps = [torch.as_tensor(each, dtype=torch.float64)[None] for each in (prediction, target, measured)]
    return {row.metric: row.value for row in score_image(*maps[:2], camera.rays(), METRICS, measured=maps[2])}


def maps(holes=()):
    truth = np.array(TRUTH)
    measured, prediction = truth + np.array(BEFORE) / 1e3, truth + np.array(AFTER) / 1e3
    for which, at in holes:
        {"truth": truth, "measured": measured, "prediction": prediction}[which][at] = np.nan
    return prediction, truth, measured


def test_shares_and_ratios_of_a_dozen_pixels_are_those_by_hand():
    found = scores(*maps())
    assert found["Harm_worse_3mm"] == pytest.approx(3 / 12)  # -4 to -8, 10 to 16, 2 to 5.1 mm
    assert found["Harm_better_3mm"] == pytest.approx(3 / 12)  # 4 to 0, -10 to 2, 10 to 6.5
    # half of the pixels of each third are off by +x, half by -x: the noise is 1.4826 x of 4, 10 and 2 mm
    assert found["Harm_worse_noise"] == pytest.approx(1 / 12)
    assert found["Harm_ratio"] == pytest.approx(62.5 / 64)
    thirds = [found[f"Harm_{name}"] for name in ("near", "middle", "far")]
    assert thirds == pytest.approx([16 / 16, 34.5 / 40, 12 / 8])
    assert found["Harm_worst"] == pytest.approx(1.5)
    assert found["Harm_covered"] == 1


def test_the_measurement_itself_does_no_harm():
    _, truth, measured = maps()
    found = scores(measured, truth, measured)
    assert all(found[f"Harm_{name}"] == 0 for name in ("worse_3mm", "worse_noise", "better_3mm"))
    assert all(found[f"Harm_{name}"] == 1 for name in ("ratio", "near", "middle", "far", "worst", "covered"))


def test_holes_do_not_count_but_those_of_the_prediction_are_not_covered():
    found = scores(*maps([("measured", (0, 1)), ("truth", (0, 4)), ("prediction", (1, 2))]))
    assert found["Harm_worse_3mm"] == 0  # these were the three pixels that got worse
    assert found["Harm_better_3mm"] == pytest.approx(3 / 9)
    assert found["Harm_covered"] == pytest.approx(9 / 10)


def test_a_smaller_map_is_enlarged_without_bending_planes():
    rows = torch.arange(24, dtype=torch.float64)[:, None]
    truth = 1 / (0.5 + 0.01 * (rows + torch.arange(40)))
    small = 1 / (0.5 + 0.01 * (4 * torch.arange(6, dtype=torch.float64)[:, None] + 4 * torch.arange(10) + 3))
    small[1, 2] = torch.nan
    enlarged = enlarge(small[None], (24, 40))
    assert enlarged[0, 4:8, 8:12].isnan().all()
    assert enlarged.isfinite().sum() == 24 * 40 - 16
    torch.testing.assert_close(enlarged[0, 16:], truth[16:])  # away from the hole


def test_without_a_measurement_or_after_an_alignment_there_is_no_harm_to_score():
    prediction, truth, measured = maps()
    rows = score_image(*(torch.tensor(each)[None] for each in (prediction, truth)), CAMERA.rays(), METRICS)
    assert {row.metric for row in rows} == {"Pairs_RE", "Pairs_delta_105"}
    pair = pair_of(prediction, truth, CAMERA).replaced(measured=torch.tensor(measured)[None, None])
    assert align_pair(pair, "none").measured is not None
    assert align_pair(pair, "scale").measured is None


def test_distances_scale_with_the_prediction():
    for factor, within in ((1.04, 1), (1.06, 0), (0.94, 0)):
        found = pair_errors(pair_of(factor * np.array(TRUTH), np.array(TRUTH), CAMERA))
        assert float(found["RE"]) == pytest.approx(abs(factor - 1))
        assert float(found["delta_105"]) == within


def test_a_distance_is_that_of_points_in_space():
    """Of two pixels of a camera with f = 1 at u = -1/2 and 1/2, at 1 m and 1 m, then at 1 m and 2 m."""
    camera = Camera(width=2, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.0)
    found = pair_errors(pair_of(np.array([[1.0, 2.0]]), np.array([[1.0, 1.0]]), camera))
    assert float(found["RE"]) == pytest.approx(math.hypot(1.5, 1) - 1)  # (-.5, 0, 1) to (1, 0, 2), in place of 1 m


def test_pairs_depend_on_the_truth_alone_and_reach_all_of_it():
    mask = torch.zeros(1, 1, 8, 8, dtype=torch.bool)
    mask[..., 2:6, 1:7] = True
    for each in draw_pairs(mask):
        assert torch.equal(each.unique(), mask.flatten().nonzero()[:, 0])
