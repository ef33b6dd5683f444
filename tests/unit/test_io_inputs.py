"""A pair of files as it is read: unit, range type and holes by who tells them first, and the part that counts."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from dsr.geometry.camera import Camera
from dsr.io.depth_files import encode
from dsr.io.inputs import FolderUnits, read_picture
from dsr.io.pairs import Pair
from dsr.io.reading import CameraChoice, Reading, RigFiles

OWN = {"width": 16, "height": 12, "fx": 15.0, "fy": 15.0, "cx": 7.5, "cy": 5.5}


@pytest.fixture
def make(tmp_path):
    """Write a pair: a grey photo, a depth file, and camera.json where it has entries."""

    def write(depth, name="depth.npy", size=(12, 16), camera=None, **entries):
        Image.fromarray(np.full((*size, 3), 51, np.uint8)).save(tmp_path / "photo.png")
        if name.endswith(".npy"):
            np.save(tmp_path / name, depth)
        else:
            Image.fromarray(depth).save(tmp_path / name)
        path = tmp_path / "camera.json" if entries or camera else None
        if path is not None:
            path.write_text(json.dumps({**(camera or OWN), **entries}))
        return Pair("x", tmp_path / "photo.png", tmp_path / name, path)

    return write


def read(pair, units=None, **reading):
    return read_picture(pair, Reading(**reading), units)


def texts(picture):
    return [assumption.text for assumption in picture.assumptions]


def test_photo_is_in_0_to_1_and_depth_in_metres_with_nan_in_holes(make):
    picture = read(make(np.array([[0, 1000], [2500, 65535]] * 3, np.uint16).repeat(4, 1), "depth.png"))
    assert torch.equal(picture.rgb, torch.full((3, 12, 16), 0.2))
    expected = torch.tensor([[torch.nan, 1.0], [2.5, torch.nan]] * 3).repeat_interleave(4, 1)[None]
    assert torch.allclose(picture.depth_lr, expected, equal_nan=True)


@pytest.mark.parametrize(
    ("given", "entries", "layout", "metres"),
    [
        (0.01, {"depth_unit": "m"}, 2e-4, 20.0), (None, {"depth_unit": 5e-4}, 2e-4, 1.0), (None, {}, 2e-4, 0.4),
        (None, {}, None, 2.0),
    ],
)  # fmt: skip
def test_unit_is_the_users_then_the_camera_files_then_the_layouts(make, given, entries, layout, metres):
    pair = make(np.full((3, 4), 2000, np.uint16), **entries)
    picture = read(Pair(pair.name, pair.rgb, pair.depth, pair.camera, unit=layout), unit=given)
    assert float(picture.depth_lr[0, 0, 0]) == pytest.approx(metres)


def test_maps_of_a_folder_have_the_unit_of_the_first_by_name_in_whatever_order_they_are_read(make):
    pairs = [make(np.full((3, 4), value), name) for name, value in (("b.npy", 300.0), ("a.npy", 2.0), ("c.npy", 3.0))]
    for order in (pairs, pairs[::-1], pairs[:1] + pairs[1:]):
        units = FolderUnits(order)
        assert [float(read(pair, units).depth_lr[0, 0, 0]) for pair in pairs] == [300, 2, 3]
    assert float(read(pairs[0]).depth_lr[0, 0, 0]) == pytest.approx(0.3)


def test_unit_of_a_folder_skips_maps_that_are_damaged_all_holes_or_of_another_type(make, tmp_path):
    damaged, empty, whole = tmp_path / "a.npy", np.full((3, 4), np.nan), np.full((3, 4), 2000, np.uint16)
    pairs = [
        make(empty, "b.npy"),
        make(whole, "c.npy"),
        make(np.full((3, 4), 250.0), "d.npy"),
        make(whole * 0.5, "e.npy"),
    ]
    damaged.write_bytes(b"none")
    units = FolderUnits([Pair("a", tmp_path / "photo.png", damaged), *pairs])
    assert [float(read(pair, units).depth_lr[0, 0, 0]) for pair in pairs[1:]] == pytest.approx([2.0, 0.25, 1.0])


def test_camera_file_sets_range_type_and_hole_value(make):
    pair = make(np.array([[2.0, 9.0], [2.0, 2.0]] * 3).repeat(4, 1), range_type="perspective", hole_value=9)
    picture = read(pair)
    corner = Camera(**OWN).rescale(8, 6).ray_lengths()[0, 0]
    assert float(picture.depth_lr[0, 0, 0]) == pytest.approx(float(2 / corner))
    assert bool(picture.depth_lr[0, 0, 4].isnan())
    assert picture.encoding.hole == 9
    assert any("perspective, by the camera file" in text for text in texts(picture))
    assert float(read(pair, range_type="orthogonal").depth_lr[0, 0, 0]) == 2


def test_camera_of_the_user_overrides_the_one_beside_the_pictures(make):
    pair = make(np.full((3, 4), 2.0))
    assert read(pair).camera.fx != 20
    pair = make(np.full((3, 4), 2.0), baseline=0.3)
    assert read(pair).camera == Camera(**OWN, baseline=0.3)
    assert texts(read(pair))[0] == "camera: camera.json beside the pictures"
    assert read(pair, camera=CameraChoice(intrinsics=(20, 20, 7, 5)), baseline=0.1).camera == Camera(
        16, 12, 20, 20, 7, 5, 0.1
    )


def test_photo_is_cropped_to_the_part_covered_by_the_low_resolution_map(make):
    pair = make(np.full((3, 4), 2.0), "depth_lr4.npy", (14, 17), {**OWN, "width": 17, "height": 14})
    picture = read(Pair(pair.name, pair.rgb, pair.depth, pair.camera, factor=4))
    assert tuple(picture.rgb.shape) == (3, 12, 16)
    assert picture.camera == Camera(**OWN)
    assert "the photo is cut to the part that the depth map covers" in texts(picture)


def test_disparity_of_a_depth_camera_beside_the_photos_is_written_with_its_baseline(make, tmp_path):
    pair = make(np.full((12, 16), 3.0), "disparity.npy", fx=15.0)
    (tmp_path / "ir.json").write_text(json.dumps({**OWN, "baseline": 0.05}))
    np.savetxt(tmp_path / "motion.txt", np.eye(4))
    picture = read(pair, rig=RigFiles(camera=tmp_path / "ir.json", extrinsics=tmp_path / "motion.txt"))
    values, _ = encode(picture.depth_lr, picture.encoding, picture.camera)
    assert np.nanmedian(values) == pytest.approx(3.0)


def test_disparity_without_a_positive_value_is_refused(make):
    pair = make(np.full((3, 4), 2.0), "disparity.npy", baseline=0.1, doffs=-20)
    with pytest.raises(ValueError, match=r"disparity.npy: expected at least one disparity above 0, got none"):
        read(pair)


@pytest.mark.parametrize("value", [1e19, 1e10, 1e-9, 1e-317])
def test_values_that_are_no_distances_are_holes_and_said(make, value):
    depth = np.full((3, 4), 2.0)
    depth[1, 2] = value
    picture = read(make(depth))
    assert picture.depth_lr.isnan().nonzero().tolist() == [[0, 1, 2]]
    said = [str(each) for each in picture.assumptions if "farther" in each.text]
    assert said == ["depths nearer than 1e-06 m or farther than 1e+09 m count as holes (8.3%)"]


@pytest.mark.parametrize("entries", [{"depth_unit": 1e-12}, {"depth_unit": 1e12}])
def test_map_without_any_distance_is_refused(make, entries):
    pair = make(np.full((3, 4), 2.0), **entries)
    with pytest.raises(ValueError, match=r"depth.npy: expected at least one depth of 1e-06 to 1e\+09 m, got none$"):
        read(pair)
