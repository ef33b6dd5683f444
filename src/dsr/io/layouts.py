"""Pairs of photo and depth map in folders of any layout: of recording apps, data sets, or one's own.

The layouts are: a capture (:mod:`dsr.io.captures`), which may be a single file, too; a scene of dsr
(``rgb.png``, ``camera.json`` and ``depth*`` or ``disparity*``); lists of TUM RGB-D (``rgb.txt`` and ``depth.txt``,
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats); two folders named for photos and depth maps; and files
side by side, distinguished by their names or contents. To these a model of COLMAP or a trajectory of Open3D may add
poses. Of photos beside a model without depth maps, its points are the depth.
"""

import contextlib
import os
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from dsr.io.cameras import read_any_camera
from dsr.io.captures import CAPTURE_FILES, find_capture, lacking
from dsr.io.captures.archive import unpack
from dsr.io.captures.colmap import add_model, add_transforms, find_colmap, model_file
from dsr.io.depth_files import DEPTH_SUFFIXES
from dsr.io.frames import CaptureFrame, Geometry, file_state
from dsr.io.images import read_pixels
from dsr.io.pairs import (
    Pair,
    PairingResult,
    find_camera_file,
    find_pairs_of_two_folders,
    is_registered,
    list_pictures,
    make_names_unique,
    match_pairs,
    match_times,
    picture_names,
    role_of,
    role_of_words,
    words_of,
)
from dsr.io.trajectories import add_trajectory, read_poses
from dsr.notes import Assumption
from dsr.utils.guards import naming, natural_key, numbers_in, path_within, read_text, split_numbers

_DEPTH_LR = re.compile(r"(depth|disparity)_lr(\d+)")
_TUM_UNIT = 1 / 5000
# Words in the names of calibrations, and suffixes; "" for folders.
_CALIBRATIONS = {"poses", "calib", "calibration", "camera", "cameras", "intrinsic", "intrinsics", "fov", "transforms"}
_TEXTS = ("", ".json", ".txt", ".yaml", ".yml", ".xml", ".csv")
_MAX_DEPTH = 3  # levels of subfolders that are searched
_MOST_FILES, _KINDS = 100_000, 6  # files that are counted, and kinds of them that are named


class NoPairError(ValueError):
    """There is no pair in a place, and nothing there is damaged."""


def find_pairs_of_folder(folder: Path, leave: Path | None = None) -> PairingResult:
    """Return the pairs in a folder of any layout, or in its subfolders, in a capture's file, or in a ZIP file of these.

    ``leave`` is a folder that is skipped, such as that of the results. A NoPairError if there is no pair, another
    ValueError if there is no such folder, or a capture in it is damaged.
    """
    given = folder
    if folder.suffix.lower() == ".zip" and folder.is_file():
        folder = unpack(folder, file_state(folder, "an archive"))
        while len(inside := list(folder.iterdir())) == 1 and inside[0].is_dir():
            folder = inside[0]
    if folder.is_file():
        found = find_capture(folder)
        if found is None:
            raise NoPairError(f"{folder}: expected a folder or depth in a file as {', '.join(CAPTURE_FILES)}; got none")
    elif folder.is_dir():
        found = _search(folder, None if leave is None else leave.resolve())
    else:
        raise ValueError(f"{folder}: expected a folder of photos and depth maps, there is none")
    if not found.pairs:
        unpaired = f"; {len(found.unpaired)} pictures have no partner" if found.unpaired else ""
        raise NoPairError(
            f"{given}: expected photos and depth maps that belong together, found no pair{unpaired}; "
            f"{_describe_content(folder)}"
        )
    return replace(found, pairs=make_names_unique(found.pairs))


def _search(root: Path, leave: Path | None) -> PairingResult:
    """Return the pairs in a folder or, if there are none, in the first subfolders that have some."""
    pairs, unpaired = list[Pair](), list[Path]()
    notes: dict[Assumption, None] = {}
    folders, asked = [root], set[Path]()
    while folders:
        folder = folders.pop(0)
        parts = folder.relative_to(root).parts
        found = _find_in(folder, root)
        for pair in found.pairs:
            name = pair.name
            for part in reversed(parts):
                name = part if name in ("rgb", part) else f"{part}/{name}"
            pairs.append(pair if name == pair.name else replace(pair, name=name))
        unpaired += found.unpaired
        if found.pairs:
            above = [each for each in folder.parents if each.is_relative_to(root) and each not in asked]
            asked.update(above)
            notes |= dict.fromkeys((*(note for each in reversed(above) for note in _alike(each)), *found.assumptions))
        elif len(parts) < _MAX_DEPTH:
            below = sorted((path for path in folder.iterdir() if path.is_dir()), key=natural_key)
            folders[:0] = [path for path in below if not path.name.startswith(".") and path.resolve() != leave]
    return PairingResult(tuple(pairs), tuple(notes), tuple(unpaired))


def _alike(folder: Path) -> list[Assumption]:
    """Return notes on the captures that a folder looks like, and that its pairs were not read as."""
    return [Assumption(f"{text}: read without its camera, unit and poses") for text in lacking(folder)]


