"""``dataset=sintel``: rendered scenes to train on.

Hui et al. 2016 trained MSG on 58 images of MPI Sintel, and Voynov et al. 2019 MSG-V on patches of them. They do not say
which. This data set has two or three frames of each sequence, 58 in all.

MPI Sintel with depth (Butler et al., ECCV 2012, "A Naturalistic Open Source Movie for Optical Flow Evaluation").

    ROOT/training/{clean,final}/SEQUENCE/frame_0001.png
    ROOT/training/depth/SEQUENCE/frame_0001.dpt             orthogonal depth in metres
    ROOT/training/camdata_left/SEQUENCE/frame_0001.cam      intrinsics, pixel centres at integers from 0, and pose

Both binary files are little-endian and start with the number 202021.25 as a float32; then a .dpt has width and height
(int32) and the depths row by row (float32), a .cam the 3 x 3 intrinsics and the 3 x 4 pose (float64).
"""

import struct
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np

from dsr.data.frame_files import expect_size, read_picture, to_camera, to_depth
from dsr.data.scene_source import Preparation, PreparedDataset, SceneSelection, make_records
from dsr.sample import Scene
from dsr.utils.guards import MOST_FILE, natural_key, read_limited

# Numbers of frames of the training sequences, 1064 in all
SEQUENCES = MappingProxyType({
    "alley_1": 50, "alley_2": 50, "ambush_2": 21, "ambush_4": 33, "ambush_5": 50, "ambush_6": 20, "ambush_7": 50,
    "bamboo_1": 50, "bamboo_2": 50, "bandage_1": 50, "bandage_2": 50, "cave_2": 50, "cave_4": 50, "market_2": 50,
    "market_5": 50, "market_6": 40, "mountain_1": 50, "shaman_2": 50, "shaman_3": 50, "sleeping_1": 50,
    "sleeping_2": 50, "temple_2": 50, "temple_3": 50,
})  # fmt: skip
FARTHEST = 1000.0  # largest depth in metres; the sky has a larger one
_TAG = struct.pack("<f", 202021.25)
_DPT_HEADER = struct.Struct("<4sii")
_CAM_LENGTH = 4 + 8 * (9 + 12)


def find_frames(root: Path, rendering: Literal["clean", "final"] = "final") -> dict[str, tuple[Path, Path, Path]]:
    """Return colour, depth and camera files by name ``SEQUENCE/frame_NNNN``; ``root`` holds ``training``, or is it."""
    base = root / "training" if (root / "training").is_dir() else root
    found = {}
    for depth in sorted((base / "depth").glob("*/frame_*.dpt"), key=natural_key):
        place = Path(depth.parent.name, depth.stem)
        rgb = (base / rendering / place).with_suffix(".png")
        camera = (base / "camdata_left" / place).with_suffix(".cam")
        if rgb.is_file() and camera.is_file():
            found[place.as_posix()] = (rgb, depth, camera)
    return found


def _tagged(path: Path, least: int) -> bytes:
    """Return the content of a file that begins with the tag and has at least so many bytes."""
    content = read_limited(path, MOST_FILE)
    if len(content) < least or not content.startswith(_TAG):
        came = f"{len(content)} bytes that start with {content[:4]!r}"
        raise ValueError(f"{path}: expected a {path.suffix} file (tag 202021.25, {least} bytes or more), got {came}")
    return content


def load_frame(
    rgb_path: Path, depth_path: Path, camera_path: Path, dataset: str, name: str, *, farthest: float = FARTHEST
) -> Scene:
    """Return one frame; depths beyond ``farthest`` metres are holes."""
    rgb, content = read_picture(rgb_path), _tagged(depth_path, _DPT_HEADER.size)
    _, width, height = _DPT_HEADER.unpack_from(content)
    length = len(content) - _DPT_HEADER.size
    if width < 1 or height < 1 or length != 4 * width * height:
        expected = f"{height} x {width} float32 depths behind the header"
        raise ValueError(f"{depth_path}: expected {expected}, got {length} bytes")
    values = np.frombuffer(content, "<f4", offset=_DPT_HEADER.size).reshape(height, width)
    depth = to_depth(depth_path, values, farthest)
    size = (rgb.shape[1], rgb.shape[2])
    expect_size(depth_path, depth, size)
    content = _tagged(camera_path, _CAM_LENGTH)
    if len(content) > _CAM_LENGTH:
        raise ValueError(f"{camera_path}: expected {_CAM_LENGTH} bytes, got {len(content)}")
    camera = to_camera(camera_path, np.frombuffer(content, "<f8", count=9, offset=4).reshape(3, 3), size)
    return Scene(dataset, name, rgb, camera, depth)


# The 58 frames to train on: those at a third and two thirds of each sequence, and the first of twelve sequences
FRAMES = tuple(
    f"{sequence}_frame_{number:04d}"
    for index, (sequence, length) in enumerate(SEQUENCES.items())
    for number in ((1, length // 3, 2 * length // 3) if index < 12 else (length // 3, 2 * length // 3))
)
DETECTED = ((find_frames, load_frame, "sintel"),)


class Sintel(PreparedDataset):
    """Frames of MPI Sintel (Butler et al., ECCV 2012); ``final`` renderings have blur, fog and the like."""

    evaluation = False

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = None,
        rendering: Literal["clean", "final"] = "clean",
        farthest: float = FARTHEST,
    ) -> None:
        found = make_records(find_frames(Path(root).expanduser(), rendering), load_frame, "sintel", farthest=farthest)
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__("sintel", root, found, scenes, FRAMES, preparation)
