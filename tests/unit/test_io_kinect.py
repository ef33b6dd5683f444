"""Recordings of the Azure Kinect: cameras and lenses of all modes, formats of photos, pairs by time, and refusals."""

import copy
import json
import pickle

import captures
import numpy as np
import pytest

from dsr.geometry.camera import Camera, Lens
from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import CameraChoice, Reading, RigFiles

pytest.importorskip("av")

SIZE = (480, 640)
MAP = 1300 + np.arange(320, dtype=np.uint16) // 10 * np.ones((288, 1), np.uint16)  # millimetres
CAMERA = Camera(640, 480, 307.2, 307.2, 325.9, 234.7)


def photo(number=0):
    return np.clip(captures.photo(number).repeat(10, 0).repeat(10, 1), 16, 235)


def write(path, count=1, **options):
    return captures.kinect(path, [photo(number) for number in range(count)],
                           [MAP + np.uint16(100 * number) for number in range(count)], **options)  # fmt: skip


def pictures(path):
    return [read_picture(pair, Reading()) for pair in find_pairs_of_folder(path).pairs]


@pytest.mark.parametrize("mode", ["MJPG", "NV12", "YUY2", "BGRA"])
def test_photos_of_all_formats_and_depth_are_those_that_were_stored(tmp_path, mode):
    pairs = find_pairs_of_folder(write(tmp_path / "scan.mkv", 3, mode=mode)).pairs
    for number, pair in reversed(list(enumerate(pickle.loads(pickle.dumps(pairs))))):
        stored = pair.capture.photo.read()
        assert (stored.shape, stored.dtype) == ((*SIZE, 3), np.uint8)
        assert np.abs(stored.astype(float) - photo(number)).mean() < 3
        np.testing.assert_array_equal(pair.capture.depth.read(), MAP + 100 * number)


def test_pairs_are_of_one_time_less_the_delay_that_was_asked_for(tmp_path):
    pairs = find_pairs_of_folder(write(tmp_path / "scan.mkv", 3, late=0.025)).pairs
    assert len(pairs) == 3
    for number, pair in enumerate(pairs):
        np.testing.assert_array_equal(pair.capture.depth.read(), MAP + 100 * number)
        assert read_picture(pair, Reading()).time == pytest.approx(1 + number / 30, abs=1e-4)  # the photo's


def test_recordings_in_a_folder_are_found_among_other_videos(tmp_path):
    write(tmp_path / "b.mkv", 2)
    write(tmp_path / "a.mkv", 1)
    (tmp_path / "holiday.mkv").write_bytes(b"\x1a\x45\xdf\xa3 not one of a Kinect")
    found = find_pairs_of_folder(tmp_path)
    assert [pair.name for pair in found.pairs] == ["a/000000", "b/000000", "b/000001"]


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize(
    ("size", "size_lr", "whole", "expected"),
    [
        (SIZE, (288, 320), (512, 96, 90), CAMERA),
        ((720, 1280), (576, 640), (1024, 192, 180), Camera(1280, 720, 614.4, 614.4, 652.3, 349.9)),
        ((3072, 4096), (1024, 1024), (1024, 0, 0), Camera(4096, 3072, 1966.08, 1966.08, 2088.46, 1504.78)),
    ],
)
def test_cameras_of_all_modes_are_parts_of_the_same_image(tmp_path, wide, size, size_lr, whole, expected):
    """``whole``: the side of the image, and what is cut off left and above."""
    calibration = captures.kinect_calibration(wide=wide)
    photos, depths = [np.zeros((*size, 3), np.uint8)], [np.ones(size_lr, "u2")]
    path = captures.kinect(tmp_path / "scan.mkv", photos, depths, calibration=calibration)
    geometry = find_pairs_of_folder(path).pairs[0].capture.geometry_of(size)
    (cx, cy, fx, fy), (side, left, top) = captures.KINECT_IR, whole
    own = Camera(*size_lr[::-1], side * fx, side * fy, side * cx - left - 0.5, side * cy - top - 0.5)
    for found, wanted in ((geometry.camera, expected), (geometry.rig.camera, own)):
        assert vars(found) == pytest.approx(vars(wanted))
    np.testing.assert_allclose(geometry.rig.transform, captures.kinect_motion(), atol=1e-9)
    for lens, stored in ((geometry.lens, captures.KINECT_LENS), (geometry.rig.lens, captures.KINECT_IR_LENS)):
        k1, k2, k3, k4, k5, k6, _, _, p2, p1 = stored
        assert lens == Lens("brown_conrady", (k1, k2, p1, p2, k3, k4, k5, k6))