def _find_in(folder: Path, root: Path) -> PairingResult:
    """Return the pairs of a folder, not of subfolders; camera files are searched up to the root."""
    capture = find_capture(folder)
    if capture is not None and capture.pairs:
        return capture
    found = PairingResult(())
    for layout in (_scene, _tum, _role_folders, _side_by_side):
        found = add_trajectory(folder, layout(folder))
        if found.pairs:
            break
    else:
        listed = add_transforms(folder, PairingResult(())) or find_colmap(folder)
        return listed or find_capture(folder, fallback=True) or found
    camera = find_camera_file(folder, root)
    if camera is not None:
        found = replace(found, pairs=tuple(replace(pair, camera=pair.camera or camera) for pair in found.pairs))
    model = model_file(folder)
    if model is not None and all(pair.capture is None for pair in found.pairs):
        found = add_model(found, model)
    elif camera is None:
        found = _add_calibration(folder, found)
    return replace(found, assumptions=(*_alike(folder), *found.assumptions))


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
    photo = next((folder / name for name in ("rgb.png", "rgb.jpg", "rgb.jpeg") if (folder / name).is_file()), None)
    camera, mask = folder / "camera.json", folder / "mask.png"
    if photo is None or not camera.is_file():
        return PairingResult(())
    maps = sorted(path for path in folder.iterdir() if path.suffix.lower() in DEPTH_SUFFIXES)
    factors = {path: int(match[2]) for path in maps if (match := _DEPTH_LR.fullmatch(path.stem)) and int(match[2]) > 0}
    if factors:
        path = min(factors, key=factors.__getitem__)
        return PairingResult((Pair(folder.name, photo, path, camera, factor=factors[path]),))
    maps_hr = [path for path in maps if path.stem in ("depth", "disparity")]
    pairs = [Pair(folder.name, photo, path, camera, mask if mask.is_file() else None) for path in maps_hr[:1]]
    return PairingResult(tuple(pairs))


def _tum(folder: Path) -> PairingResult:
    lists = folder / "rgb.txt", folder / "depth.txt"
    if not all(path.is_file() for path in lists):
        return PairingResult(())
    listed = [_timed(path) for path in lists]
    photos, depths = (list(each) for each in listed)
    with naming(lists[0]):
        partner = match_times(*(list(each.values()) for each in listed))
    pairs, truth = [], folder / "groundtruth.txt"
    for first, second in partner:
        photo, depth = photos[first], depths[second]
        pairs.append(Pair(photo.stem, photo, depth, unit=_TUM_UNIT, time=listed[0][photo]))
    used = {path for pair in pairs for path in (pair.rgb, pair.depth)}
    unpaired = tuple(path for path in (*photos, *depths) if path not in used)
    text = "rgb.txt and depth.txt of TUM RGB-D: depth in 1/5000 m (--depth-unit)"
    if truth.is_file() and pairs:
        trajectory = read_poses(truth)
        if trajectory.times is None:
            raise ValueError(f"{truth}: expected lines of a time, a translation and a quaternion, got matrices")
        poses = trajectory.at(np.array([listed[1][pair.depth] for pair in pairs]))
        text += f"; poses: {truth.name}, of {sum(pose is not None for pose in poses)} of {len(pairs)} frames"
        without = Assumption("no pose: groundtruth.txt has none within 20 ms of the frame")
        for place, pose in enumerate(poses):
            geometry = Geometry(None, pose, () if pose is not None else (without,))
            frame = CaptureFrame("TUM RGB-D", geometry, truth, b"" if pose is None else pose.tobytes())
            pairs[place] = replace(pairs[place], capture=frame)
    return PairingResult(tuple(pairs), (Assumption(text),), unpaired)


def _timed(path: Path) -> dict[Path, float]:
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
        if role is not None and any(picture_names(path)):
            named[role].append(path)
    if not named["rgb"] or not named["depth"]:
        return PairingResult(())
    photos, depths = named["rgb"], named["depth"]
    found = find_pairs_of_two_folders(photos[0], depths[0], ())
    extra = [path.name for path in (*photos[1:], *depths[1:])]
    text = f"folders {photos[0].name} and {depths[0].name}" + (f"; not read: {', '.join(extra)}" if extra else "")
    return replace(found, assumptions=(Assumption(text), *found.assumptions))


def _side_by_side(folder: Path) -> PairingResult:
    roles = {path: role_of(path) for path in list_pictures(folder)}
    photos = [path for path, role in roles.items() if role == "rgb"]
    depths = [path for path, role in roles.items() if role == "depth"]
    if not depths:  # then depth maps are recognised by their single channel of 16 bits or floats
        for path in photos:
            with contextlib.suppress(ValueError):  # it is damaged
                pixels = read_pixels(path, cv2.IMREAD_UNCHANGED) if path.suffix.lower() in DEPTH_SUFFIXES else None
                if pixels is not None and pixels.ndim == 2 and pixels.dtype != np.uint8:
                    depths.append(path)
        photos = [path for path in photos if path not in depths]
    return match_pairs(photos, depths)


def _describe_content(folder: Path) -> str:
    """Describe a folder in one line: the numbers of its files by kind, and the captures that it nearly matches."""
    kinds, near, count = Counter[str](), dict[str, None](), 0
    for place, below, names in os.walk(folder):
        below[:] = sorted((name for name in below if not name.startswith(".")), key=natural_key)
        within = Path(place).relative_to(folder)
        if len(within.parts) >= _MAX_DEPTH:
            below.clear()
        kinds.update(Path(name).suffix.lower() or "no suffix" for name in names if not name.startswith("."))
        near |= dict.fromkeys(f"{text} in {within}" if within.parts else text for text in lacking(Path(place)))
        count += len(names)
        if count > _MOST_FILES:
            break
    found = [f"{number} {kind}" for kind, number in kinds.most_common(_KINDS)]
    more = f" and {len(kinds) - len(found)} more kinds" if len(kinds) > len(found) else ""
    text = f"the folder has {', '.join(found)}{more}" if kinds else "the folder is empty"
    return text + "".join(f"; it looks {each}" for each in [*near][:2])
