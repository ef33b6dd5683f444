"""The contract of captures: what each frame has, damage, archives, and the table of them."""

import json
import os
import pickle
import re
import stat
import struct
import subprocess
import sys
import zipfile
import zlib
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import bombs
import captures
import cv2
import numpy as np
import pytest
import torch
from captures import FRAMES, INTRINSICS, SIZE, SIZE_LR

import dsr.io.captures as registry
from dsr.cli import main
from dsr.geometry.camera import Camera
from dsr.io.captures.contract import Capture
from dsr.io.captures.record3d import decode_lzfse
from dsr.io.inputs import FolderUnits, read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import Pair, PairingResult
from dsr.io.reading import CameraChoice, Reading

CAMERA = Camera(SIZE[1], SIZE[0], *INTRINSICS)
DOCUMENTATION = Path(__file__).resolve().parents[2] / "docs" / "captures.md"


def read_all(folder, **reading):
    pairs = find_pairs_of_folder(folder).pairs
    units = FolderUnits(pairs)
    return [read_picture(pair, Reading(**reading), units) for pair in pairs]


def said(picture):
    return "\n".join(fact.text for fact in picture.assumptions)


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "capture"
    path.mkdir()
    return path


def three_dmatch(folder):
    captures.seven_scenes(folder)
    captures.write_matrix(folder / "camera-intrinsics.txt", captures.intrinsic_matrix())
    return folder


@dataclass(frozen=True)
class Case:
    """How a capture is written, and what of it is not as that of most."""

    write: object
    own: bool = False  # intrinsics of each frame: fx grows by 1
    up: str = ""
    time: tuple = ()  # of the first frame, and between frames
    posed: bool = True
    confident: bool = False


STRAY = Case(captures.stray, own=True, up="y", time=(10, 1 / 60), confident=True)
RECORD3D = Case(lambda folder: captures.record3d(folder / "scan.r3d").parent, own=True, up="y", confident=True)
SENS = Case(lambda folder: captures.sens(folder / "a.sens"), time=(1, 0.033333))
CASES = {
    "stray video": STRAY,
    "stray files": replace(STRAY, write=lambda folder: captures.stray(folder, video=False)),
    "record3d": RECORD3D,
    "record3d unpacked": replace(RECORD3D, write=captures.record3d_unpacked),
    "record3d export": replace(RECORD3D, write=captures.record3d_export, confident=False),
    "polycam": Case(captures.polycam, own=True, up="y", confident=True),
    "arkitscenes": Case(captures.arkitscenes, own=True, up="z", time=(10, 0.1), confident=True),
    "scanner app": Case(captures.scanner_app, own=True, up="y", confident=True),
    "7-scenes": Case(three_dmatch),
    "scannet": Case(captures.scannet),
    "sens": SENS,
    "sens png raw": replace(SENS, write=lambda folder: captures.sens(folder / "a.sens", colour="png", depth="raw")),
    "sens raw 0.2 mm": replace(SENS, write=lambda folder: captures.sens(folder / "a.sens", colour="raw", scale=5000.0)),
    "replica": Case(captures.replica),
    "replica, every third frame": Case(lambda folder: captures.replica(folder, step=3)),
    "open3d": Case(captures.open3d),
    "ros 1": Case(lambda folder: captures.ros(folder / "scan.bag", 1), time=(100, 0.033), posed=False),
    "ros 2, floats": Case(lambda folder: captures.ros(folder / "scan", 2, floats=True, compressed=True),
                          time=(100, 0.033), posed=False),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_each_frame_has_what_the_capture_states_here_and_in_other_processes(folder, name):
    case = CASES[name]
    place = case.write(folder)
    pictures = read_all(place)
    assert len(pictures) == FRAMES
    for number, picture in enumerate(pictures):
        corrected = name == "polycam" and number < FRAMES - 1  # the last one has no corrected photo and camera
        fx, fy, cx, cy = INTRINSICS
        assert picture.camera == Camera(SIZE[1], SIZE[0], fx + number * case.own, fy, cx, cy - corrected)
        expected = captures.depth(number)
        if name == "7-scenes":
            expected[0, 0] = np.nan
        np.testing.assert_allclose(picture.depth_lr[0], expected, atol=6e-4)
        difference = 255 * picture.rgb.permute(1, 2, 0).numpy() - captures.photo(number)
        assert abs(np.median(difference) - 10 * corrected) < 4
        if case.posed and not (name == "arkitscenes" and number == FRAMES - 1):
            assert picture.pose.dtype == np.float64
            np.testing.assert_allclose(picture.pose, captures.pose(number), atol=1e-6)
        else:
            assert picture.pose is None
        assert picture.up == case.up
        assert picture.time == (pytest.approx(case.time[0] + case.time[1] * number, abs=1e-6) if case.time else None)
        assert (picture.confidence is not None) == case.confident
        assert "read as millimetres" not in said(picture) or name == "open3d"
    there = read_picture(pickle.loads(pickle.dumps(find_pairs_of_folder(place).pairs[1])), Reading(unit=None))
    assert torch.equal(there.rgb, pictures[1].rgb)
    np.testing.assert_array_equal(there.depth_lr, pictures[1].depth_lr)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.confident])
