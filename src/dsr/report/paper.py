"""The paper's values and scenes (Voynov et al. 2019), and where its values can stand beside those of runs.

Its 13 scenes without missing measurements are SimGeo, ICL-NUIM and Middlebury's Vintage; Middlebury's other six scenes
have missing measurements. Scenes of other data sets are grouped by whether their ground truth has holes.
"""

import functools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import NamedTuple

import pandas as pd

from dsr.evaluation.results import Run

# Method names of the paper by name in ``scores.csv``, where the label may differ from them
PAPER_METHODS = {"bicubic": "Bicubic", "dip": "DIP", "dip_v": "DIP-V", "msg": "MSG", "msg_v": "MSG-V"}
OF_FILES = ("external", "monocular", "onnx")  # methods whose maps or networks are files of a user's
REIMPLEMENTED = ("SRfS", "EG", "PDN", "DG")  # methods that the paper ran with other programs or weights than dsr's
# By data set, the scenes that the paper evaluated on: neither re-created nor other frames of the same place
PAPER_FILES = {
    "simgeo": ("lucy",),
    "middlebury": ("vintage", "recycle", "umbrella", "classroom1", "playroom", "backpack", "jadeplant"),
}
# The paper's averages over those scenes of a data set
AVERAGES = {"middlebury": "Average performance on Middlebury dataset"}
_RELEASED = ("lucy", "plant", "vintage")  # scenes that the paper's authors released as files, for a user's own folder
_FOLDER = "dsr.data.folder.Folder"  # reader of users' own folders
_PAPER_SIZE = 512  # height and width of the paper's pictures, pixels
# Settings of data sets with which their scenes are the paper's; a data set lacks some
_PAPER_SETTINGS = {"size": _PAPER_SIZE, "crop": 0.5}
# Settings of data sets that name scenes: those of the paper; a data set lacks some
_PAPER_SCENES = {"fill": ["vintage"], "without_offset": ["vintage"]}
TITLES = {"simgeo": "SimGeo", "icl": "ICL-NUIM", "middlebury": "Middlebury"}
# The scenes that the paper averages over, by data set; those not in PAPER_FILES are others of the same description
PAPER_SCENES = {
    "simgeo": (
        "cube_high_freq",
        "cube_no_texture",
        "sphere_cylinder_high_freq",
        "sphere_cylinder_low_freq",
        "sphere_cylinder_no_texture",
        "lucy",
    ),
    "icl": ("painting", "sofa", "plant", "office", "coat_rack", "displays"),
    "middlebury": PAPER_FILES["middlebury"],
}
STAND_IN = "statue"  # SimGeo scene used if Lucy is not available
_WITH = "Average performance on the scenes with missing measurements (Middlebury excluding Vintage)"


