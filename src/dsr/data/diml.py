"""``dataset=diml``: rooms before a Kinect v2 (Cho et al., arXiv 2110.11590)."""

from __future__ import annotations

from typing import get_args

from dsr.data.base import SceneSelection
from dsr.data.formats import diml
from dsr.data.formats.shared import NO_CAMERA, load_pair
from dsr.data.preparation.dataset import Preparation, PreparedDataset, add_note, list_frames, make_records


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
        split: diml.Split = "test",
        resolution: diml.Resolution = "HR",
        scenes: SceneSelection = None,
    ) -> None:
        for name, value, choices in (("split", split, diml.Split), ("resolution", resolution, diml.Resolution)):
            if value not in get_args(choices):
                raise ValueError(f"{name}: expected one of {', '.join(get_args(choices))}, got {value}")
        frames = list_frames(diml.find_frames, root, split, resolution)
        found = add_note(make_records(frames, load_pair, "diml"), NO_CAMERA)
        super().__init__("diml", root, found, None, scenes, Preparation(None), count=diml.COUNTS[split])
        self.evaluation = split == "test"
