"""``dataset=tartanair``: rendered outdoor and indoor scenes, which the paper does not use."""

from __future__ import annotations

from dsr.data.base import SceneSelection
from dsr.data.formats import tartanair
from dsr.data.preparation.dataset import Preparation, PreparedDataset, list_frames, make_records


class TartanAir(PreparedDataset):
    """Frames of TartanAir: rendered outdoor and indoor scenes (Wang et al., IROS 2020).

    Args:
        root: directory of the trajectories.
        scenes: names of the scenes to use; None and ``found`` for all in ``root``.
        size: height and width in pixels; None for the original size.
        crop: see :class:`dsr.data.preparation.dataset.Preparation`.
        farthest: depth in metres beyond which pixels are sky, that is, missing.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        farthest: float = tartanair.FARTHEST,
    ) -> None:
        frames = list_frames(tartanair.find_frames, root)
        found = make_records(frames, tartanair.load_frame, "tartanair", farthest=farthest)
        super().__init__("tartanair", root, found, None, scenes, Preparation(size, crop))