@functools.cache
def published() -> pd.DataFrame:
    """Read the paper's values in its units, one row per scene, method and scale."""
    with resources.files("dsr.report").joinpath("published.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file)


def published_row(scene: str, method: str, scale: float) -> pd.Series | None:
    """Return the paper's values for a scene (by our name or the paper's) and a method (by its name in the paper)."""
    return _published_rows().get((scene.replace("_", " ").casefold(), method, scale))


@functools.cache
def _published_rows() -> dict[tuple[str, str, float], pd.Series]:
    return {(row["scene"].casefold(), row["method"], int(row["scale"])): row for _, row in published().iterrows()}


def applies(runs: Iterable[Run], scenes: Iterable[str]) -> bool:
    """Return whether the paper's values of these scenes, of any method, can be compared with the runs' own."""
    scenes = list(scenes)
    return all(_is_papers(run, scene) for run in runs for scene in scenes)


def _is_papers(run: Run, scene: str) -> bool:
    """Return whether a scene is the paper's own, and downsampled and evaluated as in the paper."""
    dataset = run.settings.get("dataset", {})
    own = PAPER_FILES.get(run.dataset.partition(" (")[0], ())
    return (
        "validation_of" not in dataset
        and not run.truth
        and run.alignment == "none"
        and scene in (_RELEASED if dataset.get("_target_") == _FOLDER else own)
        and run.downsampling == "box"
        and run.settings.get("downsampling", {}).get("range_type") is None
        and all(dataset.get(key, value) == value for key, value in _PAPER_SETTINGS.items())
        and all((scene in dataset.get(key, names)) == (scene in names) for key, names in _PAPER_SCENES.items())
        and run.size(scene) in (None, (_PAPER_SIZE, _PAPER_SIZE))
    )


def paper_name(run: Run) -> str:
    """Return the name that a run's method has in the paper, if it is there.

    Maps and networks of files have labels of their own, which say nothing of how they were made.
    """
    return PAPER_METHODS.get(run.method, f"{run.label} ({run.method})" if run.method in OF_FILES else run.label)


def paper_row(name: str, runs: Sequence[Run], scenes: Iterable[str]) -> pd.Series | None:
    """Return the paper's values to stand beside those of some runs; None where it has none, or they do not apply.

    ``name`` is a scene or an average over scenes, empty for none of the paper's; the runs are of one method and scale.
    """
    return published_row(name, paper_name(runs[0]), runs[0].scale) if name and runs and applies(runs, scenes) else None


def average_of(dataset: str, scenes: Iterable[str]) -> str:
    """Return the paper's name of the average over some scenes of a data set, empty for none."""
    return AVERAGES[dataset] if dataset in AVERAGES and set(scenes) == set(PAPER_FILES[dataset]) else ""


def implementation_note(methods: Iterable[str]) -> str:
    """Return notes on our values of some methods, by their names in the paper; empty for none."""
    own = sorted(set(REIMPLEMENTED).intersection(methods), key=REIMPLEMENTED.index)
    return f"{', '.join(own)}: dsr's own implementation, not the one that the paper ran." if own else ""


class Place(NamedTuple):
    """A scene of a data set."""

    dataset: str
    scene: str


@dataclass(frozen=True)
class SceneSet:
    """The scenes of a table row."""

    title: str
    places: tuple[Place, ...]  # one or more scenes
    published: str = ""  # the paper's name of them; empty if it has none, or some are missing or not the paper's own
    average: bool = True  # whether the row is an average, possibly over one scene


def sets_of_dataset(places: Sequence[Place]) -> list[SceneSet]:
    """Return each scene of a data set, then their averages if there are at least two scenes."""
    dataset = places[0].dataset
    averages = _averages_of_dataset(dataset, places) if len(places) > 1 else []
    single = []
    for place in places:  # one of an unlisted data set may be a file of the paper in a user's folder
        in_paper = dataset not in PAPER_SCENES or place.scene in PAPER_FILES.get(dataset, ())
        single.append(SceneSet(place.scene, (place,), place.scene if in_paper else "", average=False))
    return [*single, *averages]


def sets_of_summary(
    places: Sequence[Place], complete: Callable[[Place], bool], apart: Collection[str] = ()
) -> list[SceneSet]:
    """Return the averages over each data set, those of the paper's summary, and similar ones over other data sets.

    ``complete`` says of a scene that is not the paper's whether its ground truth has no holes. Data sets in ``apart``,
    whose runs have different truths of the same scenes, are not averaged with others.
    """
    datasets = list(dict.fromkeys(place.dataset for place in places))
    found: list[SceneSet] = []
    for name in datasets:
        found += _averages_of_dataset(name, [place for place in places if place.dataset == name])
    found += _averages_of_paper(places)
    if any(name not in PAPER_SCENES for name in datasets):
        others = [place for place in places if place.dataset not in (*PAPER_SCENES, *apart)]
        without_holes = [place for place in others if complete(place)]
        whole = frozenset(without_holes)
        with_holes = [place for place in others if place not in whole]
        found += [_counted("Other scenes without missing measurements", without_holes)] if without_holes else []
        found += [_counted("Other scenes with missing measurements", with_holes)] if with_holes else []
    distinct: dict[frozenset[Place], SceneSet] = {}
    for each in found:
        distinct.setdefault(frozenset(each.places), each)
    return list(distinct.values())


def _of_paper(places: Sequence[Place], dataset: str) -> list[Place]:
    """Return the scenes that the paper averages over, including the stand-in if Lucy is missing."""
    own = [place for place in places if place.dataset == dataset]
    paper_scenes = PAPER_SCENES.get(dataset, ())
    stand_in = dataset == "simgeo" and Place(dataset, "lucy") not in own
    return [place for place in own if place.scene in paper_scenes or (stand_in and place.scene == STAND_IN)]


def _averages_of_dataset(dataset: str, places: Sequence[Place]) -> list[SceneSet]:
    """Return the average over the paper's scenes of a data set, and over all scenes if there are others."""
    title = TITLES.get(dataset, dataset)
    paper = _of_paper(places, dataset)
    name = average_of(dataset, [place.scene for place in paper])
    found = [_paper_set(title, paper, len(PAPER_SCENES[dataset]), name)] if paper else []
    if len(paper) < len(places):
        found.append(_counted(title, places))
    return found


def _averages_of_paper(places: Sequence[Place]) -> Iterator[SceneSet]:
    """Yield the paper's averages over data sets, over those of their scenes that are available."""
    available = [place for dataset in PAPER_SCENES for place in _of_paper(places, dataset)]
    with_holes = [place for place in available if place.dataset == "middlebury" and place.scene != "vintage"]
    without_holes = [place for place in available if place not in with_holes]
    if without_holes:
        yield _paper_set("Without missing measurements (SimGeo, ICL-NUIM, Vintage)", without_holes, 13)
    if with_holes:
        yield _paper_set("With missing measurements (Middlebury excluding Vintage)", with_holes, 6, _WITH)
    if available:
        yield _paper_set("SimGeo, ICL-NUIM, Middlebury", available, 19)


def _paper_set(title: str, places: Sequence[Place], count: int, published: str = "") -> SceneSet:
    """Return an average of the paper; without the paper's values if scenes are missing."""
    if len(places) == count:
        return SceneSet(f"{title}, average of {count} scenes", tuple(places), published)
    return SceneSet(f"{title}, average of {len(places)} of the paper's {count} scenes", tuple(places))


def _counted(title: str, places: Sequence[Place]) -> SceneSet:
    count = f"{len(places)} scenes" if len(places) > 1 else "1 scene"
    return SceneSet(f"{title}, average of {count}", tuple(places))