def changed(change):
    calibration = copy.deepcopy(captures.kinect_calibration())
    change(calibration["CalibrationInformation"]["Cameras"])
    return calibration


@pytest.mark.parametrize("centre", [0.0, 1e-3])
def test_lens_of_orbbecs_wrapper_is_read_without_a_centre_of_its_own(tmp_path, centre):
    def change(cameras):
        for each in cameras:
            each["Intrinsics"]["ModelType"] = "CALIBRATION_LensDistortionModelRational6KT"
            each["Intrinsics"]["ModelParameters"][10] = centre

    path = write(tmp_path / "scan.mkv", calibration=changed(change))
    if centre:
        with pytest.raises(ValueError, match=r"scan\.mkv: calibration\.json: "):
            pictures(path)
    else:
        (plain,), (picture,) = (pictures(each) for each in (write(tmp_path / "plain.mkv"), path))
        np.testing.assert_array_equal(picture.depth_lr, plain.depth_lr)


def test_damaged_calibration_is_named_unless_both_cameras_are_given(tmp_path):
    calibration = changed(lambda cameras: cameras[1]["Intrinsics"]["ModelParameters"].__setitem__(2, -1.0))
    (pair,) = find_pairs_of_folder(write(tmp_path / "scan.mkv", calibration=calibration)).pairs
    cx, cy, fx, fy = captures.KINECT_IR
    given = CameraChoice(intrinsics=(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy))
    with pytest.raises(ValueError, match=r"scan\.mkv: calibration\.json: "):
        read_picture(pair, Reading(camera=given))
    camera = {"width": 320, "height": 288, "fx": 512 * fx, "fy": 512 * fy, "cx": 512 * cx - 96.5, "cy": 512 * cy - 90.5}
    (tmp_path / "depth.json").write_text(json.dumps(camera))
    np.savetxt(tmp_path / "motion.txt", captures.kinect_motion())
    rig = RigFiles(camera=tmp_path / "depth.json", extrinsics=tmp_path / "motion.txt")
    picture = read_picture(pair, Reading(camera=given, rig=rig))
    assert "cameras-damaged" in [fact.code for fact in picture.assumptions]
    middle = np.nanmedian(picture.depth_lr[0, 100:140, 120:160])
    assert middle == pytest.approx(1.3, rel=0.1)


DAMAGED = {
    "none": {"CalibrationInformation": {}},
    "list": [1],
    "one camera": changed(lambda cameras: cameras.pop()),
    "lens": changed(lambda cameras: cameras[0]["Intrinsics"].update(ModelType="CALIBRATION_LensDistortionModelTheta")),
    "few": changed(lambda cameras: cameras[1]["Intrinsics"]["ModelParameters"].pop()),
    "negative": changed(lambda cameras: cameras[1]["Intrinsics"]["ModelParameters"].__setitem__(2, -1.0)),
    "text": changed(lambda cameras: cameras[1]["Intrinsics"]["ModelParameters"].__setitem__(5, "x")),
    "rotation": changed(lambda cameras: cameras[0]["Rt"].update(Rotation=[2.0] * 9)),
    "attachment": (b"calibration.json", b"calibration.text"),
    "track": (b"DEPTH", b"DEPHT"),
    "mode": (b"MJPG_480P", b"H264_480P"),
    "file": (b"\x1a\x45\xdf\xa3", b"\x1a\x45\xdf\xa4"),
    "photo": (b"\xff\xd8\xff", b"\xff\xd9\xff"),
}  # calibrations, and bytes of the recording with others


@pytest.mark.parametrize("what", DAMAGED)
def test_damaged_recordings_and_calibrations_are_refused_in_one_line(tmp_path, what):
    damage = DAMAGED[what]
    path = write(tmp_path / "scan.mkv", calibration=None if isinstance(damage, tuple) else damage)
    if isinstance(damage, tuple):
        path.write_bytes(path.read_bytes().replace(*damage))
    place = r"scan\.mkv[:/]" if isinstance(damage, tuple) else r"scan\.mkv: calibration\.json: "
    with pytest.raises(ValueError, match=place) as caught:
        pictures(path)
    assert "\n" not in str(caught.value)


def test_frames_of_a_recording_that_was_cut_off_are_read_up_to_there(tmp_path):
    path = write(tmp_path / "scan.mkv", 3)
    path.write_bytes(path.read_bytes()[:-500_000])
    found = find_pairs_of_folder(path)
    assert 1 <= len(found.pairs) < 3
    np.testing.assert_array_equal(found.pairs[0].capture.depth.read(), MAP)
