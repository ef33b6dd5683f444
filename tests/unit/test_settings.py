"""Settings out of range are refused by their key, with what was expected."""

import math

import pytest

from dsr.degradation.downsampling import Downsampling
from dsr.degradation.holes import Blobs, Shadows
from dsr.degradation.noise import GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.degradation.random_degradation import Everything
from dsr.methods.classical.bilateral import Bilateral, JointBilateral
from dsr.methods.classical.edge_guided import EdgeGuided
from dsr.methods.classical.fast_global_smoother import FastGlobalSmoother
from dsr.methods.classical.guided_filter import GuidedFilter
from dsr.methods.classical.interpolation import CubicConvolution, Interpolation
from dsr.methods.classical.realsense import RealSense
from dsr.methods.classical.shape_from_shading import ShapeFromShading
from dsr.methods.classical.tgv import TotalGeneralisedVariation
from dsr.methods.dip.upsampler import DeepImagePrior
from dsr.methods.external import External
from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.peers.local_filters import SVLRM
from dsr.methods.networks.peers.peer import Peer
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.sample import Unit
from dsr.training.objective import DepthObjective
from dsr.training.settings import PatchSettings

WRONG = {
    Interpolation: [("order", "cubic")],
    CubicConvolution: [("range_type", "depth")],
    External: [
        ("path", "nowhere"), ("file", "{seen}"), ("range_type", "depth"), ("fit", "cubic"), ("resize", "cubic"),
        ("unit", "feet"),
    ],
    Bilateral: [("window", 0), ("window", 2000), ("sigma_depth", 0), ("sigma_space", 0)],
    RealSense: [("alpha", 0), ("alpha", 1.1), ("delta", 0), ("iterations", 0), ("baseline", 0)],
    GuidedFilter: [("radius", 0), ("radius", 2000), ("epsilon", 0)],
    JointBilateral: [("radius", 0), ("sigma_space", 0), ("sigma_colour", 0)],
    FastGlobalSmoother: [("smoothness", 0), ("sigma_colour", 0), ("iterations", 0)],
    EdgeGuided: [
        *[(key, 0) for key in ("step", "candidates", "sharp_weight", "smoothness", "iterations", "radius")],
        ("sigma_space", 0), ("mixed", 0),
    ],
    TotalGeneralisedVariation: [
        ("iterations", 0), ("tolerance", -1.0), ("first", 0.0), ("second", 0.0), ("data_weight", 0.0),
        ("sharpness", -1.0), ("exponent", 0.0), ("step_ratio", 0.0),
    ],
    ShapeFromShading: [
        ("iterations", 0), ("tolerance", -1.0), ("data_weight", 0.0), ("area_weight", -1.0), ("boundary_weight", 0.0),
        ("penalty", 0.0), ("growth", 0.9), ("foreground", "/nowhere"),
    ],
    DeepImagePrior: [
        ("steps", 0), ("learning_rate", 0.0), ("average", 1.0), ("widths", (4, 0)), ("widths", (2,)), ("border", -1),
        ("validate_every", -1), ("input_noise", -1.0), ("data_loss", "l2"), ("w", -1.0), ("w_intensity", -0.1),
        ("visual", "ssim"), ("precision", "int8"),
    ],
    Peer: [("range_type", "depth"), ("range", "full"), ("precision", "float16")],
    PrimalDualNetwork: [("scale", 3), ("window", 4), ("window", 1), ("iterations", 0)],
    SparseToDense: [("width", 0), ("width", 6)],
    FacetsUNet: [("scale", 3)],
    Downsampling: [("kernel", "lanczos"), *[("sigma", value) for value in (0.0, 0.09, -1.0, math.nan)]],
    GaussianMultiplicative: [("std", 1.0)],
    TimeOfFlight: [
        ("strength", 0.0), ("strength", math.nan), ("stereo_constant", -1.0), ("doffs", -1.0), ("doffs", math.inf),
    ],
    Kinect: [
        ("std", -0.1), ("std", math.nan), ("step", 0.0), ("stereo_constant", math.inf), ("dropout", 1.1), ("jump", 0.0),
        ("reach", 0), ("reach", 1.5), ("nearest", 0.0), ("farthest", -8.0), ("farthest", 0.3),
    ],
    Blobs: [("share", 0.0), ("share", 1.0), ("size", 0.5)],
    Shadows: [("baseline", 0.0), ("baseline", math.nan)],
    Everything: [
        ("kernels", {"sinc": 1}), ("noises", {"foo": 0.1}), ("noises", {"none": 0}), ("holes", {"none": -1}),
        ("soft", 1.5), ("clear", 2), ("scales", {3: 1}),
    ],
    DepthObjective: [
        *[("shading", value) for value in (-0.1, math.nan, math.inf)], ("w", -0.1), ("w", math.nan),
        ("depth_loss", "ssim"),
    ],
    PatchSettings: [
        ("patch", 15), ("batch", 0), ("validation_scenes", -1), ("photo", 1.1), ("workers", -1), ("depth_scale", -0.1),
        ("colour", -0.1), ("colour", math.nan), ("scenes", 0),
    ],
    Unit: [("factor", 0.0), ("offset", 1.0)],
}  # fmt: skip
NEEDED = {
    DeepImagePrior: {"scale": 2, "downsampling": Downsampling("box")},
    Downsampling: {"kernel": "gaussian"},
    External: {"path": "."},
    Peer: {"peer": SVLRM(4)},
    PrimalDualNetwork: {"scale": 4},
    SparseToDense: {"scale": 4},
    Unit: {"name": "cm"},
}
CASES = [pytest.param(build, *case, id=f"{build.__name__}-{case}") for build in WRONG for case in WRONG[build]]


@pytest.mark.parametrize(("build", "key", "value"), CASES)
def test_setting_out_of_range_is_refused_by_its_key(build, key, value):
    with pytest.raises(ValueError, match=rf"\b{key}: expected ") as caught:
        build(**{**NEEDED.get(build, {}), key: value})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("build", "settings", "key"),
    [
        (DeepImagePrior, {"validate_every": 0, "oracle": True}, "validate_every"),
        (DeepImagePrior, {"visual": "dssim", "w": 0.0}, "visual"),
        (PrimalDualNetwork, {"width": 0}, "model"),
        (PrimalDualNetwork, {"layers": 1}, "model"),
        (DDRNet, {"scale": 4, "refinement": 6}, "model"),
        (FacetsUNet, {"scale": 4, "width": 0}, "width"),
        (FacetsUNet, {"scale": 4, "width": 8, "deep": 8, "blocks": 2}, "blocks"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(build, settings, key):
    with pytest.raises(ValueError, match=f"{key}: expected "):
        build(**{**NEEDED.get(build, {}), **settings})
