"""``dataset=folder``: a directory with one folder per scene.

    DIR/SCENE/rgb.png (or .jpg, .jpeg)
              camera.json
              depth.* or disparity.*         high-resolution depth; .npy, .png (16 bit), .tiff, .pfm
              mask.png                       optional; 0 where the high-resolution depth is unknown
              depth_lr.*, disparity_lr.*     optional; a measured low-resolution map of any size with the photo's field
                                             of view, disparity in its own pixels
              depth_lr4.*, disparity_lr4.*   the same, whose size has to be that of the factor in its name, here 4

Depth and disparity follow ``camera.json``, whose keys are in docs/data.md.
"""

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dsr.data.frame_files import expect_size
from dsr.data.scene_source import WITHOUT_OFFSET, SceneSelection, SceneSource, select_scenes
from dsr.geometry.camera import Camera, RangeType, from_range
from dsr.io.cameras import CameraFile, read_camera
from dsr.io.images import MAP_SUFFIXES, read_map, read_mask, read_rgb
from dsr.sample import Scene, expect_distances
from dsr.utils.guards import natural_key, opened, pixels_beside
from dsr.utils.ratios import fits_ratio, round_ratio

_RGB_NAMES = ("rgb.png", "rgb.jpg", "rgb.jpeg")
_QUANTITIES = ("depth", "disparity")
_MEASURED = re.compile(r"(depth|disparity)_lr(\d*)")


class Folder(SceneSource):
    """The scenes of a directory."""

    evaluation = False

    def __init__(
        self, root: str, scenes: SceneSelection = None, name: str = "folder", without_offset: Sequence[str] = ()
    ) -> None:
        self.name = name
        self._root = Path(root).expanduser()
        if not self._root.is_dir():
            raise ValueError(f"root: expected a directory of scenes, got {root} (no such directory)")
        found = [path.name for path in self._root.iterdir() if path.is_dir() and not path.name.startswith(".")]
        if not found:
            raise ValueError(f"root: expected a folder per scene in {root}, there is none")
        self._scenes = select_scenes(sorted(found, key=natural_key), scenes)
        if isinstance(without_offset, str):
            raise ValueError(f"without_offset: expected a list of names, got {without_offset!r}")
        self._without_offset = frozenset(without_offset)
        if unknown := self._without_offset.difference(found):
            raise ValueError(f"without_offset: expected names of scenes in {root}, got {', '.join(sorted(unknown))}")

    def load(self, scene: str) -> Scene:
        """Return one scene."""
        return load_scene(self._root / scene, self.name, offset=scene not in self._without_offset)

    def fingerprint(self, scene: str) -> str:
        """Return the SHA-256 of the scene's files, and of whether their offset is left out."""
        digest = hashlib.sha256(b"without offset" if scene in self._without_offset else b"")
        for path in sorted(path for path in (self._root / scene).iterdir() if path.is_file()):
            digest.update(os.fsencode(path.name) + b"\0")
            with opened(path) as file:
                while chunk := file.read(1 << 20):
                    digest.update(chunk)
        return digest.hexdigest()


def load_scene(folder: Path, dataset: str, *, offset: bool = True) -> Scene:
    """Return the scene in ``folder``; without ``offset``, ``doffs`` of ``camera.json`` is taken for 0."""
    description = read_camera(folder / "camera.json")
    if not offset:
        if not description.camera.doffs:
            raise ValueError(f"{folder / 'camera.json'}: without_offset: expected a doffs to leave out, there is none")
        description = replace(description, camera=replace(description.camera, doffs=0.0))
    camera = description.camera
    rgb_path = next((path for path in map(folder.joinpath, _RGB_NAMES) if path.is_file()), folder / _RGB_NAMES[0])
    rgb = read_rgb(rgb_path)
    expect_size(rgb_path, rgb[..., 0], (camera.height, camera.width), ", from camera.json")
    measured: dict[float, Tensor] = {}
    for path in sorted(folder.iterdir()):
        match = _MEASURED.fullmatch(path.stem)
        if match and path.suffix.lower() in MAP_SUFFIXES:
            ratio, depth_lr = _read_measured(path, match[1], match[2], description)
            if ratio in measured:
                raise ValueError(f"{path}: expected one map at x{round_ratio(ratio)}, there is another")
            measured[ratio] = depth_lr
    found = [folder / f"{name}{suffix}" for name in _QUANTITIES for suffix in MAP_SUFFIXES]
    found = [path for path in found if path.is_file()]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise ValueError(f"{folder}: expected one high-resolution depth map, got {names}")
    depth = _read_depth(found[0], found[0].stem, description, camera, folder / "mask.png") if found else None
    if depth is None and not measured:
        names = " or ".join(f"{name}.{{npy,png,tiff,pfm}}" for name in _QUANTITIES)
        raise ValueError(f"{folder}: expected {names}, there is none")
    pixels = torch.from_numpy(rgb).permute(2, 0, 1).float() / 255
    return Scene(dataset, folder.name, pixels, camera, depth, measured, notes=() if offset else (WITHOUT_OFFSET,))


