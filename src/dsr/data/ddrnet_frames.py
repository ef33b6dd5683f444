"""``dataset=ddrnet``: a person before a structured-light camera, at the photo's own size, with fused geometry as truth.

Yan et al., "DDRNet: Depth Map Denoising and Refinement for Consumer Depth Cameras Using Cascaded CNNs", ECCV 2018;
github.com/neycyanshi/DDRNet.

    GROUP/color_map/frame_000001.png            the photo, 640 x 480
    GROUP/depth_map/frame_000001.png            the sensor's depth, registered to the photo, 16 bits, mm, 0 = hole
    GROUP/high_quality_depth/frame_000001.png   the depth of geometry fused from many frames, mm, 0 = unknown

The camera is that of the authors' losses (src/losses.py), taken as it is: pixel centres at integers.
"""

from pathlib import Path

from dsr.data.frame_files import find_beside, name_of, read_frame
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import Camera
from dsr.sample import Scene

CAMERA = Camera(640, 480, 536.628, 536.606, 310.591, 234.759)


def find_frames(root: Path) -> dict[str, tuple[Path, Path, Path]]:
    """Return photos, sensor's and true depth by name "20170907/group1/frame_000001", in order."""
    found = {}
    others = ("depth_map/{}.png", "high_quality_depth/{}.png")
    for place, frame, (photo, measured, truth) in find_beside(root, "color_map", r"(.+)\.png", others):
        found[name_of(root, place, frame)] = (photo, measured, truth)
    return found


def load_frame(rgb_path: Path, measured_path: Path, truth_path: Path, dataset: str, name: str) -> Scene:
    """Return one frame with the sensor's map, measured at the photo's size."""
    rgb, measured, truth = read_frame(rgb_path, measured_path, truth_path, size=(CAMERA.height, CAMERA.width))
    return Scene(dataset, name, rgb, CAMERA, truth, {1: measured})


DETECTED = ((find_frames, load_frame, "ddrnet"),)


class DDRNetFrames(PreparedDataset):
    """Frames of Yan et al. (ECCV 2018) at their own size, the sensor's map as measured at x1."""

    def __init__(self, root: str, scenes: SceneSelection = None) -> None:
        found = make_records(find_frames(Path(root).expanduser()), load_frame, "ddrnet")
        super().__init__("ddrnet", root, found, scenes)
