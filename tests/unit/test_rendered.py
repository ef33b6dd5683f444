"""dataset=simgeo, six embedded scenes with the paper's Lucy where it is to be had; dataset=procedural: random ones."""

import json
import os

import cv2
import numpy as np
import pytest

from dsr.data import rendered
from dsr.data.rendered import Procedural, SimGeo
from dsr.synthetic import cache_directory
from dsr.synthetic.procedural.random_scene import render_random_scene
from dsr.synthetic.simgeo import SCENES, render_scene
from dsr.utils.console import note_once

SIZE = 64
SMALL = 48  # of a procedural scene
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

    def counted(*args):
        made.append(args)
        return render_scene(*args)

    monkeypatch.setattr(rendered, "render_scene", counted)
    return made


def assert_rendered(scene, expected=None):
    expected = expected or render_scene(NAME, SIZE)
    np.testing.assert_array_equal((scene.rgb * 255).round().byte().permute(1, 2, 0).numpy(), expected.rgb)
    np.testing.assert_array_equal(scene.depth[0].numpy(), expected.depth)
    assert scene.camera == expected.camera


def test_scene_is_rendered_once_and_then_read_from_the_cache(cache, calls):
    for _ in range(2):
        scene = SimGeo(size=SIZE).load(NAME)
        assert (scene.dataset, scene.name) == ("simgeo", NAME)
        assert_rendered(scene)
        assert calls == [(NAME, SIZE)]
    assert SimGeo(size=32).load(NAME).rgb.shape == (3, 32, 32)
    assert calls == [(NAME, SIZE), (NAME, 32)]


DAMAGES = {
    "truncated": lambda file, kept: file.write_bytes(file.read_bytes()[:-100]),
    "foreign": lambda file, kept: file.write_bytes(b"something else"),
    "without a camera": lambda file, kept: np.savez(file, rgb=kept["rgb"], depth=kept["depth"]),
    "other sizes": lambda file, kept: np.savez(file, **{**kept, "depth": kept["depth"][:-1]}),
    "a wrong camera": lambda file, kept: np.savez(file, **{**kept, "camera": json.dumps({"wide": 3})}),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_cache_file_is_replaced_with_a_note(cache, calls, damage, capfd):
    SimGeo(size=SIZE).load(NAME)
    [file] = cache.rglob("*.npz")
    with np.load(file) as kept:
        DAMAGES[damage](file, dict(kept))
    note_once.cache_clear()
    assert_rendered(SimGeo(size=SIZE).load(NAME))
    reported = capfd.readouterr().err
    assert reported.startswith(f"note: {file}: damaged")
    assert reported.count("\n") == 1
    SimGeo(size=SIZE).load(NAME)
    assert len(calls) == 2
    assert [path.name for path in file.parent.iterdir()] == [f"{NAME}.npz"]


def test_unwritable_cache_is_ignored(tmp_path, monkeypatch, calls):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DSR_CACHE", str(tmp_path / "file"))
    for _ in range(2):
        assert_rendered(SimGeo(size=SIZE).load(NAME))
    assert len(calls) == 2
    assert (tmp_path / "file").read_text() == "in the way"


def test_cache_directory_is_dsr_cache_or_the_users(monkeypatch, tmp_path):
    places = {"DSR_CACHE": tmp_path / "mine", "XDG_CACHE_HOME": tmp_path / "xdg", "HOME": tmp_path / "home"}
    for name, place in places.items():
        monkeypatch.setenv(name, str(place))
    for name, cache in (("DSR_CACHE", "mine"), ("XDG_CACHE_HOME", "xdg/dsr"), ("HOME", "home/.cache/dsr")):
        assert cache_directory() == tmp_path / cache
        monkeypatch.delenv(name)


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


def test_lucy_replaces_the_statue_where_available_and_her_fingerprint_follows_her_files(lucy):
    source = SimGeo(str(lucy.parent), size=SIZE)
    assert source.scenes() == [*SCENES[:5], "lucy"]
    scene = source.load("lucy")
    assert (scene.dataset, scene.name) == ("simgeo", "lucy")
    assert bool((scene.depth == 2.5).all())
    before, cube = source.fingerprint("lucy"), source.fingerprint(NAME)
    np.save(lucy / "depth.npy", np.full((4, 8), 2.0))
    assert source.fingerprint("lucy") != before
    assert source.fingerprint(NAME) == cube != SimGeo(size=32).fingerprint(NAME)
    assert len({SimGeo().fingerprint(scene) for scene in SimGeo().scenes()}) == len(SimGeo().scenes())


@pytest.mark.parametrize("root", [None, "nowhere"])
def test_statue_stands_in_for_a_missing_lucy(tmp_path, root):
    source = SimGeo(None if root is None else str(tmp_path / root), size=SIZE)
    assert source.scenes() == list(SCENES)
    assert SCENES[5] == "statue"
    with pytest.raises(ValueError, match=r"^scenes: 'lucy' is not there; expected some of .*statue"):
        SimGeo(None, ["lucy"], SIZE)


def test_procedural_scene_is_the_rendering_of_its_number_made_once(cache, monkeypatch):
    scene = Procedural(count=3, size=SMALL, seed=5).load("00002")
    assert (scene.dataset, scene.name) == ("procedural", "00002")
    assert_rendered(scene, render_random_scene(5, 2, SMALL))
    monkeypatch.setattr(rendered, "render_random_scene", lambda *_: pytest.fail("rendered again"))
    assert Procedural(count=3, size=SMALL, seed=5).load("00002").depth.equal(scene.depth)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [False, True])
def test_preparing_renders_what_is_missing_and_names_every_scene(cache, monkeypatch, workers):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    if workers:
        monkeypatch.setattr(rendered, "_WORTH_WORKERS", 0)
    source = Procedural(count=3, size=SMALL)
    source.load("00001")
    assert sorted(source.prepare(source.scenes())) == ["00000", "00001", "00002"]
    assert len(list(cache.rglob("*.npz"))) == 3
    assert list(source.prepare(["00002", "00000"])) == ["00002", "00000"]


@pytest.mark.slow
def test_seeds_and_sizes_do_not_share_scenes(cache):
    sources = [Procedural(count=1, size=SMALL), Procedural(count=1, size=SMALL, seed=1), Procedural(count=1, size=64)]
    for source in sources:
        source.load("00000")
    assert len(list(cache.rglob("*.npz"))) == len({source.fingerprint("00000") for source in sources}) == 3
