"""Scores in the units of the paper's tables, beside the published values."""

from __future__ import annotations

import functools
from importlib import resources

import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from dsr.metrics.formats import HEADLINES, Formats, describe_directions, in_tables
from dsr.utils.ratios import as_ratio

RECREATED = {
    "cube_high_freq": "Cube, high-frequency texture",
    "cube_no_texture": "Cube, no texture",
    "sphere_cylinder_high_freq": "Sphere and cylinder, high-frequency texture",
    "sphere_cylinder_low_freq": "Sphere and cylinder, low-frequency texture",
    "sphere_cylinder_no_texture": "Sphere and cylinder, no texture",
}
"""Embedded SimGeo scenes, and the scenes of the paper that they re-create."""
OTHER_FRAMES = ("icl",)
"""Data sets for which the paper does not specify the frames of its scenes."""
AVERAGES = {
    "simgeo": ("Average performance on SimGeo dataset", 6),
    "icl": ("Average performance on ICL-NUIM dataset", 6),
    "middlebury": ("Average performance on Middlebury dataset", 7),
}
"""The paper's averages over its scenes of a data set, and the number of scenes."""
_PUBLISHED_DOWNSAMPLING = "box"


@functools.cache
def published() -> pd.DataFrame:
    """Read the paper's values in its units, one row per scene, method and scale."""
    with resources.files("dsr.report").joinpath("published.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file)


def published_row(scene: str, method: str, scale: float) -> pd.Series | None:
    """Return the paper's values for a scene (by our name or the paper's) and a method (by its name in the paper)."""
    name = RECREATED.get(scene, scene.replace("_", " "))
    number = _published_places().get((name.casefold(), method, scale))
    return None if number is None else published().iloc[number]


@functools.cache
def _published_places() -> dict[tuple[str, str, float], int]:
    """Return the row number in :func:`published` by scene, method and scale."""
    table = published()
    keys = zip(table["scene"].str.casefold(), table["method"], table["scale"], strict=True)
    return {(scene, method, int(scale)): number for number, (scene, method, scale) in enumerate(keys)}


def paper_row(scene: str, method: str, scale: float, downsampling: str) -> pd.Series | None:
    """Return the paper's values like :func:`published_row`, None for a downsampling other than the paper's."""
    return published_row(scene, method, scale) if downsampling == _PUBLISHED_DOWNSAMPLING else None


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


def score_table(scores: pd.DataFrame, label: str, formats: Formats) -> Table:
    """Build the terminal table of one run: per scene our values and the paper's, then the mean.

    Args:
        scores: content of one ``scores.csv``.
        label: name of the method in the paper.
        formats: formats of the metrics.

    """
    ours = in_shown_units(scores, formats)
    columns = {str(name): formats[str(name)] for name in ours}
    scale, downsampling = as_ratio(scores["scale"].iloc[0]), str(scores["downsampling"].iloc[0])
    dataset = str(scores["dataset"].iloc[0])
    title = f"{label} on {dataset}, x{scale}, {downsampling} downsampling - {describe_directions(columns)}"
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("scene", overflow="fold")
    table.add_column("from")
    for column in columns.values():
        table.add_column(escape(f"{column.heading}\n{column.unit}"), justify="right", no_wrap=True)
    starred = False
    for scene, values in ours.iterrows():
        table.add_row(escape(str(scene)), "dsr", *_cells(values, columns))
        paper = paper_row(str(scene), label, scale, downsampling)
        if paper is not None and _has_any(paper, columns):
            recreated = scene in RECREATED or dataset in OTHER_FRAMES
            starred |= recreated
            table.add_row("", "paper*" if recreated else "paper", *_cells(paper, columns), style="dim")
    if len(ours) > 1:
        table.add_section()
        table.add_row("mean", "dsr", *_cells(ours.mean(), columns), style="bold")
        name, count = AVERAGES.get(dataset, ("", 0))
        paper = paper_row(name, label, scale, downsampling)
        if paper is not None and len(ours) == count and _has_any(paper, columns):
            table.add_row("", "paper*" if starred else "paper", *_cells(paper, columns), style="dim")
    if starred:
        table.caption = "* of the paper's own files; the scenes here are others of the same description"
        table.caption_justify = "left"
    return table


def _has_any(values: pd.Series, columns: Formats) -> bool:
    """Return whether a row has a value for one of the columns."""
    return bool(values.reindex(list(columns)).notna().any())


def _cells(values: pd.Series, columns: Formats) -> list[str]:
    """Format the values of a row with the digits of each column; "-" for missing values."""
    return [each.text(values[name]) if pd.notna(values.get(name)) else "-" for name, each in columns.items()]
