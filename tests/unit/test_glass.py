"""Clear, mirroring and glossy objects: how they are made, what sensors see of them, and what finds them."""

from dataclasses import replace

import pytest
import torch
from small_scenes import seeded

from dsr.data.rendered import Procedural
from dsr.degradation.glass import KINDS, Pose, add_glass, ball
from dsr.degradation.noise import NOISES
from dsr.degradation.random_degradation import SENSOR_NOISES, Everything
from dsr.geometry.camera import Camera
from dsr.inference import upsample_surface
from dsr.methods.glass import FEATURES, expect_glass, glass_features, probability_of_glass
from dsr.metrics.calibration import off_auc
from dsr.sample import AllHolesError, Scene

SIZE = 96


def _scene(slope=0.5, size=SIZE):
    """Return a floor of 2 m and nearer below, or a wall at 2 m."""
    depth = (2 - slope * torch.linspace(-0.5, 1, size, dtype=torch.float64))[:, None].repeat(1, 1, size)
    rgb = torch.rand((3, size, size), generator=seeded(1))
    return Scene("test", "room", rgb, Camera.from_fov(60, size, size), depth)


def _changed(scene, other):
    """Return the mask of the pixels with another true depth, (H, W)."""
    return (scene.depth != other.depth)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_changes_beside_an_object_and_the_truth_is_nearer_inside(kind):
    scene, found = _scene(), 0
    for seed in range(12):
        other, seen = add_glass(scene, seeded(seed), {kind: 1})
        inside = _changed(scene, other)
        found += bool(inside.any())
        assert torch.equal(other.rgb[:, ~inside], scene.rgb[:, ~inside])
        assert torch.equal(seen[:, ~inside], scene.depth[:, ~inside])
        assert bool((other.depth <= scene.depth).all())
        assert bool((other.depth > 0).all())
        assert 0 <= float(other.rgb.min()) <= float(other.rgb.max()) <= 1
        assert seen.shape == scene.depth.shape
        assert not bool(seen.isinf().any())
    assert found > 9


