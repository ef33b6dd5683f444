"""``dataset=ddrnet``: a real sensor's maps at the photo's own size, with a truth.

``downsampling=measured scale=1`` takes these maps as the input.
"""

from __future__ import annotations

from dsr.data.base import SceneSelection
from dsr.data.formats import ddrnet
from dsr.data.preparation.dataset import Preparation, PreparedDataset, list_frames, make_records


class DDRNetFrames(PreparedDataset):
    """Frames of Yan et al. (ECCV 2018) at their own size, the sensor's map as measured at x1.

    Args:
        root: directory of ``color_map``, ``depth_map`` and ``high_quality_depth``, or one above it.
        scenes: names of the scenes to use; None and ``found`` for all in ``root``.

    Raises:
        ValueError: a scene is not on disk.

    """

    def __init__(self, root: str, scenes: SceneSelection = None) -> None:
        found = make_records(list_frames(ddrnet.find_frames, root), ddrnet.load_frame, "ddrnet")
        super().__init__("ddrnet", root, found, None, scenes, Preparation(None))
