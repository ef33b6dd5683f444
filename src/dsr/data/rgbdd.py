"""``dataset=rgbdd`` and ``dataset=rgbdd_real``: a photo and two time-of-flight sensors (He et al., CVPR 2021).

``rgbdd`` has the industrial sensor's depth to downsample, ``rgbdd_real`` that of a phone beside it, which
``downsampling=measured scale=native`` takes as the input, at a ratio of 2.667.
"""

from __future__ import annotations

from typing import ClassVar

from dsr.data.base import SceneSelection
from dsr.data.formats import rgbdd
from dsr.data.formats.shared import NO_CAMERA, load_pair
from dsr.data.preparation.dataset import Preparation, PreparedDataset, add_note, list_frames, make_records


class RGBDD(PreparedDataset):
    """Images of RGB-D-D at their own size.

    Args:
        root: directory of the data set, or one above it.
        real: whether to use the images that have the phone's depth, as the measured map.
        split: ``test``, to evaluate on, or ``train``, to train on.
        scenes: names of the scenes to use, such as ``20200509112638``; None for all of the split, ``found`` for all in
            ``root``.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    soft_edges: ClassVar[bool] = True
    """Pixels at depth steps are mixtures of both sides."""

    def __init__(self, root: str, real: bool, split: rgbdd.Split = "test", scenes: SceneSelection = None) -> None:
        if split not in rgbdd.COUNTS:
            raise ValueError(f"split: expected one of {', '.join(rgbdd.COUNTS)}, got {split}")
        name, load = ("rgbdd_real", rgbdd.load_measured_frame) if real else ("rgbdd", load_pair)
        frames = list_frames(rgbdd.find_frames, root, split, real)
        found = add_note(make_records(frames, load, name), NO_CAMERA)
        super().__init__(name, root, found, None, scenes, Preparation(None), count=rgbdd.COUNTS[split])
        self.evaluation = split == "test"
