"""``dataset=diml``: rooms before a Kinect v2 (Cho et al., arXiv 2110.11590).

Cho et al., "DIML/CVL RGB-D Dataset: 2M RGB-D Images of Natural Indoor and Outdoor Scenes", arXiv 2110.11590;
dimlrgbd.github.io. As the readers of de Lutio et al. ("Learning Graph Regularisation for Guided Super-Resolution", CVPR
2022) and of others have it:

    test/HR/12. Livingroom/color/in_01_160217_123138_c.png                       the photo, 1344 x 756
    test/HR/12. Livingroom/depth_filled/in_01_160217_123138_depth_filled.png     depth without holes, 16 bits, mm

likewise ``LR``, the same at 512 x 288, and ``train``. No camera is published for these sizes; 60 degrees of horizontal
view are assumed. The outdoor data, whose depth comes from stereo matching, is not read.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, get_args

from dsr.data.frame_files import NO_CAMERA, find_beside, in_natural_order, load_pair
from dsr.data.preparation import Preparation, PreparedDataset, add_note, list_frames, make_records
from dsr.data.scene_source import SceneSelection

Split = Literal["test", "train"]
Resolution = Literal["HR", "LR"]
COUNTS = {"test": 503, "train": 1609}
"""Numbers of scenes."""
_PHOTO = re.compile(r"(.+)_c\.png")


def find_frames(
    root: Path, split: Split | None = None, resolution: Resolution | None = None
) -> dict[str, tuple[Path, Path]]:
    """Return photos and depths by name "in_01_160217_123138", in order.

    Args:
        root: directory of the data, or any directory above a room.
        split: folder of the frames; None for both.
        resolution: folder of the frames below that; None for both, of which a frame is used at the higher one.

    Raises:
        ValueError: there is no such directory.

    """
    found: dict[str, tuple[Path, Path]] = {}
    for place, frame, (photo, depth) in find_beside(root, "color", _PHOTO, ("depth_filled/{}_depth_filled.png",)):
        at_split, at_resolution = place.resolve().parts[-3:-1]
        if split in (None, at_split) and resolution in (None, at_resolution):
            found.setdefault(frame, (photo, depth))
    return in_natural_order(found)


class DIML(PreparedDataset):
    """Frames of the indoor sample data of DIML/CVL RGB-D at their own size, with the authors' filled depth.

    Args:
        root: directory of ``train`` and ``test``, or one above it.
        split: ``test``, to evaluate on, or ``train``, to train on.
        resolution: ``HR``, 1344 x 756 pixels, or ``LR``, 512 x 288.
        scenes: names of the scenes to use, such as ``in_01_160217_123138``; None for all of the split, ``found`` for
            all in ``root``.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        split: Split = "test",
        resolution: Resolution = "HR",
        scenes: SceneSelection = None,
    ) -> None:
        for name, value, choices in (("split", split, Split), ("resolution", resolution, Resolution)):
            if value not in get_args(choices):
                raise ValueError(f"{name}: expected one of {', '.join(get_args(choices))}, got {value}")
        frames = list_frames(find_frames, root, split, resolution)
        found = add_note(make_records(frames, load_pair, "diml"), NO_CAMERA)
        super().__init__("diml", root, found, None, scenes, Preparation(None), count=COUNTS[split])
        self.evaluation = split == "test"
