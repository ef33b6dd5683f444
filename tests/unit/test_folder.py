"""dataset=folder: units, range types and holes come out as metres worked out by hand; what does not fit is refused."""

import json
import math

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


def loaded(folder):
    depth = load_scene(folder, "folder").depth
    assert depth is not None
    assert depth.shape == (1, H, W)
    return depth[0].double().numpy()


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


@pytest.mark.parametrize("name", ["rgb.jpg", "rgb.jpeg"])
def test_photo_may_be_a_jpg(scene, name):
    (scene / "rgb.png").unlink()
    cv2.imwrite(str(scene / name), np.full((H, W, 3), (0, 128, 255), np.uint8))
    np.save(scene / "depth.npy", Z)
    np.testing.assert_allclose(load_scene(scene, "folder").rgb[:, 2, 3].numpy(), [1.0, 0.5, 0.0], atol=0.02)


@pytest.mark.parametrize("name", ["depth.npy", "depth.png", "depth.tiff", "depth.pfm"])
def test_depth_unit_applies_to_every_format(scene, name):
    stored = Z * 8  # whole numbers, for the PNG
    if name.endswith("npy"):
        np.save(scene / name, stored)
    else:
        cv2.imwrite(str(scene / name), stored.astype(np.uint16 if name.endswith("png") else np.float32))
    for unit, metres in (("m", 1.0), ("mm", 0.001), (0.25, 0.25)):
        describe(scene, depth_unit=unit)
        np.testing.assert_allclose(loaded(scene), Z * 8 * metres, rtol=1e-12)


@pytest.mark.parametrize("suffix", [".npy", ".tiff", ".pfm"])
def test_floating_point_depth_without_a_unit_is_metres(scene, suffix):
    if suffix == ".npy":
        np.save(scene / "depth.npy", Z)
    else:
        cv2.imwrite(str(scene / f"depth{suffix}"), Z.astype(np.float32))
    np.testing.assert_array_equal(loaded(scene), Z)


def test_png_of_whole_numbers_without_a_unit_is_refused(scene, capfd):
    cv2.imwrite(str(scene / "depth.png"), (Z * 8).astype(np.uint16))
    message = refusal(scene, capfd)
    assert message.startswith("/depth.png: ")
    assert "depth_unit" in message


def test_unknown_unit_is_refused_by_file_and_key(scene, capfd):
    np.save(scene / "depth.npy", Z)
    describe(scene, depth_unit="furlong")
    assert refusal(scene, capfd).startswith("/camera.json: depth_unit: expected m, mm or a positive number")


def test_perspective_depth_is_divided_by_the_ray_lengths(scene):
    ray = [[math.hypot((u - CX) / F, (v - CY) / F, 1.0) for u in range(W)] for v in range(H)]
    np.save(scene / "depth.npy", Z * np.array(ray))
    describe(scene, range_type="perspective")
    np.testing.assert_allclose(loaded(scene), Z, rtol=1e-12)


def test_orthogonal_depth_is_unchanged(scene):
    np.save(scene / "depth.npy", Z)
    describe(scene, range_type="orthogonal")
    np.testing.assert_array_equal(loaded(scene), Z)


@pytest.mark.parametrize(("baseline", "unit", "metres"), [(0.5, "m", 0.5), (500, "mm", 0.5), (0.25, None, 0.25)])
@pytest.mark.parametrize("doffs", [0.0, 1.5])
def test_disparity_is_converted_by_baseline_focal_length_and_doffs(scene, baseline, unit, metres, doffs):
    np.save(scene / "disparity.npy", metres * F / Z - doffs)
    units = {} if unit is None else {"baseline_unit": unit}
    describe(scene, range_type="disparity", baseline=baseline, doffs=doffs, **units)
    np.testing.assert_allclose(loaded(scene), Z, rtol=1e-12)


def test_disparity_between_minus_doffs_and_0_is_a_far_point(scene):
    values = np.full((H, W), -1.0)
    np.save(scene / "disparity.npy", values)
    describe(scene, baseline=0.5, doffs=3.0)
    np.testing.assert_allclose(loaded(scene), 0.5 * F / 2.0)


