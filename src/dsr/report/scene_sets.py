"""The scenes of a table: one by one, and in the sets that the paper averages over (Voynov et al. 2019, summary table).

SimGeo, ICL-NUIM and Middlebury's Vintage are the paper's 13 scenes without missing measurements, Middlebury's other six
those with. Scenes of other data sets are sorted by their truth: with holes in it or without.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from dsr.report.tables import AVERAGES, OTHER_FRAMES, RECREATED

TITLES = {"simgeo": "SimGeo", "icl": "ICL-NUIM", "middlebury": "Middlebury"}
PAPER_SCENES = {
    "simgeo": (*RECREATED, "lucy"),
    "icl": ("painting", "sofa", "plant", "office", "coat_rack", "displays"),
    "middlebury": ("vintage", "recycle", "umbrella", "classroom1", "playroom", "backpack", "jadeplant"),
}
"""The scenes that the paper averages over, by data set."""
STAND_IN = "statue"
"""Of SimGeo, where Lucy is not there."""
_WITHOUT = "Average performance on the scenes without missing measurements (SimGeo, ICL-NUIM, Vintage)"
_WITH = "Average performance on the scenes with missing measurements (Middlebury excluding Vintage)"
_ALL = "Average performance on SimGeo, ICL-NUIM, Middlebury"


class Place(NamedTuple):
    """A scene of a data set."""

    dataset: str
    scene: str


@dataclass(frozen=True)
class SceneSet:
    """Scenes that a row of a table is about.

    Args:
        title: for readers.
        places: the scenes, one or more.
        published: the name of the paper's row about them; "" where it has none or where scenes of its are not here.
        recreated: whether some of the scenes only re-create the paper's.
        average: whether it is an average, if only over one scene.

    """

    title: str
    places: tuple[Place, ...]
    published: str = ""
    recreated: bool = False
    average: bool = True


def sets_of_dataset(places: Sequence[Place]) -> list[SceneSet]:
    """Return each scene of a data set, then their averages where there are two scenes or more."""
    dataset = places[0].dataset
    averages = _averages_of_dataset(dataset, places) if len(places) > 1 else []
    return [*map(_single, places), *averages]


def sets_of_summary(places: Sequence[Place], complete: Callable[[Place], bool]) -> list[SceneSet]:
    """Return the averages over each data set and those of the paper's summary; of other data sets those alike.

    Args:
        places: all scenes.
        complete: whether the truth of a scene has no hole; asked only of scenes that the paper has not.

    """
    datasets = list(dict.fromkeys(place.dataset for place in places))
    found = [each for name in datasets for each in _averages_of_dataset(name, _within(places, name))]
    found += _averages_of_paper(places)
    if any(name not in PAPER_SCENES for name in datasets):
        others = [place for place in places if place.dataset not in PAPER_SCENES]
        whole = [place for place in others if complete(place)]
        broken = [place for place in others if place not in whole]
        found += [_counted("Other scenes without missing measurements", whole)] if whole else []
        found += [_counted("Other scenes with missing measurements", broken)] if broken else []
    distinct: dict[frozenset[Place], SceneSet] = {}
    for each in found:
        distinct.setdefault(frozenset(each.places), each)
    return list(distinct.values())


def _within(places: Sequence[Place], dataset: str) -> list[Place]:
    return [place for place in places if place.dataset == dataset]


def _single(place: Place) -> SceneSet:
    """Return a scene by itself; one of another data set may be the paper's own file, in somebody's folder."""
    dataset, scene = place
    known = scene in PAPER_SCENES.get(dataset, (scene,))
    name = RECREATED.get(scene, scene.replace("_", " ")) if known else ""
    return SceneSet(scene, (place,), name, _recreated([place]), average=False)


def _recreated(places: Sequence[Place]) -> bool:
    """Return whether a scene is not of the paper's own files."""
    return any(dataset in OTHER_FRAMES or scene in (*RECREATED, STAND_IN) for dataset, scene in places)


def _of_paper(places: Sequence[Place], dataset: str) -> list[Place]:
    """Return those of the scenes that the paper averages over, the stand-in among them where it is needed."""
    own = _within(places, dataset)
    wanted = PAPER_SCENES.get(dataset, ())
    stand_in = dataset == "simgeo" and Place(dataset, "lucy") not in own
    return [place for place in own if place.scene in wanted or (stand_in and place.scene == STAND_IN)]


def _averages_of_dataset(dataset: str, places: Sequence[Place]) -> list[SceneSet]:
    """Return the average over the paper's scenes of a data set, and over all where there are others."""
    title = TITLES.get(dataset, dataset)
    paper = _of_paper(places, dataset)
    found = [_paper_set(title, paper, len(PAPER_SCENES[dataset]), AVERAGES[dataset][0])] if paper else []
    if len(paper) < len(places):
        found.append(_counted(title, places))
    return found


def _averages_of_paper(places: Sequence[Place]) -> Iterator[SceneSet]:
    """Yield the paper's averages over data sets, as far as their scenes are here."""
    all_of_them = [place for dataset in PAPER_SCENES for place in _of_paper(places, dataset)]
    broken = [place for place in all_of_them if place.dataset == "middlebury" and place.scene != "vintage"]
    whole = [place for place in all_of_them if place not in broken]
    if whole:
        yield _paper_set("Without missing measurements (SimGeo, ICL-NUIM, Vintage)", whole, 13, _WITHOUT)
    if broken:
        yield _paper_set("With missing measurements (Middlebury excluding Vintage)", broken, 6, _WITH)
    if all_of_them:
        yield _paper_set("SimGeo, ICL-NUIM, Middlebury", all_of_them, 19, _ALL)


def _paper_set(title: str, places: Sequence[Place], count: int, published: str) -> SceneSet:
    """Return an average of the paper's; without the paper's figures where scenes lack."""
    if len(places) == count:
        return SceneSet(f"{title}, average of {count} scenes", tuple(places), published, _recreated(places))
    return SceneSet(f"{title}, average of {len(places)} of the paper's {count} scenes", tuple(places))


def _counted(title: str, places: Sequence[Place]) -> SceneSet:
    """Return an average that the paper has not."""
    count = f"{len(places)} scenes" if len(places) > 1 else "1 scene"
    return SceneSet(f"{title}, average of {count}", tuple(places))
