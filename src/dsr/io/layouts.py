"""Pairs of photo and depth map in folders of any layout: of recording apps, data sets, or one's own.

Which app made a capture, by what lies in its folder.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from dsr.geometry.poses import Matrix
from dsr.io.cameras import read_any_camera
from dsr.io.captures.archive import unpack
from dsr.io.captures.arkit import find_arkitscenes, find_polycam, find_scanner_app
from dsr.io.captures.colmap import add_model, find_colmap, model_file
from dsr.io.captures.data_sets import find_replica, find_scannet, find_seven_scenes, find_sunrgbd
from dsr.io.captures.heic import find_heic
from dsr.io.captures.kinect import find_kinect
from dsr.io.captures.nerfstudio import add_transforms
from dsr.io.captures.record3d import find_record3d
from dsr.io.captures.ros import find_ros
from dsr.io.captures.scannet import find_scannetpp, find_sens
from dsr.io.captures.stray import find_stray
from dsr.io.captures.zed import find_zed
from dsr.io.depth_files import DEPTH_SUFFIXES
from dsr.io.formats import FORMATS
from dsr.io.frames import CaptureFrame, Geometry
from dsr.io.images import read_pixels
from dsr.io.open3d import add_trajectory
from dsr.io.pairs import (
    Pair,
    PairingResult,
    find_camera_file,
    find_pairs_of_two_folders,
    has_name,
    has_pictures,
    is_registered,
    list_pictures,
    make_names_unique,
    match_pairs,
    match_times,
    role_of,
    role_of_words,
    words_of,
)
from dsr.io.photos import HEIC_SUFFIXES
from dsr.io.trajectories import read_poses
from dsr.notes import Assumption
from dsr.utils.guards import natural_key, numbers_in, path_within, read_text, split_numbers

_DEPTH_LR = re.compile(r"(depth|disparity)_lr(\d+)")
_TUM_UNIT = 1 / 5000
_CALIBRATIONS = {"poses", "calib", "calibration", "camera", "cameras", "intrinsic", "intrinsics", "fov", "transforms"}
_TEXTS = ("", ".json", ".txt", ".yaml", ".yml", ".xml", ".csv")
"""Words in the names of calibrations, and suffixes; "" for folders."""
_MAX_DEPTH = 3
"""Levels of subfolders that are searched."""

CAPTURE_FILES = (".r3d", ".bag", ".mcap", ".db3", ".mkv", ".sens", ".zip", *HEIC_SUFFIXES)
"""Suffixes of captures that are a single file."""
_FILES = (find_record3d, find_ros, find_kinect, find_heic, find_sens)
_LAYOUTS = (
    find_stray, find_polycam, find_arkitscenes, find_scanner_app, find_scannetpp, find_scannet, find_seven_scenes,
    find_sunrgbd, find_replica, find_zed, *_FILES,
)  # fmt: skip
"""A video of ScanNet++ is asked before those of a Kinect."""
_MOST_FILES = 100_000
"""Largest number of files that are counted."""
_KINDS = 6
"""Largest number of kinds of files that are named."""


class NoPairError(ValueError):
    """There is no pair in a place, and nothing there is damaged."""


def find_pairs_of_folder(folder: Path, leave: Path | None = None) -> PairingResult:
    """Return the pairs in a folder of any of these layouts, or in its subfolders.

    The layouts are: a capture (:mod:`dsr.io.captures`), which may be a single file, too; a scene of dsr (``rgb.png``,
    ``camera.json`` and ``depth*`` or ``disparity*``); lists of TUM RGB-D (``rgb.txt`` and ``depth.txt``,
    https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats); two folders named for photos and depth maps; and
    files side by side, distinguished by their names or contents; to these a model of COLMAP or a trajectory of
    Open3D may add poses. Of photos beside a model without depth maps, its points are the depth.

    Args:
        folder: folder to search, a capture's file, or a ZIP file of what a folder has, which is unpacked.
        leave: folder that is skipped, such as that of the results.

    Raises:
        NoPairError: there is no pair in it.
        ValueError: there is no such folder, or a capture in it is damaged.

    """
    given = folder
    if folder.suffix.lower() == ".zip" and folder.is_file():
        folder = unpack(folder)
        while len(inside := list(folder.iterdir())) == 1 and inside[0].is_dir():
            folder = inside[0]
    if folder.is_file():
        single = _find_at(folder)
        return replace(single, pairs=make_names_unique(single.pairs))
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of photos and depth maps, there is none")
    found = _search(folder, folder, None if leave is None else leave.resolve(), 0)
    if not found.pairs:
        unpaired = f"; {len(found.unpaired)} pictures have no partner" if found.unpaired else ""
        raise NoPairError(
            f"{given}: expected photos and depth maps that belong together, found no pair{unpaired}; "
            f"{describe_content(folder, _MAX_DEPTH)}"
        )
    return PairingResult(make_names_unique(found.pairs), found.assumptions, found.unpaired)


def _search(folder: Path, root: Path, leave: Path | None, depth: int) -> PairingResult:
    """Return the pairs in a folder or, if there are none, those in its subfolders."""
    found = _find_at(folder, root)
    if found.pairs:
        return found
    deeper = [
        (path, _search(path, root, leave, depth + 1))
        for path in sorted(folder.iterdir(), key=natural_key)
        if depth < _MAX_DEPTH and path.is_dir() and not path.name.startswith(".") and path.resolve() != leave
    ]
    pairs = [
        replace(pair, name=path.name if pair.name in ("rgb", path.name) else f"{path.name}/{pair.name}")
        for path, below in deeper
        for pair in below.pairs
    ]
    alike = _alike(folder) if pairs else ()
    assumptions = tuple(dict.fromkeys((*alike, *(fact for _, below in deeper for fact in below.assumptions))))
    unpaired = (*found.unpaired, *(path for _, below in deeper for path in below.unpaired))
    return PairingResult(tuple(pairs), assumptions, unpaired)


def _alike(folder: Path) -> tuple[Assumption, ...]:
    """Return notes on the captures that a folder looks like, and that its pairs were not read as."""
    return tuple(Assumption(f"{text}: read without its camera, unit and poses") for text in lacking(folder))


def _find_at(place: Path, root: Path | None = None) -> PairingResult:
    """Return the pairs of a capture or a folder, not of subfolders; camera files are searched up to a root."""
    capture = find_capture(place)
    if capture is not None and (capture.pairs or place.is_file()):
        return capture
    if place.is_file():
        raise NoPairError(f"{place}: expected a folder, or a capture as {', '.join(CAPTURE_FILES)}")
    found = PairingResult(())
    for layout in (_scene, _tum, _role_folders, _side_by_side):
        found = add_trajectory(place, layout(place))
        if found.pairs:
            camera = find_camera_file(place, root or place)
            if camera is not None and any(pair.camera is None for pair in found.pairs):
                pairs = tuple(replace(pair, camera=pair.camera or camera) for pair in found.pairs)
                found = replace(found, pairs=pairs)
            model = model_file(place)
            if model is not None and all(pair.capture is None for pair in found.pairs):
                found = add_model(found, model)
            elif camera is None:
                found = _add_calibration(place, found)
            return replace(found, assumptions=(*_alike(place), *found.assumptions))
    return add_transforms(place, PairingResult(())) or find_colmap(place) or found


def _add_calibration(folder: Path, found: PairingResult) -> PairingResult:
    """Return pairs with the cameras of nerfstudio, RTAB-Map, ETH3D or MoGe, and a note of files that are not read."""
    listed = add_transforms(folder, found)
    if listed is not None:
        return listed
    files, stems = {}, {pair.rgb.stem for pair in found.pairs}
    for pattern in ("calibration.txt", "fov.json", "*.yaml", "*calib*/*.yaml"):
        for path in folder.glob(pattern):
            role, of_photo = role_of_words(words_of(path.stem)), path.stem in stems
            if role == "rgb" or (role is None and (of_photo or _CALIBRATIONS & {*words_of(path.stem)})):
                with contextlib.suppress(ValueError, OSError):  # a file of something else
                    read_any_camera(path)
                    files[path.stem] = path
    only = next(iter(files.values())) if len(files) == 1 else None
    pairs = tuple(replace(pair, camera=files.get(pair.rgb.stem, only)) for pair in found.pairs)
    words = {"poses"} if any(pair.camera for pair in pairs) else _CALIBRATIONS
    used = {path.parent for pair in pairs for path in (pair.rgb, pair.depth)}
    others = sorted(path for path in folder.iterdir() if path.suffix in _TEXTS and path not in used)
    unread = [path.name for path in others if words & set(words_of(path.stem))]
    notes = [Assumption(f"not read: {', '.join(unread)} (--camera, --poses)")] if unread else []
    return replace(found, pairs=pairs, assumptions=(*found.assumptions, *notes))


def _scene(folder: Path) -> PairingResult:
    """Return the pair of a scene of dsr, with its low-resolution map of the smallest factor if it has one."""
    photo = next((folder / name for name in ("rgb.png", "rgb.jpg", "rgb.jpeg") if (folder / name).is_file()), None)
    if photo is None or not (folder / "camera.json").is_file():
        return PairingResult(())
    maps = sorted(path for path in folder.iterdir() if path.suffix.lower() in DEPTH_SUFFIXES)
    factors = {path: int(match[2]) for path in maps if (match := _DEPTH_LR.fullmatch(path.stem)) and int(match[2]) > 0}
    camera = folder / "camera.json"
    if factors:
        path = min(factors, key=factors.__getitem__)
        return PairingResult((Pair(folder.name, photo, path, camera, None, None, factors[path]),))
    maps_hr = [path for path in maps if path.stem in ("depth", "disparity")]
    mask = folder / "mask.png"
    pairs = [Pair(folder.name, photo, path, camera, mask if mask.is_file() else None) for path in maps_hr[:1]]
    return PairingResult(tuple(pairs))


def _tum(folder: Path) -> PairingResult:
    """Return the pairs of TUM's lists of times and files."""
    lists = folder / "rgb.txt", folder / "depth.txt"
    if not all(path.is_file() for path in lists):
        return PairingResult(())
    photos, depths = (_timed(path) for path in lists)
    partner = match_times(photos, depths)
    pairs = [
        Pair(path.stem, path, partner[path], unit=_TUM_UNIT, time=photos[path]) for path in photos if path in partner
    ]
    used = {*partner, *partner.values()}
    unpaired = [path for path in (*photos, *depths) if path not in used]
    text, truth = "rgb.txt and depth.txt of TUM RGB-D: depth in 1/5000 m (--depth-unit)", folder / "groundtruth.txt"
    if truth.is_file() and pairs:
        poses = _tum_poses(truth, [depths[pair.depth] for pair in pairs])
        text += f"; poses: {truth.name}, of {sum(pose is not None for pose in poses)} of {len(pairs)} frames"
        described = [b"" if pose is None else pose.tobytes() for pose in poses]
        frames = [CaptureFrame("TUM RGB-D", partial(_tum_geometry, pose), truth, each)
                  for pose, each in zip(poses, described, strict=True)]  # fmt: skip
        pairs = [replace(pair, capture=frame) for pair, frame in zip(pairs, frames, strict=True)]
    return PairingResult(tuple(pairs), (Assumption(text),), tuple(unpaired))


