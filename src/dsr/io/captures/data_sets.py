"""Pictures with cameras and poses in text beside them: 7-Scenes, SUN RGB-D, Replica as renderings, and ZED's exports.

7-Scenes (microsoft.com, RGB-D Dataset 7-Scenes); 3DMatch has the same names, and a camera. The cameras of 7-Scenes,
Kinects v1, are not calibrated; its page names 585 pixels and the centre 320, 240. SUN RGB-D turns millimetres to the
left by three bits (``read3dPoints.m`` of its toolbox); ``depth_bfx/`` has the same, filled.

Replica as NICE-SLAM renders it; https://github.com/cvg/nice-slam, src/utils/datasets.py and configs/Replica. Line n of
``traj.txt`` is the pose of the n-th photo if there are as many lines as photos, else of the photo numbered n from 0.

ZED SDK's sample *SVO Export*; https://github.com/stereolabs/zed-sdk, recording/export/svo (mode LEFT + DEPTH_16Bit),
and https://github.com/stereolabs/zed-open-capture, examples/include/calibration.hpp. ``SN*.conf`` has both cameras
before they are rectified, for each resolution; Baseline, TY and TZ in mm, the latter for each resolution, for all, or
not at all, which is 0; RX, CV and RZ, a rotation vector. OpenCV's ``stereoRectify`` makes the rectified camera of them;
the SDK, which may calibrate anew when it opens a camera, has another one within about a percent.
"""

import configparser
import contextlib
import functools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from dsr.geometry.camera import Camera
from dsr.io.cameras import read_camera
from dsr.io.captures.contract import has_name
from dsr.io.captures.scannet import with_pose
from dsr.io.frames import CaptureFrame, Geometry, Size
from dsr.io.pairs import (
    PHOTO_SUFFIXES,
    Pair,
    PairingResult,
    find_camera_file,
    list_pictures,
    match_pairs,
    numbered_files,
    paired,
    picture_names,
)
from dsr.io.photos import same_aspect
from dsr.io.reading import SUNRGBD_BITS
from dsr.io.trajectories import NO_POSE, describe_capture, intrinsics_camera, read_poses
from dsr.io.units import TURNED_BACK
from dsr.notes import Assumption
from dsr.utils.guards import MOST_TEXT, named_numbers, natural_key, read_limited, read_text, refusing

_KINECT = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
_NICE_SLAM, _REPLICA_UNIT = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5), 1 / 6553.5
_PARAMS = ("cam_params.json", "camera.json")
_ZED_SIZES = {
    (1242, 2208): "2K", (1200, 1920): "FHD1200", (1080, 1920): "FHD", (720, 1280): "HD", (600, 960): "SVGA",
    (376, 672): "VGA",
}  # fmt: skip
_ZED_CAMERA = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def find_seven_scenes(folder: Path) -> PairingResult | None:
    """Return the frames of a sequence of 7-Scenes or 3DMatch."""
    if not has_name(folder, "", ".pose.txt"):
        return None
    photos, depths = (
        {path.name.removesuffix(end): path for end in ends for path in folder.glob(f"*{end}")}
        for ends in ((".color.jpg", ".color.png"), (".depth.png",))
    )
    both, unpaired = paired({name: photos[name] for name in sorted(photos, key=natural_key)}, depths)
    if not both:
        return None
    camera = find_camera_file(folder, folder.parent)
    pairs = []
    for name in both:
        path = folder / f"{name}.pose.txt"
        content = read_limited(path, MOST_TEXT) if path.is_file() else b""
        frame = CaptureFrame("7-Scenes", functools.partial(_seven_scenes, path, camera), path, content)
        pairs.append(Pair(name, photos[name], depths[name], camera, unit=1e-3, capture=frame))
    text = "a sequence of 7-Scenes or 3DMatch: depth in millimetres; from the folder: poses"
    return PairingResult(tuple(pairs), (Assumption(text),), unpaired)


def _seven_scenes(path: Path, camera: Path | None, size: Size) -> Geometry:
    if camera is not None or not same_aspect(size, (_KINECT.height, _KINECT.width)):
        return with_pose(None, path)
    text = "camera: 585 pixels and the centre 320, 240 assumed, which 7-Scenes names; its Kinects are not calibrated"
    return with_pose(_KINECT, path, (Assumption(f"{text} (--intrinsics)"),))


def find_sunrgbd(folder: Path) -> PairingResult | None:
    """Return the pair of a scene of SUN RGB-D."""
    matrix, kinds = folder / "intrinsics.txt", [folder / kind for kind in ("depth", "depth_bfx")]
    kinds = [path for path in kinds if path.is_dir() and any(picture_names(path))]
    ours = matrix.is_file() and any((folder / name).is_dir() for name in ("depth_bfx", "extrinsics"))
    if not ours or not kinds or not (folder / "image").is_dir():
        return None
    found = match_pairs(list_pictures(folder / "image"), list_pictures(kinds[0]), matrix)
    pairs = tuple(replace(pair, unit=1e-3, bits=SUNRGBD_BITS) for pair in found.pairs)
    text = f"a scene of SUN RGB-D, depth of {kinds[0].name}/: {TURNED_BACK}; --depth-unit overrides it"
    return PairingResult(pairs, (Assumption(text),), found.unpaired) if pairs else None


