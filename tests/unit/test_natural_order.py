"""Frames in the order of the numbers in their names, 2 before 10, so that each gets its own pose in every layout."""

import random
import re
from functools import partial

import captures
import numpy as np
import pytest

from dsr.data.folder import Folder
from dsr.io.inputs import Reading, read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.utils.guards import natural_key

FRAMES = 12
NAMES = {
    "plain": "{0}",
    "words": "frame_{0}",
    "gaps": "{gap}",
    "two numbers": "v2_{0}_{late}",
    "some zeros": "{0:02}",
    "times": "{time:.3f}",
}  # Names of frames 0 to 11; as texts they sort otherwise, but for those with enough zeros


def named(style, number):
    """Return the name of a frame."""
    return NAMES[style].format(number, gap=number**2, late=95 + number, time=95.5 + number)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(captures, "FRAMES", FRAMES)
    path = tmp_path / "capture"
    path.mkdir()
    return path


def renamed(folder, style, first=0):
    """Give the files of a capture, numbered from ``first``, the names of a style."""
    found = [path for path in folder.rglob("*") if re.fullmatch(r"\d+", path.stem) and path.is_file()]
    for path in found:  # first out of each other's way
        path.rename(path.with_name(f"old{path.name}"))
    for path in found:
        path.with_name(f"old{path.name}").rename(path.with_name(named(style, int(path.stem) - first) + path.suffix))
    return folder


def pairs(folder, style, photo, depth):
    """Write photos and maps under names with {} for that of the frame."""
    for number in range(FRAMES):
        name = named(style, number)
        captures.save(folder / photo.format(name), captures.photo(number))
        captures.save(folder / depth.format(name), captures.millimetres(number))
    return folder


def frame_numbers(pairs):
    """Return the numbers of the frames that maps show, which lie half a metre farther with each number."""
    pictures = [read_picture(pair, Reading(unit=pair.unit or 1e-3)) for pair in pairs]
    return [round(2 * float(np.nanmin(picture.depth_lr) - captures.depth().min())) for picture in pictures], pictures


def pose_numbers(poses):
    """Return the numbers of poses, which lie a decimetre to the right with each number."""
    return [None if pose is None else round(10 * pose[0, 3]) for pose in poses]


def replica(folder, style):
    """Write renderings whose poses are those of all numbers, or of the frames that are there."""
    captures.replica(folder, step=4 if style == "gaps" else 1)
    for path in (folder / "results").iterdir():
        if style != "gaps":
            path.rename(path.with_name(f"{path.stem[:5]}{named(style, int(path.stem[5:]))}{path.suffix}"))
    return folder


def open3d(folder, style):
    """Write a folder of Open3D whose poses are not in the order of their numbers."""
    path = renamed(captures.open3d(folder), style) / "scene" / "trajectory.log"
    lines = path.read_text().splitlines(keepends=True)
    entries = ["".join(lines[start : start + 5]) for start in range(0, len(lines), 5)]
    random.Random(0).shuffle(entries)
    path.write_text("".join(entries))
    return folder


NUMBERS = ["plain", "gaps", "some zeros"]
CAPTURES = {
    "stray": (lambda folder, style: renamed(captures.stray(folder, video=False), style), ["plain"]),
    "polycam": (lambda folder, style: renamed(captures.polycam(folder), style, first=1000), list(NAMES)),
    "open3d": (open3d, list(NAMES)),
    "arkitscenes": (lambda folder, _: captures.arkitscenes(folder, start=99.5), ["times"]),
    "7-scenes": (lambda folder, style: captures.seven_scenes(folder, partial(named, style)), list(NAMES)),
    "scannet": (lambda folder, style: renamed(captures.scannet(folder), style), NUMBERS),
    "scanner app": (lambda folder, style: captures.scanner_app(folder, partial(named, style)), NUMBERS),
    "replica": (replica, NUMBERS),
    "tum": (lambda folder, style: captures.tum(folder, partial(named, style)), list(NAMES)),
}


@pytest.mark.parametrize(("layout", "style"), [(each, style) for each in CAPTURES for style in CAPTURES[each][1]])
def test_frames_of_a_capture_have_their_own_poses(folder, layout, style):
    found = find_pairs_of_folder(CAPTURES[layout][0](folder, style)).pairs
    numbers, pictures = frame_numbers(found)
    assert numbers == list(range(FRAMES))
    last = None if layout == "arkitscenes" else FRAMES - 1
    assert pose_numbers([picture.pose for picture in pictures]) == [*range(FRAMES - 1), last]


PAIRS = {
    "two folders": ("rgb/{}.png", "depth/{}.png"),
    "side by side": ("{}_color.png", "{}_depth.png"),
    "words in front": ("color_{}.png", "depth_{}.png"),
    "a folder for each": ("{}/color.png", "{}/depth.png"),
}


@pytest.mark.parametrize("style", NAMES)
@pytest.mark.parametrize("layout", PAIRS)
def test_pairs_are_in_the_order_of_their_numbers(folder, layout, style):
    found = find_pairs_of_folder(pairs(folder, style, *PAIRS[layout])).pairs
    assert frame_numbers(found)[0] == list(range(FRAMES))


def test_scenes_of_dsr_and_folders_of_folders_are_in_order(folder):
    for number in range(FRAMES):
        (folder / f"{number}").mkdir()
        for name in ("rgb.png", "camera.json", "depth.npy"):
            (folder / f"{number}" / name).touch()
    expected = [f"{number}" for number in range(FRAMES)]
    assert [pair.name for pair in find_pairs_of_folder(folder).pairs] == expected
    assert Folder(str(folder)).scenes() == expected


def test_times_in_names_decide_rather_than_their_digits(folder):
    """Half a second comes after a quarter, though 25 is more than 5."""
    times = [repr(1305031102 + number / 8) for number in range(FRAMES)]
    for number, time in enumerate(times):
        captures.save(folder / "rgb" / f"{time}.png", captures.photo(number))
        captures.save(folder / "depth" / f"{time}.png", captures.millimetres(number))
    assert frame_numbers(find_pairs_of_folder(folder).pairs)[0] == list(range(FRAMES))


def test_key_sorts_numbers_by_value_and_paths_folder_by_folder():
    names = ["2/b", "10", "01", "1", "2", "a", "10/a", "2/10", "a1-b", "a/1", "2/9", "9" * 5000, "10a", "é2", "é10"]
    expected = ["01", "1", "2", "2/9", "2/10", "2/b", "10", "10/a", "10a", "9" * 5000, "a", "a/1", "a1-b", "é2", "é10"]
    assert sorted(names, key=natural_key) == expected
    zeros = ["00000", "00001", "00010", "00100"]
    assert sorted(zeros, key=natural_key) == sorted(zeros)