def _tum_poses(path: Path, times: list[float]) -> list[Matrix | None]:
    """Return the poses nearest in time to depth maps, None where there is none within 20 ms."""
    trajectory = read_poses(path)
    if trajectory.times is None:
        raise ValueError(f"{path}: expected lines of a time, a translation and a quaternion, got matrices")
    return trajectory.at(np.array(times))


def _tum_geometry(pose: Matrix | None, _: tuple[int, int]) -> Geometry:
    """Return the pose of a frame; TUM's lists have no camera."""
    notes = () if pose is not None else (Assumption("no pose: groundtruth.txt has none within 20 ms of the frame"),)
    return Geometry(None, pose, notes)


def _timed(path: Path) -> dict[Path, float]:
    """Return the files in a list of TUM RGB-D, with their times in seconds."""
    times: dict[Path, float] = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        time = numbers_in(split_numbers(words[0]))
        if len(time) != 1 or len(words) < 2:
            raise ValueError(f"{path}: line {number}: expected a time and a file name, got {line!r:.60}")
        times[path_within(path.parent, words[1], f"{path}: line {number}")] = time[0]
    return times


def _role_folders(folder: Path) -> PairingResult:
    """Return the pairs of two subfolders whose names say that they hold photos and depth maps."""
    named: dict[str, list[Path]] = {"rgb": [], "depth": [], "other": []}
    for path in sorted(folder.iterdir(), key=lambda path: (not is_registered(path.name), len(path.name), path.name)):
        role = role_of_words(words_of(path.name)) if path.is_dir() else None
        if role is not None and has_pictures(path):
            named[role].append(path)
    if not named["rgb"] or not named["depth"]:
        return PairingResult(())
    found = find_pairs_of_two_folders(named["rgb"][0], named["depth"][0], ())
    extra = [path.name for paths in (named["rgb"], named["depth"]) for path in paths[1:]]
    text = f"folders {named['rgb'][0].name} and {named['depth'][0].name}"
    assumption = Assumption(text + (f"; not read: {', '.join(extra)}" if extra else ""))
    return replace(found, assumptions=(assumption, *found.assumptions))


