"""``dataset=nyu``: NYU Depth v2, the 1449 labelled frames: indoor scenes of a Kinect, which the paper does not use.

Silberman et al., "Indoor Segmentation and Support Inference from RGBD Images", ECCV 2012.

``nyu_depth_v2_labeled.mat`` is a MATLAB 7.3 file, that is HDF5, which turns axes around: images (N, 3, 640, 480) uint8,
depths and rawDepths (N, 640, 480) float32, orthogonal metres in the colour camera. rawDepths is the Kinect's depth, 0
for a hole; depths was filled by the authors (colourisation after Levin et al.). One frame is read at a time.

The camera is camera_params.m of the official toolbox, which counts pixels from 1. The toolbox cuts off the white border
(get_projection_mask.m): rows 45 to 471, columns 41 to 601, counted from 1, which leaves 427 x 561.

Guided depth super-resolution trains on the first 1000 frames and tests on the last 449 (Kim et al., "Deformable Kernel
Networks for Joint Image Filtering", IJCV 2021), 640 x 480 pixels with the border and the filled depth. DCTNet (Zhao et
al., CVPR 2022) has the latter as files, ``RGB/1000.jpg`` and ``Depth/1000.npy`` in metres, numbered from 0.
"""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import h5py
import numpy as np
import torch

from dsr.data.frame_files import expect_size, find_beside, in_natural_order, read_picture, to_depth
from dsr.data.matlab import expect_own_values
from dsr.data.scene_source import Preparation, PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import Camera
from dsr.io.images import read_map
from dsr.sample import Scene
from dsr.utils.guards import expect_one_of, naming, refusing

CAMERA = Camera(640, 480, 518.85790117450188, 519.46961112127485, 325.58244941119034 - 1, 253.73616633400465 - 1)
BORDER = (44, 40, 427, 561)  # of the window that the projected depth covers: first row and column, height, width
Split = Literal["train", "test"]
SPLITS = MappingProxyType({"train": range(1, 1001), "test": range(1001, 1450)})  # numbers of the frames
_FRAME = MappingProxyType({
    "images": ((3, 640, 480), np.dtype(np.uint8)),
    "depths": ((640, 480), np.dtype(np.float32)),
    "rawDepths": ((640, 480), np.dtype(np.float32)),
})  # fmt: skip


def find_frames(path: Path) -> dict[str, tuple[Path, int]]:
    """Return the file and the frame's number by name "0001" to "1449", as the official split counts."""
    with _opened(path) as arrays:
        return {f"{number:04d}": (path, number) for number in range(1, len(arrays["images"]) + 1)}


def load_frame(path: Path, number: int, dataset: str, name: str, *, filled: bool = False, crop: bool = True) -> Scene:
    """Return a frame by its number from 1; ``crop`` cuts off the border, which leaves 427 x 561 pixels."""
    key = "depths" if filled else "rawDepths"
    damaged = f"{path}: expected frame {number} of {key} and images, got a damaged file"
    with _opened(path) as arrays, refusing(damaged, OSError):
        pixels, metres = arrays["images"][number - 1], arrays[key][number - 1]
    rgb = torch.from_numpy(pixels).permute(0, 2, 1).contiguous().float() / 255  # (3, 480, 640)
    depth, camera = to_depth(path, metres.T), CAMERA
    if crop:
        top, left, height, width = BORDER
        rgb, depth = (image[:, top : top + height, left : left + width] for image in (rgb, depth))
        camera = camera.crop(*BORDER)
    if not depth.isfinite().any():
        raise ValueError(f"{path}: expected at least one known pixel in frame {number}, all are holes")
    return Scene(dataset, name, rgb, camera, depth)


def find_files(root: Path) -> dict[str, tuple[Path, Path]]:
    """Return photos and depths in files of their own by the frame's name: ``RGB/1000.jpg`` is "1001"."""
    found: dict[str, tuple[Path, Path]] = {}
    for _, number, (photo, depth) in find_beside(root, "RGB", r"(\d{1,4})\.jpg", ("Depth/{}.npy",)):
        found.setdefault(f"{int(number) + 1:04d}", (photo, depth))
    return in_natural_order(found)


def load_files(rgb_path: Path, depth_path: Path, dataset: str, name: str) -> Scene:
    """Return one frame of files of their own, with its border and the filled depth."""
    size = (CAMERA.height, CAMERA.width)
    rgb, depth = read_picture(rgb_path, size), to_depth(depth_path, read_map(depth_path))
    expect_size(depth_path, depth, size)
    return Scene(dataset, name, rgb, CAMERA, depth)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Mapping[str, h5py.Dataset]]:
    """Open the file and yield its arrays, checked to be as the module says."""
    size = path.stat().st_size
    with refusing(f"{path}: expected a MATLAB 7.3 (HDF5) file, got {size} bytes damaged or foreign", OSError):
        file = h5py.File(path, "r")
    with file:
        arrays = {}
        for key, (shape, dtype) in _FRAME.items():
            # damaged inside: h5py raises KeyError, RuntimeError, OSError, ...
            with refusing(f"{path}: expected the array {key}, got a damaged or foreign file", Exception):
                array, count = file[key], file["images"].shape[0]
                came = (array.dtype, array.shape)
            with naming(f"{path}: expected the array {key}"):
                expect_own_values(array)
            if came != (dtype, (count, *shape)):
                sizes = ", ".join(map(str, shape))
                raise ValueError(f"{path}: {key}: expected {dtype} (frames, {sizes}), got {came[0]} {came[1]}")
            arrays[key] = array
        yield arrays


DETECTED = ((find_files, load_files, "nyu"),)


class NYU(PreparedDataset):
    """Labelled frames of NYU Depth v2: indoor scenes of a Kinect (Silberman et al., ECCV 2012)."""

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        filled: bool = False,
        split: Split | None = None,
    ) -> None:
        folder, self.soft_edges = Path(root).expanduser(), filled or split is not None
        labelled = folder / "nyu_depth_v2_labeled.mat"
        frames = find_frames(labelled) if labelled.is_file() else {}
        if split is None:
            found = make_records(frames, load_frame, "nyu", filled=filled)
            super().__init__("nyu", root, found, scenes, preparation=Preparation(size, crop))
            return
        expect_one_of("split", split, (*SPLITS, None))
        found = make_records(frames, load_frame, "nyu", filled=True, crop=False)
        found = found or make_records(find_files(folder), load_files, "nyu")
        named = [f"{number:04d}" for number in SPLITS[split]]
        super().__init__("nyu", root, {name: found[name] for name in named if name in found}, scenes, named)
        self.evaluation = split == "test"
