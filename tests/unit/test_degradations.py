"""What holds of every degradation; holes of low-resolution maps; random ones: truth, map and what hints say of it."""

from dataclasses import replace

import pytest
import torch
from small_scenes import seeded
from torch.nn import functional

from dsr.degradation.downsampling import FACTS, KERNELS, Downsampling, Measured, encode_facts, local_noise, make_sample
from dsr.degradation.glass import KINDS, add_glass
from dsr.degradation.holes import Blobs, Shadows
from dsr.degradation.noise import NOISES, GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.degradation.random_degradation import Everything, add_folds
from dsr.geometry.camera import Camera
from dsr.geometry.hole_size import distance_to_known, wide_holes
from dsr.sample import Scene
from dsr.training.patches import soften

CLEAN = Everything(noises={"none": 1}, holes={"none": 1}, displaced=0, rounded=0, folds=0, relief=0, told=1)


def _scene(size=128, step=True):
    """Return a slope with a nearer square on it."""
    depth = torch.linspace(2, 3, size, dtype=torch.float64).repeat(1, size, 1)
    if step:
        depth[:, size // 4 : size // 2, size // 4 : size // 2] = 1.2
    rgb = torch.rand((3, size, size), generator=torch.Generator().manual_seed(0))
    return Scene("test", "slope", rgb, Camera.from_fov(60, size, size), depth)


def _averaged(depth, depth_lr, scale, kernel="box"):
    """Return whether a map has averages of inverse depth or, as some have, of depth."""
    model, fine = Downsampling(kernel), depth.float()
    means = {"inverse": model(fine.reciprocal(), scale).reciprocal(), "depth": model(fine, scale)}
    return next((name for name, each in means.items() if torch.allclose(depth_lr, each, rtol=1e-5)), None)


@pytest.mark.parametrize("kernel", KERNELS)
def test_clean_maps_are_those_of_the_kernel_and_hints_name_it(kernel):
    everything = replace(CLEAN, kernels={kernel: 1})
    found = set()
    for seed in range(20):
        sample, hints = everything(_scene(), 4, seeded(seed), soft=seed % 2 == 1)
        found.add(_averaged(_scene().true_depth, sample.depth_lr, 4, kernel))
        facts = torch.zeros(FACTS)
        facts[KERNELS.index(kernel)] = facts[len(KERNELS) + seed % 2] = facts[-1] = 1
        assert torch.equal(hints.facts, facts)
        assert float(hints.noise.max()) < 1e-6
    assert found == {"inverse"} | ({"depth"} if kernel != "nearest" else set())


@pytest.mark.parametrize("kind", ["white", "correlated", "waves", "structured", "flight", "lidar", "stereo"])
def test_hint_of_the_noise_is_as_large_as_it_is(kind):
    everything, scene = replace(CLEAN, noises={kind: 1}, kernels={"box": 1}), _scene(256, step=False)
    for seed in range(6):
        sample, hints = everything(scene, 2, seeded(seed))
        clean, _ = replace(everything, noises={"none": 1})(scene, 2, seeded(seed))
        _, untold = replace(everything, told=0)(scene, 2, seeded(seed))
        assert not bool(untold.facts.any() or untold.noise.any())
        error = (clean.depth_lr / sample.depth_lr).float() - 1
        measured = float(error[error.isfinite()].clamp(-0.1, 0.1).square().mean().sqrt())
        assert 1e-4 < measured < 0.1
        assert float(hints.noise.square().mean().sqrt()) == pytest.approx(measured, rel=0.6)
        assert bool(sample.depth_lr.isfinite().any())


def test_soft_scenes_have_half_the_size_and_mixed_values_at_steps():
    scene = _scene(126)
    soft = soften(scene)
    assert (soft.camera.width, soft.camera.height) == (63, 63)
    blocks = scene.depth.reciprocal().unfold(1, 2, 2).unfold(2, 2, 2).mean(dim=(-2, -1)).reciprocal()
    torch.testing.assert_close(soft.depth, blocks)
    whole = soften(scene, 1.0, halve=False)
    assert whole.camera == scene.camera
    assert torch.equal(whole.rgb, scene.rgb)
    assert 2 <= int(((whole.depth > 1.25) & (whole.depth < 1.95))[0, 36].sum()) <= 10  # across edges of the square
    assert soft.camera.fx == pytest.approx(scene.camera.fx / 2)
    assert bool(((soft.depth > 1.25) & (soft.depth < 1.95)).any())  # neither the square nor the slope


def test_relief_is_in_the_truth_and_its_means_in_the_map():
    everything = replace(CLEAN, kernels={"box": 1}, relief=1)
    scene, rough = _scene(step=False), 0
    for seed in range(20):
        sample, hints = everything(scene, 4, seeded(seed))
        change = (sample.depth / scene.depth - 1).abs()
        assert 1e-6 < float(change.mean()) < 0.02
        rough += float(change.mean()) > 1e-4
        assert _averaged(sample.depth, sample.depth_lr, 4), seed
        assert float(hints.noise.max()) < 1e-6, "the map has no noise"
    assert 3 < rough < 20
    same, _ = replace(everything, noises={"white": 1})(scene, 1, seeded())
    assert same.depth is scene.depth, "at factor 1 relief could not be distinguished from noise"


@pytest.mark.parametrize("kind", ["white", "correlated", "waves", "structured", "flight", "lidar", "stereo"])
def test_holes_of_the_truth_leave_their_surroundings_alone(kind):
    """Noise beside a hole is as large as elsewhere, and nothing is taken for a depth of 0 or of the mean."""
    scene = _scene(256, step=False)
    depth = scene.depth.clone()
    depth[:, 100:140, 60:180] = torch.nan
    everything = replace(CLEAN, noises={kind: 1}, kernels={"nearest": 1}, told=0)
    for seed in range(12):
        sample, _ = everything(replace(scene, depth=depth), 2, seeded(seed))
        assert bool(sample.depth_lr[:, 50:70, 30:90].isnan().all())
        clean, _ = everything(scene, 2, seeded(100))
        truth = Downsampling("nearest")(scene.depth.float(), 2)
        error = (sample.depth_lr.float() / truth - 1).abs()
        beside = error[:, 45:75, 25:95]
        assert clean.depth_lr.shape == sample.depth_lr.shape
        assert float(beside.nan_to_num(0).max()) < 0.02 + 3 * float(error[:, 90:].nan_to_num(0).max()), seed


def test_folds_are_in_truth_map_and_photo_and_only_in_places():
    scene = _scene(256, step=False)
    scene = replace(scene, rgb=torch.full_like(scene.rgb, 0.5))
    everything = replace(CLEAN, kernels={"box": 1}, folds=1, photo=0, textured=0)
    shaded, places = 0, []
    for seed in range(20):
        sample, _ = everything(scene, 2, seeded(seed))
        change = (sample.depth / scene.depth - 1).abs()[0]
        assert 1e-6 < float(change.max()) < 0.2
        places.append(float((change > 0.2 * change.max()).float().mean()))
        steepest = change.diff(dim=1).abs().amax() * scene.camera.fx
        assert float(steepest) < 4, "a slope of 0.63 at most, times the field's"
        light = (sample.rgb - 0.5).abs().amax(dim=0)
        shaded += bool(light.max() > 1e-3)
        near = functional.max_pool2d(change[None], 5, stride=1, padding=2)[0]
        assert not bool(light[near < 1e-6].gt(0.02).any()), "no shade without folds"
        assert _averaged(sample.depth, sample.depth_lr, 2), seed
    assert 5 < shaded < 20, "in some photos they cannot be seen"
    assert min(places) < 0.2


def test_each_fact_has_a_place_of_its_own():
    assert not bool(encode_facts().any())
    reported = [encode_facts(kernel) for kernel in KERNELS]
    reported += [encode_facts(soft=soft) for soft in (False, True)] + [encode_facts(noise=True)]
    assert torch.equal(torch.stack(reported), torch.eye(FACTS))
    assert torch.equal(encode_facts("bicubic", soft=True, noise=True), reported[3] + reported[6] + reported[7])
    with pytest.raises(ValueError, match=r"kernel: expected"):
        encode_facts("sinc")


def test_local_noise_ignores_holes_and_outliers():
    truth = (0.5 + 0.1 * (torch.arange(64, dtype=torch.float64) + 0.5) / 64).expand(1, 1, 48, 64)
    given = functional.avg_pool2d(truth, 4)
    error = 0.002 * torch.ones_like(given)
    error[..., 8:] = 0.02
    given = given * (1 + error)
    given[..., 2, 2], given[..., 5, 3] = torch.nan, 5.0
    noise = local_noise(given, truth)
    assert bool(noise.isfinite().all())
    torch.testing.assert_close(noise[..., 0], torch.full_like(noise[..., 0], 0.002), rtol=1e-3, atol=0)
    torch.testing.assert_close(noise[..., -1], torch.full_like(noise[..., -1], 0.02), rtol=1e-3, atol=0)


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
