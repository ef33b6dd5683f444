"""dataset=folder: units, range types and holes come out as metres worked out by hand; what does not fit is refused."""

import json
import math
import re

import cv2
import numpy as np
import pytest

from dsr.data.folder import Folder, load_scene

H, W, F = 4, 8, 2.0
CX, CY = 3.0, 1.0
Z = np.array([[1.5 + 0.125 * column + 0.5 * row for column in range(W)] for row in range(H)])
"""Exact in float16 and different in every pixel."""


def describe(folder, **changes):
    entries = {"width": W, "height": H, "fx": F, "fy": F, "cx": CX, "cy": CY, **changes}
    (folder / "camera.json").write_text(json.dumps(entries))


@pytest.fixture
def scene(tmp_path):
    """Return a scene's folder with a photo and a camera, without depth."""
    folder = tmp_path / "scene"
    folder.mkdir()
    photo = np.zeros((H, W, 3), np.uint8)
    photo[0, 0] = (51, 102, 255)  # blue, green, red
    cv2.imwrite(str(folder / "rgb.png"), photo)
    describe(folder)
    return folder


def store(folder, files):
    """Write maps in the formats of their names."""
    for name, values in files.items():
        if name.endswith("npy"):
            np.save(folder / name, values)
        else:
            cv2.imwrite(str(folder / name), values)


def refusal(folder, capfd):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the callers look at the message
        load_scene(folder, "folder")
    assert capfd.readouterr() == ("", "")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(folder))
    return message.removeprefix(str(folder))


def test_scene_has_the_name_of_its_folder_and_its_photo_in_0_to_1(scene):
    np.save(scene / "depth.npy", Z)
    record = load_scene(scene, "mine")
    assert (record.dataset, record.name) == ("mine", "scene")
    assert record.rgb.shape == (3, H, W)
    np.testing.assert_allclose(record.rgb[:, 0, 0].numpy(), [1.0, 0.4, 0.2], rtol=1e-6)


def with_values(values, *changes):
    """Return a copy with some values, (row, column, value)."""
    changed = values.copy()
    for row, column, value in changes:
        changed[row, column] = value
    return changed


def ray_length(u, v):
    return np.sqrt(((u - CX) / F) ** 2 + ((v - CY) / F) ** 2 + 1)


NAN = math.nan
RAYS = ray_length(np.arange(W), np.arange(H)[:, None])
STORED = (Z * 8).astype(np.uint16)
READ = {
    **{
        f"{name} in {unit}": ({name: values}, {"depth_unit": unit}, Z * 8 * metres)
        for name, values in (("depth.npy", Z * 8), ("depth.png", STORED), ("depth.tiff", np.float32(Z * 8)),
                             ("depth.pfm", np.float32(Z * 8)))
        for unit, metres in (("m", 1.0), ("mm", 0.001), (0.25, 0.25))
    },
    **{f"{name} in metres": ({name: np.float32(Z)}, {}, Z) for name in ("depth.npy", "depth.tiff", "depth.pfm")},
    "distances along the rays": ({"depth.npy": Z * RAYS}, {"range_type": "perspective"}, Z),
    **{
        f"disparity, {units}, {doffs}": (
            {"disparity.npy": metres * F / Z - doffs}, {"range_type": "disparity", "doffs": doffs, **units}, Z)
        for units, metres in (({"baseline": 0.5, "baseline_unit": "m"}, 0.5),
                              ({"baseline": 500, "baseline_unit": "mm"}, 0.5), ({"baseline": 0.25}, 0.25))
        for doffs in (0.0, 1.5)
    },
    "infinity and NaN": ({"depth.npy": with_values(Z, (0, 1, math.inf), (2, 3, NAN), (3, 7, -math.inf))}, {},
                         with_values(Z, (0, 1, NAN), (2, 3, NAN), (3, 7, NAN))),
    "a hole value": ({"depth.png": with_values(STORED, (1, 2, 0))}, {"depth_unit": 0.125, "hole_value": 0},
                     with_values(Z, (1, 2, NAN))),
    "a mask": ({"depth.npy": with_values(Z, (0, 0, 0)),  # would be refused if the mask came too late
                "mask.png": with_values(np.full((H, W), 255, np.uint8), (0, 0, 0), (3, 5, 0))}, {},
               with_values(Z, (0, 0, NAN), (3, 5, NAN))),
}  # fmt: skip


@pytest.mark.parametrize("case", READ)
def test_units_range_types_and_holes_become_metres_and_nan(scene, case):
    files, changes, expected = READ[case]
    store(scene, files)
    describe(scene, **changes)
    depth = load_scene(scene, "folder").depth
    np.testing.assert_allclose(depth[0].double(), expected, rtol=1e-12)


