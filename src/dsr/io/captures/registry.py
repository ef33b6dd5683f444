"""All captures and layouts that dsr reads, in the order in which they are asked whether a folder or a file is theirs.

Other packages add readers by an entry point of the group ``dsr.captures`` that names a
:class:`~dsr.io.captures.contract.Capture`.
"""

from __future__ import annotations

import functools
from importlib.metadata import entry_points
from pathlib import Path

from dsr.io.captures.arkit import ARKITSCENES, POLYCAM, SCANNER_APP
from dsr.io.captures.colmap import COLMAP
from dsr.io.captures.contract import KINECT1, Capture
from dsr.io.captures.data_sets import REPLICA, SCANNET, SEVEN_SCENES, SUNRGBD
from dsr.io.captures.heic import HEIC
from dsr.io.captures.kinect import KINECT
from dsr.io.captures.realsense import REALSENSE
from dsr.io.captures.record3d import RECORD3D
from dsr.io.captures.ros import ROS
from dsr.io.captures.scannet import SCANNETPP
from dsr.io.captures.stray import STRAY
from dsr.io.captures.zed import ZED
from dsr.io.pairs import PairingResult
from dsr.utils.guards import refusing

# Layouts of loose pictures, which dsr.io.layouts and dsr.io.trajectories recognise.
_OPEN3D = Capture(
    "Open3D",
    "a folder of its reconstruction system",
    "two folders of pictures, and `scene/trajectory.log` or `trajectory.log`",
    "depth by its values, mostly mm; intrinsics (`camera_intrinsic.json`, `intrinsic.json`); poses",
    "written by its format",
    "",
    "https://www.open3d.org/docs/release/tutorial/reconstruction_system/system_overview.html",
    marks=("scene/trajectory.log", "trajectory.log"),
    needs={"color/": ("color/*", "image/*", "rgb/*"), "depth/": ("depth/*",)},
)
_TUM = Capture(
    "TUM RGB-D",
    "a sequence of the data set, or of a program that writes its lists",
    "`rgb.txt` and `depth.txt`",
    "depth in 1/5000 m; pairs by time, within 20 ms; poses by time (`groundtruth.txt`)",
    "193 real frames of another program; lists and poses of a real sequence",
    KINECT1,
    "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats",
    marks=("rgb.txt", "depth.txt"),
    needs={"rgb.txt": ("rgb.txt",), "depth.txt": ("depth.txt",)},
)
_ICL = Capture(
    "ICL-NUIM",
    "the rendered frames",
    "`*.depth` beside the photos",
    "depth in cm along the ray (text); the data set's intrinsics",
    "a real frame",
    "",
    "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html",
)
_ANY = Capture(
    "any two folders, or files side by side",
    "photos, and depth as PNG, TIFF, EXR, PFM, NPY or NPZ",
    "names that say rgb, color, depth ..., else by one channel of 16 bits or floats",
    "depth by its values, intrinsics of a camera file beside them",
    "real frames of seven sensors",
    "",
    "",
)
CAPTURES = (
    STRAY, POLYCAM, ARKITSCENES, SCANNER_APP,
    SCANNETPP,  # before Kinects, which have videos of the same suffix
    SCANNET, SEVEN_SCENES, SUNRGBD, REPLICA, ZED, RECORD3D, ROS, REALSENSE, KINECT, HEIC, COLMAP, _OPEN3D, _TUM, _ICL,
    _ANY,
)  # fmt: skip
CAPTURE_FILES = (*dict.fromkeys(suffix for each in CAPTURES for suffix in each.suffixes), ".zip")


@functools.cache
def all_captures() -> tuple[Capture, ...]:
    """Return the captures in the order of asking, those of other packages first."""
    others = []
    for entry in entry_points(group="dsr.captures"):
        with refusing(f"the capture {entry.name} of another package ({entry.value}) cannot be imported", Exception):
            others.append(entry.load())
    return (*others, *CAPTURES)


def find_capture(place: Path) -> PairingResult | None:
    """Return the frames of a capture, a folder or a file; None if it is none."""
    return next((found for each in all_captures() if (found := each.frames(place)) is not None), None)


def lacking(folder: Path) -> list[str]:
    """Return the captures that a folder resembles, each with its missing files: ``like ScanNet, without depth/``."""
    return [
        f"like {each.name}, without {', '.join(missing)}" for each in all_captures() if (missing := each.lacks(folder))
    ]


def markdown() -> list[str]:
    """Return the lines of a table of captures in Markdown."""
    lines = ["| device or program | export | recognised by | read | tried | the sensor |", "| --- " * 6 + "|"]
    for each in CAPTURES:
        name = f"[{each.name}]({each.source})" if each.source else each.name
        lines.append(f"| {name} | {each.export} | {each.found_by} | {each.read} | {each.tried} | {each.faults} |")
    return lines
