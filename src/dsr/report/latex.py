"""Tables as LaTeX with booktabs rules: for inclusion in a paper, or as a complete document."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Sequence

from dsr.report.table_parts import Cell, Column, Group, PaperTable, Row, Style

MISSING = "--"
_END = "\\end{table}\n"
_ROWS, _ROWS_TURNED = 42, 26
"""Maximum rows of a portrait and of a landscape page."""
_WIDE = 135
"""Maximum characters of a row that is legible on a portrait page."""
_SPECIAL = {
    "\\": "\\textbackslash{}", "{": "\\{", "}": "\\}", "$": "\\$", "&": "\\&", "#": "\\#", "%": "\\%", "_": "\\_",
    "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "<": "\\textless{}", ">": "\\textgreater{}",
    "|": "\\textbar{}", '"': "\\textquotedbl{}", "`": "\\textasciigrave{}",
    "\N{PLUS-MINUS SIGN}": "$\\pm$", "\N{EN DASH}": "--", "\N{MULTIPLICATION SIGN}": "$\\times$",
}  # fmt: skip
_LAST_LETTER = 0x17F
"""Last code point of Latin Extended-A; the font encoding T1 has no letters after it."""
_HEAD = r"""\documentclass{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\IfFileExists{lmodern.sty}{\usepackage{lmodern}}{}
\usepackage{textcomp}
\usepackage[a4paper,margin=18mm]{geometry}
\usepackage{booktabs,graphicx,pdflscape}
\setlength{\parindent}{0pt}
\begin{document}
"""


def to_document(tables: Sequence[PaperTable]) -> str:
    """Return a complete document with all tables, each also with the paper's values."""
    parts = [_HEAD]
    for table in tables:
        for published in (False, True)[: 1 + table.has_published]:
            text = to_latex(table, published=published)
            text = text.replace(_END, f"{_END}\\clearpage\n")  # landscape does not turn pages of floats alone
            turned = _width(table, published=published) > _WIDE
            parts.append(f"\\begin{{landscape}}\n{text}\\end{{landscape}}\n" if turned else text)
    return "\n".join([*parts, "\\end{document}\n"])


def to_latex(table: PaperTable, *, published: bool = False) -> str:
    r"""Return a table as LaTeX for ``\input``; it needs the packages booktabs and graphicx, and the encoding T1.

    A table is at most as wide as the text. A table too long for a page is split.

    Args:
        table: table to write.
        published: whether to add the paper's values in parentheses, without spreads and intervals.

    """
    columns = table.published_columns() if published else table.columns
    groups = [list(_rows(table, group, columns, published=published)) for group in table.groups]
    most = _ROWS_TURNED if _width(table, published=published) > _WIDE else _ROWS
    pages = list(_pages([rows for rows in groups if rows], most))
    return "\n".join(_page(table, columns, page, number, published) for number, page in enumerate(pages))


def latex_text(text: str) -> str:
    r"""Escape a text for LaTeX, on one line; letters missing from the fonts become code points such as U+65E5."""
    composed = unicodedata.normalize("NFC", " ".join(text.split()))
    return "".join(map(_letter, composed))


def _heading(column: Column) -> str:
    """Format the name of a metric with the part after the underscore as a subscript."""
    name, _, index = column.heading.partition("_")
    return latex_text(name) + (f"$_{{{latex_text(index)}}}$" if index else "")


def _letter(letter: str) -> str:
    if letter in _SPECIAL:
        return _SPECIAL[letter]
    plain = letter.isascii() and letter.isprintable()
    return letter if plain or (letter.isalpha() and ord(letter) <= _LAST_LETTER) else f"[U+{ord(letter):04X}]"


def _pages(groups: Sequence[list[str]], most: int) -> Iterator[list[list[str]]]:
    """Yield the rows of each page by group, at most ``most``; a group that fits on one page is not split."""
    page: list[list[str]] = []
    for rows in groups:
        for start in range(0, len(rows), most):
            part = rows[start : start + most]
            if page and sum(map(len, page)) + len(part) > most:
                yield page
                page = []
            page.append(part)
    if page:
        yield page


def _page(
    table: PaperTable, columns: Sequence[Column], groups: Sequence[Sequence[str]], number: int, published: bool
) -> str:
    """Return one table environment."""
    title = table.title + (", beside the paper's values (in parentheses)" if published else "")
    caption = f"{title}. {' '.join(table.notes)}" if number == 0 else f"{title}, continued."
    seeds = table.seeded and not published
    kinds = "ll" + "r" * seeds + "r" * len(columns)
    head = ["Scene", "Method", *(["Seeds"] if seeds else []), *(_heading(column) for column in columns)]
    units = ["", "", *([""] if seeds else []), *(latex_text(column.unit) for column in columns)]
    body = "\n\\midrule\n".join("\n".join(rows) for rows in groups)
    return rf"""\begin{{table}}[htbp]
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
{_END}"""


def _rows(table: PaperTable, group: Group, columns: Sequence[Column], *, published: bool) -> Iterator[str]:
    """Yield the lines of a group; the title is in the first line, that of an average in a line of its own."""
    title = latex_text(group.about.title)
    compared = any(row.published for row in group.rows)  # all of our rows are needed, since the best is marked
    shown = [row for row in group.rows if not published or (compared and row.cells)]
    if group.about.average and shown:
        seeds_too = table.seeded and not published
        yield f"\\multicolumn{{{2 + seeds_too + len(columns)}}}{{@{{}}l}}{{{title}}} \\\\"
        title = ""
    for row in shown:
        cells = [_beside(c, row) if published else _STYLE.text(c, row.cells.get(c.key), row.seeds) for c in columns]
        seeds = [str(row.seeds)] if table.seeded and not published else []
        title = (
            f"{{}}{title}" if title.startswith(("[", "*")) else title
        )  # else it would be an option of the rule before
        yield " & ".join([title, latex_text(row.label), *seeds, *cells]) + " \\\\"
        title = ""
    for name, values in group.paper_only.items() if published and compared else ():
        cells = [f"({values[c.key]:g})" if c.key in values else MISSING for c in columns]
        yield " & ".join([title, f"{latex_text(name)} (paper)", *cells]) + " \\\\"
        title = ""


def _beside(column: Column, row: Row) -> str:
    """Format our value and the paper's."""
    cell, paper = row.cells.get(column.key), row.published.get(column.key)
    ours = MISSING if cell is None else _STYLE.text(column, _bare(cell), 1)
    return f"{ours} ({MISSING if paper is None else f'{paper:g}'})"


def _bare(cell: Cell) -> Cell:
    """Return a cell without its spread and interval."""
    return Cell(cell.mean, scenes=cell.scenes, of=cell.of, rank=cell.rank)


def _number(text: str) -> str:
    """Format a number with a proper minus sign."""
    return f"${text}$" if text.startswith("-") else text


def _width(table: PaperTable, *, published: bool) -> int:
    """Return the number of characters of the longest row, without markup."""
    columns = table.published_columns() if published else table.columns
    wide = 0
    for group in table.groups:
        labels = [*(row.label for row in group.rows), *group.paper_only]
        for row in group.rows:
            cells = [_beside(c, row) if published else _STYLE.text(c, row.cells.get(c.key), row.seeds) for c in columns]
            plain = [text.replace("\\textbf", "").replace("\\underline", "").replace("$\\pm$", "+") for text in cells]
            shown = [max(len(text), len(c.heading)) + 2 for text, c in zip(plain, columns, strict=True)]
            title = "" if group.about.average else group.about.title
            wide = max(wide, len(title) + max(map(len, labels)) + sum(shown))
    return wide


_STYLE = Style(MISSING, {0: ("", ""), 1: ("\\textbf{", "}"), 2: ("\\underline{", "}")}, "$\\pm$", "$n = {}$", _number)
