"""The page: one self-contained HTML file without network access."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from dsr.geometry.shading import VIEWING_LIGHT, VIEWING_TONES
from dsr.utils.files import write_text
from dsr.utils.guards import opened
from dsr.viewer.surfaces import Packed

MARK = '<meta name="generator" content="dsr view">'
"""What a page begins with that a new one may replace."""
_SCRIPTS = ("decode.js", "mesh.js", "scene.js", "controls.js", "page.js")
_COLOURS = "magma"


def save_view(path: Path, results: Sequence[Packed], *, title: str, notes: Sequence[str] = ()) -> None:
    """Write the page atomically.

    A content security policy allows the page's own script, style and pictures alone, so that it cannot ask any server.
    All names are escaped, or shown as text by the script.

    Args:
        path: HTML file.
        results: packed results; one at least.
        title: title of the page.
        notes: remarks on the page as a whole.

    """
    style, script = _asset("view.css"), "\n".join(_asset(name) for name in _SCRIPTS)
    script = f'"use strict";\n{script}'
    policy = (
        f"default-src 'none'; img-src data: blob:; style-src '{_digest(style)}'; script-src '{_digest(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    content = {
        "title": title,
        "notes": list(notes),
        "light": VIEWING_LIGHT,
        "tones": VIEWING_TONES,
        "colours": mpl.colormaps[_COLOURS](np.arange(256), bytes=True)[:, :3].tobytes().hex(),
        "results": [{**result.about, "thumb": _data_url(result.pictures["thumb"])} for result in results],
    }
    parts = {
        "MARK": MARK,
        "POLICY": policy,
        "TITLE": html.escape(title),
        "STYLE": style,
        "SCRIPT": script,
        "STATIC": "\n".join(_static(result) for result in results),
        "DATA": "\n".join(_blocks(content, results)),
    }
    write_text(path, re.sub(r"\{\{([A-Z]+)\}\}", lambda found: parts[found.group(1)], _asset("view.html")))


def is_view(path: Path) -> bool:
    """Return whether a file is a page of this command."""
    with opened(path) as file:
        return MARK.encode() in file.read(1024)


def _blocks(content: Mapping[str, Any], results: Sequence[Packed]) -> list[str]:
    """Return the data as elements that a browser neither shows nor runs."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    text = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    blocks = [f'<script type="application/json" id="content">{text}</script>']
    for number, result in enumerate(results):
        blocks += [
            f'<script type="text/plain" id="{name}-{number}">{data}</script>' for name, data in result.data.items()
        ]
    return blocks


def _static(result: Packed) -> str:
    """Return the pictures of a result for browsers without WebGL."""
    name, holes = html.escape(result.about["name"]), "; holes are pink"
    figures = []
    for key, text in (("before", "before: the depth map as it came"), ("after", "after")):
        if key in result.pictures:
            pink = holes if result.about[key]["holes"] else ""
            alt = f"{name}, {text}, as a grey surface lit from the upper left{pink}"
            picture = f'<img src="{_data_url(result.pictures[key])}" alt="{alt}">'
            figures.append(f"<figure>{picture}<figcaption>{text}{pink}</figcaption></figure>")
    return f'<section class="still"><h2>{name}</h2><div class="pair">{"".join(figures)}</div></section>'


def _data_url(jpeg: bytes) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"


def _asset(name: str) -> str:
    """Read an asset of the package."""
    return resources.files("dsr.viewer").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """Return the hash of a text in the form of a content security policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