def find_replica(folder: Path) -> PairingResult | None:
    """Return the frames of a scene of Replica as NICE-SLAM renders it."""
    photos = numbered_files(folder / "results", PHOTO_SUFFIXES, "frame")
    depths = numbered_files(folder / "results", (".png",), "depth")
    both, unpaired = paired(photos, depths)
    trajectory, places = folder / "traj.txt", [place / name for place in (folder, folder.parent) for name in _PARAMS]
    params = next((path for path in places if path.is_file()), None)
    if not both or not (params or trajectory.is_file()):
        return None
    unit = None
    if params is not None:
        with contextlib.suppress(ValueError):  # which is reported where its camera is needed
            unit = read_camera(params).depth_unit
    poses = read_poses(trajectory).poses if trajectory.is_file() else ()
    in_order = len(poses) == len(photos)
    pairs = []
    for rank, number in enumerate(photos):
        if number not in depths:
            continue
        place = rank if in_order else number
        pose = poses[place] if place < len(poses) else None
        known = Geometry(None, pose, (NO_POSE,) if pose is None else ())
        content = repr(None if pose is None else pose.tolist()).encode()
        frame = CaptureFrame("Replica", known if params else functools.partial(_replica, known), trajectory, content)
        files = photos[number], depths[number]
        pairs.append(Pair(photos[number].stem, *files, params, unit=unit or _REPLICA_UNIT, capture=frame))
    text = "a scene of Replica as NICE-SLAM renders it" + ("" if params else ": depth in 1/6553.5 m (--depth-unit)")
    note = Assumption(text + ("; from the folder: poses" if poses else ""))
    return PairingResult(tuple(pairs), (note,), unpaired)


def _replica(found: Geometry, size: Size) -> Geometry:
    if not same_aspect(size, (_NICE_SLAM.height, _NICE_SLAM.width)):
        return found
    text = "camera: 600 pixels assumed, that of NICE-SLAM's renderings; there is no cam_params.json"
    return found._replace(camera=_NICE_SLAM, assumptions=(Assumption(text), *found.assumptions))


def find_zed(folder: Path) -> PairingResult | None:
    """Return the frames of a folder of exported pictures with a calibration."""
    calibrations = sorted(path for path in folder.glob("SN*.conf") if path.is_file())
    photos, depths = (numbered_files(folder, (".png",), kind) for kind in ("left", "depth"))
    both, unpaired = paired(photos, depths)
    if not calibrations or not both:
        return None
    if len(calibrations) > 1:
        raise ValueError(f"{folder}: expected one calibration of ZED, got {', '.join(p.name for p in calibrations)}")
    path, text = calibrations[0], read_text(calibrations[0])
    frame = CaptureFrame("ZED", functools.partial(_zed, path, text), path, text.encode())
    pairs = tuple(
        Pair(photos[number].stem.removeprefix("left"), photos[number], depths[number], unit=1e-3, capture=frame)
        for number in both
    )
    note = describe_capture("pictures of ZED", "millimetres", pairs, poses=False)
    return PairingResult(pairs, (note,), unpaired)


def _zed(path: Path, text: str, size: Size) -> Geometry:
    if size not in _ZED_SIZES:
        sizes = ", ".join(f"{width} x {height}" for height, width in _ZED_SIZES)
        return Geometry(None, None, (Assumption(f"{path.name} is not used: it is of photos of {sizes}"),))
    resolution = _ZED_SIZES[size]
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    with refusing(f"{path}: expected the calibration of ZED, got a damaged or foreign file", configparser.Error):
        parser.read_string(text)
    if parser.has_section("STEREO"):
        for name in ("TY", "TZ"):
            parser["STEREO"].setdefault(f"{name}_{resolution}", parser.get("STEREO", name, fallback="0"))
    stereo = "Baseline", *(f"{name}_{resolution}" for name in ("TY", "TZ", "RX", "CV", "RZ"))
    names = {f"LEFT_CAM_{resolution}": _ZED_CAMERA, f"RIGHT_CAM_{resolution}": _ZED_CAMERA, "STEREO": stereo}
    stored = dict(parser)
    numbers = [named_numbers(f"{path}: {each}", stored.get(each, {}), keys) for each, keys in names.items()]
    if not np.isfinite(np.concatenate(numbers)).all():
        raise ValueError(f"{path}: expected finite numbers, got {numbers!s:.200}")
    left, right, between = (np.array(each) for each in numbers)
    matrices = [np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) for fx, fy, cx, cy, *_ in (left, right)]
    with refusing(f"{path}: expected the calibration of two cameras side by side, got another", cv2.error):
        rectified = cv2.stereoRectify(
            matrices[0], left[4:], matrices[1], right[4:], size[::-1], cv2.Rodrigues(between[3:])[0],
            between[:3].reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
        )[2]  # fmt: skip
    camera = intrinsics_camera(str(path), size, [float(rectified[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))])
    return Geometry(camera, None, (Assumption("camera: that of the factory calibration, which the SDK refines"),))
