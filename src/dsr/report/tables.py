"""Scores in the units of the paper's tables, beside the published values."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from importlib import resources

import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from dsr.evaluation.results import Run
from dsr.metrics.formats import HEADLINES, Formats, describe_directions, in_tables

PAPER_METHODS = {"bicubic": "Bicubic", "dip": "DIP", "dip_v": "DIP-V", "msg": "MSG", "msg_v": "MSG-V"}
"""Method names of the paper by name in ``scores.csv``, where the label may differ from them."""
REIMPLEMENTED = ("SRfS", "EG", "PDN", "DG")
"""Methods that the paper ran with other programs or weights than dsr's."""
PAPER_FILES = {
    "simgeo": ("lucy",),
    "middlebury": ("vintage", "recycle", "umbrella", "classroom1", "playroom", "backpack", "jadeplant"),
}
"""By data set, the scenes that the paper evaluated on: neither re-created nor other frames of the same place."""
AVERAGES = {"middlebury": "Average performance on Middlebury dataset"}
"""The paper's averages over those scenes of a data set."""
_RELEASED = ("lucy", "plant", "vintage")
"""Scenes that the paper's authors released as files, for a user's own folder."""
_FOLDER = "dsr.data.folder.Folder"
"""Reader of users' own folders."""
_PAPER_SIZE = 512
"""Height and width of the paper's pictures, pixels."""
_PAPER_SETTINGS = {"size": _PAPER_SIZE, "crop": 0.5, "fill": ["vintage"], "without_offset": ["vintage"]}
"""Settings of data sets with which their scenes are the paper's; a data set lacks some."""


@functools.cache
def published() -> pd.DataFrame:
    """Read the paper's values in its units, one row per scene, method and scale."""
    with resources.files("dsr.report").joinpath("published.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file)


def published_row(scene: str, method: str, scale: float) -> pd.Series | None:
    """Return the paper's values for a scene (by our name or the paper's) and a method (by its name in the paper)."""
    number = _published_places().get((scene.replace("_", " ").casefold(), method, scale))
    return None if number is None else published().iloc[number]


@functools.cache
def _published_places() -> dict[tuple[str, str, float], int]:
    """Return the row number in :func:`published` by scene, method and scale."""
    table = published()
    keys = zip(table["scene"].str.casefold(), table["method"], table["scale"], strict=True)
    return {(scene, method, int(scale)): number for number, (scene, method, scale) in enumerate(keys)}


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
        and scene in (_RELEASED if dataset.get("_target_") == _FOLDER else own)
        and run.downsampling == "box"
        and run.settings.get("downsampling", {}).get("range_type") is None
        and all(dataset.get(key, value) == value for key, value in _PAPER_SETTINGS.items())
        and run.size(scene) in (None, (_PAPER_SIZE, _PAPER_SIZE))
    )


def paper_name(run: Run) -> str:
    """Return the name that a run's method has in the paper, if it is there."""
    return PAPER_METHODS.get(run.method, run.label)


def paper_row(name: str, runs: Sequence[Run], scenes: Iterable[str]) -> pd.Series | None:
    """Return the paper's values to stand beside those of some runs; None where it has none, or they do not apply.

    Args:
        name: scene, or average over scenes; empty for none of the paper's.
        runs: runs of one method at one scale.
        scenes: the scene or scenes.

    """
    return published_row(name, paper_name(runs[0]), runs[0].scale) if name and runs and applies(runs, scenes) else None


def average_of(dataset: str, scenes: Iterable[str]) -> str:
    """Return the paper's name of the average over some scenes of a data set, empty for none."""
    return AVERAGES[dataset] if dataset in AVERAGES and set(scenes) == set(PAPER_FILES[dataset]) else ""


def implementation_note(methods: Iterable[str]) -> str:
    """Return what to know of our values of some methods, by their names in the paper; empty for nothing."""
    own = sorted(set(REIMPLEMENTED).intersection(methods), key=REIMPLEMENTED.index)
    return f"{', '.join(own)}: dsr's own implementation, not the one that the paper ran." if own else ""


def in_shown_units(scores: pd.DataFrame, formats: Formats) -> pd.DataFrame:
    """Return one run's scores as scene x metric, in the units of tables, worst of four lights.

    Args:
        scores: content of one ``scores.csv``.
        formats: formats of its metrics.

    """
    worst = scores[scores["variant"].fillna("").isin(HEADLINES)]
    wide = worst.pivot_table(index="scene", columns="metric", values="value", sort=False)
    columns = {name: each for name, each in in_tables(formats).items() if name in wide}
    return wide[list(columns)].mul(pd.Series({name: each.factor for name, each in columns.items()}, dtype=float))


def score_table(run: Run, formats: Formats) -> Table:
    """Build the terminal table of one run: per scene our values and the paper's, then the mean."""
    ours = in_shown_units(run.scores, formats)
    columns = {str(name): formats[str(name)] for name in ours}
    about = f"{run.label} on {run.dataset}, x{run.scale}, {run.downsampling} downsampling"
    title = f"{about} - {describe_directions(columns)}"
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("scene", overflow="fold")
    table.add_column("from")
    for column in columns.values():
        table.add_column(escape(f"{column.heading}\n{column.unit}"), justify="right", no_wrap=True)
    scenes = [str(scene) for scene in ours.index]
    papers = [paper_row(scene, [run], [scene]) for scene in scenes]
    for scene, (_, values), paper in zip(scenes, ours.iterrows(), papers, strict=True):
        table.add_row(escape(scene), "dsr", *_cells(values, columns))
        if paper is not None and _has_any(paper, columns):
            table.add_row("", "paper", *_cells(paper, columns), style="dim")
    if len(ours) > 1:
        table.add_section()
        table.add_row("mean", "dsr", *_cells(ours.mean(), columns), style="bold")
        paper = paper_row(average_of(run.dataset, scenes), [run], scenes)
        if paper is not None and _has_any(paper, columns):
            table.add_row("", "paper", *_cells(paper, columns), style="dim")
    if any(paper is not None for paper in papers):
        table.caption = implementation_note([paper_name(run)]) or None
        table.caption_justify = "left"
    return table


def _has_any(values: pd.Series, columns: Formats) -> bool:
    """Return whether a row has a value for one of the columns."""
    return bool(values.reindex(list(columns)).notna().any())


def _cells(values: pd.Series, columns: Formats) -> list[str]:
    """Format the values of a row with the digits of each column; "-" for missing values."""
    return [each.text(values[name]) if pd.notna(values.get(name)) else "-" for name, each in columns.items()]
