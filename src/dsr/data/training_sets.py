"""``dataset=middlebury_train`` and ``dataset=sintel``: real and rendered scenes to train on.

Hui et al. 2016 trained MSG on 34 images of Middlebury (6 of 2001, 10 of 2006, 18 of 2014) and 58 of MPI Sintel, and
Voynov et al. 2019 MSG-V on patches of both. Which ones is not published. Here: all of 2001 and 2006, of 2014 all but
the seven that are evaluated on, and 58 frames of Sintel, two or three of each sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from dsr.data.base import Wanted
from dsr.data.formats import sintel
from dsr.data.middlebury import EVALUATION_2014, SCENES, TRAINING_2014, records_2014, records_levels
from dsr.data.native import Native, Preparation, Record, listed, records_of

MIDDLEBURY = {2001: SCENES[2001], 2006: SCENES[2006], 2014: TRAINING_2014}
"""Scenes by year."""
_SINTEL_THIRDS = 12
"""Of so many sequences a third frame is used: 2 x 23 + 12 = 58."""


def sintel_frames() -> tuple[str, ...]:
    """Return the 58 frames: of each sequence those a third and two thirds in, of the first twelve the first, too."""
    frames = []
    for index, (sequence, length) in enumerate(sintel.SEQUENCES.items()):
        numbers = [1] if index < _SINTEL_THIRDS else []
        frames += [f"{sequence}_frame_{number:04d}" for number in (*numbers, length // 3, 2 * length // 3)]
    return tuple(frames)


class MiddleburyTrain(Native):
    """Scenes of Middlebury 2001, 2006 and 2014 that nothing is evaluated on.

    Args:
        root: where the folders ``middlebury2001``, ``middlebury2006`` and ``middlebury2014`` lie.
        scenes: names of the ones to use; None for all of the years, ``found`` for those that are there.
        size: of the shorter side, at most, in pixels; None for scenes as they are.
        years: which years to use.

    Raises:
        ValueError: a scene is not there, or a value is out of range.

    """

    evaluation = False

    def __init__(
        self, root: str, scenes: Wanted = None, size: int | None = 720, years: Sequence[int] = tuple(MIDDLEBURY)
    ) -> None:
        name, folder = "middlebury_train", Path(root).expanduser()
        found: dict[str, Record] = {}
        for year in years:
            if year not in MIDDLEBURY:
                raise ValueError(f"dataset.years: expected some of {', '.join(map(str, MIDDLEBURY))}, got {year}")
            place = folder / f"middlebury{year}"
            found |= records_2014(place, name) if year == 2014 else records_levels(place, name, year)
        for scene in EVALUATION_2014:
            found.pop(scene, None)
        named = [scene for year in years for scene in MIDDLEBURY[year]]
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__(name, folder, found, named, scenes, preparation)


class Sintel(Native):
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
        scenes: Wanted = None,
        size: int | None = None,
        rendering: Literal["clean", "final"] = "clean",
        farthest: float = sintel.FARTHEST,
    ) -> None:
        folder = Path(root).expanduser()
        frames = listed(sintel.find_frames, folder, rendering)
        found = records_of(frames, sintel.load_frame, "sintel", farthest=farthest)
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__("sintel", folder, found, sintel_frames(), scenes, preparation)
