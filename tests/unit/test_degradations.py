"""What holds of every degradation; holes of low-resolution maps: how they are made, and how wide they are."""

import pytest
import torch
from small_scenes import seeded

from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.degradation.glass import KINDS, add_glass
from dsr.degradation.holes import Blobs, Shadows
from dsr.degradation.noise import NOISES, GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.degradation.random_degradation import Everything, add_folds
from dsr.geometry.camera import Camera
from dsr.geometry.hole_size import distance_to_known, wide_holes
from dsr.sample import Scene

CAMERA = Camera(width=40, height=30, fx=50.0, fy=50.0, cx=19.5, cy=14.5)


WALL = torch.linspace(2, 3, 128).repeat(1, 128, 1).double()
WALL[:, 32:64, 32:64] = 1.2
WALL[:, 100:110, 90:100] = torch.nan
ROOM = Scene("set", "hall", torch.rand(3, 128, 128, generator=seeded()), Camera.from_fov(60, 128, 128), WALL)
BOX = Downsampling("box")
SENSORS = {"gaussian": GaussianMultiplicative(0.02), "flight": TimeOfFlight(), "kinect": Kinect()}
DEGRADATIONS = {
    **{name: lambda seed, sensor=sensor: sensor(WALL, seeded(seed)) for name, sensor in SENSORS.items()},
    **{
        f"random {kind}": lambda seed, kind=kind: NOISES[kind](1 / WALL.float(), ROOM.rgb[:1], seeded(seed))
        for kind in NOISES
    },
    **{f"seen {kind}": lambda seed, kind=kind: add_glass(ROOM, seeded(seed), {kind: 1})[1] for kind in KINDS},
    "blobs": lambda seed: WALL.masked_fill(Blobs()(WALL, ROOM.camera, seeded(seed)), torch.nan),
    "folds": lambda seed: add_folds(ROOM, seeded(seed)).depth,
    "far beyond": lambda seed: make_sample(ROOM, 2, BOX, "disparity", GaussianMultiplicative(0.9), seed).depth_lr,
    **{
        f"everything x{scale}": lambda seed, scale=scale: Everything()(ROOM, scale, seeded(seed))[0].depth_lr
        for scale in (1, 2, 4, 8, 16)
    },
}


@pytest.mark.parametrize("name", DEGRADATIONS)
def test_degradation_is_a_function_of_its_generator_keeps_holes_and_gives_positive_depth(name):
    one, again, other = (DEGRADATIONS[name](seed) for seed in (7, 7, 8))
    torch.testing.assert_close(again, one, rtol=0, atol=0, equal_nan=True)
    assert not torch.equal(one.nan_to_num(), other.nan_to_num())
    assert bool((one.nan_to_num(1) > 0).all())
    if name in (*SENSORS, "blobs", "folds", "everything x1"):
        assert bool(one[WALL.isnan()].isnan().all())
    if name in ("gaussian", "flight", "folds"):
        assert torch.equal(one.isnan(), WALL.isnan())


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_sensor_has_the_same_noise_in_float32(sensor):
    single, double = (sensor(depth, seeded(1)) for depth in (WALL.float(), WALL.float().double()))
    assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
    torch.testing.assert_close(single.double(), double, rtol=1e-6, atol=0, equal_nan=True)


def _edges(mask):
    """How many neighbouring pixels differ."""
    return int((mask[..., 1:] != mask[..., :-1]).sum() + (mask[..., 1:, :] != mask[..., :-1, :]).sum())


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_blobs_have_the_requested_fraction_and_are_connected(share):
    depth = torch.ones(1, 60, 80)
    fine, coarse = (Blobs(share, size)(depth, CAMERA, seeded()) for size in (8, 24))
    assert int(fine.sum()) == int(coarse.sum()) == round(share * 4800)
    scattered = torch.rand(1, 60, 80) < share
    assert _edges(coarse) < _edges(fine) < 0.6 * _edges(scattered)


@pytest.mark.parametrize("baseline", [0.2, -0.2])
def test_shadow_is_as_wide_as_the_disparities_differ(baseline):
    depth = torch.full((1, 30, 40), 4.0)
    depth[:, 10:20, 15:25] = 1.0
    mask = Shadows(baseline)(depth, CAMERA, seeded())
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
    assert not bool(Shadows(0.1)(slope, CAMERA, seeded()).any())


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


def test_distance_is_that_of_the_nearest_known_pixel():
    known = torch.rand((1, 23, 31), generator=torch.Generator().manual_seed(0)) < 0.05
    rows, columns = torch.meshgrid(torch.arange(23.0), torch.arange(31.0), indexing="ij")
    y, x = known[0].nonzero().T
    expected = torch.hypot(rows[..., None] - y, columns[..., None] - x).amin(-1)
    torch.testing.assert_close(distance_to_known(known)[0], expected, rtol=1e-4, atol=1e-4)


def test_without_known_pixels_the_distance_is_infinite():
    known = torch.zeros((1, 4, 5), dtype=torch.bool)
    assert bool(distance_to_known(known).isinf().all())
    assert bool(wide_holes(known, 6).all())


def test_narrow_parts_of_wide_holes_are_not_wide():
    known = torch.ones((1, 60, 80), dtype=torch.bool)
    known[:, 10:40, 10:40] = False  # 30 pixels wide
    known[:, 20:26, 40:70] = False  # a channel of 6 pixels
    wide = wide_holes(known, 12)
    assert not bool((wide & known).any())
    assert bool(wide[:, 14:36, 14:36].all())
    assert not bool(wide[:, :, 45:].any())
    assert 0.9 * 900 < int(wide[:, :, :40].sum()) <= 900  # but for the corners
    assert not bool(wide_holes(known, 32).any())


def test_holes_at_the_border_are_wide_from_half_of_the_width_on():
    known = torch.ones((1, 40, 50), dtype=torch.bool)
    known[:, :, :8] = False
    assert bool(wide_holes(known, 14)[:, :, :7].all())
    assert not bool(wide_holes(known, 16).any())


@pytest.mark.parametrize("size", [1, 3, 5])
def test_holes_of_a_few_pixels_are_never_wide(size):
    known = torch.ones((1, 16, 16), dtype=torch.bool)
    known[:, 5 : 5 + size, 5 : 5 + size] = False
    assert not bool(wide_holes(known, 0.1).any())
