"""``dataset=sintel``: rendered scenes to train on.

Hui et al. 2016 trained MSG on 58 images of MPI Sintel, and Voynov et al. 2019 MSG-V on patches of them. They do not say
which. This data set has two or three frames of each sequence, 58 in all.
"""

from __future__ import annotations

from typing import Literal

from dsr.data.base import SceneSelection
from dsr.data.formats import sintel
from dsr.data.preparation.dataset import Preparation, PreparedDataset, list_frames, make_records

_SEQUENCES_WITH_THREE = 12
"""Number of sequences of which three frames are used, not two: 2 x 23 + 12 = 58."""


def sintel_frames() -> tuple[str, ...]:
    """Return the 58 frames: those at a third and two thirds of each sequence, and the first of twelve sequences."""
    frames = []
    for index, (sequence, length) in enumerate(sintel.SEQUENCES.items()):
        numbers = [1] if index < _SEQUENCES_WITH_THREE else []
        frames += [f"{sequence}_frame_{number:04d}" for number in (*numbers, length // 3, 2 * length // 3)]
    return tuple(frames)


class Sintel(PreparedDataset):
    """Frames of MPI Sintel (Butler et al., ECCV 2012).

    Args:
        root: directory of ``training``.
        scenes: names of the scenes to use; None for 58, ``found`` for all that are there.
        size: largest length of the shorter side in pixels; None for the original size.
        rendering: ``clean``, or ``final`` with blur, fog and the like.
        farthest: depth in metres beyond which pixels are sky, that is, missing.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    evaluation = False

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = None,
        rendering: Literal["clean", "final"] = "clean",
        farthest: float = sintel.FARTHEST,
    ) -> None:
        frames = list_frames(sintel.find_frames, root, rendering)
        found = make_records(frames, sintel.load_frame, "sintel", farthest=farthest)
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__("sintel", root, found, sintel_frames(), scenes, preparation)
