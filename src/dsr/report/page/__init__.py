"""Report page ``index.html``: one self-contained HTML file of an evaluation."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dsr.evaluation.results import BenchmarkSetting, Results, one_per_method
from dsr.geometry.lights import BASIS, LIGHTS, VIEWING_LIGHT
from dsr.pictures.canvas import HOLE_COLOUR
from dsr.report.html_page import asset, fill, json_text, palette
from dsr.report.page.content import links, metrics_data, problem_data, run_data, standings
from dsr.report.page.scene_content import PictureStore, calibration_data, scene_data
from dsr.report.shown_scenes import View, views_of
from dsr.report.worker_pool import WorkerPool
from dsr.utils.files import write_text
from dsr.utils.progress import Steps, megabytes

_LONGEST = 1024
"""Longer side of a picture, pixels, if none is given and the page has few surfaces."""
_MOST_PIXELS = 48 * _LONGEST**2
"""Of all surfaces of a page together, if no size is given; they take 1 to 4 bytes each."""
_COLOUR_MAPS = {"depth": "viridis", "error": "RdBu_r", "angle": "magma"}
_SCRIPTS = ("core.js", "values.js", "tables.js", "scenes.js", "report.js")


class Pictures:
    """The pictures of all scenes and the agreement of their errors, which the workers begin at once."""

    def __init__(self, workers: WorkerPool, longest: int | None = None) -> None:
        self.results = workers.results
        problems = self.results.problems()
        views = [view for problem in problems for view in views_of(self.results, problem)]
        surfaces = sum(len(view.runs) + 2 for view in views)  # with input and truth
        self.longest = longest or min(_LONGEST, math.isqrt(_MOST_PIXELS // max(surfaces, 1)))
        self.places = [(view.problem, view.scene) for view in views]
        self.scenes: Iterator[_Encoded] = workers.map(functools.partial(_encode_scene, self.longest), self.places)
        self.calibration = workers.map(calibration_data, problems)


_Encoded = tuple[dict[str, Any] | None, PictureStore, list[str]]
"""Data of a scene (None for a scene without pictures), its pictures, and notes."""


def _encode_scene(longest: int, results: Results, place: tuple[BenchmarkSetting, str]) -> _Encoded:
    """Encode the pictures of a scene."""
    problem, scene = place
    view = View(problem, scene, one_per_method(results.by_scene(problem)[scene]))
    store, notes = PictureStore(longest), list[str]()
    return scene_data(view, store, notes), store, notes


def save_page(
    path: Path,
    pictures: Pictures,
    *,
    title: str = "dsr report",
    progress: Steps | None = None,
    leaderboard: bool = False,
) -> list[str]:
    """Write a page with the scores, renderings, errors, times and settings of runs, atomically; return notes on it.

    The page works as a local file, without a server, and links to the tables, figures and correlations beside it. It
    computes the renderings from 8-bit normals, so they differ from :func:`dsr.geometry.surface.render` by quantization
    only. The tables of a ``leaderboard`` begin with the methods by mean rank.
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
        "metrics": metrics_data(results),
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
