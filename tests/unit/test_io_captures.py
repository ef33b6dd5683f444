"""Captures in the layouts of apps: camera, unit, holes, pose and confidence of each frame, and every refusal."""

import json
import pickle
import re
import struct
import sys
import zipfile
from types import SimpleNamespace

import captures
import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from captures import FRAMES, INTRINSICS, SIZE, SIZE_LR

from dsr.geometry.camera import Camera
from dsr.io.captures.archive import decode_lzfse
from dsr.io.captures.ros_images import decode_message
from dsr.io.inputs import FolderUnits, read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import Reading

BROKEN_POSE = "expected a rigid pose"


def write_export(folder):
    """Write Record3D's export of EXR depth and photos."""
    for number in range(FRAMES):
        captures.save(folder / "rgb" / f"{number}.jpg", captures.photo(number))
        (folder / "depth").mkdir(exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"R": captures.depth(number).astype(np.float32)}) as file:
            file.write(str(folder / "depth" / f"{number}.exr"))
    (folder / "metadata.json").write_text(json.dumps(captures.record3d_metadata()))
    return folder


def unpacked(folder):
    with zipfile.ZipFile(captures.record3d(folder.parent / "packed.r3d")) as archive:
        archive.extractall(folder)
    return folder


LAYOUTS = {
    "stray video": captures.stray, "stray files": lambda folder: captures.stray(folder, video=False),
    "record3d": lambda folder: captures.record3d(folder / "scan.r3d").parent, "record3d unpacked": unpacked,
    "record3d export": write_export, "polycam": captures.polycam, "arkitscenes": captures.arkitscenes,
}  # fmt: skip


def read_all(folder, **reading):
    pairs = find_pairs_of_folder(folder).pairs
    units = FolderUnits(pairs)
    return [read_picture(pair, Reading(**reading), units) for pair in pairs]


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "capture"
    path.mkdir()
    return path


@pytest.mark.parametrize("layout", LAYOUTS)
def test_camera_depth_and_pose_of_each_frame_come_from_the_capture(folder, layout):
    pictures = read_all(LAYOUTS[layout](folder))
    assert len(pictures) == FRAMES
    fx, fy, cx, cy = INTRINSICS
    for number, picture in enumerate(pictures):
        corrected = layout == "polycam" and number < FRAMES - 1
        expected = Camera(SIZE[1], SIZE[0], fx + number, fy, cx, cy - corrected)
        assert picture.camera == expected
        np.testing.assert_allclose(picture.depth_lr[0], captures.depth(number), atol=6e-4)
        difference = 255 * picture.rgb.permute(1, 2, 0).numpy() - captures.photo(number)
        assert abs(np.median(difference) - 10 * corrected) < 4
        if layout == "arkitscenes" and number == FRAMES - 1:
            assert picture.pose is None
        else:
            assert picture.pose.dtype == np.float64
            np.testing.assert_allclose(picture.pose, captures.pose(number), atol=1e-6)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_world_and_time_are_those_that_the_capture_says(folder, layout):
    """ARKit's world has y up, that of ARKitScenes' laser scans z; Stray Scanner and ARKitScenes have times."""
    pictures = read_all(LAYOUTS[layout](folder))
    assert {picture.up for picture in pictures} == {"z" if layout == "arkitscenes" else "y"}
    step = {"stray video": 1 / 60, "stray files": 1 / 60, "arkitscenes": 0.1}.get(layout)
    for number, picture in enumerate(pictures):
        assert picture.time == (None if step is None else pytest.approx(10 + step * number))


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "record3d export"])
@pytest.mark.parametrize(("least", "columns"), [(None, 0), (0, 0), (0.5, 2), (0.6, 4), (1, 4)])
def test_pixels_of_too_little_confidence_become_holes(folder, layout, least, columns):
    picture = read_all(LAYOUTS[layout](folder), min_confidence=least)[0]
    holes = torch.zeros(SIZE_LR, dtype=torch.bool)
    holes[:, :columns] = True
    assert torch.equal(picture.depth_lr[0].isnan(), holes)
    np.testing.assert_allclose(picture.confidence[0], captures.levels() / 2, atol=0.002)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_can_be_handed_to_other_processes(folder, layout):
    pairs = find_pairs_of_folder(LAYOUTS[layout](folder)).pairs
    here, there = (read_picture(pair, Reading()) for pair in (pairs[1], pickle.loads(pickle.dumps(pairs[1]))))
    assert torch.equal(here.rgb, there.rgb)
    np.testing.assert_array_equal(here.pose, there.pose)


