"""placeholder"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from real_sensors import _exr
from torch import Tensor

from dsr.data.detection import find_scenes
from dsr.data.frame_files import read_picture
from dsr.degradation.downsampling import scene_generator
from dsr.degradation.random_degradation import Everything
from dsr.geometry.camera import Camera
from dsr.sample import AllHolesError, Scene
from dsr.synthetic.procedural.random_scene import render_random_scene
from dsr.synthetic.simgeo import SCENES, render_scene

FOLDERS = ("ddrnet", "icl_nuim", "middlebury2005", "middlebury2006", "middlebury2014", "rgbdd_real", "sunrgbd", "tartanair")
SENSORS = Everything(
    noises={"white": 1, "correlated": 1, "structured": 1, "flight": 1, "lidar": 1, "stereo": 1},
    holes={"none": 2, "blobs": 1, "shadows": 1, "steps": 1, "dark": 1, "pixels": 1},
    folds=0, relief=0,
)  # fmt: skip


class Right(NamedTuple):
    """A photo, (3, H, W) in [0, 1], and the depth map of it, (1, h, w) in metres, NaN in holes."""

    dataset: str
    name: str
    rgb: Tensor
    depth: Tensor


def degraded(dataset: str, scene: Scene, scales: tuple[int, ...]) -> Iterator[Right]:
    """Yield a scene's map reduced by each factor as a sensor may measure it."""
    for scale in scales:
        generator = scene_generator(scale, dataset, scene.name, scale)
        scene = scene.crop(0, 0, *(size // scale * scale for size in scene.rgb.shape[-2:]))
        try:
            sample, _ = SENSORS(scene, scale, generator)
        except AllHolesError:
            continue
        yield Right(f"{dataset}, x{scale}" if scale > 1 else f"{dataset}, noisy", scene.name, sample.rgb.float().clamp(0, 1), sample.depth_lr.float())


def scenes_of(shared: Path) -> Iterator[tuple[str, Scene]]:
    """Yield data set and scene of everything that has a truth."""
    for folder in [*(shared / "real" / name for name in FOLDERS), *sorted((shared / "modern").iterdir()), shared / "scenes"]:
        for _, load in find_scenes(folder):
            yield folder.name if folder.parent.name != "modern" else f"modern {folder.name}", load()


def raw(shared: Path) -> Iterator[Right]:
    """Yield the maps of sensors as they are."""
    real = shared / "real"

    def right(dataset: str, photo: Path, depth: Path, name: str = "") -> Right:
        if depth.suffix == ".exr":
            values = _exr(depth)
        else:
            stored = np.load(depth) if depth.suffix == ".npy" else cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
            if stored.ndim == 3:
                stored = stored[..., 0]
            stored = stored.astype(np.float32)
            if "disparity" in depth.name:
                stored = 1 / stored
            elif dataset == "sunrgbd raw":
                stored = (stored.astype(np.uint16) >> 3).astype(np.float32)
            values = torch.from_numpy(stored)[None] / 1000
            values = values.masked_fill(~(values > 0), torch.nan)
        return Right(dataset, name or photo.stem, read_picture(photo).float(), values)

    for path in sorted((real / "ddrnet/depth_map").glob("*.png")):
        yield right("ddrnet raw", real / "ddrnet/color_map" / path.name, path)
    for path in sorted((real / "rgbdd_real/DepthLR").glob("*.png")):
        yield right("rgbdd_real raw", real / "rgbdd_real/RGB" / f"{path.name.split('_')[0]}_RGB.jpg", path)
    yield right("iphone_lidar", real / "iphone_lidar/image.jpg", real / "iphone_lidar/arkit_depth.png")
    for folder in sorted((real / "depth_camera").iterdir()):
        yield right("depth_camera", next(folder.glob("rgb.*")), folder / "raw_depth.png", folder.name)
    for path in sorted((real / "stereo_board/depth").glob("*.png")):
        yield right("stereo_board", real / "stereo_board/color" / path.name, path)
    for path in sorted((real / "cleargrasp").glob("*-depth-img.exr")):
        yield right("cleargrasp", path.with_name(path.name.replace("-depth-img.exr", "-rgb-img.jpg")), path)
    for path in sorted((real / "tofmark").glob("*_depth.bmp")):
        yield right("tofmark", path.with_name(path.name.replace("_depth", "")), path)
    for folder in sorted((real / "sunrgbd").iterdir()):
        for path in folder.glob("depth/*.png"):
            yield right("sunrgbd raw", next((folder / "image").glob("*.jpg")), path, folder.name)
    yield right("books raw", shared / "scenes/books/rgb.png", shared / "scenes/books/disparity_lr4.npy", "books")


def from_shared(shared: Path) -> Iterator[Right]:
    """Yield everything real."""
    yield from raw(shared)
    for dataset, scene in scenes_of(shared):
        yield Right(dataset, scene.name, scene.rgb.float(), scene.depth.float())
        for ratio, measured in scene.measured.items():
            if dataset != "ddrnet":
                yield Right(f"{dataset}, measured", f"{scene.name} x{ratio}", scene.rgb.float(), measured.float())
        yield from degraded(dataset, scene, (4, 8))
