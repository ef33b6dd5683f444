"""Report page ``index.html``: one self-contained HTML file of an evaluation."""

from __future__ import annotations

import functools
import html
import math
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsr.evaluation.results import BenchmarkSetting, Results
from dsr.geometry.lights import BASIS, LIGHTS, VIEWING_LIGHT
from dsr.pictures.canvas import HOLE_COLOUR
from dsr.report.html_page import asset, block, fill, json_text, palette
from dsr.report.page.content import links, metrics_data, problem_data, run_data, standings
from dsr.report.page.scene_content import View, calibration_data, scene_data, views_of
from dsr.report.page.value_pictures import LEVELS, Level, PictureStore, megabytes
from dsr.report.worker_pool import WorkerPool
from dsr.utils.files import write_text
from dsr.utils.progress import Steps

_COLOUR_MAPS = {"depth": "viridis", "error": "RdBu_r", "angle": "magma"}
_SCRIPTS = ("core.js", "values.js", "tables.js", "scenes.js", "report.js")
_SAMPLE = 6
"""Number of scenes from which the total size is estimated."""


class _TooLargeError(Exception):
    """The pictures exceed the budget."""


@dataclass(frozen=True)
class _Stored:
    """Pictures of all scenes, data of the scenes (None for a scene without pictures), and notes."""

    pool: PictureStore
    scenes: list[dict[str, Any] | None]
    notes: list[str]


class _Scene(NamedTuple):
    """A view: its setting, its scene, and the numbers of its runs."""

    problem: BenchmarkSetting
    name: str
    runs: tuple[int, ...]


class Pictures:
    """The pictures of all scenes and the agreement of the errors, which the workers begin at once.

    Args:
        workers: runs, and what encodes their pictures.

    Attributes:
        calibration: yields the result of :func:`dsr.report.page.scene_content.calibration_data` of each setting.

    """

    def __init__(self, workers: WorkerPool) -> None:
        self.results = workers.results
        self.views = views_of(workers.results)
        self._workers = workers
        self._first = self._encode(LEVELS[0])
        self.calibration = workers.map(calibration_data, workers.results.problems())

    def stored(self, budget: float, progress: Steps) -> _Stored:
        """Encode the pictures at the best level within the budget in bytes, otherwise at the last level."""
        for level in LEVELS[:-1]:
            encoded = self._first if level is LEVELS[0] else self._encode(level)
            try:
                return _at_level(encoded, level, len(self.views), budget, progress)
            except _TooLargeError:
                encoded.close()
        return _at_level(self._encode(LEVELS[-1]), LEVELS[-1], len(self.views), math.inf, progress)

    def _encode(self, level: Level) -> Generator[_Encoded]:
        """Return the encoded scenes in the order of :func:`_spread`."""
        numbers = {id(run): number for number, run in enumerate(self.results.runs)}
        views = [self.views[number] for number in _spread(len(self.views))]
        scenes = [_Scene(view.problem, view.scene, tuple(numbers[id(run)] for run in view.runs)) for view in views]
        return self._workers.map(functools.partial(_encode_scene, level), scenes)


_Encoded = tuple[dict[str, Any] | None, PictureStore, list[str]]
"""Data of a scene, its pictures, and notes."""


def _encode_scene(level: Level, results: Results, scene: _Scene) -> _Encoded:
    """Encode the pictures of a scene."""
    pool, notes = PictureStore(level), list[str]()
    view = View(scene.problem, scene.name, tuple(results.runs[number] for number in scene.runs))
    return scene_data(view, pool, notes), pool, notes


