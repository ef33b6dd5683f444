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

_WHOLE_PAGE = 6  # the page has at most this many times the vertices of one surface
_PHOTO, _SMALL_PHOTO, _FEW = 2048, 1024, 4  # pixels of the photos' longer side on pages of few results, and of more


def view(request: ViewRequest, console: Console) -> list[str]:
    """Write the page and open it; return the problems of results that cannot be read, one line each."""
    page = request.page or request.output / "view.html"
    expect_target(page)
    if page.exists() and not (page.is_file() and is_view(page)):
        raise ValueError(f"{page}: is there already and no page of `dsr view`; take another -o")
    folders = find_results(request.output)
    places = np.linspace(0, len(folders) - 1, min(len(folders), request.most)).round()
    chosen = [folders[at] for at in np.unique(places.astype(int))]
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
    largest, factors = max(each.vertices for each in packed), sorted({each.about["after"]["factor"] for each in packed})
    reduced = "" if factors == [1] else f", maps reduced by {' or '.join(map(str, factors))} each way"
    count = "1 result" if len(packed) == 1 else f"{len(packed)} results"
    size = megabytes(page.stat().st_size)
    show(console, f"{count}, at most {largest:,} vertices each{reduced}, {size} -> {page}")
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
