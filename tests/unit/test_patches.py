"""Training patches: pure functions of the seed and their number, true to geometry, cut from training scenes alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.data.patches import Batch, PatchData, Patches, PatchSettings, WholeScenes, tensors_of
from dsr.degrade import Downsampling, Measured, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.msg_net import normalised
from dsr.sample import Scene

BOX = Downsampling("box")
CAMERA = Camera(width=60, height=44, fx=50.0, fy=47.0, cx=33.3, cy=17.9)
STEREO = replace(CAMERA, baseline=0.12, doffs=1.7)
NORMAL = torch.tensor([0.3, -0.4, -1.0], dtype=torch.float64)[:, None, None]
SIZE = 16


def _tilted(camera: Camera) -> Tensor:
    return -2.0 / (NORMAL * camera.rays()).sum(dim=0, keepdim=True)


def _scene(number: int = 0, camera: Camera = CAMERA, depth: Tensor | None = None) -> Scene:
    """Return a scene whose photo says where each pixel lies: R the column, G the row, B the scene."""
    v, u = torch.meshgrid(torch.arange(float(camera.height)), torch.arange(float(camera.width)), indexing="ij")
    rgb = torch.stack((u / 255, v / 255, torch.full_like(u, number / 255)))
    return Scene("set", f"scene{number}", rgb, camera, _tilted(camera) if depth is None else depth)


def _settings(**changes: Any) -> PatchSettings:
    return PatchSettings(**{"size": SIZE, "batch": 2, "steps": 3, "validation_scenes": 2, "colour": 0.0, **changes})


def _patches(scenes: list[Scene] | None = None, count: int = 40, **changes: Any) -> Patches:
    return Patches(scenes or [_scene()], _settings(**changes), 4, BOX, count=count)


def _places(patch: Batch) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the rows and columns of the scene that a patch shows, and the scene's number."""
    columns, rows, number = (patch["rgb"] * 255).round().int().numpy()
    return rows, columns, int(number[0, 0])


def _same(first: Batch, second: Batch) -> bool:
    return all(torch.equal(first[name], second[name]) for name in first)


class _Source:
    """A data set of six scenes."""

    name = "set"

    def __init__(self, scenes: list[Scene]) -> None:
        self._scenes = {scene.name: scene for scene in scenes}

    def scenes(self) -> list[str]:
        return list(self._scenes)

    def load(self, scene: str) -> Scene:
        return self._scenes[scene]

    def fingerprint(self, scene: str) -> str:
        return scene


def _data(scenes: list[Scene] | None = None, scale: int = 4, **changes: Any) -> PatchData:
    return PatchData(_Source(scenes or [_scene(i) for i in range(6)]), _settings(**changes), scale, BOX, seed=7)


def _epoch(data: PatchData, epoch: int, max_steps: int = -1) -> list[Batch]:
    data.trainer = SimpleNamespace(current_epoch=epoch, max_steps=max_steps)  # type: ignore[assignment]
    data.setup()
    return list(data.train_dataloader())


def test_a_patch_is_a_pure_function_of_the_seed_and_its_number() -> None:
    scenes, settings = [_scene(i) for i in range(3)], _settings(colour=0.1)
    whole = Patches(scenes, settings, 4, BOX, seed=5, count=12)
    later = Patches(scenes, settings, 4, BOX, seed=5, first=7, count=3)
    assert (len(whole), len(later)) == (12, 3)
    assert all(_same(later[i], whole[7 + i]) for i in (2, 0, 1))  # whatever was asked for before
    assert _same(whole[7], whole[7])
    assert not any(_same(whole[i], whole[7]) for i in range(12) if i != 7)
    assert not _same(Patches(scenes, settings, 4, BOX, seed=6, count=12)[7], whole[7])


def test_the_global_random_states_neither_matter_nor_change() -> None:
    patches = _patches(colour=0.1)
    torch.manual_seed(1)
    before, first = torch.get_rng_state(), patches[3]
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    np.random.seed(3)  # noqa: NPY002 - the global state is what is tested
    assert _same(patches[3], first)


