"""Tables as Markdown, LaTeX and CSV files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd

from dsr.evaluation.results import Results
from dsr.report.latex import to_document, to_latex
from dsr.report.paper_tables import build_tables
from dsr.report.table_parts import Column, Group, PaperTable, Row, Style
from dsr.utils.files import write_text

__all__ = ["aligned", "to_csv", "to_latex", "to_markdown", "write_tables"]

MISSING = "\N{EN DASH}"
_STYLE = Style(MISSING, {0: ("", ""), 1: ("**", "**"), 2: ("<ins>", "</ins>")}, "\N{PLUS-MINUS SIGN}", "n = {}")
_SPECIAL = re.compile(r"[\\`*\[\]<>|~&#]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")
_FACTS_FROM = 7
"""Index of the first CSV column with values; earlier columns identify the row."""


def write_tables(folder: Path, results: Results, study: pd.DataFrame | None = None) -> list[Path]:
    """Write all tables of some runs.

    Args:
        folder: output directory for ``NAME.md``, ``NAME.tex``, ``NAME_published.tex`` (if the paper has values) and
            ``NAME.csv`` of each table, and for ``all.md`` and ``all.tex`` with all tables.
        results: runs.
        study: see :func:`dsr.report.paper_tables.build_tables`.

    Returns:
        Paths of the files.

    Raises:
        ValueError: the table of the study is invalid.

    """
    tables = build_tables(results, study)
    texts = {"all.md": "\n".join(map(to_markdown, tables)), "all.tex": to_document(tables)}
    for table in tables:
        texts |= {f"{table.name}.md": to_markdown(table), f"{table.name}.tex": to_latex(table)}
        if table.has_published:
            texts[f"{table.name}_published.tex"] = to_latex(table, published=True)
        texts[f"{table.name}.csv"] = to_csv(table)
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


def to_markdown(table: PaperTable) -> str:
    """Format a table as Markdown, followed by a comparison with the paper's values if there are any."""
    head = ["scene", "method", *(["seeds"] if table.seeded else []), *map(_heading, table.columns)]
    rows = [row for group in table.groups for row in _rows(table, group)]
    parts = [
        f"## {escaped(table.title)}",
        aligned(head, rows, 2),
        "\n".join(f"- {escaped(note)}" for note in table.notes),
    ]
    if table.has_published:
        columns = table.published_columns()
        rows = [row for group in table.groups for row in _compared(columns, group)]
        parts += [f"### {escaped(table.title)}, beside the paper"]
        parts += [aligned(["scene", "method", "", *map(_heading, columns)], rows, 3)]
        parts += ["- Difference: ours - paper. Ratio: ours / paper."]
    return "\n\n".join(parts) + "\n"


