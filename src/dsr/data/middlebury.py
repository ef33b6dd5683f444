"""``dataset=middlebury``, ``middlebury2001`` .. ``middlebury2006``: stereo benchmarks to evaluate on.

``middlebury`` has the seven scenes of the 2014 data set on which Voynov et al. 2019 evaluate, the others have all
scenes of their year. :mod:`dsr.data.middlebury_train` has scenes to train on.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.download import catalogue
from dsr.data.formats import middlebury
from dsr.data.preparation.dataset import Preparation, PreparedDataset, SceneRecord


def _names(folders: Sequence[str]) -> tuple[str, ...]:
    """Return the names of scenes: those of their folders in lower case."""
    return tuple(name.casefold() for name in folders)


EVALUATION_2014 = _names(catalogue.EVALUATION_2014)
SCENES = {
    2001: _names(catalogue.SCENES_2001),
    2003: _names(catalogue.SCENES_2003),
    2005: _names(catalogue.SCENES_2005),
    2006: _names(catalogue.SCENES_2006),
}
TRAINING_2014 = _names(catalogue.TRAINING_2014)
_WITHOUT_OFFSET = "depth is not metric: the disparity offset is left out, as in the paper"
_FILES_2014 = ("im0.png", "calib.txt", "disp0.pfm", "disp0GT.pfm")


class Middlebury(PreparedDataset):
    """Scenes of Middlebury 2014.

    Args:
        root: directory of folders such as ``Recycle-perfect`` or ``Recycle``.
        scenes: names of the scenes to use; None for the paper's seven, ``found`` for all in ``root``.
        size, crop: see :class:`dsr.data.preparation.dataset.Preparation`.
        fill: names of the scenes whose holes are inpainted.
        without_offset: names of the scenes whose disparity offset is replaced by 0, which makes their depth wrong. The
            paper does so with Vintage, but not with Recycle and Playroom.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        fill: Sequence[str] = ("vintage",),
        without_offset: Sequence[str] = ("vintage",),
    ) -> None:
        found = records_2014(Path(root).expanduser(), "middlebury", without_offset)
        super().__init__("middlebury", root, found, EVALUATION_2014, scenes, Preparation(size, crop, fill=tuple(fill)))


class MiddleburyLevels(PreparedDataset):
    """Scenes of Middlebury 2001, 2003, 2005 or 2006, with disparities in 8 bits.

    Args:
        root: directory of the scenes.
        year: year of the data set.
        scenes: names of the scenes to use; None for all of the data set, ``found`` for all in ``root``.
        size, crop: see :class:`dsr.data.preparation.dataset.Preparation`.
        fill: names of the scenes whose holes are inpainted.
        smooth: whether the steps that rounding to whole levels makes are smoothed; see
            :mod:`dsr.data.preparation.dequantization`.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        year: int,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        fill: Sequence[str] = (),
        smooth: bool = True,
    ) -> None:
        if year not in middlebury.YEARS:
            raise ValueError(f"year: expected one of {', '.join(map(str, middlebury.YEARS))}, got {year}")
        name = f"middlebury{year}"
        found = records_levels(Path(root).expanduser(), name, year, smooth=smooth)
        preparation = Preparation(size, crop, fill=tuple(fill))
        super().__init__(name, root, found, SCENES[year], scenes, preparation)


def records_2014(folder: Path, dataset: str, without_offset: Collection[str] = ()) -> dict[str, SceneRecord]:
    """Return the records of the scenes of 2014 on disk; the disparity offset of ``without_offset`` is replaced by 0."""
    return {
        name: SceneRecord(
            tuple(path for path in map(place.joinpath, _FILES_2014) if path.is_file()),
            functools.partial(middlebury.load_2014, place, dataset, name, offset=name not in without_offset),
            settings="without offset" if name in without_offset else "",
            note=_WITHOUT_OFFSET if name in without_offset else "",
        )
        for name, place in middlebury.find_2014(folder).items()
    }


def records_levels(folder: Path, dataset: str, year: int, *, smooth: bool = True) -> dict[str, SceneRecord]:
    """Return the records of the scenes of 2001 to 2006 on disk."""
    return {
        name: SceneRecord(
            tuple(path for path in (files.photo, files.disparity, files.shift, *files.measured.values()) if path),
            functools.partial(middlebury.load_levels, files, dataset, name, year, smooth=smooth),
            settings="" if smooth else "terraces",
            note=middlebury.shortcoming(files, year),
        )
        for name, files in middlebury.find_levels(folder).items()
    }
