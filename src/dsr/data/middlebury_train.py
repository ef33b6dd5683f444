"""``dataset=middlebury_train``: scenes of Middlebury to train on, none of which is evaluated on.

Hui et al. 2016 trained MSG on 34 images of Middlebury (6 of 2001, 10 of 2006, 18 of 2014), and Voynov et al. 2019 MSG-V
on patches of them. Which ones is not published. Here: all of 2001 and 2006, and of 2014 all but the seven that are
evaluated on.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.middlebury import EVALUATION_2014, SCENES, TRAINING_2014, records_2014, records_levels
from dsr.data.preparation.records import Preparation, PreparedDataset, Record

MIDDLEBURY = {2001: SCENES[2001], 2006: SCENES[2006], 2014: TRAINING_2014}
"""Scenes by year."""


class MiddleburyTrain(PreparedDataset):
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
        self, root: str, scenes: SceneSelection = None, size: int | None = 720, years: Sequence[int] = tuple(MIDDLEBURY)
    ) -> None:
        name, folder = "middlebury_train", Path(root).expanduser()
        found: dict[str, Record] = {}
        for year in years:
            if year not in MIDDLEBURY:
                raise ValueError(f"years: expected some of {', '.join(map(str, MIDDLEBURY))}, got {year}")
            place = folder / f"middlebury{year}"
            found |= records_2014(place, name) if year == 2014 else records_levels(place, name, year)
        for scene in EVALUATION_2014:
            found.pop(scene, None)
        named = [scene for year in years for scene in MIDDLEBURY[year]]
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__(name, folder, found, named, scenes, preparation)
