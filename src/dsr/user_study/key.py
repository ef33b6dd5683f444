"""The key of a study: which picture of its page is of which method and scene. It stays with whoever runs the study."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dsr.utils.files import write_text

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
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        version = content["page"]
        trials = {name: _trial(trial) for name, trial in content["trials"].items()}
        per_person, repeat = int(content["scenes_per_person"]), int(content["repeat"])
        key = Key(str(content["study"]), str(content["light"]), per_person, repeat, trials)
    except FileNotFoundError:
        raise ValueError(f"{path}: expected the key of a study that dsr study build made, there is none") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: expected the key of a study, got a damaged or foreign file") from error
    if version != PAGE_VERSION:
        raise ValueError(f"{path}: expected the key of a study of version {PAGE_VERSION}, got {version!r}")
    return key


def _trial(content: Mapping[str, Any]) -> Trial:
    """Return one trial from its JSON."""
    candidates = {name: Candidate(**candidate) for name, candidate in content["candidates"].items()}
    scale = int(content["scale"])
    return Trial(str(content["dataset"]), str(content["scene"]), scale, str(content["downsampling"]), candidates)