def test_measured_map_is_in_its_own_pixels(scene):
    coarse = np.array([[2.0, 4.0]])
    np.save(scene / "depth.npy", Z)
    np.save(scene / "disparity_lr4.npy", 0.5 * (F / 4) / coarse - 1.0 / 4)  # focal length and doffs of its pixels
    describe(scene, baseline=0.5, doffs=1.0)
    [(scale, depth)] = load_scene(scene, "folder").measured.items()
    assert scale == 4
    np.testing.assert_allclose(depth[0].double(), coarse, rtol=1e-12)
    (scene / "disparity_lr4.npy").unlink()
    # a pixel (u, v) of half the size looks along the centre of its 2 x 2 block
    lengths = ray_length(2 * np.arange(W // 2) + 0.5, 2 * np.arange(H // 2)[:, None] + 0.5)
    store(scene, {"depth_lr2.npy": 3000 * lengths, "depth.npy": Z * 1000})
    describe(scene, range_type="perspective", depth_unit="mm")
    np.testing.assert_allclose(load_scene(scene, "folder").measured[2][0].double(), 3.0, rtol=1e-12)


def test_scene_with_a_measured_map_needs_no_high_resolution_depth(scene):
    coarse = np.array([[1.0, np.nan]])
    np.save(scene / "depth_lr4.npy", coarse)
    record = load_scene(scene, "folder")
    assert record.depth is None
    np.testing.assert_array_equal(record.measured[4][0].numpy(), coarse)


def test_mask_applies_to_the_high_resolution_depth_alone(scene):
    mask = with_values(np.zeros((H, W), np.uint8), (0, 0, 255))
    store(scene, {"depth.npy": Z, "depth_lr4.npy": np.array([[1.0, 2.0]]), "mask.png": mask})
    record = load_scene(scene, "folder")
    assert int(record.depth.isfinite().sum()) == 1
    assert bool(record.measured[4].isfinite().all())


STEREO = {"baseline": 0.5}
COARSE = np.ones((1, 2))
REFUSED = {
    "a PNG without a unit": ({"depth.png": (Z * 8).astype(np.uint16)}, {}, "/depth.png: .*depth_unit"),
    "8 bits": ({"depth.png": np.full((H, W), 200, np.uint8)}, {"depth_unit": "mm"}, "/depth.png: expected 16 bits "),
    "an unknown unit": ({"depth.npy": Z}, {"depth_unit": "furlong"}, "/camera.json: depth_unit: expected m, mm or "),
    "no baseline": ({"disparity.npy": 1 / Z}, {}, '/disparity.npy: .*"baseline"'),
    "a depth of disparities": ({"depth.npy": Z}, {**STEREO, "range_type": "disparity"}, "/depth.npy: .*range_type"),
    "a disparity of depths": (
        {"disparity.npy": Z}, {**STEREO, "range_type": "orthogonal"}, "/disparity.npy: .*range_type"),
    "two maps of one size": ({"depth_lr.npy": COARSE, "depth_lr4.npy": COARSE}, {}, "/depth_lr4.npy: .*one map at x4"),
    "a map of another size": ({"depth_lr2.npy": np.ones((H, W))}, {}, "/depth_lr2.npy: expected 2 x 4 .* got 4 x 8$"),
    "no depth": ({}, {}, r".*depth\.\{npy,png,tiff,pfm\}.*disparity\.\{npy,png,tiff,pfm\}"),
    "two depths": ({"depth.npy": Z, "disparity.npy": Z}, {}, r".*depth\.npy.*disparity\.npy"),
    "a depth of another size": ({"depth.npy": Z.T}, {}, "/depth.npy: expected 4 x 8 pixels.* got 8 x 4$"),
    "a mask of holes": ({"depth.npy": Z, "mask.png": np.zeros((H, W), np.uint8)}, {}, ".*all are holes"),
    **{
        f"a {name} of another size": (
            {"depth.npy": Z, name: np.full((W, H), 255, np.uint8)}, {}, f"/{name}: expected 4 x 8 pixels.* got 8 x 4$")
        for name in ("mask.png", "rgb.png")
    },
    **{
        f"a map of {size}": ({"depth_lr.npy": np.ones(size)}, {}, f".*aspect.* got {size[0]} x {size[1]}$")
        for size in ((H, 2 * W), (2 * H, W), (4, 4), (1, 6))
    },
    **{
        f"{name} of one pixel": ({"depth.npy": Z, name: np.ones((1, 1))}, {}, f"/{name}: ")
        for name in ("depth_lr0.npy", "depth_lr5.npy", "disparity_lr64.npy")
    },
    **{
        f"{name} of holes": ({name: np.full(size, np.nan)}, {}, f"/{name}: expected at least one known pixel")
        for name, size in (("depth.npy", (H, W)), ("depth_lr4.npy", (1, 2)))
    },
    **{
        f"{name} of {value}": (
            {name: with_values(np.ones(size), (0, 0, value))}, STEREO, f"/{name}: .*positive.* got {value} .*hole_val")
        for name, size in (("depth.npy", (H, W)), ("depth_lr4.npy", (1, 2)), ("disparity.npy", (H, W)))
        for value in (0, -1)
    },
    **{
        f"a {name} of {value}": (
            {f"{name}.npy": with_values(Z, (0, 0, value))}, STEREO,
            f"/{name}.npy: expected depths of 1e-06 to 1e.09 m, got .* in 3.1.% of the pixels")
        for name, value in (("depth", 1e19), ("depth", 1e-9), ("disparity", 1e-12))
    },
    **{
        f"a disparity of {value}": (
            {"disparity.npy": with_values(Z, (0, 0, value))}, {**STEREO, "doffs": 3.0}, ".*positive values")
        for value in (-3.0, -4.0)
    },
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_scene_that_cannot_be_is_refused_by_file_and_key(scene, capfd, case):
    files, changes, message = REFUSED[case]
    store(scene, files)
    describe(scene, **changes)
    assert re.match(message, refusal(scene, capfd))


@pytest.mark.parametrize("name", ["rgb.png", "camera.json", "mask.png", "depth.npy"])
def test_missing_or_broken_file_is_refused_by_name(scene, capfd, name):
    store(scene, {"depth.npy": Z, "mask.png": np.full((H, W), 255, np.uint8)})
    (scene / name).write_bytes((scene / name).read_bytes()[:50])
    assert refusal(scene, capfd).startswith(f"/{name}: ")
    (scene / name).unlink()
    if name in ("rgb.png", "camera.json"):
        assert refusal(scene, capfd).startswith(f"/{name}: ")


@pytest.fixture
def root(tmp_path):
    for name in ("b", "a", "ü [c]", ".hidden"):
        (tmp_path / name).mkdir()
    (tmp_path / "readme.txt").write_text("no scene")
    return tmp_path


def test_scenes_are_all_visible_folders_in_order_or_those_chosen(root):
    assert Folder(str(root)).scenes() == ["a", "b", "ü [c]"]
    assert Folder(str(root), ["b", "a"]).scenes() == ["b", "a"]
    for place, scenes, message in (
        (root, ["a", "d"], r"^scenes: 'd' is not there; expected some of a, b, ü \[c\]"),
        (root, [], "^scenes: expected names, each once"),
        (root, ["a", "a"], "^scenes: expected names, each once"),
        (root / "nowhere", None, "^root: .*nowhere"),
        (root / "readme.txt", None, "^root: .*readme.txt"),
        (root / "a", None, "^root: expected a folder per scene"),
    ):
        with pytest.raises(ValueError, match=message):
            Folder(str(place), scenes)


def test_fingerprint_of_a_scene_changes_with_names_and_bytes_alone(scene):
    source = Folder(str(scene.parent))
    prints = [source.fingerprint("scene")]
    np.save(scene / "depth.npy", Z)
    prints.append(source.fingerprint("scene"))
    (scene / "depth.npy").rename(scene / "disparity.npy")
    prints.append(source.fingerprint("scene"))
    content = bytearray((scene / "disparity.npy").read_bytes())
    content[-1] ^= 1
    (scene / "disparity.npy").write_bytes(content)
    prints.append(source.fingerprint("scene"))
    assert len(set(prints)) == 4
    (scene / "disparity.npy").touch()
    assert source.fingerprint("scene") == prints[-1]


def test_disparity_offset_of_named_scenes_is_left_out(scene):
    np.save(scene / "disparity.npy", 0.5 * F / Z)
    describe(scene, baseline=0.5, doffs=3.0)
    with_offset, without = Folder(str(scene.parent)), Folder(str(scene.parent), without_offset=["scene"])
    found = without.load("scene")
    assert found.depth is not None
    np.testing.assert_allclose(found.depth[0].numpy(), Z, rtol=1e-6)
    np.testing.assert_allclose(with_offset.load("scene").depth[0].numpy(), 0.5 * F / (0.5 * F / Z + 3.0), rtol=1e-6)
    assert found.camera.doffs == 0
    assert (len(found.notes), with_offset.load("scene").notes) == (1, ())
    assert with_offset.fingerprint("scene") != without.fingerprint("scene")
    with pytest.raises(ValueError, match=r"^without_offset: .*got vintage"):
        Folder(str(scene.parent), without_offset=["vintage"])
    with pytest.raises(ValueError, match=r"^without_offset: expected a list"):
        Folder(str(scene.parent), without_offset="scene")
    describe(scene, baseline=0.5)
    with pytest.raises(ValueError, match=r"without_offset: expected a doffs"):
        without.load("scene")