def test_pixels_of_too_little_confidence_become_holes(folder, name):
    place = CASES[name].write(folder)
    for least, columns in ((None, 0), (0, 0), (0.5, 2), (0.6, 4), (1, 4)):
        picture = read_all(place, min_confidence=least)[0]
        holes = torch.zeros(SIZE_LR, dtype=torch.bool)
        holes[:, :columns] = True
        assert torch.equal(picture.depth_lr[0].isnan(), holes)
        np.testing.assert_allclose(picture.confidence[0], captures.levels() / 2, atol=0.002)


@pytest.mark.parametrize("name", CASES)
def test_a_file_that_is_cut_off_is_one_line_that_names_it(folder, name):
    place = CASES[name].write(folder)
    path = max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: (path.stat().st_size, path))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 + 1])
    problems = []
    try:
        pairs = find_pairs_of_folder(place).pairs
    except ValueError as error:
        pairs, problems = (), [str(error)]
    for pair in pairs:
        try:
            read_picture(pair, Reading())
        except ValueError as error:
            problems.append(str(error))
    assert problems
    assert all("\n" not in problem and str(folder) in problem for problem in problems)
    assert all(path.name in problem or place.name in problem for problem in problems)


WRITERS = {
    "Stray Scanner": captures.stray, "Record3D": captures.record3d_unpacked, "Polycam": captures.polycam,
    "ARKitScenes": captures.arkitscenes, "3D Scanner App": captures.scanner_app, "ScanNet": captures.scannet,
    "ScanNet++ iPhone": lambda folder: captures.scannetpp(folder, "files") or folder / "iphone",
    "7-Scenes or 3DMatch": captures.seven_scenes, "SUN RGB-D": lambda folder: captures.sunrgbd(folder) or folder,
    "Replica of NICE-SLAM": captures.replica, "ZED": captures.zed, "Open3D": captures.open3d,
}  # fmt: skip


@pytest.mark.parametrize("name", [each.name for each in registry.CAPTURES if each.needs and each.name != "TUM RGB-D"])
def test_folder_that_lacks_a_part_of_a_capture_is_told_which(folder, name):
    (capture,) = (each for each in registry.CAPTURES if each.name == name)
    part = capture.needs[-1]
    place = WRITERS[name](folder)
    assert registry.lacking(place) == []
    for path in [path for pattern in part.split(" or ") for path in place.glob(pattern)]:
        path.unlink()
    marked = any(any(place.glob(mark)) for mark in capture.marks)
    assert any(text.startswith(f"like {name}, without ") and part in text for text in registry.lacking(place)) == marked


def test_capture_without_photos_is_refused_and_without_cameras_is_read_as_pictures(folder):
    captures.polycam(folder / "scan")
    for path in folder.glob("scan/keyframes/*cameras/*"):
        path.unlink()
    found = find_pairs_of_folder(folder)
    assert len(found.pairs) == FRAMES
    assert found.assumptions[0].text.startswith("like Polycam, without keyframes/cameras/*.json or ")
    for path in folder.glob("scan/keyframes/*images/*"):
        path.unlink()
    with pytest.raises(ValueError, match="it looks like Polycam, without keyframes/images/"):
        find_pairs_of_folder(folder)


