"""``dataset=lu`` and ``dataset=middlebury8``: the 8-bit benchmarks of guided depth super-resolution.

    DIR/RGB/RGBD_01_ouput_color.png            the photo; the name is spelt that way in Lu's, "output" in Middlebury's
    DIR/Depth/RGBD_01_output_depth.png         8 bits, nearer is brighter, without holes; 0 is a level like any other

Lu et al., "Depth Enhancement via Low-Rank Matrix Completion", CVPR 2014, recorded ``RGBD_01`` to ``RGBD_06`` with a
structured-light sensor and filled their holes, as well as those of thirty pairs of Middlebury 2001 to 2006
(``Middlebury_01`` to ``Middlebury_30``, at a third of the size of 2005 and 2006). The field computes errors in levels.

What depth a level stands for is not published. So the cameras here are invented, in such a way that disparity in pixels
is the level and every level, even some below 0 which interpolation may make, has a positive depth, focal * baseline /
(level + offset): of Lu 0.80 m at level 255 and 3.5 m at 0, with the focal length that is usual for such sensors; of
Middlebury 1.3 m and 3.0 m, with the camera of 2005 and 2006, three levels to a pixel, and the shift of Art.
"""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import torch

from dsr.data.frame_files import expect_size, find_beside, in_natural_order, read_picture
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import Camera, baseline_times_focal, from_range
from dsr.io.images import read_levels
from dsr.sample import Scene, Unit
from dsr.utils.guards import expect_one_of


@dataclass(frozen=True)
class Benchmark:
    """A benchmark of 8-bit levels."""

    prefix: str  # of its files' names, before the number
    count: int  # number of its scenes
    focal: float  # in pixels
    baseline: float  # distance of the second camera in metres
    offset: float  # added to levels to give disparity


BENCHMARKS = MappingProxyType({
    "lu": Benchmark("RGBD", 6, 525.0, 0.5, 75.0),
    "middlebury8": Benchmark("Middlebury", 30, 3740 / 3, 0.48, 200.0),
})  # fmt: skip


def find_frames(root: Path, dataset: str) -> dict[str, tuple[Path, Path]]:
    """Return the photos and maps of a benchmark by name, in order."""
    found: dict[str, tuple[Path, Path]] = {}
    prefix = BENCHMARKS[dataset].prefix
    for spelling in ("output", "ouput"):
        pattern = rf"({prefix}_\d{{2}})_{spelling}_color\.png"
        for _, frame, (photo, levels) in find_beside(root, "RGB", pattern, ("Depth/{}_output_depth.png",)):
            found.setdefault(frame, (photo, levels))
    return in_natural_order(found)


def load_frame(rgb_path: Path, levels_path: Path, dataset: str, name: str) -> Scene:
    """Return one scene, whose errors are counted in levels; in its map of 8 bits, 0 is a level and no hole."""
    rgb, levels = read_picture(rgb_path), read_levels(levels_path)
    height, width = rgb.shape[1:]
    expect_size(levels_path, levels, (height, width))
    invented = BENCHMARKS[dataset]
    camera = Camera.centred(width, height, invented.focal)
    camera = replace(camera, baseline=invented.baseline, doffs=invented.offset)
    depth = from_range(torch.from_numpy(levels).double()[None], camera, "disparity")
    unit = Unit("levels", inverse=True, factor=baseline_times_focal(camera), offset=camera.doffs, limits=(0.0, 255.0))
    return Scene(dataset, name, rgb, camera, depth, unit=unit)


NOTE = "depth is not metric: the camera is invented, and levels are read as disparity"
DETECTED = tuple((functools.partial(find_frames, dataset=each), load_frame, each) for each in BENCHMARKS)


class EightBit(PreparedDataset):
    """Six pairs of Lu et al. (CVPR 2014) or thirty of Middlebury 2001 to 2006, at their own size."""

    soft_edges = True

    def __init__(self, root: str, benchmark: Literal["lu", "middlebury8"], scenes: SceneSelection = None) -> None:
        expect_one_of("benchmark", benchmark, BENCHMARKS)
        found = make_records(find_frames(Path(root).expanduser(), benchmark), load_frame, benchmark, NOTE)
        known = BENCHMARKS[benchmark]
        named = [f"{known.prefix}_{number:02d}" for number in range(1, known.count + 1)]
        super().__init__(benchmark, root, found, scenes, named)
