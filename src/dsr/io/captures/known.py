"""What each layout needs: to say which file a folder lacks that looks like a capture, and what it holds instead."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from dsr.io.pairs import has_name
from dsr.utils.guards import natural_key

_MOST_FILES = 100_000
"""Largest number of files that are counted."""
_KINDS = 6
"""Largest number of kinds of files that are named."""


@dataclass(frozen=True)
class _Known:
    """A layout, as patterns of files from its folder on.

    Args:
        name: of the app or data set.
        marks: of which one tells it from others; ``*`` in the last part stands for anything.
        needs: names of its parts, each with patterns of which one has to be there.

    """

    name: str
    marks: tuple[str, ...]
    needs: dict[str, tuple[str, ...]]


_LAYOUTS = (
    _Known("Stray Scanner", ("odometry.csv", "camera_matrix.csv"),
           {"depth/": ("depth/*",), "rgb.mp4 or rgb/": ("rgb.mp4", "rgb/*")}),
    _Known("Record3D", ("rgbd/*.depth",), {"metadata": ("metadata",), "rgbd/*.jpg": ("rgbd/*.jpg",)}),
    _Known("Polycam", ("keyframes/*",), {
        "keyframes/images/": ("keyframes/images/*.jpg", "keyframes/corrected_images/*.jpg"),
        "keyframes/cameras/*.json": ("keyframes/cameras/*.json", "keyframes/corrected_cameras/*.json"),
        "keyframes/depth/": ("keyframes/depth/*.png",)}),
    _Known("ARKitScenes", ("lowres_depth/*", "lowres_wide.traj"), {
        "lowres_depth/": ("lowres_depth/*.png",),
        "wide/, color/ or lowres_wide/": ("wide/*.png", "color/*.png", "lowres_wide/*.png")}),
    _Known("3D Scanner App", ("conf_00000.png", "frame_*.json"), {
        "frame_*.jpg": ("frame_*.jpg",), "frame_*.json": ("frame_*.json",),
        "depth_*.png": ("depth_*.png", "frame_*.exr")}),
    _Known("ScanNet", ("intrinsic/intrinsic_*.txt", "pose/*.txt"), {
        "color/": ("color/*",), "depth/": ("depth/*.png",),
        "intrinsic/intrinsic_color.txt": ("intrinsic/intrinsic_*.txt",)}),
    _Known("ScanNet++", ("pose_intrinsic_imu.json", "depth.bin"), {
        "pose_intrinsic_imu.json": ("pose_intrinsic_imu.json",), "depth.bin": ("depth.bin", "depth/*.png"),
        "rgb.mkv": ("rgb.mkv", "rgb.mp4", "rgb/*.jpg")}),
    _Known("7-Scenes", ("*.pose.txt",), {"*.color.png": ("*.color.png",), "*.depth.png": ("*.depth.png",)}),
    _Known("SUN RGB-D", ("depth_bfx/*",), {
        "image/": ("image/*",), "intrinsics.txt": ("intrinsics.txt",)}),
    _Known("Replica", ("results/depth*.png",), {
        "results/frame*.jpg": ("results/frame*",), "traj.txt or cam_params.json": ("traj.txt", "cam_params.json")}),
    _Known("TUM RGB-D", ("rgb.txt", "depth.txt"), {"rgb.txt": ("rgb.txt",), "depth.txt": ("depth.txt",)}),
    _Known("Open3D", ("scene/trajectory.log", "trajectory.log"), {
        "color/": ("color/*", "image/*", "rgb/*"), "depth/": ("depth/*",)}),
    _Known("ROS 2", ("*.db3", "*.mcap"), {"metadata.yaml": ("metadata.yaml",)}),
)  # fmt: skip


def lacking(folder: Path) -> list[str]:
    """Return which layouts a folder looks like, and what it lacks for each: ``like ScanNet, without depth/``."""
    return [
        f"like {each.name}, without {', '.join(missing)}"
        for each in _LAYOUTS
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
    """Return how many files of which kinds a folder holds, and which layouts it nearly has, in a line.

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
