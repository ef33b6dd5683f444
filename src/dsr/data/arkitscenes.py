"""``dataset=arkitscenes``: a tablet's lidar at a ratio of 7.5, with a laser scanner's depth as the truth.

``downsampling=measured scale=native`` takes the lidar's maps as the input.
"""

from __future__ import annotations

from dsr.data.base import SceneSelection
from dsr.data.formats import arkitscenes
from dsr.data.preparation.dataset import Preparation, PreparedDataset, add_note, list_frames, make_records
from dsr.geometry.camera import ASSUMED_FOV

NOTE = f"there is no .pincam file: {ASSUMED_FOV:g} degrees of horizontal view are assumed"
"""Of scenes without intrinsics."""


class ARKitScenes(PreparedDataset):
    """Frames of ARKitScenes for depth upsampling (Baruch et al., NeurIPS 2021) at their own size, 1920 x 1440.

    Args:
        root: directory of ``Training`` and ``Validation``.
        split: ``validation``, to evaluate on, or ``training``, to train on.
        scenes: names of the scenes to use, such as ``41069021_305.244``; None and ``found`` for all of the split in
            ``root``.
        min_confidence: lowest confidence of the lidar's pixels, 0 to 2; the others become holes.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        split: arkitscenes.Split = "validation",
        scenes: SceneSelection = None,
        min_confidence: int = 0,
    ) -> None:
        if split not in arkitscenes.SPLITS:
            raise ValueError(f"split: expected one of {', '.join(arkitscenes.SPLITS)}, got {split}")
        if min_confidence not in range(3):
            raise ValueError(f"min_confidence: expected 0, 1 or 2, got {min_confidence}")
        frames = list_frames(arkitscenes.find_frames, root, split)
        records = make_records(frames, arkitscenes.load_frame, "arkitscenes", min_confidence=min_confidence)
        found = records | add_note({name: records[name] for name, files in frames.items() if files[-1] is None}, NOTE)
        super().__init__("arkitscenes", root, found, None, scenes, Preparation(None))
        self.evaluation = split == "validation"
