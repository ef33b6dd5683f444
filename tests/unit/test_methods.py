"""What holds of all methods: constant maps stay so, the problem is left as it is; of classical ones: planes, holes."""

from functools import partial

import pytest
import torch
from methods_at_hand import AT_HAND, PEERS, build
from small_scenes import disparity_of, plane, random_scene, sample_of

from dsr.methods.classical.bilateral import Bilateral, JointBilateral
from dsr.methods.classical.edge_guided import EdgeGuided
from dsr.methods.classical.fast_global_smoother import FastGlobalSmoother
from dsr.methods.classical.guided_filter import GuidedFilter
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.classical.realsense import RealSense
from dsr.methods.classical.tgv import TotalGeneralisedVariation
from dsr.methods.recipe import read_recipe

GUIDED = {"guided_filter": GuidedFilter, "joint_bilateral": JointBilateral, "smoother": FastGlobalSmoother}
EXACT = {**GUIDED, "edge_guided": EdgeGuided}
ORDERS = {order: partial(Interpolation, order) for order in ("nearest", "bilinear", "bicubic")}
PLANAR = {**EXACT, "tgv": partial(TotalGeneralisedVariation, iterations=300)}
FILLING = {**EXACT, **ORDERS, "bilateral": Bilateral, "realsense": RealSense}


def test_low_resolution_maps_average_what_the_paper_averages_for_a_method():
    kinds = {name: read_recipe(name).kind.range_type for name in ("bicubic", "msg_v", "facets", "dip", "dip_v")}
    assert kinds == {
        "bicubic": "perspective", "msg_v": "disparity", "facets": "disparity", "dip": "orthogonal",
        "dip_v": "orthogonal",
    }  # fmt: skip


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


@pytest.mark.parametrize("name", [name for name in (*AT_HAND, *PEERS) if name != "eg"])  # which needs edges
def test_constant_map_stays_constant_in_its_type_and_nothing_else_changes(name, tmp_path):
    """With a hole in it, at a size that few networks' strides divide; the state of the global generator, too."""
    method, sample = build(name, tmp_path), sample_of(torch.full((72, 88), 5.0).double(), doffs=1.5)
    sample.depth_lr[:, 3:5, 4:6] = torch.nan
    before, state = sample.depth_lr.clone(), torch.get_rng_state()
    depth = method(sample)
    assert (depth.shape, depth.dtype) == ((1, 72, 88), torch.float64)
    assert torch.equal(sample.depth_lr.nan_to_num(), before.nan_to_num())
    assert torch.equal(torch.get_rng_state(), state)
    assert bool((depth[depth.isfinite()] > 0).all())
    if not name.startswith("dip"):  # of two steps
        tolerance = 0.02 if name in ("srfs", *ORDERS) else 1e-5  # interpolation is of perspective depth
        torch.testing.assert_close(depth[:, 40:60], sample.depth[:, 40:60], rtol=tolerance, atol=0)
