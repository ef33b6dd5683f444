"""``dataset=nyu``: indoor scenes of a Kinect, which the paper does not use."""

from __future__ import annotations

from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.formats import nyu
from dsr.data.preparation.dataset import Preparation, PreparedDataset, SceneRecord, list_frames, make_records


class NYU(PreparedDataset):
    """Labelled frames of NYU Depth v2: indoor scenes of a Kinect (Silberman et al., ECCV 2012).

    Args:
        root: directory of ``nyu_depth_v2_labeled.mat``, or of the test images as files.
        scenes: names of the scenes to use, ``0001`` to ``1449``; None and ``found`` for all. With a split, None for all
            of it and ``found`` for those on disk.
        size: height and width in pixels; None for the original size without the white border.
        crop: see :class:`dsr.data.preparation.dataset.Preparation`.
        filled: whether the authors' inpainted depth is the true depth, in place of the sensor's.
        split: ``test``, the last 449 frames, to evaluate on, or ``train``, the first 1000, to train on, as in the
            literature on guided depth super-resolution: 640 x 480 pixels with the border and the inpainted depth,
            whatever ``size``, ``crop`` and ``filled`` are. None for all frames.

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
        split: nyu.Split | None = None,
    ) -> None:
        if split is None:
            found = _records(root, filled=filled)
            super().__init__("nyu", root, found, None, scenes, Preparation(size, crop))
            return
        if split not in nyu.SPLITS:
            raise ValueError(f"split: expected one of {', '.join(nyu.SPLITS)}, or null, got {split}")
        named = [f"{number:04d}" for number in nyu.SPLITS[split]]
        found = _records(root, filled=True, crop=False) or make_records(
            list_frames(nyu.find_files, root), nyu.load_files, "nyu"
        )
        found = {name: found[name] for name in named if name in found}
        super().__init__("nyu", root, found, named, scenes, Preparation(None))
        self.evaluation = split == "test"


def _records(root: str, **settings: bool) -> dict[str, SceneRecord]:
    """Return the records of the frames of the labelled file; none where there is no such file."""
    path = Path(root).expanduser() / "nyu_depth_v2_labeled.mat"
    return make_records(nyu.find_frames(path) if path.is_file() else {}, nyu.load_frame, "nyu", **settings)
