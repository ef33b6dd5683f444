"""Recordings of the Azure Kinect: both cameras, lenses, formats of photos, pairs by time, and every refusal."""

import copy
import functools
import json
import pickle

import captures
import cv2
import numpy as np
import pytest

from dsr.geometry.camera import Camera
from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import CameraChoice, Reading, RigFiles

pytest.importorskip("av")

SIZE, SIZE_LR = (480, 640), captures.KINECT_DEPTH
NORMAL, DISTANCE = np.array([0.15, -0.25, 1.0]), 1.3  # A plane before the depth camera: NORMAL X = DISTANCE


def opencv(lens):
    """Coefficients in OpenCV's order, from those of the SDK."""
    return np.array([lens[0], lens[1], lens[9], lens[8], *lens[2:6]])


def matrix_of_colour():
    """Of 640 x 480, which is the whole image of 4:3."""
    cx, cy, fx, fy = captures.KINECT_COLOUR
    return np.array([[640 * fx, 0, 640 * cx - 0.5], [0, 480 * fy, 480 * cy - 0.5], [0, 0, 1]])


def rays(matrix, size, lens=None):
    """Directions (h, w, 3) of the pixels, found by projecting and correcting them."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    straight = np.stack(((x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1], np.ones(size)), -1)
    found = straight.reshape(-1, 3).copy()
    for _ in range(0 if lens is None else 60):
        off = cv2.projectPoints(found, np.zeros(3), np.zeros(3), np.eye(3), lens)[0].reshape(-1, 2)
        found[:, :2] -= off - straight.reshape(-1, 3)[:, :2]
    return found.reshape(*size, 3)


@functools.cache
def plane():
    """Millimetres of the plane in pixels of the depth camera's mode 320 x 288, with its lens."""
    cx, cy, fx, fy = captures.KINECT_IR
    matrix = np.array([[512 * fx, 0, 512 * cx - 96.5], [0, 512 * fy, 512 * cy - 90.5], [0, 0, 1]])
    seen = rays(matrix, SIZE_LR, opencv(captures.KINECT_IR_LENS))
    return np.round(1000 * DISTANCE / (seen @ NORMAL)).astype(np.uint16)


def photo(number=0):
    return np.clip(captures.photo(number).repeat(10, 0).repeat(10, 1), 16, 235)


def write(path, count=1, **options):
    return captures.kinect(path, [photo(number) for number in range(count)],
                           [plane() + np.uint16(100 * number) for number in range(count)], **options)  # fmt: skip


def pictures(path):
    return [read_picture(pair, Reading()) for pair in find_pairs_of_folder(path).pairs]


@pytest.mark.parametrize("wide", [False, True])
def test_depth_map_lies_where_the_photo_shows_it(tmp_path, wide):
    (picture,) = pictures(write(tmp_path / "scan.mkv", calibration=captures.kinect_calibration(wide=wide)))
    matrix = matrix_of_colour()
    camera = picture.camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy],
                               [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])  # fmt: skip
    motion = captures.kinect_motion()
    normal = motion[:3, :3] @ NORMAL
    found = picture.depth_lr[0].numpy()
    own = camera.rescale(found.shape[1], found.shape[0])
    seen = rays(np.array([[own.fx, 0, own.cx], [0, own.fy, own.cy], [0, 0, 1]]), found.shape)
    error = found - (DISTANCE + normal @ motion[:3, 3]) / (seen @ normal)
    assert np.isfinite(error).mean() > 0.3
    assert np.nanquantile(np.abs(error), 0.99) < 2e-3


def test_distortion_of_the_photo_is_undone(tmp_path):
    direction, matrix = np.array([[0.45, -0.3, 1.0]]), matrix_of_colour()
    place = cv2.projectPoints(direction, np.zeros(3), np.zeros(3), matrix, opencv(captures.KINECT_LENS))[0].ravel()
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    spot = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 18)
    marked = np.repeat((255 * spot).astype(np.uint8)[..., None], 3, -1)
    (picture,) = pictures(captures.kinect(tmp_path / "scan.mkv", [marked], [plane()]))
    light = np.where(picture.rgb[1] > 0.2, picture.rgb[1], 0)
    centre = [(light * each).sum() / light.sum() for each in (x, y)]
    expected = (matrix @ direction[0])[:2]
    assert np.abs(place - expected).max() > 2
    np.testing.assert_allclose(centre, expected, atol=0.5)


