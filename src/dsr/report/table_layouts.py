"""Tables in the layouts of readers and programs: Markdown, LaTeX with booktabs rules, CSV, and a terminal."""

import re
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from dsr.evaluation.results import Results, Run, alignment_note
from dsr.metrics.formats import PAPER, Formats, MetricFormat, by_family, describe_directions, in_tables
from dsr.report.paper import average_of, implementation_note, paper_name, paper_row
from dsr.report.tables import FACTS, Cell, Fact, Group, PaperTable, Row, build_tables, shown
from dsr.utils.files import write_text

MISSING = "\N{EN DASH}"
_SPECIAL = re.compile(r"[\\`*\[\]<>|~&#]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")
_ROWS = 26  # maximum rows of a table in LaTeX: those of a page in landscape format
_LATEX_SPECIAL = {
    "\\": "\\textbackslash{}", "{": "\\{", "}": "\\}", "$": "\\$", "&": "\\&", "#": "\\#", "%": "\\%", "_": "\\_",
    "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "<": "\\textless{}", ">": "\\textgreater{}",
    "|": "\\textbar{}", '"': "\\textquotedbl{}", "`": "\\textasciigrave{}",
    "\N{PLUS-MINUS SIGN}": "$\\pm$", "\N{EN DASH}": "--", "\N{MULTIPLICATION SIGN}": "$\\times$",
}  # fmt: skip
_LAST_LETTER = 0x17F  # last code point of Latin Extended-A; the font encoding T1 has no letters after it
_HEAD = r"""\documentclass{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\IfFileExists{lmodern.sty}{\usepackage{lmodern}}{}
\usepackage{textcomp}
\usepackage[a4paper,landscape,margin=18mm]{geometry}
\usepackage{booktabs,graphicx}
\setlength{\parindent}{0pt}
\begin{document}
"""


def write_tables(
    folder: Path, results: Results, study: pd.DataFrame | None = None, *, intervals: bool = False
) -> list[Path]:
    """Write all tables of some runs, and return the files.

    They are ``NAME.md``, ``NAME.tex``, ``NAME_published.tex`` (if the paper has values) and ``NAME.csv`` of each table,
    and ``all.md`` and ``all.tex`` with all tables.
    """
    tables = build_tables(results, study, intervals=intervals)
    texts = {"all.md": "\n".join(map(to_markdown, tables)), "all.tex": to_document(tables)}
    for table in tables:
        texts |= {f"{table.name}.md": to_markdown(table), f"{table.name}.tex": to_latex(table)}
        if table.has_published:
            texts[f"{table.name}_published.tex"] = to_latex(table, published=True)
        texts[f"{table.name}.csv"] = to_csv(table)
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


@dataclass(frozen=True)
class Style:
    """Formatting of cells in a layout."""

    escape: Callable[[str], str]  # makes a text fit for the layout
    missing: str  # text of a missing value
    marks: Mapping[int, tuple[str, str]]  # text before and after a value, by rank
    plus_minus: str  # between a value and its spread
    seeds: str  # format of the number of seeds, with ``{}``
    star: str  # mark of a value that is better than the second best by a test
    number: Callable[[str], str] = str

    def text(self, column: MetricFormat, cell: Cell | None, seeds: int) -> str:
        """Format a cell; the number of seeds is added if it differs from that of the row."""
        if cell is None or not cell.scenes:
            return self.missing if cell is None else f"{self.missing} (0 of {cell.of})"
        before, after = self.marks[cell.rank]
        text = f"{before}{self.number(shown(column, cell.mean))}{after}" + self.star * cell.significant
        if cell.spread is not None:
            text += f" {self.plus_minus} {self.number(shown(column, cell.spread))}"
        if cell.interval is not None:
            text += " [{}, {}]".format(*(shown(column, bound) for bound in cell.interval))
        if cell.seeds not in (0, seeds):
            text += f" ({self.seeds.format(cell.seeds)})"
        return text if cell.complete else f"{text} ({cell.scenes} of {cell.of})"

    def row(self, row: Row, facts: Sequence[Fact], columns: Formats, *, first: bool) -> list[str]:
        """Format our values of a row, after its identifying columns; only the first row of a group names the scene."""
        return [*self.facts(row, facts, first=first),
                *(self.text(each, row.cells.get(key), row.seeds) for key, each in columns.items())]  # fmt: skip

    def facts(self, row: Row, facts: Sequence[Fact], *, first: bool) -> list[str]:
        """Format the columns that identify a row."""
        values = ("" if fact.name == "scene" and not first else fact.value(row) for fact in facts)
        return [self.missing if value is None else self.escape(str(value)) for value in values]

    def paper(self, columns: Formats, values: Mapping[str, float], around: str = "{}") -> list[str]:
        """Format the paper's values with its own number of digits."""
        return [around.format(f"{values[key]:g}") if key in values else self.missing for key in columns]


