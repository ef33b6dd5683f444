"""Self-contained HTML pages without network access: their templates, scripts, styles and embedded data."""

import base64
import functools
import hashlib
import json
import re
from collections.abc import Mapping
from importlib import resources
from typing import Any

import jinja2
import matplotlib as mpl
import numpy as np

from dsr.io.photos import data_url


def asset(*names: str) -> str:
    """Return the text of files of the package, one after another, with the stylesheets that they import in place."""
    folder = resources.files("dsr.report") / "assets"
    text = "\n".join((folder / name).read_text(encoding="utf-8") for name in names)
    return re.sub(r'@import "(\w+\.css)";', lambda found: asset(found[1]), text)


def fill(template: str, parts: Mapping[str, Any]) -> str:
    """Return a Jinja template of the package with its parts, escaped unless the template calls them safe."""
    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("dsr.report", "assets"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    pages.filters["data_url"] = data_url
    return pages.get_template(template).render(parts)


def policy(style: str, script: str, images: str) -> str:
    """Return a policy (W3C CSP 3) that allows this style, this script and some sources of pictures, but no server."""
    own = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script)]
    return (
        f"default-src 'none'; img-src {images}; style-src 'sha256-{own[0]}'; script-src 'sha256-{own[1]}'; "
        "base-uri 'none'; form-action 'none'"
    )


def json_text(value: Any) -> str:
    """Serialize as JSON without characters that could begin or end an HTML tag."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


@functools.cache
def palette(name: str) -> str:
    """Return the 256 colours of a colour map, six hexadecimal digits each."""
    return mpl.colormaps[name](np.arange(256), bytes=True)[:, :3].tobytes().hex()
