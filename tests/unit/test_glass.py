"""Clear, mirroring and glossy objects: nothing changes beside them, the truth is theirs, and sensors see it wrongly."""

from dataclasses import replace

import pytest
import torch

from dsr.degradation.glass import KINDS, Pose, add_glass, ball
from dsr.degradation.random_degradation import SENSOR_NOISES, Everything
from dsr.geometry.camera import Camera
from dsr.sample import AllHolesError, Scene

SIZE = 96


def _generator(seed=0):
    return torch.Generator().manual_seed(seed)


def _scene(slope=0.5, size=SIZE):
    """Return a floor of 2 m and nearer below, or a wall at 2 m."""
    depth = (2 - slope * torch.linspace(-0.5, 1, size, dtype=torch.float64))[:, None].repeat(1, 1, size)
    rgb = torch.rand((3, size, size), generator=_generator(1))
    return Scene("test", "room", rgb, Camera.from_fov(60, size, size), depth)


def _changed(scene, other):
    """Return the mask of the pixels with another true depth, (H, W)."""
    return (scene.depth != other.depth)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_changes_beside_an_object_and_the_truth_is_nearer_inside(kind):
    scene, found = _scene(), 0
    for seed in range(25):
        other, seen = add_glass(scene, _generator(seed), {kind: 1})
        inside = _changed(scene, other)
        found += bool(inside.any())
        assert torch.equal(other.rgb[:, ~inside], scene.rgb[:, ~inside])
        assert torch.equal(seen[:, ~inside], scene.depth[:, ~inside])
        assert bool((other.depth <= scene.depth).all())
        assert bool((other.depth > 0).all())
        assert 0 <= float(other.rgb.min()) <= float(other.rgb.max()) <= 1
        assert seen.shape == scene.depth.shape
        assert not bool(seen.isinf().any())
    assert found > 20


@pytest.mark.parametrize("kind", KINDS)
def test_an_object_is_a_function_of_the_generator(kind):
    (one, seen), (other, again) = (add_glass(_scene(), _generator(7), {kind: 1}) for _ in range(2))
    assert torch.equal(one.rgb, other.rgb)
    assert torch.equal(one.depth, other.depth)
    torch.testing.assert_close(seen, again, rtol=0, atol=0, equal_nan=True)
    assert not torch.equal(one.rgb, add_glass(_scene(), _generator(8), {kind: 1})[0].rgb)


@pytest.mark.parametrize("kind", KINDS)
def test_holes_of_the_truth_are_no_depth_to_a_sensor(kind):
    scene = _scene()
    holes = torch.rand((1, SIZE, SIZE), generator=_generator()) < 0.7
    holes[..., : SIZE // 2] = True
    scene = replace(scene, depth=scene.depth.masked_fill(holes, torch.nan))
    for seed in range(10):
        other, seen = add_glass(scene, _generator(seed), {kind: 1})
        assert bool((other.depth.isfinite() | scene.depth.isnan()).all())
        assert bool((seen.isnan() | (seen > 0)).all())
        assert bool(((seen >= other.depth * 0.5) | seen.isnan()).all())


def test_a_ball_is_round():
    pose = Pose(48, 80, (0, -1), 0.4, -0.4, 2)
    body = ball(pose, 30, (SIZE, SIZE))
    v, u = torch.meshgrid(
        torch.arange(body.rows.start, body.rows.stop),
        torch.arange(body.columns.start, body.columns.stop),
        indexing="ij",
    )
    right, down = u - 48.0, v - 50.0
    away = (right.square() + down.square()).sqrt()
    assert torch.equal(body.mask[away < 29], torch.ones_like(body.mask[away < 29]))
    assert not bool(body.mask[away > 31].any())
    inner = away < 25
    expected = (900 - away.square()).clamp(min=0).sqrt()
    torch.testing.assert_close(body.near[inner], expected[inner], rtol=0.02, atol=0.3)
    torch.testing.assert_close(body.far[inner], -expected[inner], rtol=0.02, atol=0.3)
    normals = torch.stack((right, down, expected)) / 30
    torch.testing.assert_close(body.front[:, inner], normals[:, inner], rtol=0, atol=0.05)


def test_a_mirror_shows_the_virtual_image_or_nothing():
    scene, shown, lost = _scene(slope=0), 0, 0
    for seed in range(30):
        other, seen = add_glass(scene, _generator(seed), {"mirror": 1})
        behind = (seen - other.depth)[0][_changed(scene, other)]
        known = behind[behind.isfinite()]
        assert bool(((known.abs() < 1e-6) | ((known - 2).abs() < 1e-6)).all())  # a wall 2 m before the mirror
        shown += int((known > 1).sum())
        lost += int(behind.isnan().sum())
    assert shown > 1000
    assert lost > 1000


def test_clear_objects_are_seen_through_missed_or_seen_and_opaque_ones_are_right():
    scene, through, missed, right, opaque = _scene(slope=0), 0.0, 0.0, 0.0, 0.0
    for seed in range(40):
        other, seen = add_glass(scene, _generator(seed), {"vessel": 1})
        inside = _changed(scene, other)
        if int(inside.sum()) > 50:
            error = (seen / other.depth - 1)[0][inside]
            through += float((error > 0.03).double().mean()) / 40
            missed += float(error.isnan().double().mean()) / 40
            right += float((error.abs() < 0.01).double().mean()) / 40
        other, seen = add_glass(scene, _generator(seed), {"gloss": 1})
        inside = _changed(scene, other)
        opaque += float(torch.equal(seen[:, ~inside], scene.depth[:, ~inside]))
        error = (seen / other.depth - 1)[0][inside]
        assert float((error == 0).double().mean()) > 0.3
    assert min(through, missed, right) > 0.08


def _sample(everything, seed, *, soft=False):
    generator = _generator(seed)
    sample, hints = everything(_scene(), 2, generator, soft=soft)
    return sample, hints.noise, generator.get_state()


@pytest.mark.parametrize("kind", ["none", "white", "correlated", *SENSOR_NOISES])
def test_maps_that_show_no_glass_are_what_they_were(kind):
    without = Everything(noises={kind: 1}, told=0)
    for seed in range(3):
        for soft in {True, kind in SENSOR_NOISES}:  # truths with soft steps have no glass in any map
            one, other = (_sample(replace(without, clear=share), seed, soft=soft) for share in (0, 1))
            assert torch.equal(one[2], other[2])
            for name in ("rgb", "depth", "depth_lr"):
                first, second = getattr(one[0], name), getattr(other[0], name)
                torch.testing.assert_close(first, second, rtol=0, atol=0, equal_nan=True)


def test_maps_show_what_sensors_see_and_hints_on_noise_leave_it_out():
    everything = Everything(
        noises={"waves": 1}, holes={"none": 1}, kernels={"nearest": 1}, folds=0, relief=0, displaced=0, rounded=0,
        photo=0, textured=0, clear=1, told=1,
    )  # fmt: skip
    beyond = 0
    for seed in range(20):
        try:
            sample, noise, _ = _sample(everything, seed)
        except AllHolesError:
            continue
        before = _scene().depth / sample.depth  # in the objects above 1
        far = (sample.depth_lr / sample.depth[..., ::2, ::2] > 1.1) & (before[..., ::2, ::2] > 1)
        beyond += int(far.sum())
        assert float(noise.max()) < 0.05
    assert beyond > 200
