"""Training patches: pure functions of the seed and their number, true to geometry, cut from training scenes alone."""

import itertools
import multiprocessing
import os
import signal
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_scenes import SceneList

from dsr.degradation.downsampling import Downsampling, Measured, encode_facts
from dsr.degradation.noise import GaussianMultiplicative, Kinect
from dsr.degradation.random_degradation import Everything
from dsr.geometry.camera import Camera
from dsr.sample import Scene
from dsr.training.data_module import Part, PatchData, WholeScenes
from dsr.training.degradation import Degradation
from dsr.training.patches import Patches, augment, mirror, rotate90
from dsr.training.settings import PatchSettings

BOX = Downsampling("box")
X4 = Degradation(4, BOX)
CAMERA = Camera(width=60, height=44, fx=50.0, fy=47.0, cx=33.3, cy=17.9)
STEREO = replace(CAMERA, baseline=0.12, doffs=1.7)
NORMAL = torch.tensor([0.3, -0.4, -1.0], dtype=torch.float64)[:, None, None]
SIZE = 16


def _tilted(camera):
    return -2.0 / (NORMAL * camera.rays()).sum(dim=0, keepdim=True)


def _scene(number=0, camera=CAMERA, depth=None):
    """Return a scene whose photo says where each pixel lies: R the column, G the row, B the scene."""
    v, u = torch.meshgrid(torch.arange(float(camera.height)), torch.arange(float(camera.width)), indexing="ij")
    rgb = torch.stack((u / 255, v / 255, torch.full_like(u, number / 255)))
    return Scene("set", f"scene{number}", rgb, camera, _tilted(camera) if depth is None else depth)


def _settings(**changes):
    plain = {"patch": SIZE, "batch": 2, "validation_scenes": 2}
    return PatchSettings(**{**plain, "rotate": False, "depth_scale": 0.0, "colour": 0.0, "photo": 0.0, **changes})


def _patches(scenes=None, **changes):
    return Patches([scenes or [_scene()]], _settings(**changes), X4)


def _places(patch):
    """Return the rows and columns of the scene that a patch shows, and the scene's number."""
    columns, rows, number = (patch["rgb"] * 255).round().int().numpy()
    return rows, columns, int(number[0, 0])


def _same(first, second):
    return all(torch.equal(first[name], second[name]) for name in first)


def _data(scenes=None, degradation=X4, **changes):
    return PatchData(
        [Part(SceneList(scenes or [_scene(i) for i in range(6)]))], _settings(**changes), degradation, seed=7
    )


def _batches(data, count, step=0, *, accumulate=1, rank=0, world=1):
    """Return the first batches that a trainer at some step gets."""
    data.trainer = SimpleNamespace(
        global_step=step,
        accumulate_grad_batches=accumulate,
        global_rank=rank,
        world_size=world,
        max_steps=8,
        strategy=SimpleNamespace(root_device=torch.device("cpu")),
    )
    data.setup()
    return list(itertools.islice(data.train_dataloader(), count))


def _equal(first, second):
    return len(first) == len(second) and all(map(_same, first, second))


def test_patch_is_a_pure_function_of_the_seed_and_its_number():
    scenes, settings = [_scene(i) for i in range(3)], _settings(colour=0.1)
    whole, later = (Patches([scenes], settings, X4, seed=5) for _ in range(2))
    assert all(_same(later[i], whole[i]) for i in (9, 7, 8))  # whatever was asked for before
    assert not any(_same(whole[i], whole[7]) for i in range(12) if i != 7)
    assert not _same(Patches([scenes], settings, X4, seed=6)[7], whole[7])


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals")
def test_workers_outlast_a_signal_to_the_whole_group_until_the_trainer_has_ended():
    data, alone, before = _data(workers=2), _batches(_data(), 6), set(multiprocessing.active_children())
    data.setup()
    batches = iter(data.train_dataloader())
    first = next(batches)
    workers = set(multiprocessing.active_children()) - before
    assert len(workers) == 2
    for worker in workers:
        os.kill(worker.pid, signal.SIGTERM)
    time.sleep(0.3)  # a worker that has ended is an error as soon as its parent hears of it
    assert _equal([first, *itertools.islice(batches, 5)], alone)
    assert all(worker.is_alive() for worker in workers)
    del batches  # ends the workers
    assert not any(worker.is_alive() for worker in workers)


