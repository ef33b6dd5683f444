"""``dataset=nyu``: rooms by a Kinect, which the paper does not use."""

from __future__ import annotations

from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.formats import nyu
from dsr.data.preparation.records import Preparation, PreparedDataset, records_of


class NYU(PreparedDataset):
    """Labelled frames of NYU Depth v2: rooms by a Kinect (Silberman et al., ECCV 2012).

    Args:
        root: where ``nyu_depth_v2_labeled.mat`` lies.
        scenes: names of the ones to use, ``0001`` to ``1449``; None and ``found`` for all.
        size: height and width in pixels; None for frames as they are, without their white border.
        crop: see :class:`dsr.data.preparation.records.Preparation`.
        filled: whether the authors' filled depth is taken for the truth, not what the sensor measured.

    Raises:
        ValueError: the file is missing or damaged, a scene is not there, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        filled: bool = False,
    ) -> None:
        folder = Path(root).expanduser()
        path = folder / "nyu_depth_v2_labeled.mat"
        frames = nyu.find_frames(path) if path.is_file() else {}
        found = records_of(frames, nyu.load_frame, "nyu", filled=filled)
        super().__init__("nyu", folder, found, tuple(found), scenes, Preparation(size, crop))
