"""Turn the cross-references of docstrings (``:func:`dsr.upsample```) into links of the documentation."""

from __future__ import annotations

import re
from typing import Any

import griffe

import dsr

_ROLE = re.compile(r":(?:func|class|mod|data|attr|meth|exc):`~?([\w.]+)`")


class Roles(griffe.Extension):
    """Replace each role by a link where the documentation has the name, else by the name alone.

    A section ``Example:`` is one of lines that run, which Griffe knows as ``Examples:``.
    """

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring is not None:
            text = obj.docstring.value.replace("\nExample:\n", "\nExamples:\n")
            obj.docstring.value = _ROLE.sub(_link, text)


def _link(role: re.Match[str]) -> str:
    """Return the link of a role; a name of ``dsr`` itself is documented where its home is."""
    name = role[1].removeprefix("dsr.").partition(".")[0]
    target = role[1].replace(f"dsr.{name}", f"{dsr._HOMES[name]}.{name}", 1) if name in dsr._HOMES else role[1]
    return f'<autoref optional identifier="{target}"><code>{role[1]}</code></autoref>'
