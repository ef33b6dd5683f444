"""``dataset=icl``: synthetic rooms with exact depth.

Handa et al., "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014. Voynov et al. 2019
evaluate on six frames, which they name by what they show. Their size and crop follow from their camera of Plant: frames
are resized to a height of 512 and cropped to the square in the middle. Which frames they used is unknown. Those below
are spread over the trajectories; ``dataset.frames`` takes others.

    DIR/scene_00_NNNN.png, .depth     as rendered: colour (8 or 16 bits), distances along the rays in centimetres
    DIR/rgb/N.png, DIR/depth/N.png    as for the TUM benchmark: orthogonal depth, 5000 levels a metre, 0 for a hole
    DIR/rgb.png, DIR/depth.png        the same, one frame a folder

All are 640 x 480 of one camera, 481.20, -480.00, 319.50, 239.50.
"""

import re
from collections.abc import Mapping
from pathlib import Path

from dsr.data.frame_files import expect_size, name_of, read_16bit, read_picture, to_depth, walk
from dsr.data.scene_source import Preparation, PreparedDataset, SceneSelection, make_records, rename_frames
from dsr.geometry.camera import from_range
from dsr.io.depth_files import ICL_CAMERA as CAMERA
from dsr.io.depth_files import read_depth_file
from dsr.sample import Scene

FARTHEST = 100.0  # largest depth in metres; longer rays have hit nothing
LEVELS = 5000  # levels per metre of the depth pictures
_RENDERED, _NUMBER = re.compile(r"scene_00_(\d+)\.depth"), re.compile(r"\d{1,9}")
_SIZE = (480, 640)


def find_frames(root: Path) -> dict[str, tuple[Path, Path]]:
    """Return colour and depth files by name "living_room_traj2/0120", or the folder's if it holds one frame."""
    found: dict[str, tuple[Path, Path]] = {}
    for folder, below, files in walk(root):
        if "rgb" in below and "depth" in below:
            below[:] = [name for name in below if name not in ("rgb", "depth")]
            colours, depths = (
                {int(path.stem): path for path in (folder / kind).glob("*.png") if _NUMBER.fullmatch(path.stem)}
                for kind in ("rgb", "depth")
            )
            for number in sorted(colours.keys() & depths.keys()):
                found[name_of(root, folder, f"{number:04d}")] = (colours[number], depths[number])
        if "rgb.png" in files and "depth.png" in files:
            found[name_of(root, folder)] = (folder / "rgb.png", folder / "depth.png")
        for match in filter(None, map(_RENDERED.fullmatch, files)):
            colour = Path(match[0]).with_suffix(".png").name
            if colour in files:
                found[name_of(root, folder, f"{int(match[1]):04d}")] = (folder / colour, folder / match[0])
    return found


def load_frame(rgb_path: Path, depth_path: Path, dataset: str, name: str) -> Scene:
    """Return one frame at 640 x 480; a ``.depth`` file has distances along the ray in centimetres."""
    rgb = read_picture(rgb_path, _SIZE)
    if depth_path.suffix.lower() == ".depth":
        depth = from_range(to_depth(depth_path, read_depth_file(depth_path) / 100, FARTHEST), CAMERA, "perspective")
    else:
        levels = read_16bit(depth_path)
        expect_size(depth_path, levels, _SIZE)
        depth = to_depth(depth_path, levels / LEVELS)
    return Scene(dataset, name, rgb, CAMERA, depth)


DETECTED = ((find_frames, load_frame, "icl"),)


class ICL(PreparedDataset):
    """Frames of ICL-NUIM; ``frames`` says which frame each of the paper's names stands for. None: all by their own."""

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        frames: Mapping[str, str] | None = None,
    ) -> None:
        found = make_records(rename_frames(find_frames(Path(root).expanduser()), frames or {}), load_frame, "icl")
        super().__init__("icl", root, found, scenes, tuple(frames) if frames else None, Preparation(size, crop))
