"""Holes of low-resolution maps."""

import pytest
import torch

from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.degradation.holes import Blobs, Shadows
from dsr.degradation.noise import GaussianMultiplicative
from dsr.geometry.camera import Camera
from dsr.sample import Scene

CAMERA = Camera(width=40, height=30, fx=50.0, fy=50.0, cx=19.5, cy=14.5)


def _generator(seed=0):
    return torch.Generator().manual_seed(seed)


def _edges(mask):
    """How many neighbouring pixels differ."""
    return int((mask[..., 1:] != mask[..., :-1]).sum() + (mask[..., 1:, :] != mask[..., :-1, :]).sum())


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_blobs_have_the_requested_fraction_and_are_connected(share):
    depth = torch.ones(1, 60, 80)
    fine, coarse = (Blobs(share, size)(depth, CAMERA, _generator()) for size in (8, 24))
    assert int(fine.sum()) == int(coarse.sum()) == round(share * 4800)
    scattered = torch.rand(1, 60, 80) < share
    assert _edges(coarse) < _edges(fine) < 0.6 * _edges(scattered)


def test_blobs_depend_on_the_generator_alone():
    depth = torch.ones(1, 30, 40)
    masks = [Blobs()(depth * scale, CAMERA, _generator(seed)) for seed, scale in ((1, 1), (1, 2), (2, 1))]
    assert torch.equal(masks[0], masks[1])
    assert not torch.equal(masks[0], masks[2])


@pytest.mark.parametrize("baseline", [0.2, -0.2])
def test_shadow_is_as_wide_as_the_disparities_differ(baseline):
    depth = torch.full((1, 30, 40), 4.0)
    depth[:, 10:20, 15:25] = 1.0
    mask = Shadows(baseline)(depth, CAMERA, _generator())
    width = 7  # 0.2 m x 50 px x (1 / 1 m - 1 / 4 m) = 7.5 px: pixels 1 to 7 away are nearer than that
    expected = torch.zeros_like(mask)
    if baseline > 0:
        expected[:, 10:20, 15 - width : 15] = True
    else:
        expected[:, 10:20, 25 : 25 + width] = True
    assert torch.equal(mask, expected)


def test_plane_with_missing_parts_has_no_shadows():
    slope = torch.linspace(2, 3, 40).expand(1, 30, 40).clone()
    slope[:, 5:9, 10:20] = torch.nan
    assert not bool(Shadows(0.1)(slope, CAMERA, _generator()).any())


@pytest.mark.parametrize("make", [lambda: Blobs(0.0), lambda: Blobs(1.0), lambda: Blobs(0.1, 0.5), lambda: Shadows(0.0),
                                  lambda: Shadows(float("nan"))])  # fmt: skip
def test_values_out_of_range_are_refused(make):
    with pytest.raises(ValueError, match=r"^(share|size|baseline): expected"):
        make()


def test_sample_with_holes_has_the_same_values_elsewhere():
    depth = 2 + torch.rand(1, 32, 40)
    scene = Scene("set", "hall", torch.rand(3, 32, 40), CAMERA.crop(0, 0, 30, 40).rescale(40, 32), depth)
    given = (scene, 2, Downsampling("box"), "orthogonal", GaussianMultiplicative(0.01), 7)
    plain, holed = make_sample(*given), make_sample(*given, Blobs(0.1, 4))
    holes = holed.depth_lr.isnan()
    assert int(holes.sum()) == 32
    assert torch.equal(plain.depth_lr[~holes], holed.depth_lr[~holes])
    assert torch.equal(holed.depth, depth)
    again = make_sample(*given, Blobs(0.1, 4))
    assert torch.equal(again.depth_lr.isnan(), holes)


def test_measured_map_gets_holes_too():
    coarse = 2 + torch.rand(1, 8, 10)
    scene = Scene("set", "hall", torch.rand(3, 32, 40), CAMERA.rescale(40, 32), None, {4: coarse})
    sample = make_sample(scene, 4, Measured(), "orthogonal", holes=Blobs(0.25, 3))
    assert int(sample.depth_lr.isnan().sum()) == 20
    assert not bool(coarse.isnan().any())
