"""Data sets of depth cameras in their own folders: 7-Scenes, ScanNet's exports, SUN RGB-D, and Replica as renderings.

7-Scenes, as its page describes it (microsoft.com, RGB-D Dataset 7-Scenes); 3DMatch has the same names, and a camera.

    frame-000000.color.png, frame-000000.depth.png    640 x 480; 16-bit millimetres, 65535 in holes; photos as JPEG in
                                                      copies, as of https://github.com/andyzeng/tsdf-fusion-python
    frame-000000.pose.txt                             4 x 4, from camera to world; with commas in vReLoc
                                                      (https://github.com/loveoxford/vReLoc)
    camera-intrinsics.txt                             3DMatch: 3 x 3, here or one folder up

The cameras of 7-Scenes, Kinects v1, are not calibrated; its page names 585 pixels and the centre 320, 240.

ScanNet's exports; https://github.com/ScanNet/ScanNet, SensReader/python/SensorData.py.

    color/0.jpg, depth/0.png                          1296 x 968, often made smaller; 16-bit millimetres, registered
    pose/0.txt                                        4 x 4, from camera to world; -inf where the frame has none
    intrinsic/intrinsic_color.txt, intrinsic_depth.txt    4 x 4

SUN RGB-D; ``read3dPoints.m`` of its toolbox.

    image/0000144.jpg, depth/0000144.png              16-bit millimetres, turned to the left by three bits
    depth_bfx/0000144.png                             the same, filled; taken where depth/ has none
    intrinsics.txt, extrinsics/*.txt                  3 x 3; the tilt, which is no pose and not read

Replica as NICE-SLAM renders it; https://github.com/cvg/nice-slam, src/utils/datasets.py and configs/Replica.

    results/frame000000.jpg, results/depth000000.png  1200 x 680; 1/6553.5 m
    traj.txt                                          a pose of 4 x 4, from camera to world, in each line
    cam_params.json                                   here or one folder up: camera with w, h, fx, fy, cx, cy, scale

Line n is the pose of the n-th photo if there are as many lines as photos, else of the photo with the number n from 0.
Cameras have the axes x right, y down, z forward in all of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from dsr.geometry.camera import Camera
from dsr.geometry.poses import as_rigid
from dsr.io.cameras import read_camera
from dsr.io.captures.contract import has_name
from dsr.io.frames import CaptureFrame, Geometry, Size
from dsr.io.images import read_numbers
from dsr.io.pairs import (
    PHOTO_SUFFIXES,
    Pair,
    PairingResult,
    find_camera_file,
    has_pictures,
    list_pictures,
    match_pairs,
    numbered_files,
    paired,
)
from dsr.io.photos import same_aspect
from dsr.io.reading import SUNRGBD_BITS
from dsr.io.trajectories import NO_POSE, describe_capture, fitting_camera, read_poses
from dsr.io.units import TURNED_BACK
from dsr.notes import Assumption
from dsr.utils.guards import natural_key, read_limited

_LARGEST_TEXT = 1 << 16  # bytes of a file of a matrix
_KINECT = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
_NICE_SLAM, _REPLICA_UNIT = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5), 1 / 6553.5
_SCANNET_SIZE = (968, 1296)
_PARAMS = ("cam_params.json", "camera.json")
# Returns the camera of a photo of (height, width), and what was assumed for it.
_CameraOf = Callable[[Size], tuple[Camera | None, str]]


def find_seven_scenes(folder: Path) -> PairingResult | None:
    """Return the frames of a sequence of 7-Scenes or 3DMatch."""
    if not has_name(folder, "", ".pose.txt"):
        return None
    poses, photos, depths = (
        {path.name.removesuffix(end): path for end in ends for path in folder.glob(f"*{end}")}
        for ends in ((".pose.txt",), (".color.jpg", ".color.png"), (".depth.png",))
    )
    both, unpaired = paired({name: photos[name] for name in sorted(photos, key=natural_key)}, depths)
    if not both:
        return None
    camera = find_camera_file(folder, folder.parent)
    pairs = []
    for name in both:
        frame = _frame("7-Scenes", poses.get(name), folder / f"{name}.pose.txt", None if camera else _kinect)
        pairs.append(Pair(name, photos[name], depths[name], camera, unit=1e-3, capture=frame))
    text = "a sequence of 7-Scenes or 3DMatch: depth in millimetres; from the folder: poses"
    return PairingResult(tuple(pairs), (Assumption(text),), unpaired)


def find_scannet(folder: Path) -> PairingResult | None:
    """Return the frames of a folder of ScanNet's exports."""
    matrices = [folder / "intrinsic" / f"intrinsic_{kind}.txt" for kind in ("color", "depth")]
    matrices = [path for path in matrices if path.is_file()]
    photos, depths = numbered_files(folder / "color", PHOTO_SUFFIXES), numbered_files(folder / "depth", (".png",))
    both, unpaired = paired(photos, depths)
    if not matrices or not both:
        return None
    camera = functools.partial(_scannet_camera, matrices)
    described = b"".join(read_limited(path, _LARGEST_TEXT) for path in matrices)
    pairs = []
    for number in both:
        path = folder / "pose" / f"{photos[number].stem}.txt"
        frame = _frame("ScanNet", path if path.is_file() else None, path, camera, described)
        pairs.append(Pair(photos[number].stem, photos[number], depths[number], unit=1e-3, capture=frame))
    note = describe_capture("an export of ScanNet", "millimetres", pairs, poses=(folder / "pose").is_dir())
    return PairingResult(tuple(pairs), (note,), unpaired)