def test_pose_of_arkit_looks_forward_with_y_down(folder):
    """A camera at rest in ARKit's world, y up, looks along -z: forward is (0, 0, -1), down is (0, -1, 0)."""
    captures.polycam(folder)
    still = {f"t_{row}{column}": float(row == column) for row in range(3) for column in range(4)}
    path = folder / "keyframes" / "corrected_cameras" / "1000.json"
    path.write_text(json.dumps(captures.polycam_camera(0) | still))
    turn = read_all(folder)[0].pose[:3, :3]
    np.testing.assert_array_equal(turn @ [0, 0, 1], [0, 0, -1])
    np.testing.assert_array_equal(turn @ [0, 1, 0], [0, -1, 0])


@pytest.mark.parametrize("camera", ["camera_intrinsic.json", "camera_primesense.json"])
def test_open3d_folder_has_its_camera_and_its_trajectory(folder, camera):
    pictures = read_all(captures.open3d(folder, camera))
    assert len(pictures) == FRAMES
    for number, picture in enumerate(pictures):
        assert picture.camera == Camera(SIZE[1], SIZE[0], *INTRINSICS)
        np.testing.assert_allclose(picture.pose, captures.pose(number), atol=1e-9)
        assert (picture.up, picture.time) == ("", None)
    (folder / "depth" / "000001.png").unlink()
    found = find_pairs_of_folder(folder)
    assert any("no poses: trajectory.log has 3, for 2 pairs" in fact.text for fact in found.assumptions)
    assert {pair.capture for pair in found.pairs} == {None}


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("floats", [False, True])
def test_recordings_of_ros_are_paired_by_time_with_the_aligned_depth(folder, version, floats):
    pytest.importorskip("rosbags")
    path = captures.ros(folder / ("scan.bag" if version == 1 else "scan"), version, floats=floats, compressed=floats)
    found = find_pairs_of_folder(folder)
    assert found.assumptions[0].text.endswith("metres of /camera/aligned_depth_to_color/image_raw")
    assert any("not read: /camera/depth/image_rect_raw" in fact.text for fact in found.assumptions)
    pictures = read_all(path)
    assert len(pictures) == len(found.pairs) == FRAMES
    for number, picture in enumerate(pictures):
        assert picture.camera == Camera(SIZE[1], SIZE[0], *INTRINSICS)
        np.testing.assert_allclose(picture.depth_lr[0], captures.depth(number), atol=6e-4)
        assert abs(255 * picture.rgb.permute(1, 2, 0).numpy() - captures.photo(number)).mean() < 4
        assert (picture.pose, picture.up, picture.encoding.suffix) == (None, "", ".npy")
        assert picture.time == pytest.approx(100 + 0.033 * number, abs=1e-6)


def test_recording_whose_description_is_too_large_is_refused_before_it_is_read(folder):
    pytest.importorskip("rosbags")
    captures.ros(folder / "scan", 2)
    with (folder / "scan" / "metadata.yaml").open("ab") as file:
        file.truncate(3 << 30)  # of which nothing is on the disk
    with pytest.raises(ValueError, match=r"metadata.yaml: expected at most 16777216 bytes, got 3221225472"):
        find_pairs_of_folder(folder)


