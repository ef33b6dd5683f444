"""Turn the cross-references of docstrings (``:func:`dsr.upsample```) into links of the documentation."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:func|class|mod|data|attr|meth|exc):`~?([\w.]+)`")


class Roles(griffe.Extension):
    """Replace each role by a link where the documentation has the name, else by the name alone."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub(
                r'<autoref optional identifier="\1"><code>\1</code></autoref>', obj.docstring.value
            )
