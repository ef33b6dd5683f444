"""The loss of networks that say how sure they are, and what the module feeds them."""

import math
from dataclasses import replace

import pytest
import torch

from dsr.degradation.downsampling import Downsampling
from dsr.geometry.camera import Camera
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.network import Answer
from dsr.metrics.functional import SurfacePair
from dsr.sample import Scene
from dsr.training.degradation import Degradation, to_tensors
from dsr.training.module import SuperResolution
from dsr.training.objective import SurfaceObjective

CAMERA = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=7.5, cy=5.5, baseline=0.2)


def _batch(camera=CAMERA, *, soft=0.0):
    """Return a slope, downsampled by 4, without hints."""
    across = torch.linspace(2, 3, camera.width, dtype=torch.float64)
    depth = across.expand(1, camera.height, camera.width).contiguous()
    rgb = torch.rand((3, camera.height, camera.width), generator=torch.Generator().manual_seed(0))
    tensors = to_tensors(Degradation(4, Downsampling("box")).sample(Scene("set", "slope", rgb, camera, depth)))
    hints = {"noise": torch.zeros_like(tensors["disparity_lr"]), "facts": torch.zeros(8), "soft": torch.tensor(soft)}
    return {name: value[None] for name, value in (tensors | hints).items()}


def _answer(batch, disparity, spread=0.1, angle=0.1):
    return Answer(disparity, torch.full_like(disparity, spread), torch.full_like(disparity, angle))


def _inverse(batch):
    return batch["bf"] / batch["depth"]


def test_a_perfect_answer_has_no_loss_but_its_doubts():
    batch = _batch()
    terms = SurfaceObjective()(_answer(batch, _inverse(batch), 0.01, 0.02), batch)
    assert float(terms["lap1"]) == pytest.approx(0, abs=1e-7)
    assert float(terms["rmse_v"]) == pytest.approx(math.sqrt(1e-5), rel=1e-3)
    assert float(terms["rmse_soft"]) == 0
    assert float(terms["spread"]) == pytest.approx(math.log(0.01), rel=1e-6)
    assert float(terms["angle"]) == pytest.approx(math.log(0.02), rel=1e-6)


def test_the_terms_are_added_with_their_weights():
    batch = _batch(soft=1.0)
    objective = SurfaceObjective(depth=3.0, soft=5.0, sharp=1.5, errors=0.1)
    terms = objective(_answer(batch, 1.02 * _inverse(batch)), batch)
    others = 3 * terms["lap1"] + terms["rmse_v"] + 0.1 * (terms["spread"] + terms["angle"])
    torch.testing.assert_close(terms["loss"], others + 5 * terms["rmse_soft"])
    unit = _inverse(batch).flatten().median()
    missed = (0.02 * _inverse(batch) / unit).square().mean().sqrt()
    torch.testing.assert_close(terms["rmse_soft"], missed, rtol=1e-3, atol=0)
    sharp = objective(_answer(batch, 1.02 * _inverse(batch)), _batch())
    assert float(sharp["rmse_soft"]) == float(terms["rmse_sharp"]) == 0
    torch.testing.assert_close(sharp["rmse_sharp"], terms["rmse_soft"])
    torch.testing.assert_close(sharp["loss"], others + 1.5 * sharp["rmse_sharp"])
    formula = "3 Lap_1 + RMSE_v + 1.5 RMSE (5 of soft maps) + 0.1 (likelihoods of the expected errors)"
    assert objective.formula == formula


def test_the_likelihood_is_best_where_the_expected_error_is_the_mean_error():
    batch = _batch()
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
            found.append(float(SurfaceObjective()(_answer(batch, disparity, **reported), batch)[name]))
        assert found[1] < min(found[0], found[2]), name


def test_holes_of_the_truth_and_results_behind_infinity_count_for_nothing():
    batch = _batch(soft=1.0)
    disparity = (1.01 * _inverse(batch)).requires_grad_()
    holes = {**batch, "depth": batch["depth"].clone()}
    holes["depth"][..., 4:8, 4:8] = torch.nan
    with torch.no_grad():
        disparity[..., 0, 0] = -1.0
    terms = SurfaceObjective()(_answer(holes, disparity), holes)
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
    batch = _batch(replace(CAMERA, doffs=doffs))
    net = Remembering(4, 8, 8, 3)
    module = SuperResolution(net, SurfaceObjective())
    expected = (batch["bf"] * Downsampling("box")(batch["depth"][0].reciprocal(), 4)[None]).to(torch.float32)
    terms = module.loss_terms(batch)
    torch.testing.assert_close(net.seen.float(), expected, rtol=1e-5, atol=0)
    plain = module.loss_terms(_batch())
    torch.testing.assert_close(terms["loss"], plain["loss"], rtol=1e-4, atol=1e-4)
