"""What holds of all classical methods: planes stay planes under any photo, and holes are kept or filled."""

from functools import partial

import pytest
import torch
from small_scenes import disparity_of, plane, random_scene, sample_of

from dsr.methods.classical.bilateral import Bilateral, JointBilateral
from dsr.methods.classical.edge_guided import EdgeGuided
from dsr.methods.classical.fast_global_smoother import FastGlobalSmoother
from dsr.methods.classical.guided_filter import GuidedFilter
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.classical.tgv import TotalGeneralisedVariation

GUIDED = {"guided_filter": GuidedFilter, "joint_bilateral": JointBilateral, "smoother": FastGlobalSmoother}
EXACT = {**GUIDED, "edge_guided": EdgeGuided}
ORDERS = {order: partial(Interpolation, order) for order in ("nearest", "bilinear", "bicubic")}
PLANAR = {**EXACT, "tgv": partial(TotalGeneralisedVariation, iterations=300)}
FILLING = {**EXACT, **ORDERS, "bilateral": Bilateral}


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
@pytest.mark.parametrize("name", PLANAR)
def test_plane_is_reproduced_exactly_under_a_photo_of_noise(name, scale):
    flat, photo = plane(64, 48), random_scene(64, 48)[1]
    for kernel in ("box", "nearest") if name in GUIDED else ("box",):
        sample = sample_of(flat, photo, scale, kernel=kernel)
        torch.testing.assert_close(disparity_of(PLANAR[name]()(sample), sample), flat, rtol=0, atol=1e-9)


@pytest.mark.parametrize("fill", [False, True])
@pytest.mark.parametrize("name", FILLING)
def test_holes_are_where_the_nearest_low_resolution_pixel_is_missing_unless_filled(name, fill):
    flat = plane(48, 48)
    holed = flat.clone()
    holed[16:24, 20:32] = torch.nan
    sample = sample_of(holed)
    fine = disparity_of(FILLING[name](fill_holes=fill)(sample), sample)
    hole = ~sample.mask_lr[0].repeat_interleave(4, 0).repeat_interleave(4, 1)
    assert int(hole.sum()) == 96
    assert torch.equal(fine.isfinite(), ~hole | fill)
    if name in EXACT:
        assert float((fine - flat)[~hole].abs().max()) < 1e-9
    if name in EXACT and fill:
        assert float((fine - flat).abs().max()) < (1e-9 if name in GUIDED else 0.2)
