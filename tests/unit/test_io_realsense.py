"""Recordings of RealSense's SDK: what the SDK reads back from its own, and each part of written ones."""

import json

import captures
import cv2
import numpy as np
import pytest
import realsense
from realsense import COLOR, WRITERS, Recording, Rotation

from dsr.geometry.camera import Camera, Lens
from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import Reading

pytest.importorskip("rosbags")


def read_all(path):
    return [read_picture(pair, Reading()) for pair in find_pairs_of_folder(path).pairs]


def pixels(picture):
    return np.rint(255 * picture.rgb.permute(1, 2, 0).numpy())


def texts(path):
    found = find_pairs_of_folder(path)
    return [str(each) for each in (*found.assumptions, *read_picture(found.pairs[0], Reading()).assumptions)]


@pytest.mark.parametrize("name", ["sdk_2.55.bag", pytest.param("sdk_2.59.db3", marks=pytest.mark.nightly)])
def test_recordings_are_read_as_the_sdk_reads_them_and_aligned_as_it_aligns(shared, name):
    """The SDK's aligned maps keep the depth camera's z, which is turned into the colour camera's here."""
    folder = shared / "captures" / "realsense"
    said, arrays = json.loads((folder / f"{name}.json").read_text()), np.load(folder / f"{name}.npz")
    pairs = find_pairs_of_folder(folder / name).pairs
    assert len(pairs) == len(said["frame_numbers"])
    turn, color = np.array(said["rotation"]).reshape(3, 3).T, said["color"]
    for number, pair in enumerate(pairs):
        np.testing.assert_array_equal(pair.capture.photo.read(), arrays["color"][number])
        np.testing.assert_array_equal(pair.capture.depth.read(), arrays["depth"][number])
        assert pair.unit == pytest.approx(said["units"][number])
        picture = read_picture(pair, Reading())
        assert picture.camera == Camera(**{key: color[key] for key in ("width", "height", "fx", "fy", "cx", "cy")})
        found = picture.depth_lr[0].numpy()
        v, u = np.mgrid[: found.shape[0], : found.shape[1]]
        u, v = (u + 0.5) * color["width"] / found.shape[1] - 0.5, (v + 0.5) * color["height"] / found.shape[0] - 0.5
        z = arrays["aligned"][number][np.rint(v).astype(int), np.rint(u).astype(int)] * said["units"][number]
        rays = np.stack(((u - color["cx"]) / color["fx"], (v - color["cy"]) / color["fy"], np.ones_like(u)), -1)
        expected = (z + (turn.T @ said["translation"])[2]) / (rays @ turn)[..., 2]
        known = (z > 0) & np.isfinite(found)
        assert known.mean() > 0.98
        assert np.median(np.abs(found / expected - 1)[known]) < 0.003


def expect_plane(pictures):
    for number, picture in enumerate(pictures):
        found = picture.depth_lr[0].numpy()
        height, width = found.shape
        expected = cv2.resize(realsense.seen_by_color(number), (width, height), interpolation=cv2.INTER_LINEAR)
        known = np.isfinite(found)
        known[:2], known[-2:], known[:, :2], known[:, -2:] = False, False, False, False
        assert known.mean() > 0.6
        assert np.abs(found / expected - 1)[known].max() < 2e-3


@pytest.mark.parametrize("suffix", WRITERS)
def test_depth_is_seen_from_the_photos_camera_and_paired_by_the_frames_time_stamps(tmp_path, suffix):
    """Colour is recorded 0.4 s behind the depth of the same time stamp."""
    path = WRITERS[suffix](tmp_path / f"a{suffix}", Recording())
    pictures = read_all(path)
    assert len(pictures) == captures.FRAMES
    for number, picture in enumerate(pictures):
        assert picture.camera == Camera(*COLOR)
        assert picture.device_name == "Intel RealSense D435"
        np.testing.assert_array_equal(pixels(picture), captures.photo(number))
    expect_plane(pictures)
    assert len(read_all(tmp_path)) == captures.FRAMES  # in a folder


@pytest.mark.parametrize("suffix", WRITERS)
def test_frames_are_in_the_order_of_their_time_stamps(tmp_path, suffix):
    recording = Recording(stamps=(1066.6, 1000.0, 1033.3))
    pictures = read_all(WRITERS[suffix](tmp_path / f"a{suffix}", recording))
    assert [int(255 * picture.rgb[0, 0, 0]) for picture in pictures] == [40, 80, 0]
    assert [picture.time for picture in pictures] == pytest.approx([1.0, 1.0333, 1.0666], abs=1e-6)