@pytest.mark.parametrize("kind", KINDS)
def test_holes_of_the_truth_are_no_depth_to_a_sensor(kind):
    scene = _scene()
    holes = torch.rand((1, SIZE, SIZE), generator=seeded()) < 0.7
    holes[..., : SIZE // 2] = True
    scene = replace(scene, depth=scene.depth.masked_fill(holes, torch.nan))
    for seed in range(5):
        other, seen = add_glass(scene, seeded(seed), {kind: 1})
        assert bool((other.depth.isfinite() | scene.depth.isnan()).all())
        assert bool((seen.isnan() | (seen > 0)).all())
        assert bool(((seen >= other.depth * 0.5) | seen.isnan()).all())


def test_a_ball_is_round():
    pose = Pose(48, 80, (0, -1), 0.4, -0.4, 2)
    body = ball(pose, 30, (SIZE, SIZE))
    v, u = (torch.arange(each.start, each.stop) for each in (body.rows, body.columns))
    v, u = torch.meshgrid(v, u, indexing="ij")
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
        other, seen = add_glass(scene, seeded(seed), {"mirror": 1})
        behind = (seen - other.depth)[0][_changed(scene, other)]
        known = behind[behind.isfinite()]
        assert bool(((known.abs() < 1e-6) | ((known - 2).abs() < 1e-6)).all())  # a wall 2 m before the mirror
        shown += int((known > 1).sum())
        lost += int(behind.isnan().sum())
    assert shown > 1000
    assert lost > 1000


def _sample(everything, seed, *, soft=False):
    generator = seeded(seed)
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


def test_features_do_not_depend_on_the_unit_of_depth():
    rgb, inverse = torch.rand(3, 120, 160, generator=seeded()), 0.5 + 0.01 * torch.randn(1, 60, 80, generator=seeded())
    inverse[0, 10:14, 12:20] = torch.nan
    found = glass_features(rgb, inverse)
    assert found.shape == (FEATURES, 240, 320)
    assert bool(found.isfinite().all())
    torch.testing.assert_close(glass_features(rgb, 1e3 * inverse), found, rtol=1e-3, atol=2e-3)


def _contradiction(*, textured, holes):
    """Return a photo and a wall; amid them a patch with texture and a highlight, and a patch that is lost in part."""
    rgb, inverse = torch.full((3, 240, 320), 0.5), torch.full((1, 240, 320), 0.5)
    if textured:
        noise = torch.rand(1, 40, 40, generator=torch.Generator().manual_seed(0))
        rgb[:, 100:140, 140:180] += 0.3 * (noise - 0.5)
        rgb[:, 104:108, 150:170] = 0.95
    if holes:
        inverse[0, 104:136, 150:156] = torch.nan
        inverse[0, 120:128, 150:174] = torch.nan
    return rgb, inverse


def test_texture_and_holes_together_are_glass():
    both, texture, holes = (
        float(probability_of_glass(*_contradiction(textured=textured, holes=holes)).max())
        for textured, holes in ((True, True), (True, False), (False, True))
    )
    assert both > 0.15
    assert texture == 0
    assert both > 2 * holes


@pytest.mark.parametrize("share", [0.9, 0.5, 0.2])
def test_single_missing_or_measured_pixels_are_no_glass(share):
    rgb, inverse = _contradiction(textured=True, holes=False)
    lost = torch.rand(inverse.shape, generator=torch.Generator().manual_seed(1)) > share
    assert float((expect_glass(rgb, inverse.masked_fill(lost, torch.nan)) > 0.02).float().mean()) < 0.01


def test_what_is_cut_away_is_no_glass():
    rgb, inverse = _contradiction(textured=True, holes=False)
    inverse[..., :130] = torch.nan
    assert float(probability_of_glass(rgb, inverse).max()) == 0
    narrow = inverse.clone()
    narrow[..., :105] = 0.5
    assert float(probability_of_glass(rgb, narrow).max()) > 0


@pytest.mark.slow
def test_wrong_depth_of_simulated_vessels_is_ranked_first_and_expected_to_be_wrong():
    source, aucs = Procedural(4, size=192, seed=5), []
    for number, name in enumerate(source.scenes()):
        scene, generator = source.load(name), torch.Generator().manual_seed(number)
        full, seen = add_glass(scene, generator, {"vessel": 1})
        rgb = full.rgb.float()
        inverse = NOISES["structured"](seen.float().reciprocal(), rgb.mean(dim=0, keepdim=True), generator)
        wrong = (full.depth != scene.depth) & ((inverse * full.depth - 1).abs() > 0.02)
        known = inverse.isfinite()
        if int((wrong & known).sum()) < 100:
            continue
        found = probability_of_glass(rgb, inverse)
        assert found.shape == wrong.shape
        aucs.append(float(off_auc(found[known].double(), wrong[known].double(), 0.5)))
    assert len(aucs) >= 2
    assert sum(aucs) / len(aucs) > 0.8


def test_stated_errors_of_all_methods_know_glass_unless_the_map_is_told_to_be_clean(monkeypatch):
    rgb, depth = torch.full((3, 48, 64), 0.5), torch.full((1, 48, 64), 2.0)
    camera = Camera.from_fov(60, width=64, height=48)
    glass = torch.zeros(1, 48, 64)
    glass[:, :24] = 0.06
    monkeypatch.setattr("dsr.inference.any_ratio.expect_glass", lambda *_: glass)
    for method in ("facets", "bilateral"):
        surface = upsample_surface(rgb, depth, camera, method=method, device="cpu")
        torch.testing.assert_close(surface.depth_error[:, :24], 0.06 * surface.depth[:, :24])
        assert float(surface.depth_error[:, 26:].max()) < 0.06
        assert surface.glass == 0.5
    clean = upsample_surface(rgb, depth, camera, settings={"noise": 0.0}, device="cpu")
    assert float(clean.depth_error.max()) < 0.06
    assert clean.glass is None
