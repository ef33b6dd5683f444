"""The key of a study: which picture of its page is of which method and scene. It stays with whoever runs the study."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from dsr.utils.files import write_text
from dsr.utils.validation import describe

PAGE_VERSION = 1
"""Of the page and of the answers that it writes."""
KEY_NAME = "key.json"


@dataclass(frozen=True)
class Candidate:
    """What one picture shows.

    Args:
        label: the method's name for readers.
        method: its name in ``scores.csv``.
        run: the directory that its prediction came from.

    """

    label: str
    method: str
    run: str


@dataclass(frozen=True)
class Trial:
    """What a person is asked about one scene.

    Args:
        dataset, scene, scale, downsampling: as in ``scores.csv``.
        candidates: the methods to choose from, by the opaque id of their picture.

    """

    dataset: str
    scene: str
    scale: int
    downsampling: str
    candidates: Mapping[str, Candidate]


@dataclass(frozen=True)
class Key:
    """What a study asks.

    Args:
        study: a hash of all that is shown.
        light: e1..e4, that of the renderings.
        scenes_per_person: how many scenes each person sees.
        repeat: how many of them come twice.
        trials: by the opaque id of the scene.

    """

    study: str
    light: str
    scenes_per_person: int
    repeat: int
    trials: Mapping[str, Trial]


def write_key(path: Path, key: Key) -> None:
    """Write a key, atomically."""
    write_text(path, json.dumps({"page": PAGE_VERSION, **asdict(key)}, indent=1, ensure_ascii=False) + "\n")


def read_key(path: Path) -> Key:
    """Return what :func:`write_key` wrote.

    Raises:
        ValueError: the file is missing, damaged, or of another version.

    """
    try:
        stored = _KEY.validate_json(path.read_bytes())
    except FileNotFoundError:
        raise ValueError(f"{path}: expected the key of a study that dsr study build made, there is none") from None
    except ValidationError as error:
        raise ValueError(f"{path}: expected the key of a study; {describe(error)}") from error
    except OSError as error:
        raise ValueError(f"{path}: expected the key of a study, got {error.strerror or error}") from error
    if stored.page != PAGE_VERSION:
        raise ValueError(f"{path}: expected the key of a study of version {PAGE_VERSION}, got {stored.page!r}")
    return Key(**{each.name: getattr(stored, each.name) for each in fields(Key)})


@dataclass(frozen=True)
class _StoredKey(Key):
    """The key as its file has it."""

    page: int


_KEY = TypeAdapter(_StoredKey)
