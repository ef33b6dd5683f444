"""``dataset=tartanair``: rendered outdoor and indoor scenes, which the paper does not use.

TartanAir: rendered flights (Wang et al., IROS 2020, "TartanAir: A Dataset to Push the Limits of Visual SLAM").

    DIR/image_left/000000_left.png, DIR/depth_left/000000_left_depth.npy

or both files in one folder. Pictures are 640 x 480; depth is orthogonal, float32 in metres, and goes up to thousands of
metres in the sky. The camera is the same throughout: f = 320, centre (320, 240) in pixels, taken as it is published.
"""

import re
from pathlib import Path

import numpy as np

from dsr.data.frame_files import name_of, read_picture, to_depth, walk
from dsr.data.scene_source import Preparation, PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import Camera
from dsr.io.images import read_values
from dsr.sample import Scene

CAMERA = Camera(640, 480, 320.0, 320.0, 320.0, 240.0)
FARTHEST = 1000.0  # largest depth in metres; the sky has a larger one
_SIZE = (480, 640)
_COLOUR = re.compile(r"(\d{1,9})_left\.png")


def find_frames(root: Path) -> dict[str, tuple[Path, Path]]:
    """Return colour and depth files by name "office/Easy/P000/000000", without ``image_left``."""
    found = {}
    for folder, below, files in walk(root):
        below[:] = [name for name in below if name != "depth_left"]
        apart = folder.name == "image_left" and folder != root
        place = folder.parent if apart else folder
        depths = place / "depth_left" if apart else folder
        there = {path.name for path in depths.glob("*_left_depth.npy")}
        for match in filter(None, map(_COLOUR.fullmatch, files)):
            depth = f"{match[1]}_left_depth.npy"
            if depth in there:
                found[name_of(root, place, match[1])] = (folder / match[0], depths / depth)
    return found


def load_frame(rgb_path: Path, depth_path: Path, dataset: str, name: str, *, farthest: float = FARTHEST) -> Scene:
    """Return one frame at 640 x 480; depths beyond ``farthest`` metres are holes."""
    rgb, values = read_picture(rgb_path, _SIZE), read_values(depth_path)
    if (values.shape, values.dtype) != (_SIZE, np.dtype("<f4")):
        raise ValueError(f"{depth_path}: expected 480 x 640 float32, got {values.dtype} of shape {values.shape}")
    return Scene(dataset, name, rgb, CAMERA, to_depth(depth_path, values, farthest))


DETECTED = ((find_frames, load_frame, "tartanair"),)


class TartanAir(PreparedDataset):
    """Frames of TartanAir: rendered outdoor and indoor scenes (Wang et al., IROS 2020)."""

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        farthest: float = FARTHEST,
    ) -> None:
        found = make_records(find_frames(Path(root).expanduser()), load_frame, "tartanair", farthest=farthest)
        super().__init__("tartanair", root, found, scenes, preparation=Preparation(size, crop))