def to_markdown(table: PaperTable) -> str:
    """Format a table as Markdown, followed by a comparison with the paper's values if there are any."""
    facts = table.facts
    words = [fact for fact in facts if not fact.number]
    rows = [
        _MARKDOWN.row(row, facts, table.columns, first=number == 0)
        for group in table.groups
        for number, row in enumerate(group.rows)
    ]
    head = [*(fact.name for fact in facts), *(escaped(each.title) for each in table.columns.values())]
    parts = [
        f"## {escaped(table.title)}",
        aligned(head, rows, len(words)),
        "\n".join(f"- {escaped(note)}" for note in table.notes),
    ]
    if table.has_published:
        columns = table.published_columns
        rows = [row for group in table.groups for row in _compared(words, columns, group)]
        head = [*(fact.name for fact in words), "", *(escaped(each.title) for each in columns.values())]
        parts += [f"### {escaped(table.title)}, beside the paper", aligned(head, rows, len(words) + 1)]
        parts += ["- Difference: ours - paper. Ratio: ours / paper."]
    return "\n\n".join(parts) + "\n"


def to_csv(table: PaperTable) -> str:
    """Format a table as CSV at full precision, in the paper's units: a row per method and scene; no empty columns."""
    rows = [
        {fact.name: fact.value(row) for fact in FACTS}
        | {name: value for key, column in table.columns.items() for name, value in _values(key, column, row)}
        for group in table.groups
        for row in (*group.rows, *map(_of_paper, group.paper_only))
    ]
    frame = pd.DataFrame(rows)
    empty = [name for name in frame.columns[len(FACTS) :] if frame[name].isna().all()]
    counts = [name for name in frame.columns if name.endswith(("seeds", " scenes")) and name not in empty]
    frame = frame.drop(columns=empty).astype(dict.fromkeys(counts, "Int64"))
    return frame.to_csv(index=False, lineterminator="\n")


def to_document(tables: Sequence[PaperTable]) -> str:
    """Return a complete document with all tables, each also with the paper's values."""
    texts = [
        to_latex(table, published=published)
        for table in tables
        for published in ((False, True) if table.has_published else (False,))
    ]
    return "\\clearpage\n".join([_HEAD, *texts, "\\end{document}\n"])


def to_latex(table: PaperTable, *, published: bool = False) -> str:
    r"""Return a table as LaTeX for ``\input``; it needs the packages booktabs and graphicx, and the encoding T1.

    A table is at most as wide as the text. A table too long for a page is split. A ``published`` one has the paper's
    values in parentheses, and no spreads and intervals.
    """
    facts, columns = table.facts, table.columns
    if published:
        facts, columns = [fact for fact in facts if not fact.number], table.published_columns
    title = table.title + (", beside the paper's values (in parentheses)" if published else "")
    kinds = "".join("r" if fact.number else "l" for fact in facts) + "r" * len(columns)
    head = [fact.name.capitalize() for fact in facts]
    for column in columns.values():
        name, _, index = column.heading.partition("_")
        head.append(latex_text(name) + (f"$_{{{latex_text(index)}}}$" if index else ""))
    units = [*("" for _ in facts), *(latex_text(column.unit) for column in columns.values())]
    groups = [list(_latex_rows(group, facts, columns, published=published)) for group in table.groups]
    texts: list[str] = []
    for page in _pages([rows for rows in groups if rows]):
        caption = f"{title}, continued." if texts else f"{title}. {' '.join(table.notes)}"
        body = "\n\\midrule\n".join("\n".join(rows) for rows in page)
        texts.append(rf"""\begin{{table}}[htbp]
\centering
\caption{{{latex_text(caption)}}}
\smallskip
\resizebox{{\ifdim\width>\linewidth \linewidth\else\width\fi}}{{!}}{{%
\begin{{tabular}}{{@{{}}{kinds}@{{}}}}
\toprule
{" & ".join(head)} \\
{" & ".join(units)} \\
\midrule
{body}
\bottomrule
\end{{tabular}}%
}}
\end{{table}}
""")
    return "\n".join(texts)


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int) -> str:
    """Format a Markdown table of escaped texts with aligned columns, of which the first ``texts`` are to the left."""
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


