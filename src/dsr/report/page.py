"""Report page ``index.html``: one self-contained HTML file of an evaluation.

It has scores, published values, times, settings and links; :mod:`dsr.report.page_scenes` makes its pictures.
"""

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from dsr.evaluation.results import BenchmarkSetting, Results, Run
from dsr.geometry.lights import BASIS, LIGHTS, VIEWING_LIGHT
from dsr.metrics.formats import Formats, by_family
from dsr.pictures.canvas import HOLE_COLOUR
from dsr.report.html_page import asset, fill, json_text, palette
from dsr.report.page_scenes import Encoded, PictureStore, calibration_data, encode_scene
from dsr.report.paper import SceneSet, average_of
from dsr.report.shown_scenes import views_of
from dsr.report.tables import FACTS, Fact, Row, cells_of, rows_of, values_of
from dsr.report.worker_pool import WorkerPool
from dsr.utils.files import write_text
from dsr.utils.guards import natural_key
from dsr.utils.progress import Steps, megabytes

_LONGEST = 1024  # longer side of a picture, pixels, if none is given and the page has few surfaces
_MOST_PIXELS = 48 * _LONGEST**2  # of all surfaces of a page together, if no size is given; they take 1 to 4 bytes each
_COLOUR_MAPS = {"depth": "viridis", "error": "RdBu_r", "angle": "magma"}
_SCRIPTS = ("core.js", "values.js", "tables.js", "scenes.js", "report.js")
# Folders beside the page with files to link to, and their suffixes
_FOLDERS = {"tables": (".csv", ".md", ".tex"), "metrics": (".csv",), "figures": (".pdf",)}