def test_workers_cut_the_patches_that_the_trainer_would() -> None:
    alone, helped = (_epoch(_data(colour=0.1, workers=workers), 1) for workers in (0, 2))
    assert len(alone) == len(helped) == 3
    assert all(_same(first, second) for first, second in zip(alone, helped, strict=True))


def test_epochs_go_on_where_the_one_before_ended() -> None:
    data = _data()
    batches = [batch for epoch in range(3) for batch in _epoch(data, epoch)]
    patches = Patches([_scene(i) for i in range(4)], _settings(), 4, BOX, seed=7, count=18)
    for i, batch in enumerate(batches):
        for j in range(2):
            single = patches[2 * i + j]
            assert all(torch.allclose(batch[name][j], single[name], rtol=1e-6) for name in single)  # depth was float32


def test_some_patches_are_the_first_of_the_run() -> None:
    data = _data()
    data.setup()
    first = _epoch(data, 0)
    for i, patch in enumerate(data.some_patches(4)):
        assert all(torch.equal(patch[name], first[i // 2][name][i % 2]) for name in patch)


def test_the_last_epoch_ends_with_the_training() -> None:
    data = _data()
    assert [len(_epoch(data, epoch, max_steps=8)) for epoch in range(3)] == [3, 3, 2]


def test_held_out_scenes_are_validated_with_whole_and_never_trained_on() -> None:
    data = _data(steps=60)
    assert (data.training_names, data.validation_names) == ([f"scene{i}" for i in range(4)], ["scene4", "scene5"])
    seen = {int((255 * rgb[2, 0, 0]).round()) for batch in _epoch(data, 0) for rgb in batch["rgb"]}
    assert seen == {0, 1, 2, 3}
    whole = list(data.val_dataloader())
    assert [int((255 * batch["rgb"][0, 2, 0, 0]).round()) for batch in whole] == [4, 5]
    assert all(batch["rgb"].shape == (1, 3, 44, 60) for batch in whole)
    assert {batch["depth"].dtype for batch in whole} == {torch.float64}
    torch.testing.assert_close(whole[0]["depth"][0], _tilted(CAMERA), rtol=0, atol=0)


def test_patches_reach_every_row_and_column_of_a_scene() -> None:
    patches = _patches(count=400)
    seen: tuple[set[int], set[int]] = (set(), set())
    for i in range(400):
        for places, reached in zip(_places(patches[i])[:2], seen, strict=True):
            reached.update(places.flatten().tolist())
    assert seen == (set(range(44)), set(range(60)))


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
def test_points_of_a_patch_are_those_of_its_pixels_in_the_scene_up_to_the_mirror(camera: Camera) -> None:
    bumps = torch.from_numpy(np.random.default_rng(0).uniform(1, 3, (1, 44, 60)))
    full = (bumps * camera.rays()).numpy()
    patches, mirrors = _patches([_scene(camera=camera, depth=bumps)], count=60), set()
    for i in range(60):
        patch = patches[i]
        rows, columns, _ = _places(patch)
        mirror = (columns[0, 1] - columns[0, 0], rows[1, 0] - rows[0, 0])
        assert set(np.abs(mirror)) == {1}
        expected = full[:, rows, columns] * np.array([*mirror, 1])[:, None, None]
        np.testing.assert_allclose((patch["depth"] * patch["rays"]).numpy(), expected, rtol=0, atol=2e-6)
        mirrors.add(mirror)
    assert mirrors == {(x, y) for x in (-1, 1) for y in (-1, 1)}


def test_a_plane_is_a_plane_in_the_mirrored_frame() -> None:
    patches = _patches()
    for i in range(20):
        patch = patches[i]
        rows, columns, _ = _places(patch)
        mirror = torch.tensor([columns[0, 1] - columns[0, 0], rows[1, 0] - rows[0, 0], 1])[:, None, None]
        offset = (mirror * NORMAL * patch["depth"] * patch["rays"]).sum(dim=0)
        torch.testing.assert_close(offset, torch.full_like(offset, -2.0), rtol=2e-6, atol=0)


def test_without_flip_nothing_is_mirrored() -> None:
    patches = _patches(flip=False)
    for i in range(40):
        rows, columns, _ = _places(patches[i])
        assert columns[0, 1] - columns[0, 0] == rows[1, 0] - rows[0, 0] == 1


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
def test_the_coarse_disparity_is_the_box_mean_of_the_fine_one_in_fine_pixels(camera: Camera) -> None:
    patches = _patches([_scene(camera=camera)])
    for i in range(10):
        patch = patches[i]
        rows, columns, _ = _places(patch)
        shown = _tilted(camera).numpy()[0, rows, columns]
        fine = (camera.baseline or 0.2) * 50.0 / shown - camera.doffs
        coarse = fine.reshape(4, 4, 4, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(patch["disparity_lr"][0].numpy(), coarse, rtol=1e-6)
        np.testing.assert_allclose((patch["stereo"] / patch["depth"] - patch["doffs"])[0].numpy(), fine, rtol=1e-5)


def test_the_networks_input_depends_on_the_coarse_map_alone() -> None:
    """Fine depth that changes within its blocks, far beyond the coarse range, leaves no trace."""
    disparity = 50 * 0.2 / _tilted(CAMERA)
    checker = torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).repeat(22, 30).double()
    plain, wild = (_scene(depth=50 * 0.2 / (disparity + swing * checker)) for swing in (0.0, 2.5))
    first, second = (tensors_of(make_sample(scene, 4, BOX, "disparity")) for scene in (plain, wild))
    assert (first["depth"] - second["depth"]).abs().min() > 0.1
    assert second["depth"].max() > 1.2 * first["depth"].max()
    assert torch.equal(first["rgb"], second["rgb"])
    torch.testing.assert_close(second["disparity_lr"], first["disparity_lr"], rtol=1e-6, atol=0)
    for one, other in zip(*(normalised(each["disparity_lr"][None]) for each in (first, second)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def test_colour_is_a_gain_per_channel_of_the_asked_spread() -> None:
    grey = replace(_scene(), rgb=torch.full((3, 44, 60), 0.4))
    patches = _patches([grey], count=300, colour=0.1)
    gains = np.stack([patches[i]["rgb"].numpy() / 0.4 for i in range(300)])
    assert np.ptp(gains, axis=(2, 3)).max() < 1e-6
    gains = gains[:, :, 0, 0]
    assert gains.std(axis=0) == pytest.approx([0.1] * 3, abs=0.02)
    assert gains.mean(axis=0) == pytest.approx([1] * 3, abs=0.03)
    assert np.abs(np.corrcoef(gains.T)[np.triu_indices(3, 1)]).max() < 0.2


def test_colour_stays_within_its_range_and_off_leaves_the_photo_as_it_is() -> None:
    bright = replace(_scene(), rgb=torch.full((3, 44, 60), 0.97))
    strong, off = _patches([bright], colour=0.5), _patches([bright])
    assert all(0 <= strong[i]["rgb"].min() <= strong[i]["rgb"].max() <= 1 for i in range(40))
    assert all(torch.equal(off[i]["rgb"], torch.full((3, SIZE, SIZE), 0.97)) for i in range(5))


def test_holes_stay_holes_and_half_of_a_patch_is_known_where_that_can_be_had() -> None:
    depth = _tilted(CAMERA)
    depth[:, :, :30] = torch.nan
    patches, shares = _patches([_scene(depth=depth)], count=60), []
    for i in range(60):
        patch = patches[i]
        _, columns, _ = _places(patch)
        np.testing.assert_array_equal(patch["depth"][0].isnan().numpy(), columns < 30)
        empty = (columns < 30).reshape(4, 4, 4, 4).all(axis=(1, 3))
        np.testing.assert_array_equal(patch["disparity_lr"][0].isnan().numpy(), empty)
        shares.append(float(patch["depth"].isfinite().float().mean()))
    assert 0.5 <= min(shares) < 1


def test_scenes_that_are_mostly_holes_still_give_patches() -> None:
    depth = torch.full((1, 44, 60), torch.nan, dtype=torch.float64)
    depth[0, ::3, ::3] = _tilted(CAMERA)[0, ::3, ::3]
    patches = _patches([_scene(depth=depth)])
    assert all(0 < patches[i]["depth"].isfinite().float().mean() < 0.5 for i in range(40))


def test_shapes_and_types_are_those_promised() -> None:
    shapes = {
        "rgb": (3, 16, 16),
        "disparity_lr": (1, 4, 4),
        "depth": (1, 16, 16),
        "rays": (3, 16, 16),
        "stereo": (1, 1, 1),
        "doffs": (1, 1, 1),
    }
    patch = _patches()[0]
    assert {name: tuple(value.shape) for name, value in patch.items()} == shapes
    assert {value.dtype for value in patch.values()} == {torch.float32}
    whole = WholeScenes([_scene()], 4, BOX)[0]
    assert whole["depth"].dtype == whole["rays"].dtype == whole["stereo"].dtype == torch.float64
    assert whole["rgb"].dtype == whole["disparity_lr"].dtype == torch.float32


def test_a_data_set_with_too_few_scenes_is_refused() -> None:
    with pytest.raises(ValueError, match=r"trainer.validation_scenes: expected fewer than the 6 scenes, got 6"):
        _data(validation_scenes=6)


def test_a_scene_too_small_for_a_patch_is_refused_by_name_before_training() -> None:
    small = _scene(1, replace(CAMERA, width=60, height=30))
    message = "trainer.patch: expected at most scene1's 30 x 60, got 32"
    with pytest.raises(ValueError, match=message):
        _data([_scene(0), small, _scene(2), _scene(3)], size=32).setup()
    with pytest.raises(ValueError, match=message):
        _patches([_scene(0), small], size=32)


def test_a_scene_without_true_depth_is_refused_by_name() -> None:
    measured = Scene("set", "bare", _scene().rgb, CAMERA, None, {4: torch.ones(1, 11, 15)})
    for scenes in ([measured, *(_scene(i) for i in range(2))], [*(_scene(i) for i in range(2)), measured]):
        with pytest.raises(ValueError, match="bare: expected a true depth to train with, there is none"):
            _data(scenes, validation_scenes=1).setup()


def test_a_patch_that_the_scale_does_not_divide_is_refused() -> None:
    with pytest.raises(ValueError, match=r"trainer.patch: expected a size that scale=4 divides, got 30"):
        _data(size=30)
    with pytest.raises(ValueError, match=r"trainer.patch: expected a size that scale=16 divides, got 24"):
        _data(scale=16, size=24)


def test_a_measured_map_cannot_be_cut() -> None:
    patches = Patches([_scene()], _settings(), 4, Measured())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="downsampling=measured expects a coarse map at x4"):
        patches[0]


def test_no_scene_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a scene or more"):
        Patches([], _settings(), 4, BOX)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": 15}, "trainer.patch: expected at least 16 pixels, got 15"),
        ({"batch": 0}, "trainer.batch: expected a positive number, got 0"),
        ({"steps": 0}, "trainer.validate_every: expected a positive number, got 0"),
        ({"validation_scenes": 0}, "trainer.validation_scenes: expected a positive number, got 0"),
        ({"workers": -1}, "trainer.workers: expected 0 or more, got -1"),
        ({"colour": -0.1}, "trainer.colour: expected 0 or more, got -0.1"),
        ({"colour": float("nan")}, "trainer.colour: expected 0 or more, got nan"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_its_key(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _settings(**changes)
