"""``dataset=middlebury_train``: scenes of Middlebury to train on, none of which is an evaluation scene.

Hui et al. 2016 trained MSG on 34 images of Middlebury (6 of 2001, 10 of 2006, 18 of 2014), and Voynov et al. 2019 MSG-V
on patches of them. They do not say which. This data set has all scenes of 2001 and 2006, and those of 2014 without the
seven evaluation scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.middlebury import EVALUATION_2014, SCENES, TRAINING_2014, records_2014, records_levels
from dsr.data.preparation.dataset import Preparation, PreparedDataset, SceneRecord

MIDDLEBURY = {2001: SCENES[2001], 2006: SCENES[2006], 2014: TRAINING_2014}
"""Scenes by year."""


class MiddleburyTrain(PreparedDataset):
    """Scenes of Middlebury 2001, 2006 and 2014 without the evaluation scenes.

    Args:
        root: directory of the folders ``middlebury2001``, ``middlebury2006`` and ``middlebury2014``.
        scenes: names of the scenes to use; None for all of the years, ``found`` for all in ``root``.
        size: largest length of the shorter side in pixels; None for the original size.
        years: years to use.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    evaluation = False

    def __init__(
        self, root: str, scenes: SceneSelection = None, size: int | None = 720, years: Sequence[int] = tuple(MIDDLEBURY)
    ) -> None:
        name, folder = "middlebury_train", Path(root).expanduser()
        found: dict[str, SceneRecord] = {}
        for year in years:
            if year not in MIDDLEBURY:
                raise ValueError(f"years: expected some of {', '.join(map(str, MIDDLEBURY))}, got {year}")
            place = folder / f"middlebury{year}"
            found |= records_2014(place, name) if year == 2014 else records_levels(place, name, year)
        for scene in EVALUATION_2014:
            found.pop(scene, None)
        named = [scene for year in years for scene in MIDDLEBURY[year]]
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__(name, root, found, named, scenes, preparation)