@pytest.mark.parametrize("value", [-3.0, -4.0])
def test_disparity_at_or_beyond_infinity_is_refused(scene, capfd, value):
    values = np.ones((H, W))
    values[0, 0] = value
    np.save(scene / "disparity.npy", values)
    describe(scene, baseline=0.5, doffs=3.0)
    assert refusal(scene, capfd).startswith("/disparity.npy: expected positive values")


def test_depth_unit_does_not_apply_to_disparity(scene):
    np.save(scene / "disparity.npy", 0.5 * F / Z)
    describe(scene, baseline=0.5, depth_unit="mm")
    np.testing.assert_allclose(loaded(scene), Z, rtol=1e-12)


def test_disparity_without_a_baseline_is_refused(scene, capfd):
    np.save(scene / "disparity.npy", 1 / Z)
    message = refusal(scene, capfd)
    assert message.startswith("/disparity.npy: ")
    assert '"baseline"' in message


@pytest.mark.parametrize(("name", "range_type"), [("disparity", "orthogonal"), ("depth", "disparity")])
def test_file_name_that_contradicts_the_range_type_is_refused(scene, capfd, name, range_type):
    np.save(scene / f"{name}.npy", Z)
    describe(scene, baseline=0.5, range_type=range_type)
    message = refusal(scene, capfd)
    assert message.startswith(f"/{name}.npy: ")
    assert "range_type" in message


def test_infinity_and_nan_are_holes(scene):
    values = Z.copy()
    values[0, 1], values[2, 3], values[3, 7] = np.inf, np.nan, -np.inf
    np.save(scene / "depth.npy", values)
    expected = Z.copy()
    expected[0, 1] = expected[2, 3] = expected[3, 7] = np.nan
    np.testing.assert_array_equal(loaded(scene), expected)


def test_infinite_disparity_is_a_hole(scene):
    values = 0.5 * F / Z
    values[1, 1] = np.inf
    np.save(scene / "disparity.npy", values)
    describe(scene, baseline=0.5)
    depth = loaded(scene)
    assert np.isnan(depth[1, 1])
    assert np.isfinite(depth).sum() == H * W - 1


def test_hole_value_of_the_camera_file_is_compared_before_units(scene):
    stored = (Z * 8).astype(np.uint16)
    stored[1, 2] = 0
    cv2.imwrite(str(scene / "depth.png"), stored)
    describe(scene, depth_unit=0.125, hole_value=0)
    expected = Z.copy()
    expected[1, 2] = np.nan
    np.testing.assert_array_equal(loaded(scene), expected)


def test_mask_png_removes_pixels_where_it_is_0(scene):
    values = Z.copy()
    values[0, 0] = 0  # would be refused if the mask came too late
    np.save(scene / "depth.npy", values)
    mask = np.full((H, W), 255, np.uint8)
    mask[0, 0] = mask[3, 5] = 0
    cv2.imwrite(str(scene / "mask.png"), mask)
    expected = Z.copy()
    expected[0, 0] = expected[3, 5] = np.nan
    np.testing.assert_array_equal(loaded(scene), expected)


def test_measured_disparity_is_in_its_own_pixels(scene):
    np.save(scene / "depth.npy", Z)
    coarse_z = np.array([[2.0, 4.0]])
    np.save(
        scene / "disparity_lr4.npy", 0.5 * (F / 4) / coarse_z - 1.0 / 4
    )  # focal length and doffs in low-resolution pixels
    describe(scene, baseline=0.5, doffs=1.0)
    record = load_scene(scene, "folder")
    assert list(record.measured) == [4]
    np.testing.assert_allclose(record.measured[4][0].double().numpy(), coarse_z, rtol=1e-12)