def find_sunrgbd(folder: Path) -> PairingResult | None:
    """Return the pair of a scene of SUN RGB-D."""
    matrix, kinds = folder / "intrinsics.txt", [folder / kind for kind in ("depth", "depth_bfx")]
    kinds = [path for path in kinds if path.is_dir() and has_pictures(path)]
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
    unit = (None if params is None else _unit(params)) or _REPLICA_UNIT  # also where the camera is given by other means
    poses = read_poses(trajectory).poses if trajectory.is_file() else ()
    in_order = len(poses) == len(photos)
    ranks = {number: rank if in_order else number for rank, number in enumerate(photos)}
    pairs = []
    for number in both:
        pose = poses[ranks[number]] if ranks[number] < len(poses) else None
        known = Geometry(None, pose, (NO_POSE,) if pose is None else ())
        described = repr(None if pose is None else pose.tolist()).encode()
        frame = CaptureFrame("Replica", known if params else functools.partial(_replica, known), trajectory, described)
        pairs.append(Pair(photos[number].stem, photos[number], depths[number], params, unit=unit, capture=frame))
    text = "a scene of Replica as NICE-SLAM renders it" + ("" if params else ": depth in 1/6553.5 m (--depth-unit)")
    note = Assumption(text + ("; from the folder: poses" if poses else ""))
    return PairingResult(tuple(pairs), (note,), unpaired)


def _frame(
    app: str, path: Path | None, expected: Path, camera: _CameraOf | None, described: bytes = b""
) -> CaptureFrame:
    """Return a frame with the pose from a file and the function that gives its camera, if there are any."""
    content = b"" if path is None else read_limited(path, _LARGEST_TEXT)
    return CaptureFrame(app, functools.partial(_geometry, path, camera), expected, described + content)


def _geometry(path: Path | None, camera: _CameraOf | None, size: Size) -> Geometry:
    """Return camera and pose of a frame."""
    found, text = (None, "") if camera is None else camera(size)
    notes = (Assumption(text),) if text else ()
    matrix = np.full((4, 4), np.nan) if path is None else read_numbers(path, 16).reshape(4, 4)
    if not np.isfinite(matrix).all():
        return Geometry(found, None, (*notes, NO_POSE))
    return Geometry(found, as_rigid(matrix, str(path)), notes)


def _kinect(size: Size) -> tuple[Camera | None, str]:
    """Return the camera that 7-Scenes names, for photos of its aspect."""
    if not same_aspect(size, (_KINECT.height, _KINECT.width)):
        return None, ""
    text = "camera: 585 pixels and the centre 320, 240 assumed, which 7-Scenes names; its Kinects are not calibrated"
    return _KINECT, f"{text} (--intrinsics)"


def _scannet_camera(paths: list[Path], size: Size) -> tuple[Camera, str]:
    """Return the camera of the first matrix that fits the photo, else of ScanNet's photos as they are recorded."""
    numbers = {}
    for path in paths:
        matrix = read_numbers(path, 16).reshape(4, 4)
        numbers[path] = [float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))]
    for path, each in numbers.items():
        try:
            return fitting_camera(str(path), (size,), each), ""
        except ValueError:  # it is of other pixels
            continue
    return fitting_camera(str(paths[0]), (size, _SCANNET_SIZE), numbers[paths[0]]), ""


def _unit(params: Path) -> float | None:
    """Return metres per value by a camera file; None if it does not say."""
    try:
        return read_camera(params).depth_unit
    except ValueError:  # is said where its camera is needed
        return None


def _replica(found: Geometry, size: Size) -> Geometry:
    """Return pose and camera of a rendering of which no file says the camera."""
    if not same_aspect(size, (_NICE_SLAM.height, _NICE_SLAM.width)):
        return found
    text = "camera: 600 pixels assumed, that of NICE-SLAM's renderings; there is no cam_params.json"
    return found._replace(camera=_NICE_SLAM, assumptions=(Assumption(text), *found.assumptions))