def _side_by_side(folder: Path) -> PairingResult:
    """Return the pairs among the files of a folder."""
    roles = {path: role_of(path) for path in list_pictures(folder)}
    photos = [path for path, role in roles.items() if role == "rgb"]
    if "depth" not in roles.values():  # then depth maps are recognised by their single channel of 16 bits or floats
        depths = [path for path in photos if path.suffix.lower() in DEPTH_SUFFIXES and _is_depth_map(path)]
        photos = [path for path in photos if path not in depths]
    else:
        depths = [path for path, role in roles.items() if role == "depth"]
    return match_pairs(photos, depths)


def _is_depth_map(path: Path) -> bool:
    """Return whether a picture has one channel of more than 8 bits."""
    try:
        pixels = read_pixels(path, cv2.IMREAD_UNCHANGED)
    except ValueError:
        return False
    return pixels.ndim == 2 and pixels.dtype != np.uint8


def find_capture(place: Path) -> PairingResult | None:
    """Return the frames of a capture, a folder or a file with one of :data:`CAPTURE_FILES`; None if it is none.

    Raises:
        ValueError: it is a capture, and a file that all of its frames need is missing or damaged.

    """
    layouts = _FILES if place.is_file() else _LAYOUTS
    return next((found for layout in layouts if (found := layout(place)) is not None), None)


