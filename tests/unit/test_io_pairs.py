"""Pairs of photo and depth map in the layouts that people have, and what has no partner."""

import cv2
import numpy as np
import pytest
from small_files import touch

from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import find_pairs_of_lists


def pairs(found, folder):
    return [(str(pair.rgb.relative_to(folder)), str(pair.depth.relative_to(folder))) for pair in found.pairs]


LAYOUTS = {
    "two folders of numbers": ("rgb/000012.png", "depth/000012.png", "rgb/000013.png", "depth/000013.png"),
    "3DMatch and 7-Scenes": ("frame-000012.color.png", "frame-000012.depth.png", "frame-000013.color.png",
                             "frame-000013.depth.png"),
    "words in front": ("color_0012.jpg", "depth_0012.png", "color_0013.jpg", "depth_0013.png"),
    "words behind": ("IMG_0012.jpg", "IMG_0012_depth.png", "IMG_0013.jpg", "IMG_0013_depth.png"),
    "ScanNet": ("color/12.jpg", "depth/12.png", "color/13.jpg", "depth/13.png"),
    "leading zeros": ("rgb/12.jpg", "depth/000012.png", "rgb/13.jpg", "depth/000013.png"),
    "RealSense": ("Color_12.png", "DepthAligned_12.npy", "Color_13.png", "DepthAligned_13.npy"),
    "Redwood": ("image/0000012-000000359000.jpg", "depth/0000012-000000359000.png", "image/0000013-000000359001.jpg",
                "depth/0000013-000000359001.png"),
    "suffixes": ("a.jpg", "a.exr", "b.jpg", "b.exr"),
    "nanoseconds": ("color/1700000000012000000.png", "depth/1700000000015000000.png",
                    "color/1700000000045000000.png", "depth/1700000000047000000.png"),
    "seconds": ("rgb/1305031102.175304.png", "depth/1305031102.160407.png", "rgb/1305031102.211214.png",
                "depth/1305031102.226738.png"),
    "a clock from 0": ("rgb/left_0000000000.png", "depth/tof_0000000000.png", "rgb/left_0000000005.png",
                       "depth/tof_0000000005.png"),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_pairs_of_a_folder_are_found_in_order(tmp_path, layout):
    names = LAYOUTS[layout]
    found = find_pairs_of_folder(touch(tmp_path, *names))
    assert pairs(found, tmp_path) == [names[:2], names[2:]]
    assert found.unpaired == ()
    assert len({pair.name for pair in found.pairs}) == 2


def test_tum_lists_are_matched_by_time_within_20_ms_in_fifths_of_a_millimetre(tmp_path):
    (tmp_path / "rgb.txt").write_text(
        "# color images\n# timestamp filename\n10.00 rgb/a.png\n10.03 rgb/b.png\n11 rgb/c.png\n"
    )
    (tmp_path / "depth.txt").write_text("# depth maps\n10.019 depth/x.png\n10.035 depth/y.png\n11.021 depth/z.png\n")
    found = find_pairs_of_folder(tmp_path)
    assert pairs(found, tmp_path) == [("rgb/a.png", "depth/x.png"), ("rgb/b.png", "depth/y.png")]
    assert [path.name for path in found.unpaired] == ["c.png", "z.png"]
    assert {pair.unit for pair in found.pairs} == {1 / 5000}


def test_damaged_tum_list_is_refused_by_file_and_line(tmp_path):
    (tmp_path / "rgb.txt").write_text("10.00\n")
    (tmp_path / "depth.txt").write_text("")
    with pytest.raises(ValueError, match=r"rgb.txt: line 1: expected a time and a file name, got '10.00'$"):
        find_pairs_of_folder(tmp_path)


def test_nearest_time_is_matched_and_no_depth_map_twice(tmp_path):
    touch(tmp_path, "rgb/1700000000.000.png", "rgb/1700000000.010.png")
    touch(tmp_path, "depth/1700000000.008.png", "depth/1699999999.9.png")
    found = find_pairs_of_folder(tmp_path)
    assert pairs(found, tmp_path) == [("rgb/1700000000.010.png", "depth/1700000000.008.png")]
    assert len(found.unpaired) == 2


def test_pictures_without_a_partner_are_named(tmp_path):
    found = find_pairs_of_folder(touch(tmp_path, "rgb/1.png", "rgb/2.png", "rgb/3.png", "depth/2.png", "depth/9.png"))
    assert pairs(found, tmp_path) == [("rgb/2.png", "depth/2.png")]
    assert [path.name for path in found.unpaired] == ["1.png", "3.png", "9.png"]


def test_masks_infrared_and_confidence_are_not_paired(tmp_path):
    found = find_pairs_of_folder(
        touch(tmp_path, "a.jpg", "a_depth.png", "a_ir.png", "a_confidence.png", "a_mask.png", "a.txt")
    )
    assert pairs(found, tmp_path) == [("a.jpg", "a_depth.png")]
    assert found.unpaired == ()


def test_ambiguous_file_names_are_resolved_by_content(tmp_path):
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"view{number}.png"), np.ones((4, 4), np.uint16))
        cv2.imwrite(str(tmp_path / f"view{number}.jpg"), np.ones((4, 4, 3), np.uint8))
    found = find_pairs_of_folder(tmp_path)
    assert pairs(found, tmp_path) == [("view0.jpg", "view0.png"), ("view1.jpg", "view1.png")]


