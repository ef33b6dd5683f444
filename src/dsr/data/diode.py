"""``dataset=diode``: rooms and streets before a laser scanner (Vasiljevic et al., 2019).

Vasiljevic et al., "DIODE: A Dense Indoor and Outdoor DEpth Dataset", arXiv 1908.00463; README.md, diode.py,
intrinsics.txt and diode_meta.json of github.com/diode-dataset/diode-devkit (MIT licence). 1024 x 768:

    val/indoors/scene_00019/scan_00183/00019_00183_indoors_000_010.png              the photo
    val/indoors/scene_00019/scan_00183/00019_00183_indoors_000_010_depth.npy        metres, 768 x 1024 x 1, float32
    val/indoors/scene_00019/scan_00183/00019_00183_indoors_000_010_depth_mask.npy   1 where the scanner saw something

likewise ``outdoor`` and ``train``. The camera is the one that the authors cut all pictures with, as they publish it
(fx is less than fy); depth is taken as orthogonal. Around depth edges the scans have points between both sides.
diode_meta.json lists fewer images of ``val`` than its archive has, 325 and 446.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from dsr.data.frame_files import expect_size, in_natural_order, read_picture, to_depth, walk
from dsr.data.preparation import Preparation, PreparedDataset, list_frames, make_records
from dsr.data.scene_source import SceneSelection
from dsr.geometry.camera import Camera
from dsr.io.images import read_array
from dsr.sample import Scene

Split = Literal["val", "train"]
Place = Literal["indoors", "outdoor"]
COUNTS = {("val", "indoors"): 325, ("val", "outdoor"): 446, ("train", "indoors"): 8574, ("train", "outdoor"): 16884}
"""Numbers of scenes."""
CAMERA = Camera(1024, 768, 886.81, 927.06, 512, 384)
_PHOTO = re.compile(r"(\d+_\d+_(indoors|outdoor)_\d+_\d+)\.png")


def find_frames(
    root: Path, split: Split | None = None, place: Place | None = None
) -> dict[str, tuple[Path, Path, Path]]:
    """Return photo, depth and mask, the first arguments of :func:`load_frame`, by name, in order.

    A name is that of the photo, such as ``00019_00183_indoors_000_010``.

    Args:
        root: directory of ``val`` and ``train``, or any directory above or below.
        split: of the frames; None for all. What is in no directory ``train`` is ``val``.
        place: ``indoors`` or ``outdoor``; None for both.

    Raises:
        ValueError: there is no such directory.

    """
    found = {}
    for folder, _, files in walk(root):
        if split in (None, "train" if "train" in folder.resolve().parts else "val"):
            there = set(files)
            for match in filter(None, map(_PHOTO.fullmatch, files)):
                names = [match[0], f"{match[1]}_depth.npy", f"{match[1]}_depth_mask.npy"]
                if place in (None, match[2]) and there.issuperset(names):
                    photo, depth, mask = (folder / each for each in names)
                    found[match[1]] = (photo, depth, mask)
    return in_natural_order(found)


def load_frame(rgb_path: Path, depth_path: Path, mask_path: Path, dataset: str, name: str) -> Scene:
    """Return one frame; pixels outside of the mask are holes.

    Raises:
        ValueError: a file is missing, damaged, or not of 1024 x 768 pixels; the message names it.

    """
    rgb, depth, mask = read_picture(rgb_path), _read(depth_path), _read(mask_path)
    for path, size in ((rgb_path, tuple(rgb.shape[1:])), (depth_path, depth.shape), (mask_path, mask.shape)):
        expect_size(path, size, (CAMERA.height, CAMERA.width))
    return Scene(dataset, name, rgb, CAMERA, to_depth(depth_path, np.where(mask > 0, depth, 0)))


def _read(path: Path) -> np.ndarray:
    """Return the values of a NumPy file, without an axis of length 1 at its end."""
    values = read_array(path)
    if values.dtype.kind not in "fiub":
        raise ValueError(f"{path}: expected numbers, got {values.dtype}")
    return values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values


class Diode(PreparedDataset):
    """Frames of DIODE at their own size.

    Args:
        root: directory of ``val`` and ``train``.
        split: ``val``, to evaluate on, or ``train``, to train on.
        place: ``indoors`` or ``outdoor``.
        scenes: names of the scenes to use, such as ``00019_00183_indoors_000_010``; None for all of the split,
            ``found`` for all in ``root``.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self, root: str, split: Split = "val", place: Place = "indoors", scenes: SceneSelection = None
    ) -> None:
        for name, value, choices in (("split", split, Split), ("place", place, Place)):
            if value not in get_args(choices):
                raise ValueError(f"{name}: expected one of {', '.join(get_args(choices))}, got {value}")
        found = make_records(list_frames(find_frames, root, split, place), load_frame, "diode")
        super().__init__("diode", root, found, None, scenes, Preparation(None), count=COUNTS[split, place])
        self.evaluation = split == "val"