def test_loader_begins_at_the_trainers_step_and_has_the_length_of_the_training():
    data = _data(colour=0.1)
    whole = _batches(data, 6)
    assert _equal(_batches(data, 2, 4), whole[4:])
    assert _equal(_batches(data, 2, 2, accumulate=2), whole[4:])
    assert len(data.train_dataloader()) == 16  # as Lightning counts the batches that were done, too
    assert len(list(data.train_dataloader())) == 12
    data.trainer.max_steps = -1
    assert len(data.train_dataloader()) == 1000
    data.trainer = None
    assert len(data.train_dataloader()) == 1000


def test_devices_share_the_batches_of_a_step():
    data = _data(colour=0.1)
    whole = _batches(data, 6)
    assert _equal(_batches(data, 2, 1, rank=0, world=2), [whole[2], whole[4]])
    assert _equal(_batches(data, 2, 1, rank=1, world=2), [whole[3], whole[5]])


def test_held_out_scenes_are_validated_whole_and_never_trained_on():
    data = _data()
    assert sum(len(names) for _, names in data.trained) == 4
    assert {kind: names for kind, (_, names) in data.held_out.items()} == {"set": ["scene4", "scene5"]}
    seen = {int((255 * rgb[2, 0, 0]).round()) for batch in _batches(data, 60) for rgb in batch["rgb"]}
    assert seen == {0, 1, 2, 3}
    [loader] = data.val_dataloader()
    whole = list(loader)
    assert [int((255 * batch["rgb"][0, 2, 0, 0]).round()) for batch in whole] == [4, 5]
    assert all(batch["rgb"].shape == (1, 3, 44, 60) for batch in whole)
    assert {batch["depth"].dtype for batch in whole} == {torch.float64}
    torch.testing.assert_close(whole[0]["depth"][0], _tilted(CAMERA), rtol=0, atol=0)


def test_parts_give_patches_by_their_fractions_and_scenes_in_turn_also_with_sparse_depth():
    sparse = torch.full((1, 44, 60), torch.nan, dtype=torch.float64)
    sparse[0, ::3, ::3] = 2.0
    parts = [_scene(0)], [_scene(1), _scene(2, depth=sparse)], [_scene(3)]
    patches = Patches(parts, _settings(), X4, shares=[1, 3, 0])
    seen = np.array([_places(patches[i])[2] for i in range(400)])
    assert np.bincount(seen, minlength=4) / 400 == pytest.approx([0.25, 0.375, 0.375, 0], abs=0.07)


def test_parts_hold_out_the_last_of_their_first_scenes_under_distinct_names():
    sources = [SceneList([_scene(i) for i in numbers]) for numbers in ((0, 1, 2, 5), (3, 4))]
    data = PatchData([Part(source) for source in sources], _settings(validation_scenes=1, scenes=3), X4)
    assert data.trained == [(sources[0], ["scene0", "scene1"]), (sources[1], ["scene3"])]
    assert data.held_out == {"set": (sources[0], ["scene2"]), "set_2": (sources[1], ["scene4"])}
    data.setup()
    assert [next(iter(loader))["rgb"][0, 2, 0, 0] * 255 for loader in data.val_dataloader()] == pytest.approx([2, 4])


def test_other_datasets_validate_whole_and_alone_where_nothing_is_held_out():
    more = {"mine": SceneList([_scene(8), BARE, _scene(9)])}
    data = PatchData([Part(SceneList([_scene(0)]))], _settings(validation_scenes=0), X4, validation=more)
    data.setup()
    assert {name: scenes for name, (_, scenes) in data.held_out.items()} == {"mine": ["scene8", "scene9"]}
    with pytest.raises(ValueError, match=r"^validation_scenes: expected"):
        _data(validation_scenes=0)


