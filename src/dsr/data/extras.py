"""``dataset=tartanair`` and ``dataset=nyu``: data sets that the paper does not use and many others do."""

from __future__ import annotations

from pathlib import Path

from dsr.data.base import Wanted
from dsr.data.formats import nyu, tartanair
from dsr.data.native import Native, Preparation, listed, records_of


class TartanAir(Native):
    """Frames of TartanAir: rendered outdoor and indoor scenes (Wang et al., IROS 2020).

    Args:
        root: where the trajectories lie.
        scenes: names of the ones to use; None and ``found`` for all in ``root``.
        size: height and width in pixels; None for frames as they are.
        crop: see :class:`dsr.data.native.Preparation`.
        farthest: metres beyond which a pixel is sky, a hole.

    Raises:
        ValueError: a scene is not there, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: Wanted = None,
        size: int | None = 512,
        crop: float = 0.5,
        farthest: float = tartanair.FARTHEST,
    ) -> None:
        folder = Path(root).expanduser()
        frames = listed(tartanair.find_frames, folder)
        found = records_of(frames, tartanair.load_frame, "tartanair", farthest=farthest)
        super().__init__("tartanair", folder, found, tuple(found), scenes, Preparation(size, crop))


class NYU(Native):
    """Labelled frames of NYU Depth v2: rooms by a Kinect (Silberman et al., ECCV 2012).

    Args:
        root: where ``nyu_depth_v2_labeled.mat`` lies.
        scenes: names of the ones to use, ``0001`` to ``1449``; None and ``found`` for all.
        size: height and width in pixels; None for frames as they are, without their white border.
        crop: see :class:`dsr.data.native.Preparation`.
        filled: whether the authors' filled depth is taken for the truth, not what the sensor measured.

    Raises:
        ValueError: the file is missing or damaged, a scene is not there, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: Wanted = None,
        size: int | None = 512,
        crop: float = 0.5,
        filled: bool = False,
    ) -> None:
        folder = Path(root).expanduser()
        path = folder / "nyu_depth_v2_labeled.mat"
        frames = nyu.find_frames(path) if path.is_file() else {}
        found = records_of(frames, nyu.load_frame, "nyu", filled=filled)
        super().__init__("nyu", folder, found, tuple(found), scenes, Preparation(size, crop))
