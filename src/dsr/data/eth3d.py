"""``dataset=eth3d``: buildings, meadows and rooms before a laser scanner (Schöps et al., CVPR 2017).

Schöps et al., "A Multi-View Stereo Benchmark with High-Resolution Images and Multi-Camera Videos", CVPR 2017;
www.eth3d.net/documentation (CC BY-NC-SA 4.0). 454 photos of the 13 scenes of the high-resolution multi-view training
set, of the archives ``*_dslr_jpg.7z`` and ``*_dslr_depth.7z``, both unpacked into one directory:

    courtyard/images/dslr_images/DSC_0286.JPG                the photo as the lens shows it, about 6048 x 4032
    courtyard/ground_truth_depth/dslr_images/DSC_0286.JPG    its orthogonal depth in metres: float32, little-endian, row
                                                             by row, nothing else; infinity where nothing is known
    courtyard/dslr_calibration_jpg/cameras.txt, images.txt   a model of COLMAP with cameras THIN_PRISM_FISHEYE

Depth belongs to the photos with distortion, not to those of ``*_dslr_undistorted.7z``. Here both are undistorted by
:func:`dsr.geometry.lens.undistort`: the pinhole camera has the same focal length and principal point, and depth is that
of the nearest pixel.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dsr.data.frame_files import in_natural_order, read_bytes, to_depth, walk
from dsr.data.preparation import Preparation, PreparedDataset, list_frames, make_records
from dsr.data.scene_source import SceneSelection
from dsr.geometry.lens import undistort
from dsr.io.captures.colmap import read_model
from dsr.io.images import read_rgb
from dsr.sample import Scene
from dsr.utils.guards import naming

COUNT = 454
"""Number of scenes."""
_PHOTOS, _DEPTHS, _MODEL = "images/dslr_images", "ground_truth_depth/dslr_images", "dslr_calibration_jpg"


def find_frames(root: Path) -> dict[str, tuple[Path, Path, Path, Path]]:
    """Return photo, depth, and the model's cameras and images, by name "courtyard/DSC_0286", in order.

    Args:
        root: directory of the scenes, or one above it, or a scene's.

    Raises:
        ValueError: there is no such directory.

    """
    found = {}
    for place, below, _ in walk(root):
        model = [place / _MODEL / name for name in ("cameras.txt", "images.txt")]
        if _MODEL in below and all(path.is_file() for path in model):
            below.clear()
            for depth in (place / _DEPTHS).glob("*.JPG"):
                photo = place / _PHOTOS / depth.name
                if photo.is_file():
                    found[f"{place.resolve().name}/{depth.stem}"] = (photo, depth, model[0], model[1])
    return in_natural_order(found)


def load_frame(
    rgb_path: Path, depth_path: Path, cameras_path: Path, images_path: Path, dataset: str, name: str
) -> Scene:
    """Return one frame, undistorted, at the photo's size.

    Raises:
        ValueError: a file is missing or damaged, the model has no image of the photo's name, or a size is not that of
            its camera; the message names the file.

    """
    for path in (cameras_path, images_path):
        if not path.is_file():
            raise ValueError(f"{path}: expected a file of a model of COLMAP, there is none")
    model = read_model(images_path)
    images = [image for image in model.images if Path(image.name).name == rgb_path.name]
    if len(images) != 1:
        raise ValueError(f"{images_path}: expected one image {rgb_path.name}, got {len(images)}")
    rgb = read_rgb(rgb_path)
    geometry = model.frame(images[0]).geometry((rgb.shape[0], rgb.shape[1]))
    camera, lens = geometry.camera, geometry.lens
    if camera is None or (camera.height, camera.width) != rgb.shape[:2]:
        raise ValueError(f"{rgb_path}: expected the size of its camera in {cameras_path.name}, got {rgb.shape[:2]}")
    content = read_bytes(depth_path, "a file of depth")
    if len(content) != 4 * camera.height * camera.width:
        raise ValueError(
            f"{depth_path}: expected 4 bytes for each of {camera.height} x {camera.width} pixels, got {len(content)}"
        )
    stored = np.frombuffer(content, "<f4").reshape(camera.height, camera.width)
    if lens is not None:
        with naming(str(rgb_path)):
            rgb, stored = undistort(rgb, camera, lens), undistort(stored, camera, lens, np.inf)
    depth = to_depth(depth_path, stored)
    photo = torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1))).float() / 255
    return Scene(dataset, name, photo, camera, depth)


class ETH3D(PreparedDataset):
    """Photos of ETH3D's multi-view training set with the laser scanner's depth.

    Args:
        root: directory of the scenes, or one above it.
        scenes: names of the scenes to use, such as ``courtyard_DSC_0286``; None for all 454, ``found`` for those in
            ``root``.
        size: the shorter side in pixels; None for the original size of 24 million pixels.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(self, root: str, scenes: SceneSelection = None, size: int | None = 1024) -> None:
        found = make_records(list_frames(find_frames, root), load_frame, "eth3d")
        super().__init__("eth3d", root, found, None, scenes, Preparation(size, None), count=COUNT)