def lacking(folder: Path) -> list[str]:
    """Return the layouts that a folder resembles, each with its missing files: ``like ScanNet, without depth/``."""
    return [
        f"like {each.name}, without {', '.join(missing)}"
        for each in FORMATS
        if _has(folder, each.marks)
        and (missing := [name for name, patterns in each.needs.items() if not _has(folder, patterns)])
    ]


def _has(folder: Path, patterns: tuple[str, ...]) -> bool:
    """Return whether a folder has a file or folder of one of several patterns."""
    for pattern in patterns:
        parent, name = folder / Path(pattern).parent, Path(pattern).name
        if (parent / name).exists() or ("*" in name and parent.is_dir() and has_name(parent, *name.split("*"))):
            return True
    return False


def describe_content(folder: Path, deep: int) -> str:
    """Describe a folder in one line: the numbers of its files by kind, and the layouts that it nearly matches.

    Args:
        folder: the folder.
        deep: levels of subfolders that are looked at.

    """
    kinds, near, count = Counter[str](), list[str](), 0
    for place, below, names in os.walk(folder):
        below[:] = sorted((name for name in below if not name.startswith(".")), key=natural_key)
        level = len(Path(place).relative_to(folder).parts)
        if level >= deep:
            below.clear()
        kinds.update(Path(name).suffix.lower() or "no suffix" for name in names if not name.startswith("."))
        near += [f"{text} in {Path(place).relative_to(folder)}" if level else text for text in lacking(Path(place))]
        count += len(names)
        if count > _MOST_FILES:
            break
    found = [f"{number} {kind}" for kind, number in kinds.most_common(_KINDS)]
    more = len(kinds) - len(found)
    text = f"the folder has {', '.join(found)}" + (f" and {more} more kinds" if more > 0 else "")
    near = list(dict.fromkeys(near))[:2]
    return (text if kinds else "the folder is empty") + "".join(f"; it looks {each}" for each in near)
