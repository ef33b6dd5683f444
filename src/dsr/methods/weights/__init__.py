"""Weights of networks, trained for this project: those that come with dsr, and those that are fetched.

``known.sha256`` lists all of them. A wheel leaves those out that only the networks of others need, see
``exclude-package-data`` in pyproject.toml; ``dsr data get weights`` fetches them.
"""

import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path

from dsr.utils.files import data_root
from dsr.utils.versions import hash_once

_HERE = Path(__file__).parent
FOLDER = "weights"  # of those that are fetched, below the directory of the data sets


@functools.cache
def known() -> Mapping[str, str]:
    """Return the SHA-256 of the files of all weights, by their names."""
    lines = (_HERE / "known.sha256").read_text("utf-8").splitlines()
    return {Path(name).stem: digest for digest, _, name in (line.partition("  ") for line in lines)}


def version() -> str:
    """Return eight digits that change when any of the weights do."""
    return hashlib.sha256("".join(known().values()).encode()).hexdigest()[:8]


def packaged_weights(name: str) -> Path | None:
    """Return the file of weights of a name, None if it is not here; of a fetched one the checksum has to be right."""
    path, fetched = _HERE / f"{name}.safetensors", data_root() / FOLDER / f"{name}.safetensors"
    if path.is_file():
        return path
    return fetched if fetched.is_file() and hash_once(fetched) == known().get(name) else None


def packaged_names() -> list[str]:
    """Return the sorted names of the weights that come with this installation."""
    return sorted(path.stem for path in _HERE.glob("*.safetensors"))


def left_out() -> list[str]:
    """Return the sorted names of the weights that this installation lacks."""
    return sorted(known().keys() - set(packaged_names()))
