"""What a result has lost of a sensor's map and gets back, on maps whose noise and lost shape are known."""

from dataclasses import replace

import pytest
import torch
from small_scenes import seeded

from dsr.geometry.camera import Camera
from dsr.inference import upsampler
from dsr.inference.any_ratio import AnyRatio
from dsr.inference.residual import restore_measured
from dsr.methods.base import MapNoise
from dsr.methods.recipe import read_recipe

NOISE = MapNoise(0.004, 2.0, 2.0)
V, U = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
WALL = torch.full((1, 120, 160), 2.0)
RIPPLE = 0.01 * torch.sin(U / 5) * torch.sin(V / 6)  # fine shape, metres
RIPPLE[:, 80:] = 0


def measure(depth, seed=0, factor=1):
    return depth + factor * NOISE.deviation * torch.randn(depth.shape, generator=seeded(seed))


def restored(result, measured):
    return restore_measured(result.reciprocal(), measured.reciprocal(), NOISE).reciprocal()


@pytest.mark.parametrize("farther", [1, 3])
def test_noise_that_was_taken_away_and_grows_with_distance_does_not_come_back(farther):
    """Residuals of white noise have about a quarter of the power that is expected of noise two pixels wide."""
    wall = farther * WALL
    assert torch.equal(restored(wall, measure(wall, farther // 2, farther)), wall)


def test_lost_shape_comes_back_where_it_was():
    truth = WALL + RIPPLE
    off = (restored(WALL, measure(truth)) - truth)[0, 10:110]
    assert float(off[:, 10:65].square().mean()) < 0.3 * float(RIPPLE[10:110, 10:65].square().mean())
    assert float(off[:, 120:150].abs().max()) < 0.001


def test_an_area_that_was_shifted_comes_back_at_any_ratio():
    shifted, measured = WALL + 0.005, measure(WALL)
    assert float((restored(shifted, measured) - 2).abs().mean()) < 0.001
    small = restored(shifted.repeat_interleave(3, 1).repeat_interleave(3, 2)[:, :, :400], measured[:, :, :134])
    assert small.shape == (1, 360, 400)
    assert float((small - 2).abs().mean()) < 0.001


def test_steps_outliers_and_holes_leave_the_result_as_it_is():
    measured = measure(WALL)
    measured[0, 30:50, 30:50] = 2.4  # a step that the result has elsewhere
    measured[0, 60:64, 100:104] = 1.0
    measured[0, :, 120:] = torch.nan
    assert torch.equal(restored(WALL, measured), WALL)


def test_upsampling_restores_unless_the_noise_is_given_or_changed(monkeypatch):
    camera, rgb = Camera.centred(64, 48, 60.0), torch.full((3, 48, 64), 0.5)
    wall = (WALL + U / 1e5)[:, :48, :64]
    monkeypatch.setattr("dsr.inference.any_ratio.restore_measured", lambda inverse, *_: 1.003 * inverse)
    for settings, mean in ({}, 2 / 1.003), ({"noise": 0.004}, 2), ({"smooth": 2.0}, 2):
        recipe = replace(read_recipe("facets", settings), settings=frozenset())  # as eval.py makes it
        found = AnyRatio(recipe, torch.device("cpu")).upsample(rgb, measure(wall), camera).depth
        assert float(found.mean()) == pytest.approx(mean, abs=1e-3), settings
    assert float(upsampler().upsample(rgb, wall, camera).depth.mean()) == pytest.approx(2, abs=1e-3)
