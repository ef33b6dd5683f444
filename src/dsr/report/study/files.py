"""The files of a study: its key, which participants do not get, and their answers; each participant counts once."""

import json
import os
from codecs import BOM_UTF8
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, TypeAdapter, ValidationError, ValidationInfo

from dsr.utils.files import write_text
from dsr.utils.guards import natural_key, read_limited
from dsr.utils.ratios import as_ratio
from dsr.utils.validation import Number, Whole, describe

PAGE_VERSION = 1  # version of the page and of the answer files that it writes
KEY_NAME = "key.json"
_LONGEST = 1e12  # maximum time of an answer in milliseconds, 30 years
_LARGEST = 10_000_000  # maximum file size, bytes; an answer file has a few thousand


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


def _expect(value: Any, info: ValidationInfo) -> Any:
    """Check that the answers belong to this study and page version."""
    expected = (info.context or {})[info.field_name]
    if value != expected:
        raise ValueError(repr(expected))
    return value


def _time(text: Any) -> datetime:
    """Parse an ISO 8601 time with its time zone."""
    with suppress(TypeError, ValueError):
        time = datetime.fromisoformat(text)
        if time.tzinfo is not None:
            return time
    raise ValueError("a time such as 2024-05-01T12:00:00Z")


class Answer(BaseModel, strict=True, extra="allow"):
    """What a participant chose for one scene; a choice is None until it is made."""

    scene: str  # its id
    again: bool  # whether this participant saw the scene for the second time
    order: list[str]
    first: str | None  # ids of the pictures chosen
    second: str | None
    ms: Annotated[Number, Field(ge=0, le=_LONGEST)]


class Answers(BaseModel, strict=True):
    """An answer file; ``finished`` is None until the last scene is answered."""

    study: Annotated[str, AfterValidator(_expect)]
    page: Annotated[Whole, AfterValidator(_expect)]
    participant: Annotated[str, Field(min_length=1)]  # random id
    finished: Annotated[datetime, BeforeValidator(_time)] | None
    trials: list[Answer]
    file: Path = Path()


def files_of(paths: Iterable[Path]) -> list[Path]:
    """Return the given files and all ``*.json`` files below the given directories, without duplicates."""
    found: dict[Path, Path] = {}
    for path in paths:
        for file in sorted(path.rglob("*.json"), key=natural_key) if path.is_dir() else [path]:
            found.setdefault(Path(os.path.realpath(file)), file)  # unlike resolve, it takes loops
    if not found:
        raise ValueError("answers: expected files that the page's last screen saved, found none")
    return list(found.values())


def read_all(files: Sequence[Path], key: Key) -> tuple[list[Answers], list[str]]:
    """Read all files; return the accepted answers in file order, and one line per rejected file.

    Of several files of one participant, or with identical answers, the one finished first is accepted.
    """
    accepted: list[Answers] = []
    rejected = []
    for file in files:
        try:
            accepted.append(read_answers(file, key))
        except ValueError as error:
            rejected.append(str(error))
    taken: dict[str, Answers] = {}
    for answers in sorted(accepted, key=lambda each: (each.finished, str(each.file))):
        content = answers.model_dump_json(include={"trials"})
        earlier = taken.get(answers.participant) or taken.get(content)
        if earlier:
            what = "the same person" if earlier.participant == answers.participant else "identical answers"
            rejected.append(f"{answers.file}: duplicate of {earlier.file} ({what}), which was finished first")
            continue
        taken |= {answers.participant: answers, content: answers}
    kept = {answers.file for answers in taken.values()}
    return [answers for answers in accepted if answers.file in kept], rejected


def read_answers(file: Path, key: Key) -> Answers:
    """Read one answer file; refuse one that is damaged, incomplete, of another study, or that the page cannot make."""
    try:
        content = read_limited(file, _LARGEST).removeprefix(BOM_UTF8)
        answers = Answers.model_validate_json(content, context={"study": key.study, "page": PAGE_VERSION})
    except OSError as error:
        raise ValueError(f"{file}: expected a file of answers, got {error.strerror or error}") from error
    except ValidationError as error:
        raise ValueError(f"{file}: {describe(error)}") from error
    if answers.finished is None:
        raise ValueError(f"{file}: incomplete, it was saved before the last scene was answered")
    for number, trial in enumerate(answers.trials):
        _expect_choices(f"{file}: trials.{number}", trial, key)
    _expect_all(file, answers.trials, key)
    answers.file = file
    return answers


def _expect_choices(where: str, trial: Answer, key: Key) -> None:
    if trial.scene not in key.trials:
        raise ValueError(f"{where}.scene: expected one of the study's, got {trial.scene!r}")
    candidates = key.trials[trial.scene].candidates
    if sorted(trial.order) != sorted(candidates):
        raise ValueError(f"{where}.order: expected each picture of the scene once, got others")
    first, second = trial.first, trial.second
    if first is None or second is None:
        raise ValueError(f"{where}: incomplete, no {'first' if first is None else 'second'} choice")
    for name, choice in (("first", first), ("second", second)):
        if choice not in candidates:
            raise ValueError(f"{where}.{name}: expected a picture that was shown, got {choice!r}")
    if first == second:
        raise ValueError(f"{where}: expected two different pictures, got the same as first and second")


def _expect_all(file: Path, given: Sequence[Answer], key: Key) -> None:
    fresh = [answer.scene for answer in given if not answer.again]
    again = [answer.scene for answer in given if answer.again]
    for scenes, number, what in ((fresh, key.scenes_per_person, "scenes"), (again, key.repeat, "repeated scenes")):
        if len(set(scenes)) != len(scenes):
            raise ValueError(f"{file}: expected {number} different {what}, got one of them twice")
        if len(scenes) != number:
            raise ValueError(f"{file}: expected {number} {what}, got {len(scenes)}")
    if not set(again) <= set(fresh):
        raise ValueError(f"{file}: expected repeated scenes that were asked before, got others")
