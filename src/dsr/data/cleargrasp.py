"""``dataset=cleargrasp`` and ``dataset=cleargrasp_synthetic``: glass and clear plastic, with true depth.

Sajjan et al., "ClearGrasp: 3D Shape Estimation of Transparent Objects for Manipulation", ICRA 2020; its code and
samples are in github.com/Shreeyak/cleargrasp (Apache 2.0).

``cleargrasp`` has captures of a RealSense at 1280 x 720, with their depth as the measured map, and of the same scene
with painted twins in the objects' places, whose depth is the truth.

    real-val/d435/000000080-transparent-rgb-img.jpg      000000080-transparent-depth-img.exr   metres, 0 or NaN = hole
    real-val/d435/000000080-opaque-depth-img.exr         000000080-mask.png                    not 0: the objects
    real-val/d435/camera_intrinsics.yaml                 xres yres fx fy cx cy

likewise ``real-test``. Depth is in 16-bit floats, whose steps are 0.5 mm from 0.5 to 1 m and 1 mm beyond.

``cleargrasp_synthetic`` has rendered scenes with exact depth, to downsample, in a folder for each object:

    synthetic-val/square-plastic-bottle-val/rgb-imgs/000000000-rgb.jpg                              1920 x 1080
    synthetic-val/square-plastic-bottle-val/depth-imgs-rectified/000000000-depth-rectified.exr      see below
    synthetic-val/square-plastic-bottle-val/segmentation-masks/000000000-segmentation-mask.png

likewise ``synthetic-test`` and the training set, whose folders end in ``-train``. Stored is the distance along the ray,
times cos(a) cos(b), where the angles a and b grow from 0 in the middle of the picture by the same amount in each column
and row, to half of :data:`VIEW` at its sides. That is up to 2 % off orthogonal depth, as which the authors use it; here
the product is undone, and the distance converted. The steps of the 16-bit floats are smoothed as those of 8-bit maps
are (:func:`dsr.data.reference_depth.smooth_levels`).

Regions of all are ``glass``, the mask of the objects, ``outside``, all the rest, and ``edges``, within
:data:`EDGE` pixels of the mask's outline, on either side.
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.data.frame_files import (
    expect_size,
    given_camera,
    in_natural_order,
    name_of,
    read_picture,
    to_depth,
    walk,
)
from dsr.data.reference_depth import smooth_levels
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import Camera
from dsr.io.depth_files import read_depth_file
from dsr.io.images import read_mask
from dsr.sample import Scene
from dsr.utils.guards import expect_one_of, read_text

Split = Literal["val", "test", "train"]
SPLITS: tuple[Split, ...] = ("val", "test", "train")
EDGE = 5  # width of the region ``edges`` on either side of the outline, pixels
VIEW = (1.2112585306167603, 0.7428327202796936)  # angles of view of the rendered pictures, across and down, radians
_REAL = ("{}-transparent-rgb-img.jpg", "{}-transparent-depth-img.exr", "{}-opaque-depth-img.exr", "{}-mask.png")
_SYNTHETIC = (
    "rgb-imgs/{}-rgb.jpg", "depth-imgs-rectified/{}-depth-rectified.exr", "segmentation-masks/{}-segmentation-mask.png"
)  # fmt: skip
NOTE = "true depth comes in 16-bit floats, steps of 0.5 to 1 mm: scores of normals and renderings show these, too"
_KEYS = ("xres", "yres", "fx", "fy", "cx", "cy")
_ENTRY = re.compile(rf"^({'|'.join(_KEYS)})\s*:\s*([-+.\deE]+)\s*(?:#.*)?$", re.MULTILINE)


def find_captures(root: Path, split: Split | None = None) -> dict[str, tuple[Path, ...]]:
    """Return the files of captures by name "real-val/d435/000000080", in order."""
    found = {}
    for folder, _, files in walk(root):
        if "camera_intrinsics.yaml" in files and _is_of(folder, split):
            for name in (file.removesuffix("-mask.png") for file in files if file.endswith("-mask.png")):
                wanted = [each.format(name) for each in _REAL]
                if set(wanted) <= set(files):
                    paths = (folder / each for each in (*wanted, "camera_intrinsics.yaml"))
                    found[name_of(root, folder, name)] = tuple(paths)
    return in_natural_order(found)


def find_renderings(root: Path, split: Split | None = None) -> dict[str, tuple[Path, ...]]:
    """Return the files of renderings by name "square-plastic-bottle-val/000000000", in order."""
    found = {}
    for folder, below, _ in walk(root):
        if {each.partition("/")[0] for each in _SYNTHETIC} <= set(below) and _is_of(folder, split):
            for photo in (folder / "rgb-imgs").glob("*-rgb.jpg"):
                name = photo.name.removesuffix("-rgb.jpg")
                files = tuple(folder / each.format(name) for each in _SYNTHETIC)
                if all(path.is_file() for path in files):
                    found[name_of(root, folder, name)] = files
    return in_natural_order(found)


def _is_of(folder: Path, split: Split | None) -> bool:
    """Return whether a folder, or one above it, has a name that ends in that of a split."""
    return split is None or any(part.endswith(f"-{split}") for part in folder.resolve().parts)


def load_capture(
    rgb_path: Path, measured_path: Path, truth_path: Path, mask_path: Path, camera_path: Path, dataset: str, name: str
) -> Scene:
    """Return a capture, with the depth of the clear objects as measured at x1, and that of their twins as the truth."""
    rgb, measured, truth = read_picture(rgb_path), read_depth(measured_path), read_depth(truth_path)
    entries = dict(_ENTRY.findall(read_text(camera_path)))
    try:
        width, height, *intrinsics = (float(entries[key]) for key in _KEYS)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{camera_path}: expected a number at each of {', '.join(_KEYS)}, got {entries}") from error
    camera = given_camera(intrinsics, (round(height), round(width)), camera_path)  # pixel centres at integers
    size = (camera.height, camera.width)
    for path, image in ((rgb_path, rgb), (measured_path, measured), (truth_path, truth)):
        expect_size(path, image, size)
    return Scene(dataset, name, rgb, camera, truth, {1: measured}, regions=read_regions(mask_path, size))


def load_rendering(rgb_path: Path, depth_path: Path, mask_path: Path, dataset: str, name: str) -> Scene:
    """Return a rendered scene with its exact orthogonal depth."""
    rgb, stored = read_picture(rgb_path), read_depth(depth_path, smooth=True)
    height, width = rgb.shape[1:]
    expect_size(depth_path, stored, (height, width))
    fx, fy = (size / 2 / math.tan(angle / 2) for size, angle in zip((width, height), VIEW, strict=True))
    camera = Camera(width, height, fx, fy, (width - 1) / 2, (height - 1) / 2)
    columns, rows = torch.arange(width, dtype=torch.float64), torch.arange(height, dtype=torch.float64)
    across, down = (columns / width - 0.5) * VIEW[0], (rows / height - 0.5) * VIEW[1]
    product = across.cos() * down.cos()[:, None]
    depth = stored * (1 / (product * camera.rays().double().norm(dim=0))[None])
    return Scene(dataset, name, rgb, camera, depth, regions=read_regions(mask_path, (height, width)))


def read_depth(path: Path, *, smooth: bool = False) -> Tensor:
    """Return the depth of an EXR file, (1, H, W) float64 in metres, NaN where it is 0 or not finite.

    ``smooth`` removes the steps of 16-bit floats, each value within half a step.
    """
    values = read_depth_file(path)
    depth = to_depth(path, np.nan_to_num(values.astype(np.float64), nan=0, posinf=0))
    if not smooth or values.dtype != np.float16:
        return depth
    levels = smooth_levels(np.where(depth[0].isfinite(), values.view(np.int16), np.nan))  # in the order of the values
    below = np.floor(np.nan_to_num(levels))
    low, high = (each.astype(np.int16).view(np.float16).astype(np.float64) for each in (below, below + 1))
    return torch.from_numpy(low + (levels - below) * (high - low))[None]


def read_regions(path: Path, size: Sequence[int]) -> dict[str, Tensor]:
    """Return the regions that a mask of ``size`` = (height, width) gives, (1, H, W) uint8."""
    mask = read_mask(path).astype(np.uint8)
    expect_size(path, mask, size)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * EDGE + 1, 2 * EDGE + 1))
    edges = cv2.dilate(mask, disc) - cv2.erode(mask, disc)
    regions = {"glass": mask, "outside": 1 - mask, "edges": edges}
    return {name: torch.from_numpy(each)[None] for name, each in regions.items()}


DETECTED = ((find_captures, load_capture, "cleargrasp"), (find_renderings, load_rendering, "cleargrasp_synthetic"))


class ClearGrasp(PreparedDataset):
    """Captures or renderings of ClearGrasp at their own size."""

    regions = ("glass", "outside", "edges")

    def __init__(self, root: str, synthetic: bool, split: Split | None = None, scenes: SceneSelection = None) -> None:
        expect_one_of("split", split, (*SPLITS, None))
        name, load = ("cleargrasp_synthetic", load_rendering) if synthetic else ("cleargrasp", load_capture)
        frames = (find_renderings if synthetic else find_captures)(Path(root).expanduser(), split)
        super().__init__(name, root, make_records(frames, load, name, NOTE), scenes)
        self.evaluation = split != "train"
