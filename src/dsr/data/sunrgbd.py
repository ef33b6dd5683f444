"""``dataset=sunrgbd``: indoor scenes of four sensors (Song et al., "SUN RGB-D", CVPR 2015).

Voynov et al. 2019 evaluate on twelve images and do not say which. This data set has three of each sensor.

    SCENE/image/*.jpg        colour
    SCENE/depth/*.png        the sensor's depth, projected into the colour camera
    SCENE/depth_bfx/*.png    the same, refined and filled by the authors
    SCENE/intrinsics.txt     3 x 3, in three lines or one

16-bit depth pictures hold millimetres turned left by three bits: mm = (v >> 3) | (v << 13), 0 for a hole. The official
toolbox (read3dPoints.m) sets what is farther than 8 m to 8 m; here it stays as measured. intrinsics.txt is taken as it
is, pixel centres at integers from 0, which is right for NYU's frames; the toolbox counts from 1, so for other sensors
the principal point is uncertain by one pixel.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dsr.data.frame_files import (
    expect_size,
    given_camera,
    in_natural_order,
    name_of,
    read_16bit,
    read_picture,
    to_camera,
    to_depth,
    walk,
)
from dsr.data.scene_source import Preparation, PreparedDataset, SceneSelection, make_records, rename_frames
from dsr.io.depth_files import turn_back_bits
from dsr.io.images import read_numbers
from dsr.io.reading import SUNRGBD_BITS
from dsr.sample import Scene

Intrinsics = tuple[float, float, float, float]  # (fx, fy, cx, cy) in pixels
_PICTURES = (".jpg", ".jpeg", ".png")


def find_frames(root: Path) -> dict[str, tuple[Path]]:
    """Return the scene folders, the first argument of :func:`load_frame`, by path below ``root``, in order."""
    found = {}
    for folder, below, _ in walk(root):
        if "image" in below and ("depth" in below or "depth_bfx" in below):
            below.clear()
            found[name_of(root, folder)] = (folder,)
    return in_natural_order(found)


def load_frame(
    folder: Path, dataset: str, name: str, *, refined: bool = False, intrinsics: Intrinsics | None = None
) -> Scene:
    """Return the scene of a folder; ``intrinsics`` are for one without ``intrinsics.txt``."""
    paths = []
    for place in (folder / "image", folder / ("depth_bfx" if refined else "depth")):
        found = sorted(path for path in place.glob("*") if path.suffix.lower() in _PICTURES)
        if len(found) != 1:
            raise ValueError(f"{place}: expected one picture ({', '.join(_PICTURES)}), got {len(found)}")
        paths += found
    matrix = folder / "intrinsics.txt"
    given = matrix if matrix.is_file() else intrinsics
    if given is None:
        raise ValueError(f"{folder}: expected intrinsics.txt, or intrinsics=(fx, fy, cx, cy) instead, got neither")
    return load_pair(paths[0], paths[1], dataset, name, given)


def load_pair(rgb_path: Path, depth_path: Path, dataset: str, name: str, intrinsics: Path | Intrinsics) -> Scene:
    """Return the scene of two files, wherever they lie, and of their intrinsics or the file that has them."""
    rgb = read_picture(rgb_path)
    depth = to_depth(depth_path, turn_back_bits(str(depth_path), read_16bit(depth_path), SUNRGBD_BITS) / 1000)
    size = (rgb.shape[1], rgb.shape[2])
    expect_size(depth_path, depth, size)
    if isinstance(intrinsics, Path):
        camera = to_camera(intrinsics, read_numbers(intrinsics, 9).reshape(3, 3), size)
    else:
        camera = given_camera(intrinsics, size)
    return Scene(dataset, name, rgb, camera, depth)


DETECTED = ((find_frames, load_frame, "sunrgbd"),)


class SunRGBD(PreparedDataset):
    """Scenes of SUN RGB-D; the true depth is what the sensor measured, with its holes, or the authors' refined one."""

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        refined: bool = False,
        frames: Mapping[str, str] | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> None:
        if intrinsics is not None and len(intrinsics) != 4:
            raise ValueError(f"intrinsics: expected fx, fy, cx, cy, got {len(intrinsics)} numbers")
        all_frames = find_frames(Path(root).expanduser())
        places = {}
        for name, path in (frames or {}).items():  # the first scene below a path, which may be below SUNRGBD
            beginnings = tuple(f"{above}{path}/".replace("/", "_") for above in ("", "SUNRGBD/"))
            below = (each for each in all_frames if f"{each}_".replace("/", "_").startswith(beginnings))
            places[name] = next(below, path)
        given = intrinsics and tuple(intrinsics)
        renamed = rename_frames(all_frames, places)
        found = make_records(renamed, load_frame, "sunrgbd", refined=refined, intrinsics=given)
        super().__init__("sunrgbd", root, found, scenes, tuple(frames) if frames else None, Preparation(size, crop))