def latex_text(text: str) -> str:
    r"""Escape a text for LaTeX, on one line; letters missing from the fonts become code points such as U+65E5."""
    letters = []
    for letter in unicodedata.normalize("NFC", " ".join(text.split())):
        plain = letter.isascii() and letter.isprintable()
        known = plain or (letter.isalpha() and ord(letter) <= _LAST_LETTER)
        letters.append(_LATEX_SPECIAL.get(letter, letter if known else f"[U+{ord(letter):04X}]"))
    return "".join(letters)


def score_tables(run: Run, formats: Formats) -> list[Table]:
    """Build the terminal tables of one run: the paper's metrics by scene, and the means of other families."""
    wide = pd.DataFrame.from_dict(run.headlines, orient="index").dropna(axis=1, how="all")
    families = {
        family: {name: each for name, each in members.items() if name in wide}
        for family, members in by_family(in_tables(formats)).items()
    }
    tables = [_score_table(run, wide, families.pop(PAPER))] if PAPER in families else []
    return [*tables, _family_table(run, wide, families)] if families else tables


def _score_table(run: Run, wide: pd.DataFrame, columns: Formats) -> Table:
    """Build a terminal table: per scene our values, worst of four lights, and the paper's, then the mean."""
    ours = wide[list(columns)] * [each.factor for each in columns.values()]
    scenes = [str(scene) for scene in ours.index]
    rows = [(scene, ours.loc[scene], paper_row(scene, [run], [scene])) for scene in scenes]
    notes = [alignment_note([run])]
    if any(paper is not None for _, _, paper in rows):
        notes.append(implementation_note([paper_name(run)]))
    if len(ours) > 1:
        rows.append(("mean", ours.mean(), paper_row(average_of(run.dataset, scenes), [run], scenes)))
    table = _terminal_table(run, f" - {describe_directions(columns)}", "\n".join(filter(None, notes)))
    table.add_column("scene", overflow="fold")
    table.add_column("from")
    for column in columns.values():
        table.add_column(escape(f"{column.heading}\n{column.unit}"), justify="right", no_wrap=True)
    for number, (name, values, paper) in enumerate(rows):
        if number == len(scenes):
            table.add_section()
        lines = [(escape(name), "dsr", values, "bold" if number == len(scenes) else None)]
        if paper is not None and paper.reindex(list(columns)).notna().any():
            lines.append(("", "paper", paper, "dim"))
        for heading, source, found, style in lines:
            texts = [each.text(found[key]) if pd.notna(found.get(key)) else "-" for key, each in columns.items()]
            table.add_row(heading, source, *texts, style=style)
    return table


def _family_table(run: Run, wide: pd.DataFrame, families: Mapping[str, Formats]) -> Table:
    """Build a terminal table with a row a metric: its mean, least and largest value of the scenes."""
    table = _terminal_table(run, "", alignment_note([run]))
    for name in ("family", "metric", "better"):
        table.add_column(name)
    for name in ("mean", "least", "most"):
        table.add_column(name, justify="right", no_wrap=True)
    for family, members in families.items():
        for number, (name, column) in enumerate(members.items()):
            values = wide[name] * column.factor
            texts = [column.text(value) for value in (values.mean(), values.min(), values.max())]
            better = "higher" if column.higher_is_better else "lower"
            table.add_row("" if number else escape(family), escape(column.title), better, *texts)
    return table


def _terminal_table(run: Run, values: str, caption: str) -> Table:
    title = f"{run.label} on {run.dataset}, x{run.scale}, {run.downsampling} downsampling{values}"
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.caption, table.caption_justify = escape(caption) or None, "left"
    return table


def _values(key: str, column: MetricFormat, row: Row) -> Iterator[tuple[str, float | int | None]]:
    cell, paper = row.cells.get(key), row.published.get(key)
    unit = f" [{column.unit.split(', ')[-1]}]" if column.unit else ""  # the key names the threshold
    low, high = (None, None) if cell is None or cell.interval is None else cell.interval
    difference, ratio = row.against_paper(key)
    yield f"{key}{unit}", None if cell is None else cell.mean
    yield f"{key} spread{unit}", None if cell is None else cell.spread
    yield f"{key} seeds", None if cell is None or cell.spread is None else cell.seeds
    yield f"{key} scenes", None if cell is None else cell.scenes
    yield f"{key} low{unit}", low
    yield f"{key} high{unit}", high
    yield f"{key} significant", 1 if cell is not None and cell.significant else None
    yield f"{key} paper{unit}", paper
    yield f"{key} difference{unit}", difference
    yield f"{key} ratio", ratio