def _read_measured(path: Path, quantity: str, factor: str, description: CameraFile) -> tuple[float, Tensor]:
    """Return the ratio and the depth of a measured map; ``factor`` is the number in its name, or empty."""
    camera = description.camera
    if factor:
        size = (camera.width // max(int(factor), 1), camera.height // max(int(factor), 1))
        if not int(factor) or not all(size):
            raise ValueError(f"{path}: expected a factor that the {camera.height} x {camera.width} photo allows")
        return int(factor), _read_depth(path, quantity, description, camera.downscale(int(factor)))
    height, width = read_map(path, pixels_beside(camera.height, camera.width)).shape
    camera_lr, ratio = camera.reduce(width, height), camera.ratio_to(width, height)
    if ratio < 1 or not fits_ratio((camera.height, camera.width), (height, width), ratio):
        raise ValueError(
            f"{path}: expected the aspect ratio of the {camera.height} x {camera.width} photo (height x width) and no "
            f"more pixels, got {height} x {width}"
        )
    return ratio, _read_depth(path, quantity, description, camera_lr)


def _read_depth(
    path: Path, quantity: str, description: CameraFile, camera: Camera, mask_path: Path | None = None
) -> Tensor:
    """Return a map as orthogonal depth, (1, H, W) in metres, NaN in holes."""
    values = read_map(path, pixels_beside(camera.height, camera.width))
    expect_size(path, values, (camera.height, camera.width), ", from camera.json")
    unit = 1.0 if quantity == "disparity" else description.depth_unit
    if unit is None and path.suffix.lower() == ".png":
        raise ValueError(f'{path}: expected its unit in camera.json: "depth_unit": "m", "mm" or metres per value')
    values[np.isinf(values)] = np.nan  # infinity stands for an unknown disparity at Middlebury
    if description.hole_value is not None:
        values[values == description.hole_value] = np.nan
    if mask_path is not None and mask_path.is_file():
        mask = read_mask(mask_path, pixels_beside(camera.height, camera.width))
        expect_size(mask_path, mask, values.shape)
        values[~mask] = np.nan
    if np.isnan(values).all():
        raise ValueError(f"{path}: expected at least one known pixel, all are holes")
    low = np.nanmin(values)
    if low <= 0 and not (quantity == "disparity" and low > -camera.doffs):
        raise ValueError(
            f"{path}: expected positive values, got {low:g} in {np.mean(values <= 0):.2%} of the pixels "
            '(mark holes by NaN, by mask.png, or by "hole_value" in camera.json)'
        )
    metres = torch.from_numpy(values)[None] * (unit or 1.0)
    depth = from_range(metres, camera, _range_type(path, quantity, description))
    expect_distances(str(path), depth)
    return depth


def _range_type(path: Path, quantity: str, description: CameraFile) -> RangeType:
    if quantity == "disparity":
        if description.range_type not in (None, "disparity"):
            raise ValueError(f"{path}: camera.json's range_type is {description.range_type!r}, expected 'disparity'")
        if description.camera.baseline is None:
            raise ValueError(f'{path}: expected "baseline" in camera.json, which disparity needs')
        return "disparity"
    if description.range_type == "disparity":
        raise ValueError(f"{path}: camera.json's range_type is 'disparity', expected 'orthogonal' or 'perspective'")
    return description.range_type or "orthogonal"
