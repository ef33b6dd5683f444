"""The page: its parts put into one file that needs no other and asks nobody."""

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

    A content security policy lets it run its own script and style and show its own pictures, and nothing else: it
    cannot send anything anywhere (W3C "Content Security Policy Level 3").

    Args:
        content: what ``study.js`` reads: the study, what each person sees, scenes and pictures.
        title: of the page.
        send_to: what to do with the file of answers.

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
    """Return a part of the page as it lies in the package."""
    return resources.files("dsr.user_study").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """Return a text's hash as a content security policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
