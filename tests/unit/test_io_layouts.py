"""Layouts of data sets and of apps' exports: camera, unit, holes and pose of each frame; archives; what is lacking."""

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

import bombs
import captures
import numpy as np
import pytest
import torch
from captures import FRAMES, INTRINSICS, SIZE

from dsr.cli import main
from dsr.geometry.camera import Camera
from dsr.io.inputs import FolderUnits, read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import CameraChoice, Reading

CAMERA = Camera(SIZE[1], SIZE[0], *INTRINSICS)


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


LAYOUTS = {
    "7-scenes": captures.seven_scenes,
    "scannet": captures.scannet,
    "sens": lambda folder: captures.sens(folder / "scene0000_00.sens").parent,
    "sens png raw": lambda folder: captures.sens(folder / "a.sens", colour="png", depth="raw"),
    "sens raw 0.2 mm": lambda folder: captures.sens(folder / "a.sens", colour="raw", scale=5000.0),
    "replica": captures.replica,
    "replica, every third frame": lambda folder: captures.replica(folder, step=3),
    "scanner app": captures.scanner_app,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_camera_unit_and_pose_of_each_frame_come_from_the_layout(folder, layout):
    place = LAYOUTS[layout](folder)
    if layout == "7-scenes":  # as 3DMatch has it
        captures.write_matrix(folder / "camera-intrinsics.txt", captures.intrinsic_matrix())
    pictures = read_all(place)
    assert len(pictures) == FRAMES
    for number, picture in enumerate(pictures):
        own = {"fx": INTRINSICS[0] + number} if layout == "scanner app" else {}
        assert picture.camera == Camera(**{**CAMERA.__dict__, **own})
        expected = captures.depth(number)
        if layout == "7-scenes":
            assert picture.depth_lr[0, 0, 0].isnan()
            expected[0, 0] = np.nan
        np.testing.assert_allclose(picture.depth_lr[0], expected, atol=6e-4)
        assert abs(255 * picture.rgb.permute(1, 2, 0).numpy() - captures.photo(number)).mean() < 4
        np.testing.assert_allclose(picture.pose, captures.pose(number), atol=1e-6)
        assert "read as millimetres" not in said(picture)
    again = read_picture(pickle.loads(pickle.dumps(find_pairs_of_folder(place).pairs[1])), Reading())
    np.testing.assert_array_equal(again.depth_lr, pictures[1].depth_lr)


def test_recordings_of_scannet_in_a_folder_are_distinguished_and_each_says_its_unit(folder):
    captures.sens(folder / "a.sens")
    captures.sens(folder / "b.sens", scale=5000.0)
    found = find_pairs_of_folder(folder)
    assert [pair.name for pair in found.pairs] == [f"{each}/{number:06}" for each in "ab" for number in range(FRAMES)]
    millimetres, fifths = (note.text for note in found.assumptions)
    assert "depth in millimetres;" in millimetres
    assert "depth in 1/5000 m;" in fifths


def test_seven_scenes_without_a_camera_has_the_usual_one_of_its_kinect(folder):
    captures.seven_scenes(folder)
    picture = read_all(folder)[0]
    assert picture.camera == Camera(640, 480, 585, 585, 320, 240).rescale(SIZE[1], SIZE[0])
    assert "camera: 585 pixels and the centre 320, 240 assumed" in said(picture)
    (folder / "frame-000001.pose.txt").unlink()
    captures.write_matrix(folder / "frame-000002.pose.txt", 2 * np.eye(4))
    pairs = find_pairs_of_folder(folder).pairs
    assert read_picture(pairs[1], Reading()).pose is None
    with pytest.raises(ValueError, match=r"frame-000002.pose.txt: expected "):
        read_picture(pairs[2], Reading())


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
    quarter = [value / 4 for value in INTRINSICS]
    assert read_all(folder)[0].camera == Camera(16, 12, *quarter)


@pytest.mark.parametrize("kind", ["lz4", "deflate", "files"])
def test_iphone_of_scannetpp_has_its_maps_video_and_aligned_poses(folder, kind):
    pytest.importorskip("lz4")
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
    found = find_pairs_of_folder(folder)
    assert "bits are turned back by 3" in found.assumptions[0].text
    assert "--depth-unit overrides it" in found.assumptions[0].text
    [picture] = read_all(folder)
    np.testing.assert_allclose(picture.depth_lr[0], captures.millimetres() * 6 / 1000, atol=1e-6)
    assert picture.camera == CAMERA
    (folder / "depth" / "0000144.png").unlink()
    [filled] = read_all(folder)
    np.testing.assert_allclose(filled.depth_lr, 1.0, atol=1e-6)
    captures.save(folder / "depth" / "0000144.png", captures.millimetres())
    [given] = read_all(folder, unit=1e-3)
    np.testing.assert_allclose(given.depth_lr[0], captures.depth(), atol=6e-4)


def test_real_scenes_of_sun_rgbd_are_read_in_metres(shared):
    for name in ("img_0063", "2014-12-18_11-31-54_260595134347"):
        [picture] = read_all(shared / "real" / "sunrgbd" / name)
        known = picture.depth_lr[~picture.depth_lr.isnan()]
        assert 1 < float(known.median()) < 4
        assert float(known.max()) < 12


def test_replica_has_its_unit_from_the_file_also_where_the_camera_is_given(folder):
    path = captures.replica(folder) / "cam_params.json"
    path.write_text(path.read_text().replace("6553.5", "1000.0"))
    [known, *_], [given, *_] = read_all(folder), read_all(folder, camera=CameraChoice(fov=60.0))
    torch.testing.assert_close(given.depth_lr, known.depth_lr, equal_nan=True)


def test_replica_has_its_unit_from_the_file_one_folder_up_or_from_the_data_set(folder):
    captures.replica(folder / "room0")
    text = (folder / "room0" / "cam_params.json").read_text()
    (folder / "cam_params.json").write_text(text.replace("6553.5", "6000"))
    (folder / "room0" / "cam_params.json").unlink()
    picture = read_all(folder / "room0")[1]
    assert picture.camera == CAMERA
    np.testing.assert_allclose(picture.depth_lr[0], captures.depth(1) * 6553.5 / 6000, atol=6e-4)
    (folder / "cam_params.json").unlink()
    picture = read_all(folder / "room0")[1]
    np.testing.assert_allclose(picture.depth_lr[0], captures.depth(1), atol=6e-4)
    (folder / "room0" / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    assert [each.pose is None for each in read_all(folder / "room0")] == [False, True, True]


@pytest.mark.parametrize("key", ["scale", "png_depth_scale"])
def test_scale_of_a_camera_file_counts_values_per_metre(folder, key):
    captures.save(folder / "rgb" / "1.png", captures.photo())
    captures.save(folder / "depth" / "1.png", (captures.depth() * 4000).astype(np.uint16))
    numbers = dict(zip(("fx", "fy", "cx", "cy"), INTRINSICS, strict=True))
    (folder / "camera.json").write_text(json.dumps({"width": 64, "height": 48, **numbers, key: 4000}))
    [picture] = read_all(folder)
    np.testing.assert_allclose(picture.depth_lr[0], captures.depth(), atol=6e-4)
    assert picture.camera == CAMERA
    for value in (0, -1, 0.001, "4000"):
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


def header(path, place, form, *values):
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, place, *values)
    path.write_bytes(content)


BROKEN_SENS = {
    "another version": (lambda path: header(path, 0, "<I", 3), "of version 4, got another file"),
    "a long name": (lambda path: header(path, 4, "<Q", 1 << 40), "of version 4, got another file"),
    "truncated header": (lambda path: path.write_bytes(path.read_bytes()[:99]), "got a damaged or foreign file"),
    "no such compression": (lambda path: header(path, 21 + 256 + 4, "<i", 2), "got compression 2 and 2"),
    "no size": (lambda path: header(path, 21 + 256 + 8, "<I", 0), "expected sizes and values per metre"),
    "no unit": (lambda path: header(path, 21 + 256 + 24, "<f", float("nan")), "expected sizes and values per metre"),
    "too many frames": (lambda path: header(path, 21 + 256 + 28, "<Q", 1 << 60), "frames, got 1152921504606846976"),
    "a frame without end": (lambda path: header(path, 21 + 292 + 80, "<Q", (1 << 64) - 1), "ends in frame 0"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-60]), "ends in frame 2"),
    "no frames": (lambda path: header(path, 21 + 256 + 28, "<Q", 0), "expected frames, there is none"),
}


