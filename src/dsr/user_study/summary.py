"""Tables of a study for the terminal."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from dsr.user_study.collect import ALL, AVERAGE, PERCENTAGES
from dsr.utils.ratios import as_ratio

_HEADINGS = ("User 1st", "User 2nd", "Top 2")


def tables_of(collected: pd.DataFrame) -> Iterator[Table]:
    """Yield a table per data set, scale and degradation, and one over all data sets if there are several.

    Args:
        collected: see :func:`dsr.user_study.collect.collect`.

    """
    for place, rows in collected.groupby(["dataset", "scale", "downsampling"], sort=False):
        dataset, scale, downsampling = place
        others = collected[(collected["scale"] == scale) & (collected["downsampling"] == downsampling)]
        if dataset != ALL or others["dataset"].nunique() > 2:
            yield _table(rows, f"{dataset}, x{as_ratio(scale)}, {downsampling} downsampling")


def _table(rows: pd.DataFrame, where: str) -> Table:
    """Return one table; the largest percentage of each scene is bold."""
    table = Table(title=f"{escape(where)}: who chose what, %, with 95 % intervals", title_justify="left")
    table.box, table.padding = box.SIMPLE_HEAD, (0, 1, 0, 0)
    table.add_column("scene", overflow="fold")
    table.add_column("method", overflow="fold")
    for heading in _HEADINGS:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("people", justify="right")
    for scene, of_scene in rows.groupby("scene", sort=False):
        table.add_section()
        for number, (_, row) in enumerate(of_scene.iterrows()):
            cells = [_cell(row, column, bold=row[column] == of_scene[column].max() > 0) for column in PERCENTAGES]
            name = escape(str(scene)) if number == 0 else ""
            heading = f"[bold]{name}[/]" if name and scene == AVERAGE else name
            table.add_row(heading, escape(row["label"]), *cells, str(row["n"]))
    return table


def _cell(row: pd.Series, column: str, *, bold: bool) -> str:
    """Format a percentage and its interval."""
    value = f"{row[column]:.1f}"
    interval = f"{row[f'{column}_low']:.0f}-{row[f'{column}_high']:.0f}"
    return f"{f'[bold]{value}[/]' if bold else value} [dim]({interval})[/]"