def test_training_scene_cannot_validate_under_another_name():
    class _Copies(SceneList):
        def fingerprint(self, scene):
            return "the same" if scene in ("scene1", "scene8") else scene

    parts = [Part(_Copies([_scene(i) for i in range(6)]))]
    with pytest.raises(ValueError, match=r"validation.mine: expected"):
        PatchData(parts, _settings(), X4, validation={"mine": _Copies([_scene(8)])})
    other = PatchData(parts, _settings(), X4, validation={"mine": _Copies([_scene(9)])})
    assert list(other.held_out) == ["set", "mine"]


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
def test_patch_has_the_points_of_its_pixels_in_the_scene_up_to_the_mirror(camera):
    bumps = torch.from_numpy(np.random.default_rng(0).uniform(1, 3, (1, 44, 60)))
    full = (bumps * camera.rays()).numpy()
    patches, mirrors = _patches([_scene(camera=camera, depth=bumps)]), set()
    for i in range(60):
        patch = patches[i]
        rows, columns, _ = _places(patch)
        mirror = (columns[0, 1] - columns[0, 0], rows[1, 0] - rows[0, 0])
        assert set(np.abs(mirror)) == {1}
        expected = full[:, rows, columns] * np.array([*mirror, 1])[:, None, None]
        np.testing.assert_allclose((patch["depth"] * patch["rays"]).numpy(), expected, rtol=0, atol=2e-6)
        mirrors.add(mirror)
    assert mirrors == {(x, y) for x in (-1, 1) for y in (-1, 1)}


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
def test_low_resolution_disparity_is_the_box_mean_in_high_resolution_pixels(camera):
    patches = _patches([_scene(camera=camera)])
    for i in range(10):
        patch = patches[i]
        rows, columns, _ = _places(patch)
        shown = _tilted(camera).numpy()[0, rows, columns]
        fine = (camera.baseline or 0.2) * 50.0 / shown - camera.doffs
        coarse = fine.reshape(4, 4, 4, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(patch["disparity_lr"][0].numpy(), coarse, rtol=1e-6)
        np.testing.assert_allclose((patch["bf"] / patch["depth"] - patch["doffs"])[0].numpy(), fine, rtol=1e-5)


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
def test_min_max_lies_between_the_patchs_and_the_scenes_and_half_are_the_scenes(camera):
    """The scene's, as the patch's camera counts it: turned, and nearer or farther."""
    patches = _patches([_scene(camera=camera)], rotate=True, depth_scale=0.5)
    coarse = 1 / (1 / _tilted(camera)).reshape(11, 4, 15, 4).mean(dim=(1, 3)).numpy()
    shares = []
    for i in range(200):
        patch = patches[i]
        rows, columns, _ = _places(patch)
        factor = patch["depth"][0, 0, 0] / _tilted(camera)[0, rows[0, 0], columns[0, 0]]
        focal = camera.fx if rows[0, 0] == rows[0, 1] else camera.fy
        stereo = (camera.baseline or 0.2) * focal
        scene = [float(stereo / (factor * z) - camera.doffs) for z in (coarse.max(), coarse.min())]
        own = [float(patch["disparity_lr"].min()), float(patch["disparity_lr"].max())]
        low, high = patch["min_max"].flatten().tolist()
        assert scene[0] - 1e-5 <= low <= own[0] + 1e-5
        assert own[1] - 1e-5 <= high <= scene[1] + 1e-5
        shares.append(1 - (high - low - (own[1] - own[0])) / (scene[1] - scene[0] - (own[1] - own[0])))
    assert np.mean(np.abs(shares) < 1e-4) == pytest.approx(0.5, abs=0.1)
    between = np.array(shares)[np.abs(shares) >= 1e-4]
    assert between.mean() == pytest.approx(0.5, abs=0.1)
    assert between.std() == pytest.approx(12**-0.5, abs=0.05)  # of a uniform distribution


def test_min_max_of_a_whole_scene_is_its_low_resolution_maps_and_that_of_a_wall_has_width():
    whole = WholeScenes([_scene()], X4)[0]
    assert whole["min_max"].flatten().tolist() == pytest.approx(
        [float(whole["disparity_lr"].min()), float(whole["disparity_lr"].max())]
    )
    wall = WholeScenes([_scene(depth=torch.full((1, 44, 60), 2.0, dtype=torch.float64))], X4)[0]
    low, high = wall["min_max"].flatten().tolist()
    assert low == pytest.approx(5)
    assert high == pytest.approx(5.005)


def test_noise_is_new_in_every_patch_and_the_same_in_every_run():
    noisy = Degradation(4, BOX, GaussianMultiplicative(0.01))
    wall = _scene(depth=torch.full((1, 44, 60), 2.0, dtype=torch.float64))
    first, again = (Patches([[wall]], _settings(), noisy) for _ in range(2))
    assert _same(first[7], again[7])
    values = np.stack([first[i]["disparity_lr"].numpy() / 5 - 1 for i in range(50)])
    assert values.std() == pytest.approx(0.01, rel=0.1)
    assert np.abs(np.corrcoef(values.reshape(50, -1))[np.triu_indices(50, 1)]).max() < 0.95
    torch.testing.assert_close(first[7]["depth"], torch.full((1, 16, 16), 2.0))
    whole, other = (WholeScenes([wall], noisy, seed)[0]["disparity_lr"] for seed in (0, 1))
    assert torch.equal(whole, WholeScenes([wall], noisy, 0)[0]["disparity_lr"])
    assert not torch.equal(whole, other)


def test_colour_is_a_gain_per_channel_of_the_given_spread():
    bright, grey = (replace(_scene(), rgb=torch.full((3, 44, 60), value)) for value in (0.97, 0.4))
    assert all(float(_patches([bright], colour=0.5)[i]["rgb"].max()) <= 1 for i in range(20))
    assert torch.equal(_patches([bright])[0]["rgb"], torch.full((3, SIZE, SIZE), 0.97))  # off
    patches = _patches([grey], colour=0.1)
    gains = np.stack([patches[i]["rgb"].numpy() / 0.4 for i in range(300)])
    assert np.ptp(gains, axis=(2, 3)).max() < 1e-6
    gains = gains[:, :, 0, 0]
    assert gains.std(axis=0) == pytest.approx([0.1] * 3, abs=0.02)
    assert gains.mean(axis=0) == pytest.approx([1] * 3, abs=0.03)
    assert np.abs(np.corrcoef(gains.T)[np.triu_indices(3, 1)]).max() < 0.2


def test_holes_are_kept_and_half_of_a_patch_is_valid_where_possible():
    depth = _tilted(CAMERA)
    depth[:, :, :30] = torch.nan
    patches, shares = _patches([_scene(depth=depth)]), []
    for i in range(60):
        patch = patches[i]
        _, columns, _ = _places(patch)
        np.testing.assert_array_equal(patch["depth"][0].isnan().numpy(), columns < 30)
        empty = (columns < 30).reshape(4, 4, 4, 4).all(axis=(1, 3))
        np.testing.assert_array_equal(patch["disparity_lr"][0].isnan().numpy(), empty)
        shares.append(float(patch["depth"].isfinite().float().mean()))
    assert 0.5 <= min(shares) < 1


SMALL = _scene(1, replace(CAMERA, width=60, height=30))
BARE = Scene("set", "bare", _scene().rgb, CAMERA, None, {4: torch.ones(1, 11, 15)})


def test_measured_map_cannot_be_cropped():
    patches = Patches([[_scene()]], _settings(), Degradation(4, Measured()))
    with pytest.raises(ValueError, match="downsampling=measured expects"):
        patches[0]


def test_measured_maps_to_validate_with_have_the_hints_of_the_assumed_model():
    scene = replace(_scene(), measured={4: torch.ones(1, 11, 15)})
    [batch] = WholeScenes([scene], Degradation(4, Measured("bicubic")), hinted=True)
    assert torch.equal(batch["facts"], encode_facts("bicubic", soft=False, noise=True)[None])


REFUSALS = {
    **{
        f"shares={shares}": (
            lambda shares=shares: Patches(len(shares) * [[_scene()]], _settings(), X4, shares=shares),
            "^shares: expected numbers of 0 or more, one of them positive, got ",
        )
        for shares in ([0.0], [2.0, -1.0], [2.0, float("nan")], [2.0, float("inf")])
    },
    "a share": (
        lambda: PatchData([Part(SceneList([_scene()]), share=-1.0)], _settings(), X4),
        "^share of .*, got -1.0",
    ),
    "too few scenes": (lambda: _data(validation_scenes=6), "^validation_scenes: expected less than .*'s 6 scenes"),
    "a patch in 4": (lambda: _data(patch=30), "^patch: expected a size that scale=4 divides"),
    "a patch in 16": (lambda: _data(degradation=Degradation(16, BOX), patch=24), "^patch: .*scale=16 divides, got 24"),
    "factors": (lambda: _degraded([_scene()], Everything(scales={4: 1, 16: 1}), size=24), "16"),
    "a small scene": (lambda: _patches([_scene(), SMALL], patch=32), "^patch: expected at most scene1's 30 x 60"),
    "no truth": (lambda: _data([BARE, *map(_scene, range(3))]).setup(), "^bare: expected a true depth, there is none"),
    "no truth to validate with": (
        lambda: PatchData([Part(SceneList([_scene()]))], _settings(validation_scenes=0), X4,
                          validation={"mine": SceneList([BARE])}).setup(),
        "^validation.mine: expected scenes with a true depth, there is none",
    ),
    "no part": (lambda: Patches([], _settings(), X4), "expected a scene or more"),
    "an empty part": (lambda: Patches([[_scene()], []], _settings(), X4), "expected a scene or more"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSALS)
def test_value_out_of_range_is_refused_by_its_key(case):
    act, message = REFUSALS[case]
    with pytest.raises(ValueError, match=message):
        act()


def test_window_that_noise_leaves_empty_is_replaced_by_another():
    far = _scene(1, depth=torch.full((1, CAMERA.height, CAMERA.width), 50.0, dtype=torch.float64))
    degradation = Degradation(4, BOX, Kinect(nearest=None, farthest=20.0))
    patches = Patches([[far, _scene()]], _settings(), degradation)
    for index in range(8):
        assert patches[index]["depth"].nanmean() < 20
    with pytest.raises(ValueError, match="patches: expected"):
        Patches([[far]], _settings(), degradation)[0]


def _degraded(scenes, everything, batch=2, size=SIZE, **changes):
    return Patches([scenes], _settings(patch=size, batch=batch, **changes), X4, everything=everything)


def test_degraded_patches_are_pure_functions_of_their_number_and_describe_themselves():
    scenes = [_scene(number) for number in range(3)]
    first, again = (_degraded(scenes, Everything(soft=0.5)) for _ in range(2))
    for index in (7, 0, 3):
        for name, value in first[index].items():
            torch.testing.assert_close(again[index][name], value, rtol=0, atol=0, equal_nan=True)
    found = [first[index] for index in range(12)]
    assert {float(patch["soft"]) for patch in found} == {0.0, 1.0}
    for patch in found:
        assert patch["depth"].shape == (1, SIZE, SIZE)
        assert patch["noise"].shape == patch["disparity_lr"].shape == (1, SIZE // 4, SIZE // 4)
        reported = patch["facts"][5:7]
        assert not bool(reported.any()) or bool(reported[int(patch["soft"])])


def test_all_patches_of_a_batch_have_one_factor():
    patches = _degraded([_scene()], Everything(scales={1: 0.5, 2: 0.5}, holes={"none": 1}), batch=3)
    factors = [SIZE // patches[index]["disparity_lr"].shape[-1] for index in range(36)]
    assert all(len(set(factors[i : i + 3])) == 1 for i in range(0, 36, 3))
    assert set(factors) == {1, 2}


def test_soft_patches_of_scenes_with_holes_of_several_sizes_are_soft():
    """A step gets mixed pixels, holes stay holes, and a map of a sensor is no obstacle."""
    scenes = []
    for number, (height, width) in enumerate(((16, 16), (44, 60), (80, 64))):
        camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2)
        depth = torch.full((1, height, width), 2.0, dtype=torch.float64)
        depth[..., ::2] = 1.0
        depth[:, :3] = torch.nan
        scene = _scene(number, camera, depth)
        scenes.append(replace(scene, measured={4.0: depth[:, : height // 4, : width // 4]}))
    everything = Everything(soft=1, folds=0, relief=0, noises={"none": 1}, holes={"none": 1}, displaced=0, rounded=0)
    patches = _degraded(scenes, everything)
    for index in range(12):
        depth = patches[index]["depth"]
        inside = depth[depth.isfinite()]
        mixed = (inside > 1.02) & (inside < 1.96)
        assert float(mixed.double().mean()) > 0.9
    sharp = _degraded(scenes, replace(everything, soft=0))[0]["depth"]
    assert set(sharp[sharp.isfinite()].tolist()) == {1.0, 2.0}


# Augmentation: what is turned or mirrored is another view of the same surface, or of its mirror image

WIDE = Camera(width=31, height=23, fx=30.0, fy=27.0, cx=13.3, cy=9.9, baseline=0.1, doffs=0.7)


def _waves():
    random = np.random.default_rng(0)
    v, u = np.mgrid[:23, :31]
    depth = torch.from_numpy(2 + 0.03 * u + 0.2 * np.sin(u / 3) * np.cos(v / 4))[None]
    depth[0, 5, 7] = torch.nan
    rgb = torch.from_numpy(random.random((3, 23, 31))).float()
    return Scene("set", "waves", rgb, WIDE, depth, {1: depth})


def _points(scene):
    return scene.depth * scene.camera.rays()


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_scene_has_the_turned_points(turns):
    expected, scene = _points(_waves()).rot90(turns, (-2, -1)), rotate90(_waves(), turns)
    for _ in range(turns):  # counterclockwise about the axis, as a picture with y down shows it
        expected = torch.stack((expected[1], -expected[0], expected[2]))
    torch.testing.assert_close(_points(scene), expected, rtol=0, atol=1e-12, equal_nan=True)
    assert torch.equal(scene.rgb, _waves().rgb.rot90(turns, (-2, -1)))
    assert not turns or not scene.measured  # which would have to be turned, too


@pytest.mark.parametrize("vertical", [False, True])
def test_mirrored_scene_has_the_mirrored_points(vertical):
    sign = torch.tensor([1.0, -1.0, 1.0] if vertical else [-1.0, 1.0, 1.0], dtype=torch.float64)[:, None, None]
    expected = sign * _points(_waves()).flip(-2 if vertical else -1)
    shown = _points(mirror(_waves(), vertical=vertical))
    torch.testing.assert_close(shown, expected, rtol=0, atol=1e-12, equal_nan=True)


def test_factor_of_a_varied_scene_is_that_of_its_depth():
    settings = PatchSettings(flip=False, rotate=False, depth_scale=0.5, colour=0.0)
    random, factors = np.random.default_rng(0), []
    for _ in range(200):
        scene, factor = augment(_waves(), settings, random)
        torch.testing.assert_close(_points(scene), factor * _points(_waves()), rtol=1e-13, atol=0, equal_nan=True)
        assert scene.camera == WIDE
        factors.append(np.log(factor))
    assert -0.5 <= min(factors) < -0.45
    assert 0.45 < max(factors) <= 0.5
    assert np.mean(factors) == pytest.approx(0, abs=0.07)