@pytest.mark.parametrize("what", BROKEN_SENS)
def test_damaged_recording_of_scannet_is_refused_in_one_line(folder, what):
    damage, message = BROKEN_SENS[what]
    path = captures.sens(folder / "a.sens")
    damage(path)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        find_pairs_of_folder(path)
    assert str(caught.value).startswith(f"{path}: ")
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


def test_maps_of_scannetpp_that_are_damaged_or_compressed_together_are_refused(folder):
    pytest.importorskip("lz4")
    captures.scannetpp(folder)
    path = folder / "iphone" / "depth.bin"
    content = path.read_bytes()
    path.write_bytes(zlib.compress(content)[2:-4])
    with pytest.raises(
        ValueError, match=r"depth.bin: expected maps one by one, map 0 is damaged, or all are compressed"
    ):
        find_pairs_of_folder(folder)
    path.write_bytes(content[:4] + b"\xff" * 40 + content[44:])
    pairs = find_pairs_of_folder(folder).pairs
    with pytest.raises(ValueError, match=r"depth.bin/000000: expected compressed data of 196608 bytes, got damaged"):
        read_picture(pairs[0], Reading())
    (folder / "iphone" / "pose_intrinsic_imu.json").write_text('{"frame_000000": {"intrinsic": [[1]]}}')
    with pytest.raises(
        ValueError, match=r"imu.json: expected ScanNet\+\+'s intrinsics and poses; frame_000000.intrinsic"
    ):
        find_pairs_of_folder(folder)


