"""``dataset=tartanair``: rendered outdoor and indoor scenes, which the paper does not use."""

from __future__ import annotations

from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.formats import tartanair
from dsr.data.preparation.records import Preparation, PreparedDataset, listed, records_of


class TartanAir(PreparedDataset):
    """Frames of TartanAir: rendered outdoor and indoor scenes (Wang et al., IROS 2020).

    Args:
        root: where the trajectories lie.
        scenes: names of the ones to use; None and ``found`` for all in ``root``.
        size: height and width in pixels; None for frames as they are.
        crop: see :class:`dsr.data.preparation.records.Preparation`.
        farthest: metres beyond which a pixel is sky, a hole.

    Raises:
        ValueError: a scene is not there, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        farthest: float = tartanair.FARTHEST,
    ) -> None:
        folder = Path(root).expanduser()
        frames = listed(tartanair.find_frames, folder)
        found = records_of(frames, tartanair.load_frame, "tartanair", farthest=farthest)
        super().__init__("tartanair", folder, found, tuple(found), scenes, Preparation(size, crop))
