"""Key of a study: maps each picture of the page to its method and scene. Participants do not get it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from dsr.utils.files import write_text
from dsr.utils.guards import read_limited
from dsr.utils.ratios import as_ratio
from dsr.utils.validation import Number, Whole, describe

PAGE_VERSION = 1
"""Version of the page and of the answer files that it writes."""
KEY_NAME = "key.json"


@dataclass(frozen=True)
class Candidate:
    """The method of one picture.

    Args:
        label: display name of the method.
        method: name of the method in ``scores.csv``.
        run: directory of the run with the prediction.

    """

    label: str
    method: str
    run: str


@dataclass(frozen=True)
class Trial:
    """One scene of a study.

    Args:
        dataset, scene, scale, downsampling: as in ``scores.csv``.
        candidates: methods to choose from, by the opaque id of their picture.

    """

    dataset: str
    scene: str
    scale: float
    downsampling: str
    candidates: Mapping[str, Candidate]


@dataclass(frozen=True)
class Key:
    """The questions of a study.

    Args:
        study: hash of everything shown.
        light: light of the renderings.
        scenes_per_person: number of scenes that each participant sees.
        repeat: number of those scenes shown twice.
        trials: scenes by opaque id.

    """

    study: str
    light: str
    scenes_per_person: int
    repeat: int
    trials: Mapping[str, Trial]


def write_key(path: Path, key: Key) -> None:
    """Write a key atomically."""
    write_text(path, json.dumps({"page": PAGE_VERSION, **asdict(key)}, indent=1, ensure_ascii=False) + "\n")


def read_key(path: Path) -> Key:
    """Read a key written by :func:`write_key`.

    Raises:
        ValueError: the file is missing, damaged, or of another version.

    """
    try:
        stored = _StoredKey.model_validate_json(read_limited(path))
    except FileNotFoundError:
        raise ValueError(f"{path}: expected the key of a study that dsr study build made, there is none") from None
    except ValidationError as error:
        raise ValueError(f"{path}: expected the key of a study; {describe(error)}") from error
    except OSError as error:
        raise ValueError(f"{path}: expected the key of a study, got {error.strerror or error}") from error
    if stored.page != PAGE_VERSION:
        raise ValueError(f"{path}: expected the key of a study of version {PAGE_VERSION}, got {stored.page!r}")
    trials = {
        name: Trial(each.dataset, each.scene, as_ratio(each.scale), each.downsampling, each.candidates)
        for name, each in stored.trials.items()
    }
    return Key(stored.study, stored.light, stored.scenes_per_person, stored.repeat, trials)


class _StoredTrial(BaseModel, strict=True):
    """A :class:`Trial` as it is stored."""

    dataset: str
    scene: str
    scale: Annotated[Number, Field(ge=1, le=1e6)]
    downsampling: str
    candidates: Annotated[dict[str, Candidate], Field(min_length=2)]


class _StoredKey(BaseModel, strict=True):
    """A :class:`Key` as it is stored, with the version of its page."""

    page: Whole
    study: str
    light: str
    scenes_per_person: Annotated[Whole, Field(ge=1, le=1e6)]
    repeat: Annotated[Whole, Field(ge=0, le=1e6)]
    trials: dict[str, _StoredTrial]
