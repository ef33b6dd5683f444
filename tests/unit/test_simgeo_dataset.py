"""dataset=simgeo: six embedded scenes behind a cache, the paper's Lucy where it is to be had."""

import json

import cv2
import numpy as np
import pytest

from dsr.data import rendered
from dsr.data.rendered import SimGeo
from dsr.synthetic.rendering import cache_directory
from dsr.synthetic.simgeo import SCENES, render_scene
from dsr.utils.console import note_once

SIZE = 64
NAME = "cube_no_texture"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of the test's own."""
    monkeypatch.setenv("DSR_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def calls(monkeypatch):
    """Return the list of renderings made from here on."""
    made = []

    def counted(name, size):
        made.append((name, size))
        return render_scene(name, size)

    monkeypatch.setattr(rendered, "render_scene", counted)
    return made


def assert_rendered(scene, name=NAME):
    expected = render_scene(name, SIZE)
    np.testing.assert_array_equal((scene.rgb * 255).round().byte().permute(1, 2, 0).numpy(), expected.rgb)
    assert scene.depth is not None
    np.testing.assert_array_equal(scene.depth[0].numpy(), expected.depth)
    assert scene.camera == expected.camera


def test_simgeo_has_five_scenes_like_the_papers_and_a_statue():
    assert SimGeo(size=SIZE).scenes() == list(SCENES)
    assert len(SCENES) == 6
    assert "statue" in SCENES


def test_scene_is_its_rendering_with_depth_in_metres(cache, calls):
    scene = SimGeo(size=SIZE).load(NAME)
    assert (scene.dataset, scene.name) == ("simgeo", NAME)
    assert scene.rgb.shape == (3, SIZE, SIZE)
    assert_rendered(scene)
    assert calls == [(NAME, SIZE)]


def test_rendering_is_made_once_and_then_read_from_the_cache(cache, calls):
    SimGeo(size=SIZE).load(NAME)
    again = SimGeo(size=SIZE).load(NAME)
    assert calls == [(NAME, SIZE)]
    assert_rendered(again)


def test_second_load_reads_the_cache(cache):
    SimGeo(size=SIZE).load(NAME)
    [file] = cache.rglob("*.npz")
    with np.load(file) as kept:
        content = dict(kept)
    content["depth"] = content["depth"] + 1
    np.savez(file, **content)
    np.testing.assert_array_equal(SimGeo(size=SIZE).load(NAME).depth[0].numpy(), render_scene(NAME, SIZE).depth + 1)


def test_sizes_do_not_share_a_rendering(cache, calls):
    SimGeo(size=SIZE).load(NAME)
    assert SimGeo(size=32).load(NAME).rgb.shape == (3, 32, 32)
    assert calls == [(NAME, SIZE), (NAME, 32)]


@pytest.mark.parametrize(
    "damage",
    ["empty", "truncated", "foreign", "without a camera", "a wrong camera", "other sizes", "another type"],
)
def test_damaged_cache_file_is_replaced_and_it_is_said(cache, calls, damage, capfd):
    SimGeo(size=SIZE).load(NAME)
    [file] = cache.rglob("*.npz")
    with np.load(file) as kept:
        content = dict(kept)
    if damage == "empty":
        file.write_bytes(b"")
    elif damage == "truncated":
        file.write_bytes(file.read_bytes()[:-100])
    elif damage == "foreign":
        file.write_bytes(b"something else")
    elif damage == "without a camera":
        np.savez(file, rgb=content["rgb"], depth=content["depth"])
    elif damage == "other sizes":
        np.savez(file, **{**content, "depth": content["depth"][:-1]})
    elif damage == "another type":
        np.savez(file, **{**content, "rgb": content["rgb"].astype("U8")})
    else:
        np.savez(file, **{**content, "camera": json.dumps({"wide": 3})})
    note_once.cache_clear()
    assert capfd.readouterr() == ("", "")
    assert_rendered(SimGeo(size=SIZE).load(NAME))
    assert len(calls) == 2
    reported = capfd.readouterr().err
    assert reported.startswith(f"note: {file}: damaged")
    assert reported.count("\n") == 1
    SimGeo(size=SIZE).load(NAME)
    assert len(calls) == 2
    assert [path.name for path in file.parent.iterdir()] == [f"{NAME}.npz"]


def test_unwritable_cache_is_ignored(tmp_path, monkeypatch, calls):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DSR_CACHE", str(tmp_path / "file"))
    source = SimGeo(size=SIZE)
    assert_rendered(source.load(NAME))
    assert_rendered(source.load(NAME))
    assert len(calls) == 2
    assert (tmp_path / "file").read_text() == "in the way"


def test_cache_directory_is_dsr_cache_or_the_users(monkeypatch, tmp_path):
    monkeypatch.setenv("DSR_CACHE", str(tmp_path / "mine"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_directory() == tmp_path / "mine"
    monkeypatch.delenv("DSR_CACHE")
    assert cache_directory() == tmp_path / "xdg" / "dsr"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_directory() == tmp_path / "home" / ".cache" / "dsr"


def test_tests_do_not_use_the_users_cache(dsr_cache):
    assert cache_directory() == dsr_cache


@pytest.fixture
def lucy(tmp_path):
    """A folder with a small Lucy."""
    folder = tmp_path / "data" / "lucy"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "rgb.png"), np.full((4, 8, 3), 9, np.uint8))
    np.save(folder / "depth.npy", np.full((4, 8), 2.5))
    camera = {"width": 8, "height": 4, "fx": 8, "fy": 8, "cx": 3.5, "cy": 1.5}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_lucy_replaces_the_statue_where_available(lucy):
    source = SimGeo(str(lucy.parent), size=SIZE)
    assert source.scenes() == [*(name for name in SCENES if name != "statue"), "lucy"]
    scene = source.load("lucy")
    assert (scene.dataset, scene.name) == ("simgeo", "lucy")
    assert scene.depth is not None
    assert bool((scene.depth == 2.5).all())


def test_fingerprint_of_lucy_follows_her_files_and_that_of_renderings_their_size(lucy):
    source = SimGeo(str(lucy.parent), size=SIZE)
    before, cube = source.fingerprint("lucy"), source.fingerprint(NAME)
    np.save(lucy / "depth.npy", np.full((4, 8), 2.0))
    assert source.fingerprint("lucy") != before
    assert source.fingerprint(NAME) == cube != SimGeo(size=32).fingerprint(NAME)
    assert len({SimGeo().fingerprint(scene) for scene in SimGeo().scenes()}) == len(SimGeo().scenes())


@pytest.mark.parametrize("root", [None, "nowhere"])
def test_statue_stands_in_for_a_missing_lucy(tmp_path, root):
    source = SimGeo(None if root is None else str(tmp_path / root), size=SIZE)
    assert source.scenes()[-1] == "statue"


def test_chosen_scenes_alone_are_available_and_an_unknown_one_is_refused(lucy):
    assert SimGeo(None, ["statue"], SIZE).scenes() == ["statue"]
    with pytest.raises(ValueError, match=r"^scenes: 'lucy' is not there; expected some of .*statue"):
        SimGeo(None, ["lucy"], SIZE)


def test_size_below_32_is_refused():
    with pytest.raises(ValueError, match=r"^size: expected at least 32 pixels, got 31"):
        SimGeo(size=31)