def test_dsr_scene_has_its_low_resolution_map_camera_and_mask(tmp_path):
    touch(tmp_path, "a/rgb.png", "a/camera.json", "a/depth.npy", "a/depth_lr8.npy", "a/disparity_lr4.npy", "a/mask.png")
    touch(tmp_path, "b/rgb.jpg", "b/camera.json", "b/disparity.pfm", "b/mask.png")
    first, second = find_pairs_of_folder(tmp_path).pairs
    assert (first.name, first.depth.name, first.factor, first.mask) == ("a", "disparity_lr4.npy", 4, None)
    assert (second.name, second.depth.name, second.factor) == ("b", "disparity.pfm", None)
    assert (second.mask, second.camera) == (tmp_path / "b" / "mask.png", tmp_path / "b" / "camera.json")
    assert find_pairs_of_folder(tmp_path / "b").pairs[0].name == "b"


def test_subfolders_are_searched_but_not_the_results(tmp_path):
    touch(tmp_path, "x/rgb/1.png", "x/depth/1.png", "x/intrinsics.txt", "y/deep/color_1.png", "y/deep/depth_1.png")
    touch(tmp_path, "out/color_7.png", "out/depth_7.png", "camera.json")
    found = find_pairs_of_folder(tmp_path, tmp_path / "out")
    named = [(pair.name, pair.camera.name) for pair in found.pairs]
    assert named == [("x/1", "intrinsics.txt"), ("y/deep/color_1", "camera.json")]
    assert [assumption.text for assumption in found.assumptions] == ["folders rgb and depth"]
    assert len(find_pairs_of_folder(tmp_path).pairs) == 3


def test_one_of_several_depth_folders_is_used_and_the_others_are_named(tmp_path):
    touch(tmp_path, "image/0001.jpg", "depth/0000001-000000000001.png", "depth_filled/0001.png", "intrinsics.txt")
    found = find_pairs_of_folder(tmp_path)
    assert pairs(found, tmp_path) == [("image/0001.jpg", "depth/0000001-000000000001.png")]
    assert found.assumptions[0].text == "folders image and depth; not read: depth_filled"


@pytest.mark.parametrize(
    "names", [(), ("a.jpg", "b.jpg"), ("color_1.png", "color_2.png", "depth_3.png", "depth_4.png")]
)
def test_folder_without_pairs_is_refused(tmp_path, names):
    with pytest.raises(ValueError, match="expected photos and depth maps that belong together, found no pair"):
        find_pairs_of_folder(touch(tmp_path, *names))
    with pytest.raises(ValueError, match="expected a folder of photos and depth maps, there is none"):
        find_pairs_of_folder(tmp_path / "none")


def test_file_lists_are_paired_in_order_with_distinct_names(tmp_path):
    touch(tmp_path, "a/p.jpg", "b/p.jpg", "q.jpg", "1.png", "2.png", "3.png", "camera.json")
    photos, depths = (
        [tmp_path / name for name in names] for names in (("a/p.jpg", "b/p.jpg", "q.jpg"), ("3.png", "1.png", "2.png"))
    )
    found = find_pairs_of_lists(photos, depths)
    named = [(pair.name, pair.depth.name) for pair in found.pairs]
    assert named == [("a_p", "3.png"), ("b_p", "1.png"), ("q", "2.png")]
    assert [pair.camera for pair in found.pairs] == [None, None, tmp_path / "camera.json"]
    assert [pair.name for pair in find_pairs_of_lists(photos[:1] * 2, depths[:2]).pairs] == ["a_p", "a_p_2"]


def test_inconsistent_lists_are_refused(tmp_path):
    touch(tmp_path, "rgb/1.jpg", "depth/2.png", "rgb/3.jpg", "depth/4.png")
    one, two = tmp_path / "rgb" / "1.jpg", tmp_path / "depth" / "2.png"
    for photos, depths, masks, message in [
        ([one, one], [two], [], "got 2 for --rgb, 1 for --depth"),
        ([one], [two], [two, two], "1 for --depth, 2 for --mask"),
        ([one], [tmp_path / "none.png"], [], "--depth: .*none.png: no such file"),
        ([one], [tmp_path / "depth"], [], "expected files, or one folder each"),
        ([tmp_path / "rgb"], [tmp_path / "rgb"], [], "expected two folders; one with both is given without"),
        ([tmp_path / "rgb"], [tmp_path / "depth"], [], "of 2 and 2 none belong together"),
        ([tmp_path / "rgb"], [tmp_path / "depth"], [two], "--mask: expected photos and depth maps as files"),
    ]:
        with pytest.raises(ValueError, match=message):
            find_pairs_of_lists(photos, depths, masks)