def test_pose_of_arkit_looks_forward_with_y_down(folder):
    """A camera at rest in ARKit's world, y up, looks along -z: forward is (0, 0, -1), down is (0, -1, 0)."""
    captures.polycam(folder)
    still = {f"t_{row}{column}": float(row == column) for row in range(3) for column in range(4)}
    path = folder / "keyframes" / "corrected_cameras" / "1000.json"
    path.write_text(json.dumps(captures.polycam_camera(0) | still))
    turn = read_all(folder)[0].pose[:3, :3]
    np.testing.assert_array_equal(turn @ [0, 0, 1], [0, 0, -1])
    np.testing.assert_array_equal(turn @ [0, 1, 0], [0, -1, 0])


def test_open3d_folder_with_another_number_of_poses_has_none(folder):
    captures.open3d(folder, "camera_primesense.json")
    assert read_all(folder)[1].camera == CAMERA
    (folder / "depth" / "000001.png").unlink()
    found = find_pairs_of_folder(folder)
    assert any("no poses: trajectory.log has 3, for 2 pairs" in fact.text for fact in found.assumptions)
    assert {pair.capture for pair in found.pairs} == {None}


def test_camera_matrix_of_stray_scanner_is_used_where_frames_have_none(folder):
    captures.stray(folder, own_intrinsics=False)
    picture = read_all(folder)[2]
    assert picture.camera == CAMERA
    assert any(fact.text.startswith("camera: camera_matrix.csv of the whole capture") for fact in picture.assumptions)


def test_frames_of_a_video_are_decoded_in_any_order(folder):
    pairs = find_pairs_of_folder(captures.stray(folder)).pairs
    for number in (2, 0, 1, 1, 0, 2):
        photo = read_picture(pairs[number], Reading()).rgb[0].mean()
        assert abs(255 * float(photo) - captures.photo(number)[..., 0].mean()) < 8


def test_first_frame_that_an_edit_list_hides_is_decoded(folder, monkeypatch):
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
    monkeypatch.delenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", raising=False)
    plain = cv2.VideoCapture(str(path))
    count = 0
    while plain.grab():
        count += 1
    plain.release()
    assert count == FRAMES - 1
    for number, picture in enumerate(read_all(folder)):
        assert abs(255 * float(picture.rgb[0].mean()) - captures.photo(number)[..., 0].mean()) < 8
    assert len(find_pairs_of_folder(folder).assumptions) == 1  # nothing is said of other numbers of frames


def test_video_that_ends_early_or_is_none_is_refused(folder):
    captures.stray(folder)
    captures.write_video(folder / "rgb.mp4", [captures.photo(1), captures.photo(2)])
    for name in ("depth", "confidence"):
        (folder / name / "000000.png").rename(folder / name / "000007.png")
    found = find_pairs_of_folder(folder)
    assert found.assumptions[1].text.startswith("rgb.mp4 has 2 frames, the depth maps count to 8: photos may be")
    pairs = found.pairs
    with pytest.raises(ValueError, match=r"rgb.mp4: expected a frame 7"):
        read_picture(pairs[-1], Reading())
    assert read_picture(pairs[0], Reading()).pose is not None
    (folder / "rgb.mp4").write_bytes((folder / "rgb.mp4").read_bytes()[:300])
    with pytest.raises(ValueError, match=r"rgb.mp4: expected a video"):
        read_picture(pairs[0], Reading())


def test_lzfse_data_of_the_real_compressor_are_read_and_damaged_ones_refused(folder):
    lzfse = pytest.importorskip("lzfse")
    captures.record3d(folder / "scan.r3d", lambda values: lzfse.compress(values.tobytes()))
    np.testing.assert_allclose(read_all(folder)[1].depth_lr[0], captures.depth(1), rtol=1e-6)
    short = b"bvx-" + struct.pack("<I", 1 << 20) + b"x" * 8
    for content in (b"", short, captures.lzfse_block(np.zeros(5, "u1"))):
        with pytest.raises(ValueError, match=r"^expected "):
            decode_lzfse(content, SIZE_LR, "<f4")