def to_csv(table: PaperTable) -> str:
    """Format a table as CSV at full precision, in the paper's units: one row per method and scene or average.

    Missing values are empty; columns without any value (spread, interval, paper) are left out.
    """
    rows = [
        {
            "kind": "average" if group.about.average else "scene",
            "scene": group.about.title,
            "dataset": " ".join(dict.fromkeys(place.dataset for place in group.about.places)),
            "scale": table.scale,
            "downsampling": table.downsampling,
            "method": row.label,
            "seeds": row.seeds or None,
            **{key: value for column in table.columns for key, value in _facts(column, row)},
        }
        for group in table.groups
        for row in (*group.rows, *(Row(f"{name} (paper)", {}, paper, 0) for name, paper in group.paper_only.items()))
    ]
    frame = pd.DataFrame(rows)
    empty = [name for name in frame.columns[_FACTS_FROM:] if frame[name].isna().all()]
    counts = [name for name in frame.columns if name.endswith(("seeds", " scenes")) and name not in empty]
    frame = frame.drop(columns=empty).astype(dict.fromkeys(counts, "Int64"))
    return frame.to_csv(index=False, lineterminator="\n")


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int) -> str:
    """Format a Markdown table with aligned columns.

    Args:
        head: headings, escaped.
        rows: cells, escaped.
        texts: number of text columns from the left; the remaining columns are numbers, aligned to the right.

    """
    widths = [max(3, *map(len, column)) for column in zip(head, *rows, strict=True)]
    rule = ["-" * width if number < texts else "-" * (width - 1) + ":" for number, width in enumerate(widths)]
    lines = []
    for row in (head, rule, *rows):
        cells = (
            text.ljust(width) if number < texts else text.rjust(width)
            for number, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def escaped(text: str) -> str:
    """Escape a text for Markdown, on one line."""
    return _SPECIAL.sub(r"\\\g<0>", " ".join(text.split()))


def _facts(column: Column, row: Row) -> Iterator[tuple[str, float | int | None]]:
    """Yield the CSV columns of one metric."""
    cell, paper = row.cells.get(column.key), row.published.get(column.key)
    unit = f" [{column.unit.split(', ')[-1]}]" if column.unit else ""  # the key names the threshold
    low, high = (None, None) if cell is None or cell.interval is None else cell.interval
    difference, ratio = (None if cell is None else cell.against(paper)) or (None, None)
    yield f"{column.key}{unit}", None if cell is None else cell.mean
    yield f"{column.key} spread{unit}", None if cell is None else cell.spread
    yield f"{column.key} seeds", None if cell is None or cell.spread is None else cell.seeds
    yield f"{column.key} scenes", None if cell is None else cell.scenes
    yield f"{column.key} low{unit}", low
    yield f"{column.key} high{unit}", high
    yield f"{column.key} paper{unit}", paper
    yield f"{column.key} difference{unit}", difference
    yield f"{column.key} ratio", ratio


def _heading(column: Column) -> str:
    return escaped(f"{column.heading} ({column.unit})" if column.unit else column.heading)


def _rows(table: PaperTable, group: Group) -> Iterator[list[str]]:
    """Yield our rows of a group, with the title in the first."""
    title = escaped(group.about.title)
    for row in group.rows:
        seeds = [str(row.seeds)] if table.seeded else []
        yield [
            title,
            escaped(row.label),
            *seeds,
            *(_STYLE.text(c, row.cells.get(c.key), row.seeds) for c in table.columns),
        ]
        title = ""


def _compared(columns: Sequence[Column], group: Group) -> Iterator[list[str]]:
    """Yield our value, the paper's, difference and ratio of each method in the paper, then its other methods."""
    title = escaped(group.about.title)
    for row in (row for row in group.rows if row.published):
        both = [_against(column, row) for column in columns]
        yield [title, escaped(row.label), "ours", *(_plain(column, row) for column in columns)]
        yield ["", "", "paper", *_paper(columns, row.published)]
        yield ["", "", "difference", *(difference for difference, _ in both)]
        yield ["", "", "ratio", *(ratio for _, ratio in both)]
        title = ""
    for name, values in group.paper_only.items():
        yield [title, name, "paper", *_paper(columns, values)]
        title = ""


def _plain(column: Column, row: Row) -> str:
    """Format a mean, with the number of scenes if some are missing."""
    cell = row.cells.get(column.key)
    if cell is None:
        return MISSING
    return column.text(cell.mean) + ("" if cell.complete else f" ({cell.scenes} of {cell.of})")


def _paper(columns: Sequence[Column], values: Mapping[str, float]) -> list[str]:
    """Format the paper's values with its own number of digits."""
    return [f"{values[column.key]:g}" if column.key in values else MISSING for column in columns]


def _against(column: Column, row: Row) -> tuple[str, str]:
    """Format the difference from the paper's value and the ratio to it."""
    cell, paper = row.cells.get(column.key), row.published.get(column.key)
    both = None if cell is None else cell.against(paper)
    if both is None:
        return MISSING, MISSING
    difference = column.text(both[0])
    return difference if difference.startswith("-") else f"+{difference}", MISSING if both[
        1
    ] is None else f"{both[1]:.2f}"
