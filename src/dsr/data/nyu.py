"""``dataset=nyu``: indoor scenes of a Kinect, which the paper does not use."""

from __future__ import annotations

from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.formats import nyu
from dsr.data.preparation.dataset import Preparation, PreparedDataset, make_records


class NYU(PreparedDataset):
    """Labelled frames of NYU Depth v2: indoor scenes of a Kinect (Silberman et al., ECCV 2012).

    Args:
        root: directory of ``nyu_depth_v2_labeled.mat``.
        scenes: names of the scenes to use, ``0001`` to ``1449``; None and ``found`` for all.
        size: height and width in pixels; None for the original size without the white border.
        crop: see :class:`dsr.data.preparation.dataset.Preparation`.
        filled: whether the authors' inpainted depth is the true depth, in place of the sensor's.

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
        path = Path(root).expanduser() / "nyu_depth_v2_labeled.mat"
        frames = nyu.find_frames(path) if path.is_file() else {}
        found = make_records(frames, nyu.load_frame, "nyu", filled=filled)
        super().__init__("nyu", root, found, None, scenes, Preparation(size, crop))
