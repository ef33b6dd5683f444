"""Report page ``index.html``: one self-contained HTML file of an evaluation."""

from __future__ import annotations

import contextlib
import functools
import html
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from dsr.evaluation.results import Results
from dsr.geometry.shading import LIGHT_NAMES, lights
from dsr.report.page.calibration import calibration_data
from dsr.report.page.content import links, metrics_data, problem_data, run_data
from dsr.report.page.encoding import LEVELS, Level, Pool, megabytes
from dsr.report.page.scenes import View, scene_data, views_of
from dsr.utils.files import write_text
from dsr.utils.progress import Steps
from dsr.viz.panels import HOLE_COLOUR

_COLOUR_MAPS = {"depth": "viridis", "error": "RdBu_r", "angle": "magma"}
_SCRIPTS = ("dom.js", "pictures.js", "tables.js", "viewer.js", "page.js")
_SAMPLE = 6
"""Number of scenes from which the total size is estimated."""


class _TooLargeError(Exception):
    """The pictures exceed the budget."""


@dataclass(frozen=True)
class _Stored:
    """Pictures of all scenes, data of the scenes (None for a scene without pictures), and notes."""

    pool: Pool
    scenes: list[dict[str, Any] | None]
    notes: list[str]


def save_page(
    path: Path,
    results: Results,
    *,
    tables: Sequence[Path] | None = None,
    title: str = "dsr report",
    budget_mb: float = 60,
    progress: Steps | None = None,
) -> list[str]:
    """Write a page with the scores, renderings, errors, times and settings of runs, atomically.

    The page works as a local file, without a server. It computes the renderings from 8-bit normals, so they differ from
    :func:`dsr.geometry.shading.render` by quantization only.

    Args:
        path: HTML file.
        results: runs.
        tables: files to link to, below the folder of the page; None for those in ``tables`` beside the page.
        title: title of the page.
        budget_mb: maximum size of the pictures, megabytes. Pictures are stored losslessly if they fit, otherwise with
            increasing compression, then at lower resolution; the page reports the choice.
        progress: called with the number of finished scenes and of all; restarts if more compression is needed.

    Returns:
        Notes on what could not be shown and how the pictures were stored.

    Raises:
        ValueError: the budget is not positive.

    """
    if not budget_mb > 0:
        raise ValueError(f"budget_mb: expected a positive number of megabytes, got {budget_mb!r}")
    views = views_of(results)
    stored = _pictures(views, 1e6 * budget_mb, progress or (lambda done, total: None))
    shown = [(view, scene) for view, scene in zip(views, stored.scenes, strict=True) if scene is not None]
    notes = stored.notes
    if shown:
        notes = [f"pictures: {stored.pool.level.text(stored.pool.reduced)}; {megabytes(stored.pool.size)}", *notes]
    problems = results.problems()
    data = {
        **_data(path, results, views, tables, title),
        "notes": [*results.notes, *notes],
        "scenes": [
            {"problem": problems.index(view.problem), "name": view.scene, "data": f"s{number}"}
            for number, (view, _) in enumerate(shown)
        ],
    }
    blocks = [_block("data", _json(data))]
    blocks += [_block(f"s{number}", _json(scene)) for number, (_, scene) in enumerate(shown)]
    blocks += [_block(name, content, "text/plain") for name, content in stored.pool.pictures.items()]
    write_text(path, _fill_template(title, blocks))
    return notes


def _pictures(views: Sequence[View], budget: float, progress: Steps) -> _Stored:
    """Encode the pictures of all scenes at the best level within the budget, otherwise at the last level."""
    for level in LEVELS[:-1]:
        with contextlib.suppress(_TooLargeError):
            return _at_level(views, level, budget, progress)
    return _at_level(views, LEVELS[-1], math.inf, progress)


def _at_level(views: Sequence[View], level: Level, budget: float, progress: Steps) -> _Stored:
    """Encode the pictures of all scenes.

    Raises:
        _TooLargeError: the size, or its estimate from the first scenes, exceeds the budget.

    """
    pool = Pool(level)
    notes: dict[int, list[str]] = {}
    scenes: dict[int, dict[str, Any] | None] = {}
    for done, number in enumerate(_spread(len(views)), start=1):
        notes[number] = []
        scenes[number] = scene_data(views[number], pool, notes[number])
        expected = pool.size * len(views) / done if done == _SAMPLE else pool.size
        if expected > budget:
            raise _TooLargeError
        progress(done, len(views))
    ordered = range(len(views))
    distinct_notes = dict.fromkeys(note for number in ordered for note in notes[number])
    return _Stored(pool, [scenes[number] for number in ordered], list(distinct_notes))


def _spread(count: int) -> Iterator[int]:
    """Yield the numbers below ``count``, first a sample of evenly spaced ones."""
    first = dict.fromkeys(int(number) for number in np.linspace(0, count - 1, min(count, _SAMPLE)).round())
    yield from first
    yield from (number for number in range(count) if number not in first)


def _data(
    path: Path, results: Results, views: Sequence[View], tables: Sequence[Path] | None, title: str
) -> dict[str, Any]:
    """Return the data of the page without scenes and pictures."""
    problems = results.problems()
    own = {problem: [view for view in views if view.problem == problem] for problem in problems}
    return {
        "title": title,
        "metrics": metrics_data(results),
        "problems": [
            {**problem_data(results, problem), "calibration": calibration_data(own[problem])} for problem in problems
        ],
        "methods": results.methods(),
        "seeds": sorted({run.seed for run in results.runs}),
        "runs": [run_data(run) for run in results.runs],
        "links": links(path.parent, tables),
        "lights": dict(zip(LIGHT_NAMES, lights().tolist(), strict=True)),
        "hole": HOLE_COLOUR,
        "colours": {use: _colours(name) for use, name in _COLOUR_MAPS.items()},
    }


@functools.cache
def _colours(name: str) -> str:
    """Return the 256 colours of a colour map, six hexadecimal digits each."""
    return mpl.colormaps[name](np.arange(256), bytes=True)[:, :3].tobytes().hex()


def _json(value: Any) -> str:
    """Serialize as JSON without characters that could begin or end an HTML tag."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _block(name: str, content: str, kind: str = "application/json") -> str:
    return f'<script type="{kind}" id="{name}">{content}</script>'


def _asset(name: str) -> str:
    return resources.files("dsr.report").joinpath("assets", name).read_text(encoding="utf-8")


def _fill_template(title: str, blocks: Sequence[str]) -> str:
    """Fill the page template."""
    parts = {
        "TITLE": html.escape(title),
        "STYLE": _asset("page.css"),
        "DATA": "\n".join(blocks),
        "SCRIPT": "\n".join(_asset(name) for name in _SCRIPTS),
    }
    page = _asset("page.html")
    for name, content in parts.items():
        page = page.replace(f"<!-- {name} -->", content, 1)
    return page