def save_page(
    path: Path,
    results: Results,
    *,
    tables: Sequence[Path] | None = None,
    title: str = "dsr report",
    budget_mb: float = 60,
    progress: Steps | None = None,
    pictures: Pictures | None = None,
    leaderboard: bool = False,
) -> list[str]:
    """Write a page with the scores, renderings, errors, times and settings of runs, atomically.

    The page works as a local file, without a server. It computes the renderings from 8-bit normals, so they differ from
    :func:`dsr.geometry.surface.render` by quantization only.

    Args:
        path: HTML file.
        results: runs.
        tables: files to link to, below the folder of the page; None for those in ``tables`` beside the page.
        title: title of the page.
        budget_mb: maximum size of the pictures, megabytes. Pictures are stored losslessly if they fit, otherwise with
            increasing compression, then at lower resolution; the page reports the choice.
        progress: called with the number of finished scenes and of all; restarts if more compression is needed.
        pictures: the runs' pictures, if they are under way; None to encode them here.
        leaderboard: whether the tables begin with the methods by mean rank.

    Returns:
        Notes on what could not be shown and how the pictures were stored.

    Raises:
        ValueError: the budget is not positive.

    """
    if not budget_mb > 0:
        raise ValueError(f"budget_mb: expected a positive number of megabytes, got {budget_mb!r}")
    pictures = Pictures(WorkerPool(results)) if pictures is None else pictures
    views = pictures.views
    stored = pictures.stored(1e6 * budget_mb, progress or (lambda done, total: None))
    shown = [(view, scene) for view, scene in zip(views, stored.scenes, strict=True) if scene is not None]
    notes = stored.notes
    if shown:
        notes = [f"pictures: {stored.pool.level.text(stored.pool.reduced)}; {megabytes(stored.pool.size)}", *notes]
    problems = results.problems()
    data = {
        **_data(path, results, list(pictures.calibration), tables, title),
        "notes": [*results.remarks, *notes],
        "standings": standings(results) if leaderboard else [],
        "scenes": [
            {"problem": problems.index(view.problem), "name": view.scene, "data": f"s{number}"}
            for number, (view, _) in enumerate(shown)
        ],
    }
    blocks = [block("data", json_text(data))]
    blocks += [block(f"s{number}", json_text(scene)) for number, (_, scene) in enumerate(shown)]
    blocks += [block(name, content, "text/plain") for name, content in stored.pool.pictures.items()]
    parts = {
        "TITLE": html.escape(title),
        "STYLE": asset("report.css"),
        "SCRIPT": asset(*_SCRIPTS),
        "DATA": "\n".join(blocks),
    }
    write_text(path, fill("report.html", parts))
    return notes


def _at_level(encoded: Iterable[_Encoded], level: Level, count: int, budget: float, progress: Steps) -> _Stored:
    """Collect the pictures of all scenes."""
    pool = PictureStore(level)
    notes: dict[int, list[str]] = {}
    scenes: dict[int, dict[str, Any] | None] = {}
    for done, (number, (scene, pictures, remarks)) in enumerate(zip(_spread(count), encoded, strict=True), start=1):
        pool.merge(pictures)
        scenes[number], notes[number] = scene, remarks
        expected = pool.size * count / done if done == _SAMPLE else pool.size
        if expected > budget:
            raise _TooLargeError
        progress(done, count)
    ordered = range(count)
    distinct_notes = dict.fromkeys(note for number in ordered for note in notes[number])
    return _Stored(pool, [scenes[number] for number in ordered], list(distinct_notes))


def _spread(count: int) -> Iterator[int]:
    """Yield the numbers below ``count``, first a sample of evenly spaced ones."""
    first = dict.fromkeys(int(number) for number in np.linspace(0, count - 1, min(count, _SAMPLE)).round())
    yield from first
    yield from (number for number in range(count) if number not in first)


def _data(
    path: Path,
    results: Results,
    calibration: Sequence[list[dict[str, Any]]],
    tables: Sequence[Path] | None,
    title: str,
) -> dict[str, Any]:
    """Return the data of the page without scenes and pictures."""
    problems = results.problems()
    return {
        "title": title,
        "metrics": metrics_data(results),
        "problems": [
            {**problem_data(results, problem), "calibration": agreement}
            for problem, agreement in zip(problems, calibration, strict=True)
        ],
        "methods": results.methods(),
        "seeds": sorted({run.seed for run in results.runs}),
        "runs": [run_data(run) for run in results.runs],
        "links": links(path.parent, tables),
        "lights": {name: light.direction for name, light in LIGHTS.items()},
        "basis": BASIS,
        "free": VIEWING_LIGHT,
        "hole": HOLE_COLOUR,
        "colours": {use: palette(name) for use, name in _COLOUR_MAPS.items()},
    }
