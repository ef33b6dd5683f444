"""``dataset=hammer``: tables with glass, metal and other things before three depth cameras, with a scanner's truth.

Jung et al., "On the Importance of Accurate Geometry Data for Dense 3D Vision Tasks", CVPR 2023, the HAMMER data set;
README.md of github.com/Junggy/HAMMER-dataset, which states no licence. Scenes 2 to 11 are to train on, 12 to 14 to
test. As the archive ``_dataset_processed.zip`` has them, by the loaders of others who use it:

    scene12_traj1_1/polarization/rgb/000000.png            the polarisation camera's photo, 1088 x 832
    scene12_traj1_1/polarization/_gt/000000.png            depth rendered from the scans, 16 bits, mm, 0 = unknown
    scene12_traj1_1/polarization/depth_d435/000000.png     the camera's depth, warped into the photo, mm, 0 = hole
    scene12_traj1_1/polarization/intrinsics.txt            3 x 3, taken as it is: pixel centres at integers

likewise ``depth_tof`` and ``depth_l515``. Sequences such as ``scene12_traj1_naked_1`` lack the objects.
"""

import re
from pathlib import Path
from typing import Literal, get_args

from dsr.data.frame_files import find_beside, in_natural_order, read_frame, to_camera
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.io.images import read_numbers
from dsr.sample import Scene
from dsr.utils.guards import expect_one_of

Sensor = Literal["d435", "tof", "l515"]
Split = Literal["test", "train"]
TEST = (12, 13, 14)  # numbers of the scenes to test on
_SEQUENCE = re.compile(r"scene(\d+)_traj\d+(_naked)?_\d+")


def find_frames(
    root: Path, sensor: Sensor = "d435", split: Split | None = None, naked: bool = False
) -> dict[str, tuple[Path, Path, Path, Path]]:
    """Return photo, measured and true depth, and intrinsics by name "scene12_traj1_1/000000", in order."""
    found = {}
    others = (f"depth_{sensor}/{{}}.png", "_gt/{}.png", "intrinsics.txt")
    for place, frame, (photo, measured, truth, intrinsics) in find_beside(root, "rgb", r"(\d+)\.png", others):
        sequence = place.resolve().parent.name
        match = _SEQUENCE.fullmatch(sequence)
        if match is None or bool(match[2]) != naked:
            continue
        if split in (None, "test" if int(match[1]) in TEST else "train"):
            found[f"{sequence}/{frame}"] = (photo, measured, truth, intrinsics)
    return in_natural_order(found)


def load_frame(
    rgb_path: Path, measured_path: Path, truth_path: Path, intrinsics_path: Path, dataset: str, name: str
) -> Scene:
    """Return one frame with a camera's map, measured at the photo's size."""
    rgb, measured, truth = read_frame(rgb_path, measured_path, truth_path)
    camera = to_camera(intrinsics_path, read_numbers(intrinsics_path, 9).reshape(3, 3), rgb.shape[1:])
    return Scene(dataset, name, rgb, camera, truth, {1: measured})


DETECTED = ((find_frames, load_frame, "hammer"),)


class Hammer(PreparedDataset):
    """Frames of HAMMER at their own size, a camera's map as measured at x1; ``naked`` are those without objects."""

    def __init__(
        self,
        root: str,
        sensor: Sensor = "d435",
        split: Split = "test",
        naked: bool = False,
        scenes: SceneSelection = None,
    ) -> None:
        expect_one_of("sensor", sensor, get_args(Sensor))
        expect_one_of("split", split, get_args(Split))
        found = make_records(find_frames(Path(root).expanduser(), sensor, split, naked), load_frame, "hammer")
        super().__init__("hammer", root, found, scenes)
        self.evaluation = split == "test"
