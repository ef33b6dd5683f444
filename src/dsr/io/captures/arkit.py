"""Captures of ARKit's lidar: videos of ARKitScenes, and exports of Polycam and 3D Scanner App.

ARKitScenes; https://github.com/apple/ARKitScenes, DATA.md and raw/README.md. ``*.pincam`` has width, height, fx, fy,
cx, cy, of a time that may be a millisecond off; ``lowres_wide.traj`` ten times a second a time, rotation (axis times
angle) and translation from the world to the camera, whose axes are x right, y down, z forward
(threedod/benchmark_scripts/utils/tenFpsDataLoader.py inverts them). The world is that of a laser scan, z up
(https://github.com/apple/ARKitScenes/issues/81).

Polycam's raw export; https://github.com/PolyCam/polyform. t_ij are the rows of the pose from ARKit's camera (y up,
looking along -z) to the world, y up; the corrected photos and cameras are taken where a frame has both. 3D Scanner
App's samples, https://github.com/laanlabs/3dScannerApp_samples, have intrinsics and ARKit's pose row by row.
"""

import functools
import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, create_model

from dsr.io.captures.contract import has_name
from dsr.io.frames import HIGHEST_LEVEL, CaptureFrame, ConfidenceMap, Geometry, Size, stated
from dsr.io.images import Pixels, read_numbers
from dsr.io.pairs import Pair, PairingResult, numbered_files, paired
from dsr.io.trajectories import (
    USUAL_SIZE,
    check_pose,
    describe_capture,
    fitting_camera,
    intrinsics_camera,
)
from dsr.notes import Assumption
from dsr.utils.guards import natural_key, numbers_in, read_limited, read_text
from dsr.utils.validation import parse_model

_ARKITSCENES, _POLYCAM, _SCANNER = "ARKitScenes", "Polycam", "3D Scanner App"
_LARGEST_PINCAM, _LARGEST_JSON = 1 << 16, 1 << 20  # bytes of a file of a camera
_MAX_GAP = 0.010  # seconds between a frame and its pose
_Motion = tuple[float, ...]


def find_arkitscenes(folder: Path) -> PairingResult | None:
    """Return the frames of a video of ARKitScenes."""
    depths = {path.stem: path for path in (folder / "lowres_depth").glob("*.png")}
    kinds = ("wide", "color", "lowres_wide")
    kind = next((kind for kind in kinds if any((folder / kind).glob("*.png"))), None)
    if not depths or kind is None:
        return None
    photos = {path.stem: path for path in sorted((folder / kind).glob("*.png"), key=natural_key)}
    trajectory = folder / "lowres_wide.traj"
    motions: dict[float, _Motion] = {}  # rotation and translation by time
    for number, line in enumerate(read_text(trajectory).splitlines() if trajectory.is_file() else (), 1):
        values = numbers_in(line.split())
        if len(values) != 7 or not math.isfinite(values[0]):
            raise ValueError(f"{trajectory}: line {number}: expected 7 numbers, got {line!r:.80}")
        motions[values[0]] = tuple(values[1:])
    times = np.array([*motions])
    both, unpaired = paired(photos, depths)
    pairs = []
    for stem in both:
        intrinsics, time = find_intrinsics(folder / f"{kind}_intrinsics", stem), _time(stem)
        gaps = np.abs(times - time)
        motion = motions[float(times[gaps.argmin()])] if (gaps <= _MAX_GAP).any() else None
        described = (b"" if intrinsics is None else read_limited(intrinsics, _LARGEST_PINCAM)) + repr(motion).encode()
        geometry = stated(_arkitscenes_geometry, f"{trajectory}: frame {stem}", intrinsics, motion)
        frame = CaptureFrame(_ARKITSCENES, geometry, intrinsics or trajectory, described)
        path = folder / "confidence" / f"{stem}.png"
        known = ConfidenceMap(path, HIGHEST_LEVEL) if path.is_file() else None
        pair = Pair(stem, photos[stem], depths[stem], unit=1e-3, capture=frame, confidence=known)
        pairs.append(replace(pair, time=time) if math.isfinite(time) else pair)
    text = f"a video of {_ARKITSCENES}, photos of {kind}"
    note = describe_capture(text, "millimetres", pairs, poses=bool(motions))
    return PairingResult(tuple(pairs), (note,), unpaired)


def _time(stem: str) -> float:
    return next(iter(numbers_in([stem.rpartition("_")[2]])), math.nan)


def find_intrinsics(folder: Path, stem: str) -> Path | None:
    """Return the file of a frame's intrinsics, whose time may differ by a millisecond; None where there is none."""
    video = stem.rpartition("_")[0]
    names = [f"{stem}.pincam", *(f"{video}_{_time(stem) + shift:.3f}.pincam" for shift in (0.0, -1e-3, 1e-3))]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _arkitscenes_geometry(place: str, intrinsics: Path | None, motion: _Motion | None) -> Geometry:
    camera = None
    if intrinsics is not None:
        width, height, *numbers = read_numbers(intrinsics, 6).tolist()
        if not (width >= 1 and height >= 1 and float(width).is_integer() and float(height).is_integer()):
            raise ValueError(f"{intrinsics}: expected a width and a height in pixels, got {width:g} and {height:g}")
        camera = intrinsics_camera(str(intrinsics), (int(height), int(width)), numbers)
    if motion is None:
        note = Assumption("no pose: lowres_wide.traj has none within 10 ms of the frame")
        return Geometry(camera, None, (note,), up="z")
    if not np.isfinite(motion).all():
        raise ValueError(f"{place}: expected a rigid pose, got {' '.join(f'{value:g}' for value in motion)}")
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a third of a second that frames without poses save

    to_camera = np.eye(4)
    to_camera[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    to_camera[:3, 3] = motion[3:]
    return Geometry(camera, check_pose(place, np.linalg.inv(to_camera)), up="z")


_INTRINSICS = ("fx", "fy", "cx", "cy")
_POSE = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]  # names of the numbers of a pose
_ENTRIES: dict[str, Any] = dict.fromkeys((*_INTRINSICS, *itertools.chain(*_POSE)), (float, ...))  # which may be NaN
_ENTRIES |= dict.fromkeys(("width", "height"), (Pixels, ...))
_PolycamCamera = create_model("_PolycamCamera", __config__=ConfigDict(strict=True), **_ENTRIES)


