"""ARKitScenes; https://github.com/apple/ARKitScenes, DATA.md and raw/README.md.

    41069021/lowres_wide/41069021_305.244.png                photo; ``wide`` (1920 x 1440) is taken where it is there
    41069021/lowres_depth/41069021_305.244.png               16-bit millimetres, 256 x 192
    41069021/confidence/41069021_305.244.png                 0 (low) to 2 (high)
    41069021/lowres_wide_intrinsics/41069021_305.244.pincam  width height fx fy cx cy
    41069021/lowres_wide.traj                                time, rotation (axis times angle), translation

Rotation and translation of the trajectory lead from the world to the camera, whose axes are x right, y down, z forward
(threedod/benchmark_scripts/utils/tenFpsDataLoader.py inverts them). The trajectory has ten poses a second; a frame
takes that within 10 ms of it. Intrinsics may be a millisecond off.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dsr.data.formats.shared import read_numbers
from dsr.io.captures.poses import check_pose, describe_capture, intrinsics_camera, read_text
from dsr.io.confidence import HIGHEST_LEVEL, ConfidenceMap
from dsr.io.encoding import Assumption
from dsr.io.frames import CaptureFrame, Geometry
from dsr.io.pairs import Pair, PairingResult
from dsr.utils.limits import read_limited
from dsr.utils.paths import natural_key

_APP = "ARKitScenes"
_LARGEST = 1 << 16
"""Largest file of a camera in bytes."""
_PHOTOS = ("wide", "color", "lowres_wide")
_MAX_GAP = 0.010
"""Largest time in seconds between a frame and its pose."""
_SHIFTS = (0.0, -1e-3, 1e-3)
_Motion = tuple[float, ...]


def find_arkitscenes(folder: Path) -> PairingResult | None:
    """Return the frames of a video of ARKitScenes; None if the folder is none."""
    depths = {path.stem: path for path in (folder / "lowres_depth").glob("*.png")}
    kind = next((kind for kind in _PHOTOS if any((folder / kind).glob("*.png"))), None)
    if not depths or kind is None:
        return None
    photos = {path.stem: path for path in sorted((folder / kind).glob("*.png"), key=natural_key)}
    motions = _read_trajectory(folder / "lowres_wide.traj")
    pairs = []
    for stem in [stem for stem in photos if stem in depths]:
        intrinsics, motion = _intrinsics(folder / f"{kind}_intrinsics", stem), _nearest(motions, stem)
        place = f"{folder / 'lowres_wide.traj'}: frame {stem}"
        geometry = functools.partial(_geometry, place, intrinsics, motion)
        told = (b"" if intrinsics is None else read_limited(intrinsics, _LARGEST)) + repr(motion).encode()
        frame = CaptureFrame(_APP, geometry, intrinsics or folder / "lowres_wide.traj", told)
        path = folder / "confidence" / f"{stem}.png"
        known = ConfidenceMap(path, HIGHEST_LEVEL) if path.is_file() else None
        pairs.append(Pair(stem, photos[stem], depths[stem], unit=1e-3, capture=frame, confidence=known))
    text = f"a video of {_APP}, photos of {kind}"
    note = describe_capture(text, "millimetres", pairs, poses=bool(motions))
    lone = [each[stem] for each in (photos, depths) for stem in each if not (stem in photos and stem in depths)]
    return PairingResult(tuple(pairs), (note,), tuple(lone))


def _read_trajectory(path: Path) -> dict[float, _Motion]:
    """Return rotation and translation by time; empty without the file."""
    motions: dict[float, _Motion] = {}
    for number, line in enumerate(read_text(path).splitlines() if path.is_file() else (), 1):
        try:
            time, *motion = map(float, line.split())
            if len(motion) != 6 or not math.isfinite(time):
                raise ValueError
        except ValueError as error:
            raise ValueError(f"{path}: line {number}: expected 7 numbers, got {line!r:.80}") from error
        motions[time] = tuple(motion)
    return motions


def _time(stem: str) -> float:
    """Return the time in a frame's name, NaN if there is none."""
    try:
        return float(stem.rpartition("_")[2])
    except ValueError:
        return float("nan")


def _nearest(motions: dict[float, _Motion], stem: str) -> _Motion | None:
    """Return the motion nearest in time to a frame."""
    times = np.fromiter(motions, np.float64, len(motions))
    gaps = np.abs(times - _time(stem))
    if not len(gaps) or not (gaps <= _MAX_GAP).any():
        return None
    return motions[float(times[int(gaps.argmin())])]


def _intrinsics(folder: Path, stem: str) -> Path | None:
    """Return the file of a frame's intrinsics."""
    video = stem.rpartition("_")[0]
    names = [f"{stem}.pincam", *(f"{video}_{_time(stem) + shift:.3f}.pincam" for shift in _SHIFTS)]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _geometry(place: str, intrinsics: Path | None, motion: _Motion | None, _: tuple[int, int]) -> Geometry:
    """Return camera and pose of a frame."""
    camera, pose, notes = None, None, []
    if intrinsics is not None:
        width, height, *numbers = read_numbers(intrinsics, 6).tolist()
        if not (width >= 1 and height >= 1 and float(width).is_integer() and float(height).is_integer()):
            raise ValueError(f"{intrinsics}: expected a width and a height in pixels, got {width:g} and {height:g}")
        camera = intrinsics_camera(str(intrinsics), (int(height), int(width)), numbers)
    if motion is None:
        notes.append(Assumption("no pose: lowres_wide.traj has none within 10 ms of the frame"))
    elif not np.isfinite(motion).all():
        raise ValueError(f"{place}: expected a rigid pose, got {' '.join(f'{value:g}' for value in motion)}")
    else:
        to_camera = np.eye(4)
        to_camera[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
        to_camera[:3, 3] = motion[3:]
        pose = check_pose(place, np.linalg.inv(to_camera))
    return Geometry(camera, pose, tuple(notes))
