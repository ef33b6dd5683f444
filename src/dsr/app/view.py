"""The command behind ``dsr view``: one page of a result, or of a folder of results."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from dsr.app.requests import ViewRequest
from dsr.app.upsample.stored import find_results, read_result
from dsr.report.surface_page import Packed, is_view, pack_result, save_view
from dsr.utils.console import ConsoleProgress, one_line, show
from dsr.utils.files import expect_target
from dsr.utils.guards import refusing_excess
from dsr.utils.progress import megabytes

_WHOLE_PAGE = 6
"""The page has at most this many times the vertices of one surface."""
_PHOTO, _SMALL_PHOTO, _FEW = 2048, 1024, 4
"""Longer side of the photos on a page of at most ``_FEW`` results, and of more, pixels."""


def view(request: ViewRequest, console: Console) -> list[str]:
    """Write the page and open it.

    Returns:
        The problems, one line each; results that cannot be read are left out.

    Raises:
        ValueError: there is no result, none can be read, or the page would replace another file.

    """
    page = request.page or request.output / "view.html"
    expect_target(page)
    if page.exists() and not (page.is_file() and is_view(page)):
        raise ValueError(f"{page}: is there already and no page of `dsr view`; take another -o")
    folders = find_results(request.output)
    chosen = [folders[at] for at in _spread(len(folders), request.most)]
    packed, problems = _pack(request, chosen, console)
    if not packed:
        raise ValueError("; ".join(problems))
    notes = []
    if len(chosen) < len(folders):
        notes.append(f"{len(chosen)} of {len(folders)} results, taken at equal distances; --most N shows more.")
    if problems:
        notes.append(f"{len(problems)} of {len(chosen)} results could not be read and are left out.")
    name = request.output.resolve().name
    save_view(page, packed, title=f"{name}: depth before and after", notes=notes)
    for note in notes:
        show(console, f"  {note}")
    show(console, _summary(page, packed))
    if request.open_page and not webbrowser.open(page.resolve().as_uri()):
        show(console, "there is no browser to open it with; open it yourself, or copy it to where there is one")
    return problems


def _pack(request: ViewRequest, folders: Sequence[Path], console: Console) -> tuple[list[Packed], list[str]]:
    """Return the packed results, and what is wrong with the others."""
    each = min(request.vertices, _WHOLE_PAGE * request.vertices // len(folders))
    photo_side = _PHOTO if len(folders) <= _FEW else _SMALL_PHOTO
    packed: list[Packed] = []
    problems: list[str] = []
    for folder in ConsoleProgress(console).track(folders, "read", label=lambda path: path.name, lines=False):
        name = "/".join(folder.relative_to(request.output).parts) or request.output.resolve().name
        try:
            with refusing_excess():
                packed.append(pack_result(read_result(folder, name), each, photo_side))
        except (ValueError, OSError) as error:
            problems.append(one_line(error))
    return packed, problems


def _spread(count: int, most: int) -> list[int]:
    """Return at most ``most`` of the numbers below ``count``, at equal distances, the first and the last among them."""
    return sorted({int(at) for at in np.linspace(0, count - 1, min(count, most)).round()})


def _summary(page: Path, packed: Sequence[Packed]) -> str:
    """Return what was written, and how surfaces were reduced."""
    count = "1 result" if len(packed) == 1 else f"{len(packed)} results"
    largest = max(each.vertices for each in packed)
    factors = sorted({each.about["after"]["factor"] for each in packed})
    reduced = "" if factors == [1] else f", maps reduced by {' or '.join(map(str, factors))} each way"
    return f"{count}, at most {largest:,} vertices each{reduced}, {megabytes(page.stat().st_size)} -> {page}"
