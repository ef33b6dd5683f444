"""The page of a study: one self-contained HTML file without network access."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping
from importlib import resources
from typing import Any


def page_of(content: Mapping[str, Any], *, title: str, send_to: str) -> str:
    """Return the page's HTML.

    A content security policy allows only the page's own script, style and pictures, so the page cannot send data
    (W3C "Content Security Policy Level 3").

    Args:
        content: data for ``study.js``: study id, scenes per participant, scenes and pictures.
        title: title of the page.
        send_to: instruction about the answer file.

    """
    style, script = _asset("study.css"), _asset("study.js")
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; script-src '{_digest(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    parts = {
        "POLICY": policy,
        "TITLE": html.escape(title),
        "SEND_TO": html.escape(send_to),
        "STYLE": style,
        "SCRIPT": script,
        "DATA": json.dumps(content, separators=(",", ":")).replace("<", "\\u003c"),
    }
    return re.sub(r"\{\{([A-Z_]+)\}\}", lambda found: parts[found.group(1)], _asset("study.html"))


def _asset(name: str) -> str:
    """Read an asset of the package."""
    return resources.files("dsr.user_study").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """Return the hash of a text in the form of a content security policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
