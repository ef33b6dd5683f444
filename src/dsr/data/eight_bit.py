"""``dataset=lu`` and ``dataset=middlebury8``: the 8-bit benchmarks of guided depth super-resolution.

The field computes their errors in levels; see :mod:`dsr.data.formats.eight_bit` for what is known of them.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from dsr.data.base import SceneSelection
from dsr.data.formats import eight_bit
from dsr.data.preparation.dataset import Preparation, PreparedDataset, add_note, list_frames, make_records

NOTE = "depth is not metric: the camera is invented, and levels are taken for disparity"


class EightBit(PreparedDataset):
    """Six pairs of Lu et al. (CVPR 2014) or thirty of Middlebury 2001 to 2006, at their own size.

    Args:
        root: directory of ``RGB`` and ``Depth``, or one above it.
        benchmark: ``lu`` or ``middlebury8``.
        scenes: names of the scenes to use, such as ``RGBD_01`` or ``Middlebury_01``; None for all of the benchmark,
            ``found`` for all in ``root``.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    soft_edges: ClassVar[bool] = True
    """Pixels at depth steps are mixtures of both sides."""

    def __init__(self, root: str, benchmark: Literal["lu", "middlebury8"], scenes: SceneSelection = None) -> None:
        if benchmark not in eight_bit.BENCHMARKS:
            raise ValueError(f"benchmark: expected one of {', '.join(eight_bit.BENCHMARKS)}, got {benchmark}")
        frames = list_frames(eight_bit.find_frames, root, benchmark)
        found = add_note(make_records(frames, eight_bit.load_frame, benchmark), NOTE)
        super().__init__(benchmark, root, found, eight_bit.BENCHMARKS[benchmark].scenes, scenes, Preparation(None))