def test_missing_package_is_named_with_the_extra_that_has_it(folder, monkeypatch):
    captures.record3d(folder / "scan.r3d")
    (folder / "bag").mkdir()
    (folder / "bag" / "scan.bag").write_bytes(b"#ROSBAG V2.0")
    for module in ("lzfse", "rosbags.highlevel"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=r"rgbd/0.depth: LZFSE data need the package lzfse: pip install -e"):
        read_all(folder)
    with pytest.raises(ValueError, match=r"need the package rosbags: pip install -e '.\[captures\]'"):
        find_pairs_of_folder(folder / "bag")


def test_archive_whose_members_are_too_large_or_of_another_app_is_refused(folder):
    path = captures.record3d(folder / "scan.r3d")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for name, content, message in (
        ("metadata", b" " * (1 << 28), "scan.r3d/metadata: expected at most 134217728 bytes, got"),
        ("metadata", b'{"app": "other"}', "metadata: expected Record3D's metadata; w: it is missing"),
        ("metadata", b"[1", "metadata: expected Record3D's metadata; got damaged JSON"),
        ("rgbd/1.depth", bytes(1 << 24), "scan.r3d/rgbd/1.depth: expected at most 66304 bytes, got"),
    ):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for each, old in members.items():
                archive.writestr(each, content if each == name else old)
        with pytest.raises(ValueError, match=re.escape(message)):
            read_all(folder)
    assert read_picture(find_pairs_of_folder(folder).pairs[2], Reading()).depth_lr.isfinite().all()


def changed(write, name, change):
    """How a capture is written of which one file has other bytes."""

    def write_changed(folder):
        write(folder)
        path = folder / name
        path.write_bytes(change(path.read_bytes()))

    return write_changed


def swap(old, new):
    return lambda content: content.replace(old, new, 1)


def put(place, form, value):
    return lambda content: content[:place] + struct.pack(form, value) + content[place + struct.calcsize(form) :]


def with_camera(**changes):
    camera = json.dumps(captures.polycam_camera(0, **changes)).encode()
    return changed(captures.polycam, "keyframes/corrected_cameras/1000.json", lambda _: camera)