def test_measured_perspective_depth_is_divided_by_the_low_resolution_ray_lengths(scene):
    def length(u, v):  # low-resolution pixel (u, v) looks along the centre of its 2 x 2 block
        return math.hypot((2 * u + 0.5 - CX) / F, (2 * v + 0.5 - CY) / F, 1.0)

    coarse = np.array([[3.0 * length(u, v) for u in range(W // 2)] for v in range(H // 2)])
    np.save(scene / "depth_lr2.npy", coarse * 1000)
    np.save(scene / "depth.npy", Z * 1000)
    describe(scene, range_type="perspective", depth_unit="mm")
    np.testing.assert_allclose(load_scene(scene, "folder").measured[2][0].double().numpy(), 3.0, rtol=1e-12)


def test_scene_with_a_measured_map_needs_no_high_resolution_depth(scene):
    coarse = np.array([[1.0, np.nan]])
    np.save(scene / "depth_lr4.npy", coarse)
    record = load_scene(scene, "folder")
    assert record.depth is None
    np.testing.assert_array_equal(record.measured[4][0].numpy(), coarse)


def test_mask_applies_to_the_high_resolution_depth_alone(scene):
    np.save(scene / "depth.npy", Z)
    np.save(scene / "depth_lr4.npy", np.array([[1.0, 2.0]]))
    mask = np.zeros((H, W), np.uint8)
    mask[0, 0] = 255
    cv2.imwrite(str(scene / "mask.png"), mask)
    record = load_scene(scene, "folder")
    assert int(record.depth.isfinite().sum()) == 1
    assert bool(record.measured[4].isfinite().all())


@pytest.mark.parametrize(("size", "ratio"), [((H, W), 1), ((2, 4), 2), ((1, 3), 8 / 3), ((3, 5), 1.6)])
def test_measured_map_of_any_size_has_the_ratio_of_the_widths(scene, size, ratio):
    values = np.random.default_rng(0).uniform(1, 2, size)
    np.save(scene / "depth_lr.npy", values)
    record = load_scene(scene, "folder")
    assert list(record.measured) == [ratio]
    np.testing.assert_array_equal(record.measured[ratio][0].numpy(), values)


def test_measured_disparity_of_any_size_is_in_its_own_pixels(scene):
    np.save(scene / "disparity_lr.npy", np.full((1, 3), 0.5 * F * 3 / 8 / 4.0))
    describe(scene, baseline=0.5)
    np.testing.assert_allclose(load_scene(scene, "folder").measured[8 / 3].numpy(), 4.0, rtol=1e-6)


@pytest.mark.parametrize("size", [(H, 2 * W), (2 * H, W), (4, 4), (1, 6)])
def test_measured_map_of_another_aspect_or_larger_than_the_photo_is_refused(scene, capfd, size):
    np.save(scene / "depth_lr.npy", np.ones(size))
    message = refusal(scene, capfd)
    assert message.startswith("/depth_lr.npy: expected the aspect ratio of the 4 x 8 photo")
    assert message.endswith(f"got {size[0]} x {size[1]}")


def test_two_measured_maps_of_one_size_are_refused(scene, capfd):
    np.save(scene / "depth_lr.npy", np.ones((1, 2)))
    np.save(scene / "depth_lr4.npy", np.ones((1, 2)))
    assert refusal(scene, capfd).startswith("/depth_lr4.npy: expected one map at x4, there is another")


@pytest.mark.parametrize("name", ["depth_lr0.npy", "depth_lr5.npy", "disparity_lr64.npy"])
def test_measured_map_at_an_impossible_factor_is_refused(scene, capfd, name):
    np.save(scene / "depth.npy", Z)
    np.save(scene / name, np.ones((1, 1)))
    assert refusal(scene, capfd).startswith(f"/{name}: ")


def test_measured_map_of_another_size_is_refused(scene, capfd):
    np.save(scene / "depth_lr2.npy", np.ones((H, W)))
    message = refusal(scene, capfd)
    assert message.startswith("/depth_lr2.npy: expected 2 x 4 pixels")
    assert message.endswith("got 4 x 8")


def test_scene_without_depth_is_refused_with_the_expected_names(scene, capfd):
    message = refusal(scene, capfd)
    assert "depth.{npy,png,tiff,pfm}" in message
    assert "disparity.{npy,png,tiff,pfm}" in message


def test_scene_with_two_high_resolution_depths_is_refused_with_both_names(scene, capfd):
    np.save(scene / "depth.npy", Z)
    np.save(scene / "disparity.npy", Z)
    message = refusal(scene, capfd)
    assert "depth.npy" in message
    assert "disparity.npy" in message


@pytest.mark.parametrize("name", ["rgb.png", "camera.json"])
def test_missing_file_is_refused_by_name(scene, capfd, name):
    np.save(scene / "depth.npy", Z)
    (scene / name).unlink()
    assert refusal(scene, capfd).startswith(f"/{name}: ")


@pytest.mark.parametrize("name", ["depth.npy", "mask.png", "rgb.png"])
def test_file_of_another_size_is_refused_with_both_sizes(scene, capfd, name):
    np.save(scene / "depth.npy", Z)
    if name == "depth.npy":
        np.save(scene / name, Z.T)
    else:
        cv2.imwrite(str(scene / name), np.full((W, H), 255, np.uint8))
    message = refusal(scene, capfd)
    assert message.startswith(f"/{name}: expected {H} x {W} pixels")
    assert message.endswith(f"got {W} x {H}")


@pytest.mark.parametrize("name", ["depth.npy", "depth_lr4.npy"])
def test_depth_without_a_valid_pixel_is_refused(scene, capfd, name):
    size = (1, 2) if "lr" in name else (H, W)
    np.save(scene / name, np.full(size, np.nan))
    assert refusal(scene, capfd) == f"/{name}: expected at least one known pixel, all are holes"


def test_mask_without_a_valid_pixel_is_refused(scene, capfd):
    np.save(scene / "depth.npy", Z)
    cv2.imwrite(str(scene / "mask.png"), np.zeros((H, W), np.uint8))
    assert "all are holes" in refusal(scene, capfd)


@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.parametrize("name", ["depth.npy", "depth_lr4.npy", "disparity.npy"])
def test_zero_or_negative_depth_is_refused_with_advice(scene, capfd, name, value):
    values = np.ones((1, 2) if "lr" in name else (H, W))
    values[0, 0] = value
    np.save(scene / name, values)
    describe(scene, baseline=0.5)
    message = refusal(scene, capfd)
    assert message.startswith(f"/{name}: expected positive values, got {value:g}")
    assert "hole_value" in message


@pytest.mark.parametrize("name", ["rgb.png", "mask.png", "depth.npy"])
def test_broken_file_is_refused_by_name(scene, capfd, name):
    np.save(scene / "depth.npy", Z)
    cv2.imwrite(str(scene / "mask.png"), np.full((H, W), 255, np.uint8))
    (scene / name).write_bytes((scene / name).read_bytes()[:50])
    assert refusal(scene, capfd).startswith(f"/{name}: expected a")


def test_8_bit_depth_is_refused(scene, capfd):
    cv2.imwrite(str(scene / "depth.png"), np.full((H, W), 200, np.uint8))
    describe(scene, depth_unit="mm")
    assert refusal(scene, capfd).startswith("/depth.png: expected 16-bit or floating point values, got uint8")


@pytest.fixture
def root(tmp_path):
    for name in ("b", "a", "ü [c]", ".hidden"):
        (tmp_path / name).mkdir()
    (tmp_path / "readme.txt").write_text("no scene")
    return tmp_path


def test_scenes_are_all_visible_folders_in_order(root):
    assert Folder(str(root)).scenes() == ["a", "b", "ü [c]"]


def test_chosen_scenes_keep_the_given_order(root):
    assert Folder(str(root), ["b", "a"]).scenes() == ["b", "a"]


def test_unknown_scene_is_refused_with_the_known_ones(root):
    with pytest.raises(ValueError, match=r"^scenes: 'd' is not there; expected some of a, b, ü \[c\]"):
        Folder(str(root), ["a", "d"])


@pytest.mark.parametrize("scenes", [[], ["a", "a"]])
def test_empty_and_duplicate_scene_lists_are_refused(root, scenes):
    with pytest.raises(ValueError, match=r"^scenes: expected names, each once"):
        Folder(str(root), scenes)


@pytest.mark.parametrize("name", ["nowhere", "readme.txt"])
def test_root_that_is_no_directory_is_refused(root, name):
    with pytest.raises(ValueError, match=rf"^root: .*{name}"):
        Folder(str(root / name))


def test_empty_root_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^root: expected a folder per scene"):
        Folder(str(tmp_path))


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


def test_released_scenes_load_with_their_holes(shared):
    source = Folder(str(shared / "scenes"))
    assert source.scenes() == ["books", "lucy", "plant"]
    disparity = np.load(shared / "scenes" / "lucy" / "disparity.npy").astype(np.float64)
    np.testing.assert_allclose(
        source.load("lucy").depth[0].double().numpy(), 0.2 * 618.0386007680322 / disparity, rtol=1e-6
    )
    books = source.load("books")
    holes = np.isnan(np.load(shared / "scenes" / "books" / "disparity.npy"))
    assert holes.any()
    np.testing.assert_array_equal(books.depth[0].isnan().numpy(), holes)
    assert books.measured[4].shape == (1, 80, 120)