class Pictures:
    """The pictures of all scenes and the agreement of their errors, which the workers begin at once."""

    def __init__(self, workers: WorkerPool, longest: int | None = None) -> None:
        self.results = workers.results
        problems = self.results.problems()
        views = [view for problem in problems for view in views_of(self.results, problem)]
        surfaces = sum(len(view.runs) + 2 for view in views)  # with input and truth
        self.longest = longest or min(_LONGEST, math.isqrt(_MOST_PIXELS // max(surfaces, 1)))
        self.places = [(view.problem, view.scene) for view in views]
        self.scenes: Iterator[Encoded] = workers.map(functools.partial(encode_scene, self.longest), self.places)
        self.calibration = workers.map(calibration_data, problems)


def save_page(
    path: Path,
    pictures: Pictures,
    *,
    title: str = "dsr report",
    progress: Steps | None = None,
    leaderboard: bool = False,
) -> list[str]:
    """Write a page with the scores, renderings, errors, times and settings of runs, atomically; return notes on it.

    It links to the tables, figures and correlations beside it; a ``leaderboard`` begins with the methods by mean rank.
    """
    results = pictures.results
    problems = results.problems()
    store, notes = PictureStore(pictures.longest), list[str]()
    shown, scenes = list[dict[str, Any]](), list[str]()
    for done, ((problem, name), (scene, own, remarks)) in enumerate(zip(pictures.places, pictures.scenes, strict=True)):
        store.pictures |= own.pictures
        store.reduced |= own.reduced
        notes += [note for note in remarks if note not in notes]
        if scene is not None:
            shown.append({"problem": problems.index(problem), "name": name, "data": f"s{len(scenes)}"})
            scenes.append(json_text(scene))
        if progress is not None:
            progress(done + 1, len(pictures.places))
    if shown:
        reduced = f", reduced to {store.longest} pixels at most" if store.reduced else ""
        size = megabytes(sum(map(len, store.pictures.values())))
        notes.insert(0, f"pictures: lossless, 8 bits{reduced}; {size}")
    data = {
        "title": title,
        "metrics": [
            {
                "id": name,
                "name": each.heading,
                "unit": each.unit,
                "digits": each.digits,
                "higher": each.higher_is_better,
                "family": family,
            }
            for family, members in by_family(results.formats).items()
            for name, each in members.items()
        ],
        "problems": [
            {**problem_data(results, problem), "calibration": agreement}
            for problem, agreement in zip(problems, pictures.calibration, strict=True)
        ],
        "methods": results.methods(),
        "seeds": sorted({run.seed for run in results.runs}),
        "runs": [run_data(run) for run in results.runs],
        "links": links(path.parent),
        "lights": {name: light.direction for name, light in LIGHTS.items()},
        "basis": BASIS,
        "free": VIEWING_LIGHT,
        "hole": HOLE_COLOUR,
        "colours": {use: palette(name) for use, name in _COLOUR_MAPS.items()},
        "notes": [*results.remarks, *notes],
        "standings": standings(results) if leaderboard else [],
        "scenes": shown,
    }
    parts = {
        "TITLE": title,
        "STYLE": asset("report.css"),
        "SCRIPT": asset(*_SCRIPTS),
        "DATA": json_text(data),
        "SCENES": scenes,
        "PICTURES": store.pictures,
    }
    write_text(path, fill("report.html", parts))
    return notes


def problem_data(results: Results, problem: BenchmarkSetting) -> dict[str, Any]:
    """Return the scores of a setting in the paper's units, per scene and on average, with the published values."""
    runs, formats = results.of(problem), results.formats
    methods = list(dict.fromkeys(run.label for run in runs))
    scores = values_of(runs, formats)
    places = tuple(dict.fromkeys(place for method in methods for place in scores.get(method, ())))
    scenes = [place.scene for place in places]
    rows: list[Row] = []
    for place in places:
        about = SceneSet(place.scene, (place,), place.scene, average=False)
        having = [method for method in methods if place in scores.get(method, ())]
        rows += rows_of(about, having, runs, scores, formats)
    facts = [fact for fact in FACTS if fact.name != "seeds" and fact.shown(rows)]
    mean = SceneSet("mean", places, average_of(problem.dataset, scenes))
    seconds: dict[str, dict[str, list[float]]] = {method: {} for method in methods}
    for run in runs:
        for scene, value in run.seconds.items():
            if math.isfinite(value):
                seconds[run.label].setdefault(str(scene), []).append(float(value))
    return {
        **problem._asdict(),
        "methods": methods,
        "scenes": scenes,
        "means": [_row(row, facts, formats) for row in rows_of(mean, methods, runs, scores, formats)],
        "rows": [_row(row, facts, formats) for row in rows],
        "facts": [{"name": fact.name, "word": not fact.number} for fact in facts],
        "seconds": {  # averaged over seeds
            method: {scene: sum(values) / len(values) for scene, values in of_method.items()}
            for method, of_method in seconds.items()
        },
    }


def _row(row: Row, facts: Sequence[Fact], formats: Formats) -> dict[str, Any]:
    """Return a row; ``values`` are means with spreads, ``counts`` the numbers of scenes of incomplete averages."""
    cells = {key: cell for key, cell in row.cells.items() if cell.scenes}
    counts = {key: cell.scenes for key, cell in row.cells.items() if not cell.complete}
    return {
        **{fact.name: fact.value(row) for fact in facts},
        "seeds": row.seeds,
        "values": {key: [each for each in (cell.mean, cell.spread) if each is not None] for key, cell in cells.items()},
        "counts": counts,
        "paper": {} if counts else {key: value for key, value in row.published.items() if key in formats},
    }


def run_data(run: Run) -> dict[str, Any]:
    """Return the settings and versions of a run as text by key."""
    return {
        "folder": run.folder.name,
        **{name: getattr(run, name) for name in ("label", "dataset", "scale", "downsampling", "seed")},
        "settings": flat(run.settings),
        "versions": flat(run.versions),
    }


def flat(values: Mapping[str, Any], above: str = "") -> dict[str, str]:
    """Flatten nested values to text by dotted key."""
    found: dict[str, str] = {}
    for key, value in values.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping) and value:
            found |= flat(value, f"{name}.")
        else:
            found[name] = "none" if value is None else str(value)
    return found


def links(folder: Path) -> list[dict[str, str]]:
    """Return the existing files beside the page: name and relative address."""
    names = [
        f"{name}/{path.name}"
        for name, suffixes in _FOLDERS.items()
        for path in sorted((folder / name).glob("*"), key=natural_key)
        if path.suffix in suffixes and path.is_file()
    ]
    return [{"name": name, "address": quote(name)} for name in names]


def standings(results: Results) -> list[dict[str, Any]]:
    """Return the methods by mean rank, the best first, with the means of metrics over all settings, in table units.

    In each setting (data set, scale, degradation) the methods are ranked by the mean of each metric that all of them
    have, over the scenes that all of them have; equal displayed values share the mean of their places. Ranks are
    averaged within each family of metrics, then over the families, then over settings, so that neither many metrics of
    one kind nor a data set with many scenes decides. A method without all settings has no means and stands last.
    """
    formats = results.formats
    ranks: dict[str, list[float]] = {label: [] for label in results.methods()}
    means: dict[str, dict[str, list[float]]] = {label: {} for label in ranks}
    for problem in results.problems():
        values = values_of(results.of(problem), formats)
        places = list(dict.fromkeys(place for scenes in values.values() for place in scenes))
        averages = {name: cells_of(values, list(values), places, name) for name in formats}
        table = pd.DataFrame({name: {label: cell.mean for label, cell in of.items()} for name, of in averages.items()})
        if table.empty:
            continue
        for label, row in table.iterrows():
            for name, value in row.dropna().items():
                means[str(label)].setdefault(str(name), []).append(float(value))
        shared = table.dropna(axis=1)
        places = pd.DataFrame(
            {
                name: shared[name].round(formats[name].digits).rank(ascending=not formats[name].higher_is_better)
                for name in shared
            }
        )
        families = [places[[name for name in members if name in places]] for members in by_family(formats).values()]
        parts = [each.mean(axis=1) for each in families if not each.empty]
        overall = pd.concat(parts, axis=1).mean(axis=1) if parts else pd.Series(dtype=float)
        for label, rank in overall.dropna().items():
            ranks[str(label)].append(float(rank))
    total = len(results.problems())
    rows = [
        {
            "method": label,
            "rank": sum(own) / len(own),
            "settings": len(own),
            "values": {name: [sum(values) / total] for name, values in means[label].items() if len(values) == total},
        }
        for label, own in ranks.items()
        if own
    ]
    return sorted(rows, key=lambda row: (row["settings"] < total, row["rank"]))
