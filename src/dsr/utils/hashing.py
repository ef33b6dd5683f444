"""Hashes of files, and of code outside of the package."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterable
from pathlib import Path

from dsr.utils.limits import opened
from dsr.utils.progress import Task

_CHUNK = 1 << 20


def file_hash(path: Path, progress: Task = lambda *_: None) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits.

    Args:
        path: the file.
        progress: is called with the bytes read and their total.

    Raises:
        OSError: it cannot be read.

    """
    digest, total = hashlib.sha256(), path.stat().st_size
    with opened(path) as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            progress(file.tell(), total)
    return digest.hexdigest()


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