MIRROR = {f"t_{row}{row}": 1.0 - 2 * (row == 0) for row in range(3)} | {
    f"t_{row}{column}": 0.0 for row in range(3) for column in range(3) if row != column
}
NO_POSE = "expected a rigid transform"
BROKEN = {
    "intrinsics of a frame": (changed(captures.stray, "odometry.csv", swap(b", 51.000000000", b", nan")),
                              "odometry.csv: frame 0: camera fy: expected"),
    "a matrix that is sheared": (with_camera(t_01=2.0), f"1000.json: {NO_POSE}"),
    "a mirrored matrix": (with_camera(**MIRROR), f"1000.json: {NO_POSE}"),
    "a camera without a key": (with_camera(fx=None), "1000.json: expected Polycam's camera; fx:"),
    "intrinsics in a file": (changed(captures.arkitscenes, "lowres_wide_intrinsics/41069021_10.001.pincam",
                                     lambda _: b"64 48 nan 51 31 24"),
                             "10.001.pincam: camera fx: expected a finite number"),
    "Record3D": (lambda folder: captures.record3d(folder / "a.r3d", perFrameIntrinsicCoeffs=[[np.nan, 1, 1, 1]]),
                 "metadata: frame 0: camera fx: expected a finite number"),
    "7-Scenes": (changed(captures.seven_scenes, "frame-000000.pose.txt", lambda _: b"2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 2"),
                 "frame-000000.pose.txt: expected "),
    "3D Scanner App": (changed(captures.scanner_app, "frame_00000.json",
                               lambda _: b'{"intrinsics": [1], "cameraPoseARFrame": []}'),
                       "frame_00000.json: expected 3D Scanner App's frame; intr"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_broken_frame_is_refused_in_one_line_and_the_others_are_read(folder, what):
    write, message = BROKEN[what]
    write(folder)
    pairs = find_pairs_of_folder(folder).pairs
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read_picture(pairs[0], Reading())
    assert "\n" not in str(caught.value)
    assert read_picture(pairs[1], Reading()).depth_lr.isfinite().any()


def test_seven_scenes_without_a_camera_has_the_usual_one_of_its_kinect(folder):
    captures.seven_scenes(folder)
    (folder / "frame-000001.pose.txt").unlink()
    pictures = read_all(folder)
    assert pictures[0].camera == Camera(640, 480, 585, 585, 320, 240).rescale(SIZE[1], SIZE[0])
    assert "camera: 585 pixels and the centre 320, 240 assumed" in said(pictures[0])
    assert pictures[1].pose is None


@pytest.mark.parametrize("layout", [captures.scannet, lambda folder, lost: captures.sens(folder / "a.sens", lost=lost)])
def test_frames_of_scannet_that_were_lost_have_no_pose(folder, layout):
    pictures = read_all(layout(folder, lost=(1,)))
    assert [picture.pose is None for picture in pictures] == [False, True, False]
    assert "no pose: " in said(pictures[1])
    assert pictures[1].camera == CAMERA


def test_photos_of_scannet_that_were_made_as_small_as_the_maps_have_the_camera_of_depth(folder):
    captures.scannet(folder)
    for number in range(FRAMES):
        captures.save(folder / "color" / f"{number}.jpg", captures.photo(number)[::4, ::4])
    assert read_all(folder)[0].camera == Camera(16, 12, *(value / 4 for value in INTRINSICS))


@pytest.mark.parametrize("kind", ["lz4", "deflate", "files"])
def test_iphone_of_scannetpp_has_its_maps_video_and_aligned_poses(folder, kind):
    captures.scannetpp(folder, kind)
    pictures = read_all(folder)
    assert len(pictures) == FRAMES
    for number, picture in enumerate(pictures):
        fx, fy, cx, cy = (4 * value for value in INTRINSICS)
        assert picture.camera == Camera(256, 192, fx + number, fy, cx, cy)
        np.testing.assert_allclose(picture.depth_lr[0], captures.iphone_map(number), atol=6e-4)
        np.testing.assert_allclose(picture.pose, captures.pose(number), atol=1e-6)
        assert abs(255 * float(picture.rgb[0].mean()) - captures.photo(number)[..., 0].mean()) < 8


def test_scene_of_sun_rgbd_has_its_bits_turned_back_and_the_sensors_own_map(folder):
    captures.sunrgbd(folder)
    assert "bits are turned back by 3" in find_pairs_of_folder(folder).assumptions[0].text
    [picture] = read_all(folder)
    np.testing.assert_allclose(picture.depth_lr[0], captures.millimetres() * 6 / 1000, atol=1e-6)
    assert picture.camera == CAMERA
    (folder / "depth" / "0000144.png").unlink()
    [filled] = read_all(folder)
    np.testing.assert_allclose(filled.depth_lr, 1.0, atol=1e-6)
    captures.save(folder / "depth" / "0000144.png", captures.millimetres())
    [given] = read_all(folder, unit=1e-3)
    np.testing.assert_allclose(given.depth_lr[0], captures.depth(), atol=6e-4)


def test_replica_has_its_unit_from_the_file_here_or_one_folder_up_or_from_the_data_set(folder):
    path = captures.replica(folder / "room0") / "cam_params.json"
    path.write_text(path.read_text().replace("6553.5", "6000"))
    path.rename(folder / "cam_params.json")
    picture = read_all(folder / "room0")[1]
    assert picture.camera == CAMERA
    np.testing.assert_allclose(picture.depth_lr[0], captures.depth(1) * 6553.5 / 6000, atol=6e-4)
    given = read_all(folder / "room0", camera=CameraChoice(fov=60.0))[1]
    torch.testing.assert_close(given.depth_lr, picture.depth_lr, equal_nan=True)
    (folder / "cam_params.json").unlink()
    (folder / "room0" / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    pictures = read_all(folder / "room0")
    np.testing.assert_allclose(pictures[1].depth_lr[0], captures.depth(1), atol=6e-4)
    assert [each.pose is None for each in pictures] == [False, True, True]


@pytest.mark.parametrize("key", ["scale", "png_depth_scale"])
def test_scale_of_a_camera_file_counts_values_per_metre(folder, key):
    captures.save(folder / "rgb" / "1.png", captures.photo())
    captures.save(folder / "depth" / "1.png", (captures.depth() * 4000).astype(np.uint16))
    numbers = dict(zip(("fx", "fy", "cx", "cy"), INTRINSICS, strict=True))
    (folder / "camera.json").write_text(json.dumps({"width": 64, "height": 48, **numbers, key: 4000}))
    [picture] = read_all(folder)
    np.testing.assert_allclose(picture.depth_lr[0], captures.depth(), atol=6e-4)
    assert picture.camera == CAMERA
    for value in (0, "4000"):
        (folder / "camera.json").write_text(json.dumps({"width": 64, "height": 48, **numbers, key: value}))
        with pytest.raises(ValueError, match=r"camera.json: "):
            read_all(folder)


def test_tum_lists_have_the_poses_of_the_ground_truth_that_are_near_in_time(folder):
    times = [1305031102.175 + number / 30 for number in range(FRAMES)]
    lines = {"rgb": [], "depth": []}
    for number, time in enumerate(times):
        captures.save(folder / "rgb" / f"{time:.6f}.png", captures.photo(number))
        captures.save(folder / "depth" / f"{time + 0.01:.6f}.png", 5 * captures.millimetres(number))
        lines["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lines["depth"].append(f"{time + 0.01:.6f} depth/{time + 0.01:.6f}.png")
    for kind, each in lines.items():
        (folder / f"{kind}.txt").write_text("# list\n" + "\n".join(each) + "\n")
    poses = [f"{time + shift:.6f} {10 * number + shift:g} 0 0 0 0 0 1"
             for number, time in enumerate(times[:2]) for shift in (0, 0.015)]  # fmt: skip
    (folder / "groundtruth.txt").write_text("# time tx ty tz qx qy qz qw\n" + "\n".join(reversed(poses)) + "\n")
    pictures = read_all(folder)
    assert [None if picture.pose is None else picture.pose[0, 3] for picture in pictures] == [0.015, 10.015, None]
    np.testing.assert_allclose(pictures[1].depth_lr[0], captures.depth(1), atol=6e-4)
    assert "2 of 3 frames" in find_pairs_of_folder(folder).assumptions[0].text
    (folder / "groundtruth.txt").write_text("1 2 3 x\n")
    with pytest.raises(ValueError, match=r"groundtruth.txt: line 1: expected numbers"):
        find_pairs_of_folder(folder)


def other_sens(change):
    return changed(SENS.write, "a.sens", change)


def other_iphone(change):
    return changed(captures.scannetpp, "iphone/depth.bin", change)


def other_zed(old, new):
    return changed(captures.zed, "SN12345.conf", swap(old, new))


CALIBRATION = r"SN12345\.conf: "
REFUSED = {
    "another version": (other_sens(put(0, "<I", 3)), "a.sens: .* of version 4, got another file"),
    "truncated header": (other_sens(lambda content: content[:99]), "damaged or foreign file"),
    "no such compression": (other_sens(put(21 + 256 + 4, "<i", 2)), "got compression 2 and 2"),
    "no unit": (other_sens(put(21 + 256 + 24, "<f", float("nan"))), "expected sizes and values per metre"),
    "too many frames": (other_sens(put(21 + 256 + 28, "<Q", 1 << 60)), "frames, got 1152921504606846976"),
    "a frame without end": (other_sens(put(21 + 292 + 80, "<Q", (1 << 64) - 1)), "ends in frame 0"),
    "no frames": (other_sens(put(21 + 256 + 28, "<Q", 0)), "expected frames, there is none"),
    "maps compressed together": (other_iphone(lambda content: zlib.compress(content)[2:-4]),
                                 "depth.bin: expected maps one by one, map 0 is damaged, or all are compressed"),
    "damaged map": (other_iphone(lambda content: content[:4] + b"\xff" * 40 + content[44:]),
                    "depth.bin/000000: expected compressed data of 196608 bytes, got damaged"),
    "text": (other_zed(b"fx=700.0", b"fx=x"), CALIBRATION),
    "damaged section": (other_zed(b"[LEFT_CAM_HD]", b"LEFT"), CALIBRATION),
    "nan": (other_zed(b"cy=355.0", b"cy=nan"), CALIBRATION),
    "two calibrations": (lambda folder: (captures.zed(folder) / "SN2.conf").touch(),
                         r"expected one calibration of .*, got SN12345\.conf, SN2\.conf"),
    "columns": (changed(captures.stray, "odometry.csv", lambda _: b"time,lat,lon\n1,2,3\n"),
                "odometry.csv: expected Stray Scanner's columns, there is no frame, x, y, z"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_damaged_capture_is_refused_in_one_line_that_names_the_file(folder, what):
    write, message = REFUSED[what]
    write(folder)
    with pytest.raises(ValueError, match=message) as caught:
        read_all(folder)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_map_of_a_recording_that_unpacks_to_another_size_is_refused_and_the_others_are_read(folder, monkeypatch):
    pack = zlib.compress
    monkeypatch.setattr(zlib, "compress", lambda data: pack(b"\0" * (1 << 26) if data[0] == 208 else data))
    path = captures.sens(folder / "a.sens")
    assert captures.millimetres(1).tobytes()[0] == 208
    pairs = find_pairs_of_folder(path).pairs
    with pytest.raises(ValueError, match=r"a.sens/depth/1: expected compressed data of 384 bytes, got more"):
        read_picture(pairs[1], Reading())
    assert read_picture(pairs[2], Reading()).depth_lr.isfinite().all()


def test_frames_of_scanner_app_without_json_have_no_camera_and_no_pose(folder):
    captures.scanner_app(folder)
    (folder / "frame_00000.json").unlink()
    found = find_pairs_of_folder(folder)
    assert [path.name for path in found.unpaired] == ["depth_00003.png"]
    picture = read_picture(found.pairs[0], Reading())
    assert picture.pose is None
    assert "no camera and no pose" in said(picture)


def test_frames_of_a_zed_have_the_camera_of_the_calibration_of_their_size_and_millimetres(tmp_path):
    pairs = find_pairs_of_folder(captures.zed(tmp_path)).pairs
    assert [pair.name for pair in pairs] == ["000000", "000001", "000002"]
    picture = read_picture(pairs[1], Reading())
    camera = picture.camera
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (700, 700, 650, 355), atol=0.01)
    np.testing.assert_allclose(picture.depth_lr, 1.1)
    for kind, values in (("left", captures.photo()), ("depth", np.full(captures.SIZE, 900, np.uint16))):
        captures.save(tmp_path / f"{kind}000000.png", values)
    assert "SN12345.conf is not used" in said(read_picture(pairs[0], Reading()))


def test_translation_of_a_zed_is_of_each_resolution_or_of_all_or_0_as_the_files_of_each_age_have_it(folder):
    """An angle of 0.02 between both cameras is 14 pixels, by a part of which the middle of the photo moves."""

    def camera():
        return read_all(folder)[0].camera

    path = captures.zed(folder, TY_HD=9.0, TZ_HD=-30.0, CV_HD=0.02) / "SN12345.conf"
    text, each = path.read_text(), camera()
    path.write_text(text.replace("TY_HD", "TY").replace("TZ_HD", "TZ"))
    assert camera() == each
    path.write_text("".join(line for line in text.splitlines(keepends=True) if not line.startswith(("TY", "TZ"))))
    without = camera()
    captures.zed(folder, CV_HD=0.02)
    assert without == camera() != each
    assert 5 < abs(without.cx - 650) < 15


def packed(path, folder, inside=""):
    """Write a ZIP file of a folder, with what macOS adds."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for each in sorted(folder.rglob("*")):
            if each.is_file():
                archive.write(each, f"{inside}{each.relative_to(folder)}")
                archive.writestr(f"__MACOSX/{inside}{each.relative_to(folder)}", b"\0\5\26\7")
    return path


@pytest.mark.parametrize("inside", ["", "2026_01_13/"])
@pytest.mark.parametrize("name", ["polycam", "stray video", "record3d"])
def test_zip_file_of_a_capture_is_read_as_its_folder(folder, tmp_path, name, inside):
    CASES[name].write(folder)
    path = packed(tmp_path / "scan.zip", folder, inside)
    plain, found = find_pairs_of_folder(folder), find_pairs_of_folder(path)
    assert [pair.name for pair in found.pairs] == [pair.name for pair in plain.pairs]
    assert found.assumptions == plain.assumptions
    for before, after in zip(read_all(folder), read_all(path), strict=True):
        assert torch.equal(before.depth_lr, after.depth_lr)
        assert before.camera == after.camera
        np.testing.assert_array_equal(before.pose, after.pose)


def test_folder_of_an_unpacked_zip_file_is_deleted_at_the_end(folder, tmp_path):
    path = packed(tmp_path / "scan.zip", captures.polycam(folder))
    place = tmp_path / "temporary"
    place.mkdir()
    command = (sys.executable, "-m", "dsr", "upsample", str(path), "-o", str(tmp_path / "out"), "--dry-run")
    done = subprocess.run(
        command, env={**os.environ, "TMPDIR": str(place)}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert f"{FRAMES} pairs of photo and depth map" in done.stdout
    assert list(place.iterdir()) == []


def hostile(path, name="a.jpg", *, link=False, bomb=False):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        if bomb:
            bombs.zeros(archive, name, b"", bombs.LARGE)
        else:
            info = zipfile.ZipInfo(name)
            info.create_system, info.external_attr = 3, (stat.S_IFLNK if link else stat.S_IFREG) << 16
            archive.writestr(info, "/etc/passwd")
    return path


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bomb": True}, "the members declare: expected at most 268435456 bytes, got 629145600"),
        ({"name": "../a.jpg"}, "refused: '../a.jpg' in it leads outside the directory it belongs into"),
        ({"name": "/tmp/a.jpg"}, "leads outside the directory it belongs into"),
        ({"name": "..\\a.jpg"}, "leads outside the directory it belongs into"),
        ({"name": "depth", "link": True}, "refused: 'depth' in it is neither a file nor a directory"),
    ],
)
def test_hostile_zip_file_is_refused_in_one_line(tmp_path, capsys, options, message):
    path = hostile(tmp_path / "scan.zip", **options)
    assert main(["upsample", str(path), "-o", str(tmp_path / "out"), "--dry-run"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line
    assert sorted(each.name for each in tmp_path.iterdir()) == ["scan.zip"]


def test_zip_file_that_unpacks_to_more_than_it_declares_or_is_damaged_is_refused(folder, tmp_path):
    bombs.r3d(tmp_path / "scan.zip")
    with pytest.raises(ValueError, match=r"scan.zip: rgbd/0.jpg: expected a member, got a damaged one"):
        find_pairs_of_folder(tmp_path / "scan.zip")
    path = packed(tmp_path / "half.zip", captures.polycam(folder))
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"half.zip: expected a ZIP archive, got a damaged, truncated or foreign file"):
        find_pairs_of_folder(path)


class Toy:
    """An entry point of a package that reads folders with the file ``toy``."""

    @staticmethod
    def load():
        pair = Pair("a", Path("a.png"), Path("b.png"))
        return Capture("Toy", *[""] * 6, lambda place: PairingResult((pair,)) if (place / "toy").is_file() else None)


def test_other_packages_add_captures_by_an_entry_point(folder, monkeypatch, capsys):
    entry = SimpleNamespace(name="toy", value="toy:TOY", load=Toy.load)
    monkeypatch.setattr(registry, "entry_points", lambda group: {"dsr.captures": [entry]}[group])
    registry.all_captures.cache_clear()
    (folder / "toy").touch()
    try:
        assert [pair.name for pair in find_pairs_of_folder(folder).pairs] == ["a"]
        assert main(["formats", "toy"]) == 0
        assert capsys.readouterr().out.startswith("Toy")
        registry.all_captures.cache_clear()
        entry.load = lambda: import_module("toy_that_is_gone")
        with pytest.raises(ValueError, match="capture toy of another package"):
            find_pairs_of_folder(folder)
    finally:
        registry.all_captures.cache_clear()


def test_documentation_has_the_table_of_captures():
    table = []
    for each in registry.CAPTURES:
        name = f"[{each.name}]({each.source})" if each.source else each.name
        table.append(f"| {name} | {each.export} | {each.found_by} | {each.read} | {each.tried} | {each.faults} |")
    shown = DOCUMENTATION.read_text(encoding="utf-8").splitlines()
    first = shown.index("| device or program | export | recognised by | read | tried | the sensor |") + 2
    assert shown[first : first + len(table)] == table


def test_command_prints_the_captures_with_a_word(capsys):
    assert main(["formats", "r3d"]) == 0
    printed = capsys.readouterr().out
    assert ("Record3D" in printed, "Polycam" in printed) == (True, False)
    assert main(["formats"]) == 0
    printed = capsys.readouterr().out
    assert all(each.name in printed for each in registry.CAPTURES)
    assert main(["formats", "daguerreotype"]) == 2
    assert "Record3D" in capsys.readouterr().err