def _of_paper(row: Row) -> Row:
    return replace(row, label=f"{row.label} (paper)")


def _compared(facts: Sequence[Fact], columns: Formats, group: Group) -> Iterator[list[str]]:
    """Yield our value, the paper's, difference and ratio of each method in the paper, then its other methods."""
    rows = [row for row in group.rows if row.published]
    for number, row in enumerate(rows):
        ours, differences, ratios = [], [], []
        for key, column in columns.items():
            cell = row.cells.get(key)
            text = shown(column, cell.mean) if cell is not None and cell.scenes else MISSING
            ours.append(text if cell is None or cell.complete else f"{text} ({cell.scenes} of {cell.of})")
            difference, ratio = row.against_paper(key)
            text = MISSING if difference is None else shown(column, difference)
            differences.append(text if text.startswith(("-", MISSING)) else f"+{text}")
            ratios.append(MISSING if ratio is None else f"{ratio:.2f}")
        blank = [""] * len(facts)
        yield [*_MARKDOWN.facts(row, facts, first=number == 0), "ours", *ours]
        yield [*blank, "paper", *_MARKDOWN.paper(columns, row.published)]
        yield [*blank, "difference", *differences]
        yield [*blank, "ratio", *ratios]
    for number, row in enumerate(group.paper_only, len(rows)):
        yield [*_MARKDOWN.facts(row, facts, first=number == 0), "paper", *_MARKDOWN.paper(columns, row.published)]


def _pages(groups: Sequence[list[str]]) -> Iterator[list[list[str]]]:
    """Yield the rows of each page by group; a group that fits on one page is not split."""
    page: list[list[str]] = []
    for rows in groups:
        for start in range(0, len(rows), _ROWS):
            part = rows[start : start + _ROWS]
            if page and sum(map(len, page)) + len(part) > _ROWS:
                yield page
                page = []
            page.append(part)
    if page:
        yield page


def _latex_rows(group: Group, facts: Sequence[Fact], columns: Formats, *, published: bool) -> Iterator[str]:
    """Yield the lines of a group; the title is in the first line, that of an average in a line of its own."""
    compared = any(row.published for row in group.rows)  # all of our rows are needed, since the best is marked
    rows = [row for row in group.rows if not published or (compared and row.cells)]
    line, average = _beside if published else _LATEX.row, group.about.average
    lines = [line(row, facts, columns, first=number == 0 and not average) for number, row in enumerate(rows)]
    for row in map(_of_paper, group.paper_only) if published and compared else ():
        first = not lines and not average
        lines.append([*_LATEX.facts(row, facts, first=first), *_LATEX.paper(columns, row.published, "({})")])
    if average and rows:
        title = latex_text(group.about.title)
        yield f"\\multicolumn{{{len(facts) + len(columns)}}}{{@{{}}l}}{{{title}}} \\\\"
    for texts in lines:
        guard = "{}" if texts[0].startswith(("[", "*")) else ""  # else it would be an option of the rule before
        yield f"{guard}{' & '.join(texts)} \\\\"


def _beside(row: Row, facts: Sequence[Fact], columns: Formats, *, first: bool) -> list[str]:
    cells = {key: replace(cell, spread=None, seeds=1, interval=None) for key, cell in row.cells.items()}
    ours = _LATEX.row(replace(row, cells=cells, seeds=1), facts, columns, first=first)
    paper = _LATEX.paper(columns, row.published)
    return [*ours[: len(facts)], *(f"{own} ({its})" for own, its in zip(ours[len(facts) :], paper, strict=True))]


_MARKDOWN = Style(
    escaped, MISSING, {0: ("", ""), 1: ("**", "**"), 2: ("<ins>", "</ins>")}, "\N{PLUS-MINUS SIGN}", "n = {}", "\\*"
)
_LATEX = Style(
    latex_text,
    "--",
    {0: ("", ""), 1: ("\\textbf{", "}"), 2: ("\\underline{", "}")},
    "$\\pm$",
    "$n = {}$",
    "$^*$",
    lambda text: f"${text}$" if text.startswith("-") else text,  # with a proper minus sign
)
