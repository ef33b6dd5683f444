"""SUN RGB-D: turned millimetres, cameras from text, scene folders anywhere below a root, every damage named."""

import cv2
import numpy as np
import pytest
from refusals import refused
from small_files import png_by_its_specification as png
from small_files import written

from dsr.data.sunrgbd import find_frames, frame_files, load_frame, load_pair, read_intrinsics

MILLIMETRES = np.array([[0, 1, 640, 3783], [8000, 9870, 8191, 8192], [65535, 5, 6, 7]])
"""0 is a hole; more than 13 bits need the lowest three of a level."""
MATRIX = "3.5 0 1.5\n0 3.25 1\n0 0 1\n"


def turned(millimetres):
    """Return levels whose 16 bits are turned left by three."""
    return [[(value << 3 & 0xFFFF) | value >> 13 for value in row] for row in millimetres.tolist()]


def jpg(shape=(3, 4)):
    return cv2.imencode(".jpg", np.full((*shape, 3), 128, np.uint8))[1].tobytes()


@pytest.fixture
def scene(tmp_path):
    folder = tmp_path / "kv2/align_kv2/000065"
    written(folder / "image/0000065.jpg", jpg())
    written(folder / "depth/0000065.png", png(turned(MILLIMETRES)))
    written(folder / "depth_bfx/0000065.png", png(turned(MILLIMETRES + 1)))
    written(folder / "intrinsics.txt", MATRIX.encode())
    written(folder / "fullres/0000065.jpg", jpg())
    return folder


def refusal(capfd, act, named):
    message = refused(act, named, capfd)
    assert message.startswith("expected ")
    return message


def test_depth_of_a_scene_is_the_sensors_or_the_refined_one(scene):
    measured, refined = load_frame(scene, "sunrgbd", "a"), load_frame(scene, "sunrgbd", "a", refined=True)
    assert measured.depth[0, 0, 2].item() == 0.640
    assert refined.depth[0, 0, 2].item() == 0.641
    camera = measured.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (4, 3, 3.5, 3.25, 1.5, 1.0)
    assert measured.rgb.mean().item() == pytest.approx(128 / 255, abs=0.01)
    assert [path.name for path in frame_files(scene, refined=True)] == ["0000065.jpg", "0000065.png", "intrinsics.txt"]


@pytest.mark.parametrize(
    "text",
    [
        "3.5 0 1.5 0 3.25 1 0 0", MATRIX + "0 0 0", "fx = 3", "1" * 5000, "nan 0 1.5 0 3 1 0 0 1",
        "-3 0 1.5 0 3 1 0 0 1", "0 0 0 0 0 0 0 0 0", "3 0 99 0 3 1 0 0 1", "3 0 1 0 3 -9 0 0 1",
        "3 2 1 0 3 1 0 0 1", "3 0 0 0 3 0 1 1 1", "1e300 0 1 0 1e300 1 0 0 1",
    ],
)  # fmt: skip
def test_invalid_intrinsics_file_is_refused(scene, capfd, text):
    path = written(scene / "intrinsics.txt", text.encode())
    refusal(capfd, lambda: load_frame(scene, "sunrgbd", "a"), path)


def test_folder_without_intrinsics_needs_them_from_the_caller(scene, capfd):
    (scene / "intrinsics.txt").unlink()
    assert "intrinsics=(fx, fy, cx, cy)" in refusal(capfd, lambda: load_frame(scene, "sunrgbd", "a"), scene)
    loaded = load_frame(scene, "sunrgbd", "a", intrinsics=(3.0, 3.0, 1.0, 2.0))
    assert (loaded.camera.cx, loaded.camera.cy) == (1.0, 2.0)
    refusal(capfd, lambda: load_frame(scene, "sunrgbd", "a", intrinsics=(3.0, 3.0, 1.0, 20.0)), "intrinsics")


def test_folder_with_no_or_two_pictures_of_a_kind_is_refused(scene, capfd):
    written(scene / "image/other.jpg", jpg())
    assert "got 2" in refusal(capfd, lambda: load_frame(scene, "sunrgbd", "a"), scene / "image")
    (scene / "depth/0000065.png").unlink()
    (scene / "image/other.jpg").unlink()
    assert "got 0" in refusal(capfd, lambda: load_frame(scene, "sunrgbd", "a"), scene / "depth")


def test_scenes_are_found_at_any_depth_by_their_path(tmp_path):
    names = ["kv1/NYUdata/NYU0002", "kv1/NYUdata/NYU0001", "xtion/sun3ddata/a/b/c", "realsense/lg/x"]
    for name in names:
        written(tmp_path / name / "image/1.jpg", b"")
        written(tmp_path / name / ("depth_bfx" if "lg" in name else "depth") / "1.png", b"")
        written(tmp_path / name / "inner/image/1.jpg", b"")
        written(tmp_path / name / "inner/depth/1.png", b"")
    written(tmp_path / "SUNRGBDtoolbox/image/1.jpg", b"")
    assert list(find_frames(tmp_path)) == sorted(names)
    assert find_frames(tmp_path)["realsense/lg/x"] == (tmp_path / "realsense/lg/x",)
    assert list(find_frames(tmp_path / names[0])) == ["NYU0002"]


def test_real_scenes_are_read_and_the_refined_depth_agrees_where_both_are_known(shared):
    frames = find_frames(shared / "real/sunrgbd")
    assert list(frames) == ["2014-12-18_11-31-54_260595134347", "img_0063"]
    for name, arguments in frames.items():
        raw = load_frame(*arguments, "sunrgbd", name)
        refined = load_frame(*arguments, "sunrgbd", name, refined=True)
        assert 0.1 < raw.depth.isnan().double().mean() < 0.4
        assert not refined.depth.isnan().any()
        assert (raw.depth - refined.depth).abs().nanmedian() < 0.01


def test_nyu_crop_starts_at_column_40_and_row_44_as_its_intrinsics_say(shared):
    folder = shared / "real/sunrgbd/img_0063"
    full, cut = (cv2.imread(str(folder / part / "img_0063.jpg")) for part in ("fullres", "image"))
    _, _, best, _ = cv2.minMaxLoc(cv2.matchTemplate(full, cut, cv2.TM_SQDIFF))
    assert best == (40, 44)
    whole = read_intrinsics(folder / "fullres/intrinsics.txt", full.shape[:2])
    camera = load_frame(folder, "sunrgbd", "a").camera
    counted_from_0 = whole.cx - 1, whole.cy - 1
    assert (counted_from_0[0] - best[0], counted_from_0[1] - best[1]) == pytest.approx((camera.cx, camera.cy))


def test_pair_of_loose_files_is_read_with_intrinsics(shared):
    folder = shared / "real/sunrgbd/open3d_sample"
    scene = load_pair(folder / "SUN_color.jpg", folder / "SUN_depth.png", "sunrgbd", "sample", (570, 570, 320, 240))
    assert scene.depth.nan_to_num(0).max().item() == 9.870  # beyond 8 m, not cut


def test_scenes_behind_links_are_found_and_circular_links_are_harmless(tmp_path):
    for part in ("image", "depth"):
        (tmp_path / "elsewhere" / "one" / part).mkdir(parents=True)
    root = tmp_path / "root"
    root.mkdir()
    (root / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(root)
    assert list(find_frames(root)) == ["linked/one"]
