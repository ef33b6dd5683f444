"""Data sets in their owners' formats: which scenes, prepared how, kept where."""

import os

import numpy as np
import pytest
import torch

import dsr.data.scene_source as module
from dsr.data.scene_source import Preparation, PreparedDataset, make_records
from dsr.geometry.camera import Camera
from dsr.sample import Scene
from dsr.synthetic import cache_directory


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DSR_CACHE", str(tmp_path / "cache"))


def frame(path, dataset, name, near=1.0):
    """Load a scene from a file with a depth in it; what a reader does."""
    if path.read_text() == "damaged":
        raise ValueError(f"{path}: expected a number, got damaged")
    depth = torch.full((1, 60, 90), near * float(path.read_text()), dtype=torch.float64)
    depth[:, 20:30, 40:50] = torch.nan
    return Scene(dataset, name, torch.full((3, 60, 90), 0.5), Camera(90, 60, 80.0, 80.0, 44.5, 29.5), depth)


@pytest.fixture
def files(tmp_path):
    """Three scenes on disk, a, b and deep/c, of 1, 2 and 3 metres."""
    (tmp_path / "set" / "deep").mkdir(parents=True)
    paths = {name: tmp_path / "set" / f"{name}.txt" for name in ("a", "b", "deep/c")}
    for depth, path in enumerate(paths.values(), 1):
        path.write_text(str(depth))
    return {name: (path,) for name, path in paths.items()}


def source(files, named=("a", "b"), wanted=None, preparation=None, **settings):
    records = make_records(files, frame, "things", **settings)
    return PreparedDataset("things", "data/things", records, wanted, named, preparation or Preparation(48))


def kept():
    return sorted(path.name for path in (cache_directory() / "prepared" / "things").glob("*"))


def test_scenes_are_those_named_or_chosen_or_all_available(files):
    assert source(files).scenes() == ["a", "b"]
    assert source(files, wanted="found").scenes() == ["a", "b", "deep_c"]
    assert source(files, wanted=["deep_c", "a"]).scenes() == ["deep_c", "a"]


def test_missing_data_is_named_with_the_command_that_fetches_it(files):
    with pytest.raises(ValueError, match="things") as refusal:
        source(files, named=("a", "z", "y"))
    assert str(refusal.value) == (
        "dataset=things: expected z, y in data/things, got 1 of 3 scenes; get it with: dsr data get things; or say "
        "where it is: dataset.root=DIR; or use what is there: dataset.scenes=found"
    )
    with pytest.raises(ValueError, match="things") as refusal:
        source({})
    assert str(refusal.value) == (
        "dataset=things: expected its files in data/things, got no such directory; get it with: dsr data get things; "
        "or say where it is: dataset.root=DIR"
    )
    with pytest.raises(ValueError, match=r"^scenes: 'z' is not there; expected some of a, b, deep_c"):
        source(files, wanted=["z"])
    with pytest.raises(ValueError, match=r"^fill: expected names of scenes, got z"):
        source(files, preparation=Preparation(48, fill=("z",)))


def test_scenes_are_resized_cropped_and_named(files):
    scene = source(files).load("b")
    assert (scene.dataset, scene.name, tuple(scene.depth.shape)) == ("things", "b", (1, 48, 48))
    assert scene.camera == Camera(90, 60, 80.0, 80.0, 44.5, 29.5).rescale(72, 48).crop(0, 12, 48, 48)
    torch.testing.assert_close(scene.depth.nanmean(), torch.tensor(2.0, dtype=torch.float64))
    assert scene.depth.isnan().any()
    assert not source(files, preparation=Preparation(48, fill=("b",))).load("b").depth.isnan().any()


def test_scenes_without_a_size_are_unchanged_and_not_cached(files):
    scene = source(files, preparation=Preparation(None)).load("a")
    assert tuple(scene.depth.shape) == (1, 60, 90)
    assert kept() == []


def test_prepared_scene_is_read_from_the_cache(files, monkeypatch):
    first = source(files).load("a")
    assert len(kept()) == 1
    monkeypatch.setattr(module, "fit", None)
    again = source(files).load("a")
    assert np.array_equal(first.depth, again.depth, equal_nan=True)
    assert torch.equal(first.rgb, again.rgb)
    assert first.camera == again.camera


def test_other_content_settings_or_version_prepare_anew(files, monkeypatch):
    plain = source(files)
    plain.load("a")
    assert plain.fingerprint("a") == source(files).fingerprint("a")
    others = [
        source(files, preparation=Preparation(32)), source(files, preparation=Preparation(48, 0.0)),
        source(files, preparation=Preparation(48, fill=("a",))), source(files, near=2.0),
    ]  # fmt: skip
    assert len({each.fingerprint("a") for each in (plain, *others)}) == 5
    for count, each in enumerate(others, 2):
        each.load("a")
        assert len(kept()) == count
    monkeypatch.setattr(module, "SCENES", 0)
    source(files).load("a")
    assert len(kept()) == 6
    files["a"][0].write_text("7")
    assert source(files).load("a").depth.nanmean() == pytest.approx(7)


def test_preparation_makes_what_is_missing_and_yields_every_scene_those_that_fail_too(files):
    data = source(files, wanted="found")
    data.load("b")
    for _ in range(2):
        assert sorted(data.prepare(data.scenes())) == ["a", "b", "deep_c"]
        assert len(kept()) == 3
    files["a"][0].write_text("damaged")
    files["b"][0].unlink()
    assert sorted(data.prepare(data.scenes())) == ["a", "b", "deep_c"]
    assert len(kept()) == 3
    with pytest.raises(ValueError, match=r"a\.txt: expected a number, got damaged"):
        data.load("a")
    with pytest.raises(ValueError, match=r"b\.txt: expected a file, there is none"):
        data.load("b")


def test_fingerprint_of_a_scene_does_not_depend_on_its_preparation(files):
    one, other = source(files), source(files, preparation=Preparation(32), near=2.0)
    assert one.content("a") == other.content("a") != one.content("b")
    assert one.fingerprint("a") != other.fingerprint("a")


def test_notes_of_a_scene_are_kept_prepared_or_not(files):
    for preparation in (Preparation(48), Preparation(48), Preparation(None)):
        data = source(files, preparation=preparation, note=lambda path: path.stem * 2)
        assert (data.load("a").notes, data.load("b").notes) == (("aa",), ("bb",))
    assert source(files).load("a").notes == ()


def test_folder_fingerprint_covers_all_files_and_large_ones_by_size_and_time(files, monkeypatch, tmp_path):
    folder = tmp_path / "set"
    data = PreparedDataset(
        "things", folder, make_records({"all": (folder, 3)}, frame, "things"), None, ["all"], Preparation(48)
    )
    before = data.content("all")
    files["deep/c"][0].write_text("4")
    assert data.content("all") != before
    monkeypatch.setattr(module, "_MAX_HASHED", 0)
    contents = []
    for text, changed in (("4", 1), ("5", 1), ("5", 2), ("55", 2)):
        files["deep/c"][0].write_text(text)
        os.utime(files["deep/c"][0], (changed, changed))
        contents.append(data.content("all"))
    assert (contents[0] == contents[1], len(set(contents))) == (True, 3)