def find_polycam(folder: Path) -> PairingResult | None:
    """Return the frames of a raw export, or of its folder ``keyframes``."""
    frames = folder / "keyframes" if (folder / "keyframes").is_dir() else folder
    kinds = [
        (frames / f"{kind}images", frames / f"{kind}cameras")
        for kind in ("corrected_", "")
        if (frames / f"{kind}images").is_dir() and any((frames / f"{kind}cameras").glob("*.json"))
    ]
    if not kinds or not (frames / "depth").is_dir():
        return None
    pairs, unpaired = [], []
    for depth in sorted((frames / "depth").glob("*.png"), key=natural_key):
        files = ((photos / f"{depth.stem}.jpg", cameras / f"{depth.stem}.json") for photos, cameras in kinds)
        photo, camera = next(((each, file) for each, file in files if each.is_file() and file.is_file()), (None, None))
        if photo is None or camera is None:
            unpaired.append(depth)
            continue
        geometry = stated(_polycam_geometry, camera)
        frame = CaptureFrame(_POLYCAM, geometry, camera, read_limited(camera, _LARGEST_JSON))
        confidence = frames / "confidence" / depth.name
        known = ConfidenceMap(confidence, 255) if confidence.is_file() else None
        pairs.append(Pair(depth.stem, photo, depth, unit=1e-3, capture=frame, confidence=known))
    notes = [describe_capture(f"a capture of {_POLYCAM}", "millimetres", pairs, poses=True)]
    corrected = sum(pair.rgb.parent.name == "corrected_images" for pair in pairs)
    if corrected:
        notes.append(Assumption("photos and cameras are the corrected ones", f"{corrected} of {len(pairs)}"))
    return PairingResult(tuple(pairs), tuple(notes), tuple(unpaired))


def _polycam_geometry(path: Path) -> Geometry:
    model = parse_model(_PolycamCamera, read_text(path, _LARGEST_JSON), path, f"expected {_POLYCAM}'s camera; ")
    stored = model.model_dump()
    numbers, *rows = ([stored[name] for name in names] for names in (_INTRINSICS, *_POSE))
    camera = intrinsics_camera(str(path), (stored["height"], stored["width"]), numbers)
    pose = check_pose(str(path), np.array([*rows, [0, 0, 0, 1]], dtype=np.float64), opengl=True)
    return Geometry(camera, pose, up="y")


class _ScannerFrame(BaseModel, strict=True):
    """A file of a frame of 3D Scanner App; numbers may be NaN here."""

    intrinsics: Annotated[list[float], Field(min_length=9, max_length=9)]
    pose: Annotated[list[float], Field(min_length=16, max_length=16)] = Field(alias="cameraPoseARFrame")


def find_scanner_app(folder: Path) -> PairingResult | None:
    """Return the frames of an export of all data of 3D Scanner App."""
    if not has_name(folder, "frame_", ".json"):
        return None
    frames, photos = (numbered_files(folder, (suffix,), "frame_") for suffix in (".json", ".jpg"))
    depths = numbered_files(folder, (".exr",), "frame_") | numbered_files(folder, (".png",), "depth_")
    if not photos or not depths or not frames:
        return None
    if b"cameraPoseARFrame" not in read_limited(next(iter(frames.values())), _LARGEST_JSON):
        return None
    confidences = numbered_files(folder, (".png",), "conf_")
    both, unpaired = paired(photos, depths)
    pairs = []
    for number in both:
        path = frames.get(number)
        content = b"" if path is None else read_limited(path, _LARGEST_JSON)
        geometry = functools.partial(_scanner_geometry, path)
        frame = CaptureFrame(_SCANNER, geometry, path or folder / f"frame_{number:05}.json", content)
        known = ConfidenceMap(confidences[number], HIGHEST_LEVEL) if number in confidences else None
        unit = 1e-3 if depths[number].suffix.lower() == ".png" else None
        name = photos[number].stem
        pairs.append(Pair(name, photos[number], depths[number], unit=unit, capture=frame, confidence=known))
    unit_text = "millimetres" if all(pair.unit for pair in pairs) else "floats"
    note = describe_capture(f"a capture of {_SCANNER}", unit_text, pairs, poses=True)
    return PairingResult(tuple(pairs), (note,), unpaired)


def _scanner_geometry(path: Path | None, size: Size) -> Geometry:
    if path is None:
        return Geometry(assumptions=(Assumption("no camera and no pose: there is no JSON of the frame"),))
    stored = parse_model(_ScannerFrame, read_text(path, _LARGEST_JSON), path, f"expected {_SCANNER}'s frame; ")
    fx, _, cx, _, fy, cy = stored.intrinsics[:6]
    camera = fitting_camera(str(path), (size, USUAL_SIZE), (fx, fy, cx, cy))
    pose = check_pose(str(path), np.reshape(stored.pose, (4, 4)), opengl=True)
    return Geometry(camera, pose, up="y")
