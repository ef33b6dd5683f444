"""``dataset=sintel``: rendered scenes to train on.

Hui et al. 2016 trained MSG on 58 images of MPI Sintel, and Voynov et al. 2019 MSG-V on patches of them. Which ones is
not published. Here: two or three frames of each sequence.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from dsr.data.base import SceneSelection
from dsr.data.formats import sintel
from dsr.data.preparation.records import Preparation, PreparedDataset, listed, records_of

_SINTEL_THIRDS = 12
"""Of so many sequences a third frame is used: 2 x 23 + 12 = 58."""


def sintel_frames() -> tuple[str, ...]:
    """Return the 58 frames: of each sequence those a third and two thirds in, of the first twelve the first, too."""
    frames = []
    for index, (sequence, length) in enumerate(sintel.SEQUENCES.items()):
        numbers = [1] if index < _SINTEL_THIRDS else []
        frames += [f"{sequence}_frame_{number:04d}" for number in (*numbers, length // 3, 2 * length // 3)]
    return tuple(frames)


class Sintel(PreparedDataset):
    """Frames of MPI Sintel (Butler et al., ECCV 2012).

    Args:
        root: where ``training`` lies.
        scenes: names of the ones to use; None for 58, ``found`` for all that are there.
        size: of the shorter side, at most, in pixels; None for frames as they are.
        rendering: ``clean``, or ``final`` with blur, fog and the like.
        farthest: metres beyond which a pixel is sky, a hole.

    Raises:
        ValueError: a scene is not there, or a value is out of range.

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
        folder = Path(root).expanduser()
        frames = listed(sintel.find_frames, folder, rendering)
        found = records_of(frames, sintel.load_frame, "sintel", farthest=farthest)
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__("sintel", folder, found, sintel_frames(), scenes, preparation)