def test_damaged_recording_or_one_without_depth_is_refused(folder):
    pytest.importorskip("rosbags")
    path = captures.ros(folder / "scan.bag", 1)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"scan.bag: expected a recording of ROS, got a damaged one") as caught:
        find_pairs_of_folder(folder)
    assert "\n" not in str(caught.value)
    path.write_bytes(content.replace(b"16UC1", b"mono8"))
    with pytest.raises(ValueError, match=r"scan.bag: expected a topic of depth .* got /camera/aligned_depth"):
        find_pairs_of_folder(folder)


@pytest.mark.parametrize("floats", [False, True])
def test_compressed_depth_of_ros_is_decoded(floats):
    """Floats are stored as a / z + b, rounded, behind the two numbers of this quantisation."""
    a, b = 20_000.0, 3.0
    stored = np.round(a / captures.depth() + b).astype(np.uint16) if floats else captures.millimetres()
    stored[0, 0] = 0
    header = struct.pack("<iff", 0, a if floats else 0, b if floats else 0)
    data = header + cv2.imencode(".png", stored)[1].tobytes()
    kind = "32FC1" if floats else "16UC1"
    message = SimpleNamespace(format=f"{kind}; compressedDepth png", data=np.frombuffer(data, np.uint8))
    values = decode_message("topic", message)
    expected = captures.depth() * (1 if floats else 1000)
    expected[0, 0] = np.nan if floats else 0
    np.testing.assert_allclose(values, expected, rtol=1e-3)
    message.data = message.data[:40]
    with pytest.raises(ValueError, match=r"^topic: expected depth as a 16-bit PNG \(compressedDepth\), got 40 bytes"):
        decode_message("topic", message)


@pytest.mark.parametrize(("encoding", "order"), [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("rgba8", (0, 1, 2, 0))])
def test_images_of_ros_have_their_channels_in_order_and_may_have_padded_rows(encoding, order):
    pixels = captures.photo()[..., list(order)]
    rows = np.pad(pixels.reshape(SIZE[0], -1), ((0, 0), (0, 5)))
    about = {"height": SIZE[0], "width": SIZE[1], "step": rows.shape[1], "is_bigendian": 0}
    message = SimpleNamespace(encoding=encoding, data=rows.reshape(-1), **about)
    np.testing.assert_array_equal(decode_message("topic", message), captures.photo())
    message.height += 1
    with pytest.raises(ValueError, match=r"^topic: expected an image of 64 x 49 pixels in rows of \d+ bytes, got"):
        decode_message("topic", message)


def test_camera_matrix_of_stray_scanner_is_used_where_frames_have_none(folder):
    captures.stray(folder, own_intrinsics=False)
    picture = read_all(folder)[2]
    assert picture.camera == Camera(SIZE[1], SIZE[0], *INTRINSICS)
    assert any(fact.text.startswith("camera: camera_matrix.csv of the whole capture") for fact in picture.assumptions)


def test_frames_of_a_video_are_decoded_in_any_order(folder):
    pairs = find_pairs_of_folder(captures.stray(folder)).pairs
    for number in (2, 0, 1, 1, 0, 2):
        photo = read_picture(pairs[number], Reading()).rgb[0].mean()
        assert abs(255 * float(photo) - captures.photo(number)[..., 0].mean()) < 8


