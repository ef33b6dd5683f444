"""Hashes of files and of the package's own code."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

import dsr


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_of_code(names: Iterable[str]) -> str:
    """Return a hash of the code of modules and packages, given by their paths below the package.

    Raises:
        FileNotFoundError: a module or package does not exist.

    """
    package = Path(dsr.__file__).parent
    digest = hashlib.sha256()
    for name in names:
        path = package / name
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such module or package")
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()
