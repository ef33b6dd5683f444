"""Key of a study: maps each picture of the page to its method and scene. Participants do not get it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from dsr.utils.files import write_text
from dsr.utils.guards import read_limited
from dsr.utils.ratios import as_ratio
from dsr.utils.validation import Number, Whole, describe

PAGE_VERSION = 1
"""Version of the page and of the answer files that it writes."""
KEY_NAME = "key.json"


@dataclass(frozen=True)
class Candidate:
    """The method of one picture."""

    label: str  # display name
    method: str  # name in ``scores.csv``
    run: str  # directory of the run with the prediction


@dataclass(frozen=True)
class Trial:
    """One scene of a study, named as in ``scores.csv``."""

    dataset: str
    scene: str
    scale: Annotated[Number, Field(ge=1, le=1e6), AfterValidator(as_ratio)]
    downsampling: str
    # methods to choose from, by the opaque id of their picture
    candidates: Annotated[dict[str, Candidate], Field(min_length=2)]


@dataclass(frozen=True)
class Key:
    """The questions of a study."""

    study: str  # hash of everything shown
    light: str  # of the renderings
    scenes_per_person: Annotated[Whole, Field(ge=1, le=1e6)]
    repeat: Annotated[Whole, Field(ge=0, le=1e6)]  # number of those scenes shown twice
    trials: dict[str, Trial]  # by opaque id
    page: Whole = PAGE_VERSION


def write_key(path: Path, key: Key) -> None:
    """Write a key atomically."""
    write_text(path, json.dumps(asdict(key), indent=1, ensure_ascii=False) + "\n")


def read_key(path: Path) -> Key:
    """Read a key written by :func:`write_key`; refuse a missing or damaged one, and another version."""
    try:
        key = TypeAdapter(Key).validate_json(read_limited(path), strict=True)
    except FileNotFoundError:
        raise ValueError(f"{path}: expected the key of a study that dsr study build made, there is none") from None
    except ValidationError as error:
        raise ValueError(f"{path}: expected the key of a study; {describe(error)}") from error
    except OSError as error:
        raise ValueError(f"{path}: expected the key of a study, got {error.strerror or error}") from error
    if key.page != PAGE_VERSION:
        raise ValueError(f"{path}: expected the key of a study of version {PAGE_VERSION}, got {key.page!r}")
    return key