def test_first_frame_that_an_edit_list_hides_is_decoded(folder):
    """Stray Scanner writes the first frame before time 0; players leave it out, its maps are numbered with it."""
    captures.stray(folder)
    path = folder / "rgb.mp4"
    content = path.read_bytes()
    start = content.index(b"elst") + 4
    version, entries, duration, _ = struct.unpack_from(">IIIi", content, start)
    assert (version, entries) == (0, 1)
    ticks = struct.unpack_from(">I", content, content.index(b"stts") + 16)[0]
    hidden = struct.pack(">IIIi", version, entries, duration * 2 // 3, ticks)
    path.write_bytes(content[:start] + hidden + content[start + 16 :])
    plain = cv2.VideoCapture(str(path))
    count = 0
    while plain.grab():
        count += 1
    plain.release()
    assert count == FRAMES - 1
    for number, picture in enumerate(read_all(folder)):
        assert abs(255 * float(picture.rgb[0].mean()) - captures.photo(number)[..., 0].mean()) < 8
    assert len(find_pairs_of_folder(folder).assumptions) == 1  # nothing is said of other numbers of frames


def test_lzfse_data_of_the_real_compressor_are_read(folder):
    lzfse = pytest.importorskip("lzfse")
    captures.record3d(folder / "scan.r3d", lambda values: lzfse.compress(values.tobytes()))
    np.testing.assert_allclose(read_all(folder)[1].depth_lr[0], captures.depth(1), rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected LZFSE data, got 0 bytes"),
        (b"bvx-" + struct.pack("<I", 1 << 31) + b"x" * 8, "they end early, after 16 bytes"),
        (b"bvxn" + struct.pack("<II", 1 << 31, 4) + b"x" * 4 + b"bvx$", "got LZFSE data of 2147483648"),
        (b"bvxn" + struct.pack("<II", 768, 4) + b"\x06xxx" + b"bvx$", "LZFSE data"),
        (captures.lzfse_block(np.zeros(5, "u1")), "expected 16 x 12 values of float32 (768 bytes), got LZFSE data of"),
    ],
)  # fmt: skip
def test_lzfse_data_that_are_damaged_or_declare_another_size_are_not_unpacked(content, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        decode_lzfse(content, SIZE_LR, "<f4")


def test_missing_package_is_named_with_the_extra_that_has_it(folder, monkeypatch):
    captures.record3d(folder / "scan.r3d")
    (folder / "bag").mkdir()
    (folder / "bag" / "scan.bag").write_bytes(b"#ROSBAG V2.0")
    for module in ("lzfse", "rosbags.highlevel"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        ValueError, match=r"rgbd/0.depth: LZFSE data need the package lzfse: pip install -e '.\[captures\]'"
    ):
        read_all(folder)
    with pytest.raises(ValueError, match=r"need the package rosbags: pip install -e '.\[captures\]'"):
        find_pairs_of_folder(folder / "bag")


def test_archive_that_is_truncated_foreign_or_a_bomb_is_refused(folder):
    path = captures.record3d(folder / "scan.r3d")
    content = path.read_bytes()
    path.write_bytes(content[:-200])
    with pytest.raises(ValueError, match=r"scan.r3d: expected a ZIP archive, got a damaged, truncated or foreign file"):
        find_pairs_of_folder(folder)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", b" " * (1 << 28))
    with pytest.raises(ValueError, match=r"scan.r3d/metadata: expected at most 134217728 bytes, the archive declares"):
        find_pairs_of_folder(folder)
    for text, message in (
        ('{"app": "other"}', "metadata: expected Record3D's metadata; w: it is missing"),
        ("[1", "metadata: expected Record3D's metadata as JSON, got something else"),
        (json.dumps(captures.record3d_metadata(dw=-1)), "metadata; dw: expected"),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("metadata", text)
        with pytest.raises(ValueError, match=re.escape(message)):
            find_pairs_of_folder(folder)


def test_member_larger_than_a_map_is_not_unpacked(folder):
    path = captures.record3d(folder / "scan.r3d")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, bytes(1 << 24) if name == "rgbd/1.depth" else content)
    pairs = find_pairs_of_folder(folder).pairs
    with pytest.raises(ValueError, match=r"scan.r3d/rgbd/1.depth: expected at most 66304 bytes, the archive declares"):
        read_picture(pairs[1], Reading())
    assert read_picture(pairs[2], Reading()).depth_lr.isfinite().all()


def replace_text(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def break_stray_intrinsics(folder):
    captures.stray(folder)
    replace_text(folder / "odometry.csv", ", 51.000000000", ", nan")


def break_stray_pose(folder):
    captures.stray(folder)
    rows = (folder / "odometry.csv").read_text().splitlines()
    rows[1] = ", ".join([*rows[1].split(", ")[:8], "3.0", *rows[1].split(", ")[9:]])
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")


def break_polycam(**changes):
    def write(folder):
        captures.polycam(folder)
        path = folder / "keyframes" / "corrected_cameras" / "1000.json"
        path.write_text(json.dumps(captures.polycam_camera(0, **changes)))

    return write


def break_arkitscenes(folder):
    captures.arkitscenes(folder)
    (folder / "lowres_wide_intrinsics" / "41069021_10.001.pincam").write_text("64 48 nan 51 31 24")


def break_open3d(folder):
    captures.open3d(folder)
    path = folder / "scene" / "trajectory.log"
    path.write_text("\n".join(["0 0 1", "2 0 0 0", *path.read_text().splitlines()[2:]]) + "\n")


def break_video(folder):
    captures.stray(folder)
    captures.write_video(folder / "rgb.mp4", [captures.photo(1), captures.photo(2)])
    for name in ("depth", "confidence"):
        (folder / name / "000000.png").rename(folder / name / "000007.png")


MIRROR = {f"t_{row}{row}": 1.0 - 2 * (row == 0) for row in range(3)} | {
    f"t_{row}{column}": 0.0 for row in range(3) for column in range(3) if row != column
}
NO_NUMBER = "camera fx: expected a finite number"
BROKEN = {
    "intrinsics that are not a number": (break_stray_intrinsics, "odometry.csv: frame 0: camera fy: expected"),
    "a quaternion of another length": (break_stray_pose, f"odometry.csv: frame 0: {BROKEN_POSE}"),
    "a matrix that is sheared": (break_polycam(t_01=2.0), f"1000.json: {BROKEN_POSE}"),
    "a mirrored matrix": (break_polycam(**MIRROR), f"1000.json: {BROKEN_POSE}"),
    "JSON intrinsics that are not a number": (break_polycam(fx=float("nan")), f"1000.json: {NO_NUMBER}"),
    "a camera without a key": (break_polycam(fx=None), "1000.json: expected Polycam's camera; fx: expected"),
    "intrinsics file": (break_arkitscenes, f"10.001.pincam: {NO_NUMBER}"),
    "a trajectory that scales": (break_open3d, f"trajectory.log: pose 0: {BROKEN_POSE}"),
    "Record3D": (
        lambda folder: captures.record3d(folder / "a.r3d", perFrameIntrinsicCoeffs=[[float("nan"), 1, 1, 1]]),
        f"metadata: frame 0: {NO_NUMBER}",
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_broken_frame_is_refused_in_one_line_and_the_others_are_read(folder, what):
    write, message = BROKEN[what]
    write(folder)
    pairs = find_pairs_of_folder(folder).pairs
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read_picture(pairs[0], Reading())
    assert "\n" not in str(caught.value)
    assert read_picture(pairs[1], Reading()).depth_lr.isfinite().all()


def test_video_that_ends_early_or_is_none_is_refused(folder):
    break_video(folder)
    found = find_pairs_of_folder(folder)
    assert found.assumptions[1].text.startswith("rgb.mp4 has 2 frames, the depth maps count to 8: photos may be")
    pairs = found.pairs
    with pytest.raises(ValueError, match=r"rgb.mp4: expected a frame 7, the video is damaged or ends after 2 frames"):
        read_picture(pairs[-1], Reading())
    assert read_picture(pairs[0], Reading()).pose is not None
    (folder / "rgb.mp4").write_bytes((folder / "rgb.mp4").read_bytes()[:300])
    with pytest.raises(ValueError, match=r"rgb.mp4: expected a video, got a damaged or foreign file"):
        read_picture(pairs[0], Reading())


def test_odometry_of_another_app_is_refused(folder):
    captures.stray(folder)
    (folder / "odometry.csv").write_text("time,lat,lon\n1,2,3\n")
    with pytest.raises(ValueError, match=r"odometry.csv: expected Stray Scanner's columns, there is no frame, x, y, z"):
        find_pairs_of_folder(folder)