def test_frames_of_scanner_app_without_json_or_with_a_broken_one(folder):
    captures.scanner_app(folder)
    (folder / "frame_00000.json").unlink()
    reported = json.loads((folder / "frame_00001.json").read_text())
    (folder / "frame_00001.json").write_text(json.dumps({**reported, "intrinsics": [1, 2]}))
    found = find_pairs_of_folder(folder)
    assert [path.name for path in found.unpaired] == ["depth_00003.png"]
    picture = read_picture(found.pairs[0], Reading())
    assert picture.pose is None
    assert "no camera and no pose" in said(picture)
    with pytest.raises(ValueError, match=r"frame_00001.json: expected 3D Scanner App's frame; intrinsics"):
        read_picture(found.pairs[1], Reading())
    confident = read_picture(found.pairs[2], Reading(min_confidence=0.5))
    assert confident.depth_lr[0].isnan()[:, :2].all()


def packed(path, folder, inside=""):
    """Write a ZIP file of a folder, with what macOS adds."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for each in sorted(folder.rglob("*")):
            if each.is_file():
                archive.write(each, f"{inside}{each.relative_to(folder)}")
                archive.writestr(f"__MACOSX/{inside}{each.relative_to(folder)}", b"\0\5\26\7")
    return path


ZIPPED = {
    "polycam": captures.polycam, "scanner app": captures.scanner_app, "stray": captures.stray,
    "record3d": lambda folder: captures.record3d(folder / "scan.r3d").parent, "replica": captures.replica,
}  # fmt: skip


@pytest.mark.parametrize("inside", ["", "2026_01_13/"])
@pytest.mark.parametrize("layout", ZIPPED)
def test_zip_file_of_a_capture_is_read_as_its_folder(folder, tmp_path, layout, inside):
    ZIPPED[layout](folder)
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


def remove(*names):
    def change(folder):
        for name in names:
            for path in folder.glob(name):
                path.unlink()

    return change


LACKING = {
    "stray without maps": (captures.stray, remove("depth/*"), "like Stray Scanner, without depth/"),
    "polycam without photos": (captures.polycam, remove("keyframes/*images/*"),
                               "like Polycam, without keyframes/images/"),
    "scannet without photos": (captures.scannet, remove("color/*"), "like ScanNet, without color/"),
    "7-scenes without maps": (captures.seven_scenes, remove("*.depth.png"),
                              "like 7-Scenes or 3DMatch, without *.depth.png"),
    "scanner app without maps": (captures.scanner_app, remove("depth_*.png"),
                                 "like 3D Scanner App, without depth_*.png"),
}  # fmt: skip


@pytest.mark.parametrize("what", LACKING)
@pytest.mark.parametrize("below", [False, True])
def test_capture_that_lacks_a_file_is_refused_with_its_name_and_that_of_the_file(folder, what, below):
    write, change, message = LACKING[what]
    change(write(folder / "scan" if below else folder))
    if below and what == "7-scenes without maps":
        captures.save(folder / "photo.jpg", captures.photo())
    with pytest.raises(ValueError, match=re.escape(f"it looks {message}{' in scan' * below}")) as caught:
        find_pairs_of_folder(folder)
    assert "\n" not in str(caught.value)


def test_capture_without_its_cameras_is_read_as_pictures_and_says_so(folder):
    remove("keyframes/*cameras/*")(captures.polycam(folder))
    found = find_pairs_of_folder(folder)
    assert len(found.pairs) == FRAMES
    assert found.assumptions[0].text.startswith("like Polycam, without keyframes/cameras/*.json: ")
    assert not any("like " in fact.text for fact in find_pairs_of_folder(captures.open3d(folder / "o")).assumptions)
