"""``dataset=ibims``: rooms before a laser scanner, with their planes and depth edges marked (Koch et al., 2018).

Koch, Liebel, Fraundorfer, Körner, "Evaluation of CNN-based Single-Image Depth Estimation Methods", ECCV Workshops 2018.
100 scenes of 640 x 480 pixels, each a MATLAB file with a structure ``data``:

    ibims1_core_mat/corridor_01.mat    rgb, depth in metres, 0 = hole, calib, edges, mask_invalid and mask_transp,
                                       0 where a pixel is not to be counted, mask_wall, mask_table and mask_floor, in
                                       which planes are numbered from 1

or, with the same in it, as pictures, a folder for each:

    ibims1_core_raw/rgb/corridor_01.png        ibims1_core_raw/depth/corridor_01.png     16 bits, v 50 / 65535 metres
    ibims1_core_raw/calib/corridor_01.txt      ibims1_core_raw/edges/corridor_01.png     and so on; fx,fy,cx,cy

``calib`` is the transpose of a matrix of intrinsics, and its pixels are counted from 1: the principal point is less by
1 here. As in the authors' evaluation, pixels whose depth is 0, invalid, or behind something transparent have no truth.
Regions are ``planes``, numbered from 1 (walls, then tables, then floors), and ``edges``, lines of a pixel.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dsr.data.frame_files import (
    expect_size,
    find_beside,
    given_camera,
    in_natural_order,
    read_16bit,
    read_picture,
    to_camera,
    to_depth,
    walk,
)
from dsr.data.matlab import read_variables
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import Camera
from dsr.io.images import read_levels
from dsr.sample import Scene
from dsr.utils.guards import read_text

COUNT = 100  # number of scenes
SIZE = (480, 640)
FARTHEST = 50.0  # depth of the largest value in pictures, metres
_VALID = ("mask_invalid", "mask_transp")
_PLANES = ("mask_wall", "mask_table", "mask_floor")
_MASKS = (*_VALID, "edges", *_PLANES)
Pictures = tuple[Path, Path, Path, *tuple[Path | None, ...]]


def find_matrices(root: Path) -> dict[str, tuple[Path]]:
    """Return the MATLAB files of scenes by name, in order, without results of methods, ``*_results.mat``."""
    found: dict[str, tuple[Path]] = {}
    for folder, _, files in walk(root):
        names = (file.removesuffix(".mat") for file in files if file.endswith(".mat"))
        found |= {name: (folder / f"{name}.mat",) for name in names if not name.endswith("_results")}
    return in_natural_order(found)


def find_pictures(root: Path) -> dict[str, Pictures]:
    """Return the files of scenes in folders, the first arguments of :func:`load_pictures`, by name, in order."""
    found: dict[str, Pictures] = {}
    needed = ("depth/{}.png", "calib/{}.txt", *(f"{mask}/{{}}.png" for mask in _VALID))
    for place, name, (photo, depth, calibration, *_) in find_beside(root, "rgb", r"(.+)\.png", needed):
        masks = (place / mask / photo.name for mask in _MASKS)
        found[name] = (photo, depth, calibration, *(path if path.is_file() else None for path in masks))
    return in_natural_order(found)


def load_matrices(path: Path, dataset: str, name: str) -> Scene:
    """Return the scene of a MATLAB file."""
    stored = {key.removeprefix("data."): values for key, values in read_variables(path).items()}
    needed = ("rgb", "depth", "calib", *_VALID)
    missing = [key for key in needed if key not in stored]
    if missing:
        raise ValueError(f"{path}: expected {', '.join(needed)} in a structure data, got no {', '.join(missing)}")
    shapes = {"rgb": (*SIZE, 3), "calib": (3, 3), **dict.fromkeys(("depth", *_MASKS), SIZE)}
    for key, shape in shapes.items():
        if key in stored and stored[key].size and stored[key].shape != shape:
            raise ValueError(f"{path}: {key}: expected shape {shape}, got {stored[key].shape}")
    if stored["rgb"].dtype != np.uint8:
        raise ValueError(f"{path}: rgb: expected 8 bits a channel, got {stored['rgb'].dtype}")
    rgb = torch.from_numpy(np.ascontiguousarray(stored["rgb"].transpose(2, 0, 1))).float() / 255
    camera = to_camera(path, stored["calib"].T - np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]]), SIZE)  # pixels from 1
    masks = {key: stored[key] for key in _MASKS if key in stored and stored[key].size}
    return _scene(path, rgb, camera, stored["depth"], masks, dataset, name)


def load_pictures(rgb_path: Path, depth_path: Path, calibration_path: Path, *paths: Path | str | None) -> Scene:
    """Return the scene of pictures; ``paths`` are the files of :data:`_MASKS`, then the names of data set and scene."""
    *mask_paths, dataset, name = paths
    rgb, depth = read_picture(rgb_path, SIZE), read_16bit(depth_path)
    given = {key: path for key, path in zip(_MASKS, mask_paths, strict=True) if isinstance(path, Path)}
    masks = {key: read_levels(path) for key, path in given.items()}
    for path, image in ((depth_path, depth), *((given[key], mask) for key, mask in masks.items())):
        expect_size(path, image, SIZE)
    text = read_text(calibration_path)
    try:
        fx, fy, cx, cy = map(float, text.replace(",", " ").split())
    except ValueError as error:
        raise ValueError(f"{calibration_path}: expected fx,fy,cx,cy, got {text[:60]!r}") from error
    camera = given_camera((fx, fy, cx - 1, cy - 1), SIZE, calibration_path)  # pixels are counted from 1
    return _scene(depth_path, rgb, camera, depth * (FARTHEST / 65535), masks, str(dataset), str(name))


def _scene(
    path: Path, rgb: Tensor, camera: Camera, depth: np.ndarray, masks: Mapping[str, np.ndarray], dataset: str, name: str
) -> Scene:
    """Return the scene of depth in metres, 0 in holes, and masks."""
    valid = np.all([masks[key] > 0 for key in _VALID], axis=0)
    truth = to_depth(path, np.where(valid, depth, 0))
    planes = np.zeros(SIZE, np.int64)
    for mask in (masks[key].astype(np.int64) for key in _PLANES if key in masks):
        planes = np.where(mask > 0, mask + planes.max(), planes)
    if planes.max() > 255:
        raise ValueError(f"{path}: expected up to 255 planes, got {planes.max()}")
    regions = {"planes": planes.astype(np.uint8), "edges": (masks.get("edges", np.zeros(SIZE)) > 0).astype(np.uint8)}
    found = {key: torch.from_numpy(region)[None] for key, region in regions.items() if region.any()}
    return Scene(dataset, name, rgb, camera, truth, regions=found)


DETECTED = ((find_pictures, load_pictures, "ibims"),)


class IBims(PreparedDataset):
    """Scenes of iBims-1 at their own size, of pictures or of MATLAB files."""

    regions = ("planes", "edges")

    def __init__(self, root: str, scenes: SceneSelection = None) -> None:
        folder = Path(root).expanduser()
        found = make_records(find_pictures(folder), load_pictures, "ibims")
        found |= make_records(find_matrices(folder), load_matrices, "ibims")
        super().__init__("ibims", root, found, scenes, count=COUNT)