@pytest.mark.parametrize(("suffix", "version", "unit"), [(".bag", 4, 1e-4), (".db3", 4, 2.5e-4), (".bag", 2, 5e-4)])
def test_depth_is_in_the_units_of_the_option_or_of_the_property_of_file_version_2(tmp_path, suffix, version, unit):
    depths = [realsense.seen_by_depth(number, unit) for number in range(captures.FRAMES)]
    recording = Recording(version=version, unit=unit, depths=depths)
    expect_plane(read_all(WRITERS[suffix](tmp_path / f"a{suffix}", recording)))


@pytest.mark.parametrize("suffix", WRITERS)
def test_both_cameras_have_their_lenses_of_the_sdks_models(tmp_path, suffix):
    numbers = (-0.25, 0.08, 0.0, 0.0, -0.01)
    lens = ("Inverse Brown Conrady", numbers)
    recording = Recording(depth_lens=lens, color_lens=("Brown Conrady", numbers))
    [pair, *_] = find_pairs_of_folder(WRITERS[suffix](tmp_path / f"a{suffix}", recording)).pairs
    geometry = pair.capture.geometry_of((48, 64))
    assert geometry.lens == Lens("brown_conrady", numbers)
    assert geometry.rig.lens == Lens("modified_brown_conrady", numbers)
    assert sum("-0.25" in str(each) for each in read_picture(pair, Reading()).assumptions) == 2
    recording.depth_lens = ("Ftheta", numbers)
    unknown = WRITERS[suffix](tmp_path / f"b{suffix}", recording)
    assert any("is not undone" in text and "'Ftheta'" in text for text in texts(unknown))


@pytest.mark.parametrize("suffix", WRITERS)
def test_registered_depth_is_left_where_it_is(tmp_path, suffix):
    depths = [realsense.seen_by_depth(number, camera=COLOR) for number in range(captures.FRAMES)]
    still = Recording(depth=COLOR, depths=depths, turn=Rotation.identity(), shift=(0, 0, 0))
    untold = Recording(depth=COLOR, depths=depths, turn=None)
    for name, recording in (("still", still), ("untold", untold)):
        path = WRITERS[suffix](tmp_path / f"{name}{suffix}", recording)
        picture = read_all(path)[1]
        np.testing.assert_allclose(picture.depth_lr[0], 1e-3 * depths[1], atol=1e-6)
        assert any("registered to the photo" in text for text in texts(path))


def test_images_of_a_db3_may_be_raw_and_those_of_a_bag_in_yuv(tmp_path):
    expect_plane(read_all(realsense.db3(tmp_path / "a.db3", Recording(raw=True))))
    grey = [np.full((48, 64, 3), 60 + 40 * number, np.uint8) for number in range(captures.FRAMES)]
    for encoding, place in (("YUYV", 0), ("yuv422", 1)):
        yuv = []
        for each in grey:
            both = np.full((48, 64, 2), 128, np.uint8)
            both[..., place] = np.rint(16 + each[..., 0] * (219 / 255))
            yuv.append(both)
        pictures = read_all(realsense.bag(tmp_path / f"{encoding}.bag", Recording(photos=yuv, encoding=encoding)))
        assert [pixels(picture).mean() for picture in pictures] == pytest.approx([60, 100, 140], abs=2)


def test_recording_without_a_stream_of_an_old_version_or_interrupted_is_one_line(tmp_path):
    path = realsense.bag(tmp_path / "a.bag", Recording())
    content = path.read_bytes()
    cases = {
        content.replace(b"Color_0", b"Other_0"): "a.bag: expected a stream Color of RealSense's SDK, got Depth, Other",
        content[:4096].replace(content[content.index(b"index_pos=") + 10 :][:8], bytes(8)) + content[4096:]:
            "a.bag: expected a recording of ROS, got a damaged one .Bag is not indexed, reindex",
    }  # fmt: skip
    for changed, said in cases.items():
        path.write_bytes(changed)
        with pytest.raises(ValueError, match=said) as caught:
            find_pairs_of_folder(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"color_lens": ("Brown Conrady", (0.1, float("nan"), 0, 0, 0))}, "lens: expected"),
        ({"color": (64, 48, -1.0, 51.0, 31.0, 24.0)}, "camera fx: expected"),
        ({"color": (0, 48, 50.0, 51.0, 31.0, 24.0)}, "expected a positive width and height"),
        ({"shift": (float("nan"), 0, 0)}, "expected finite numbers"),
        ({"unit": -1.0}, "expected Depth_Units in metres"),
    ],
)
@pytest.mark.parametrize("suffix", WRITERS)
def test_what_describes_the_streams_is_checked(tmp_path, suffix, change, said):
    path = WRITERS[suffix](tmp_path / f"a{suffix}", Recording(**change))
    with pytest.raises(ValueError, match=f"^{tmp_path}/a{suffix}.*{said}"):
        read_all(path)
