"""Hashes of files, and of code outside of the package."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterable
from pathlib import Path

from dsr.utils.limits import opened


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        OSError: it cannot be read.

    """
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_outside_code(targets: Iterable[str]) -> str | None:
    """Return a hash of the modules outside of this package that classes and functions come from; None for no such.

    A module in a package stands for all modules in its folder and the folders below.

    Args:
        targets: dotted paths, ``module.name``.

    """
    own = __name__.partition(".")[0]
    modules = sorted({target.rpartition(".")[0] for target in targets if target.partition(".")[0] != own})
    digest = hashlib.sha256()
    for name in modules:
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, ValueError):  # what cannot be imported is refused where it is built
            continue
        if spec is None or spec.origin is None:
            continue
        path = Path(spec.origin)
        for file in [path] if "." not in name else sorted(path.parent.rglob("*.py")):
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16] if modules else None