@pytest.mark.parametrize("mode", ["MJPG", "NV12", "YUY2", "BGRA"])
def test_photos_of_all_formats_and_depth_are_those_that_were_stored(tmp_path, mode):
    pairs = find_pairs_of_folder(write(tmp_path / "scan.mkv", 3, mode=mode)).pairs
    for number, pair in reversed(list(enumerate(pickle.loads(pickle.dumps(pairs))))):
        stored = pair.capture.photo.read()
        assert (stored.shape, stored.dtype) == ((*SIZE, 3), np.uint8)
        assert np.abs(stored.astype(float) - photo(number)).mean() < 3
        np.testing.assert_array_equal(pair.capture.depth.read(), plane() + 100 * number)


def test_pairs_are_of_one_time_less_the_delay_that_was_asked_for(tmp_path):
    pairs = find_pairs_of_folder(write(tmp_path / "scan.mkv", 3, late=0.025)).pairs
    assert len(pairs) == 3
    for number, pair in enumerate(pairs):
        np.testing.assert_array_equal(pair.capture.depth.read(), plane() + 100 * number)
        assert read_picture(pair, Reading()).time == pytest.approx(1 + number / 30, abs=1e-4)  # the photo's


def test_recordings_in_a_folder_are_found_among_other_videos(tmp_path):
    write(tmp_path / "b.mkv", 2)
    write(tmp_path / "a.mkv", 1)
    (tmp_path / "holiday.mkv").write_bytes(b"\x1a\x45\xdf\xa3 not one of a Kinect")
    found = find_pairs_of_folder(tmp_path)
    assert [pair.name for pair in found.pairs] == ["a/000000", "b/000000", "b/000001"]


@pytest.mark.parametrize(
    ("size", "size_lr", "expected"),
    [
        ((720, 1280), (576, 640), Camera(1280, 720, 614.4, 614.4, 652.3, 349.9)),
        ((3072, 4096), (1024, 1024), Camera(4096, 3072, 1966.08, 1966.08, 2088.46, 1504.78)),
    ],
)
def test_cameras_of_other_modes_are_parts_of_the_same_image(tmp_path, size, size_lr, expected):
    dark = np.zeros((*size, 3), np.uint8)
    (pair,) = find_pairs_of_folder(captures.kinect(tmp_path / "scan.mkv", [dark], [np.ones(size_lr, "u2")])).pairs
    geometry = pair.capture.geometry_of(size)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(geometry.camera, name) == pytest.approx(getattr(expected, name))
    left, top = {(576, 640): (192, 180), (1024, 1024): (0, 0)}[size_lr]
    cx, cy, fx, fy = captures.KINECT_IR
    own = geometry.rig.camera
    np.testing.assert_allclose([own.fx, own.fy, own.cx, own.cy],
                               [1024 * fx, 1024 * fy, 1024 * cx - left - 0.5, 1024 * cy - top - 0.5])  # fmt: skip
    np.testing.assert_allclose(geometry.rig.transform, captures.kinect_motion(), atol=1e-9)


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
    matrix, (cx, cy, fx, fy) = matrix_of_colour(), captures.KINECT_IR
    given = CameraChoice(intrinsics=(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    with pytest.raises(ValueError, match=r"scan\.mkv: calibration\.json: "):
        read_picture(pair, Reading(camera=given))
    camera = {"width": 320, "height": 288, "fx": 512 * fx, "fy": 512 * fy, "cx": 512 * cx - 96.5, "cy": 512 * cy - 90.5}
    (tmp_path / "depth.json").write_text(json.dumps(camera))
    np.savetxt(tmp_path / "motion.txt", captures.kinect_motion())
    rig = RigFiles(camera=tmp_path / "depth.json", extrinsics=tmp_path / "motion.txt")
    picture = read_picture(pair, Reading(camera=given, rig=rig))
    assert "cameras-damaged" in [fact.code for fact in picture.assumptions]
    middle = np.nanmedian(picture.depth_lr[0, 100:140, 120:160])
    assert middle == pytest.approx(DISTANCE, rel=0.1)


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
    np.testing.assert_array_equal(found.pairs[0].capture.depth.read(), plane())
