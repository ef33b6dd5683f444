"""The files of answers that people send back: read, checked, and each person's taken once."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from dsr.user_study.key import PAGE_VERSION, Key

_LARGEST = 10_000_000
"""Bytes; a file of answers has some thousands."""


@dataclass(frozen=True)
class Answer:
    """What somebody chose for one scene.

    Args:
        scene: the scene's id.
        again: whether it is the second time that this person is asked.
        first, second: the ids of the pictures chosen.
        seconds: how long it took.

    """

    scene: str
    again: bool
    first: str
    second: str
    seconds: float


@dataclass(frozen=True)
class Answers:
    """A complete file of answers.

    Args:
        file: where it was read.
        participant: a random id.
        finished: when.
        content: a hash of what was answered, whoever it was.
        given: one for each scene shown.

    """

    file: Path
    participant: str
    finished: datetime
    content: str
    given: tuple[Answer, ...]


def files_of(paths: Iterable[Path]) -> list[Path]:
    """Return the files named and those called ``*.json`` below directories named, each once.

    Raises:
        ValueError: there is no file.

    """
    found: dict[Path, Path] = {}
    for path in paths:
        for file in sorted(path.rglob("*.json")) if path.is_dir() else [path]:
            found.setdefault(file.resolve(), file)
    if not found:
        raise ValueError("answers: expected files that the page's last screen saved, found none")
    return list(found.values())


def read_all(files: Sequence[Path], key: Key) -> tuple[list[Answers], list[str]]:
    """Return the answers that count, in the order of their files, and why each of the others is left out.

    Of one person's files, and of files that hold the very same answers, the one finished first counts.
    """
    good: list[Answers] = []
    left_out = []
    for file in files:
        try:
            good.append(read_answers(file, key))
        except ValueError as error:
            left_out.append(str(error))
    taken: dict[str, Answers] = {}
    for answers in sorted(good, key=lambda each: (each.finished, str(each.file))):
        earlier = taken.get(answers.participant) or taken.get(answers.content)
        if earlier:
            what = "the same person" if earlier.participant == answers.participant else "the very same answers"
            left_out.append(f"{answers.file}: a double of {earlier.file} ({what}), which was finished first and counts")
            continue
        taken |= {answers.participant: answers, answers.content: answers}
    kept = {answers.file for answers in taken.values()}
    return [answers for answers in good if answers.file in kept], left_out


def read_answers(file: Path, key: Key) -> Answers:
    """Return one file of answers.

    Raises:
        ValueError: it is damaged, of another study, incomplete, or has answers that the page cannot give; one line.

    """
    content = _read(file)
    study, version = content.get("study"), content.get("page")
    if study != key.study:
        raise ValueError(f"{file}: expected answers to the study {key.study}, got those to {study!r}")
    if version != PAGE_VERSION:
        raise ValueError(f"{file}: expected answers of version {PAGE_VERSION}, got {version!r}")
    participant = content.get("participant")
    if not isinstance(participant, str) or not participant:
        raise ValueError(f"{file}: participant: expected an id, got {participant!r}")
    finished = _time(file, content.get("finished"))
    trials = content.get("trials")
    if not isinstance(trials, list):
        raise ValueError(f"{file}: trials: expected a list, got {type(trials).__name__}")
    given = tuple(_answer(f"{file}: trial {number}", trial, key) for number, trial in enumerate(trials, 1))
    _expect_all(file, given, key)
    digest = hashlib.sha256(json.dumps(trials, sort_keys=True).encode()).hexdigest()
    return Answers(file, participant, finished, digest, given)


def _read(file: Path) -> dict[str, Any]:
    """Return a JSON object of a sane size."""
    try:
        if file.stat().st_size > _LARGEST:
            raise ValueError(f"{file}: expected a file of answers, got one of {file.stat().st_size / 1e6:.0f} MB")
        content = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ValueError(f"{file}: expected a file of answers, got {error.strerror or error}") from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{file}: expected a file of answers, got damaged JSON") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file}: expected a file of answers, got a JSON {type(content).__name__}")
    return content


def _time(file: Path, text: Any) -> datetime:
    """Return a time with its zone, as ISO 8601 writes it."""
    if text is None:
        raise ValueError(f"{file}: incomplete, it was saved before the last scene was answered")
    try:
        time = datetime.fromisoformat(text)
    except (TypeError, ValueError):
        time = None
    if time is None or time.tzinfo is None:
        raise ValueError(f"{file}: finished: expected a time such as 2024-05-01T12:00:00Z, got {text!r}")
    return time


def _answer(where: str, trial: Any, key: Key) -> Answer:
    """Return what was chosen in one trial."""
    if not isinstance(trial, Mapping):
        raise ValueError(f"{where}: expected an object, got {type(trial).__name__}")
    scene, order = trial.get("scene"), trial.get("order")
    if not isinstance(scene, str) or scene not in key.trials:
        raise ValueError(f"{where}: scene: expected one of the study's, got {scene!r}")
    candidates = key.trials[scene].candidates
    if not isinstance(order, list) or not all(isinstance(name, str) for name in order):
        raise ValueError(f"{where}: order: expected a list of pictures, got {order!r}")
    if sorted(order) != sorted(candidates):
        raise ValueError(f"{where}: order: expected each picture of the scene once, got others")
    for name in ("first", "second"):
        if trial.get(name) is None:
            raise ValueError(f"{where}: incomplete, no {name} choice")
        if not isinstance(trial[name], str) or trial[name] not in candidates:
            raise ValueError(f"{where}: {name}: expected a picture that was shown, got {trial[name]!r}")
    if trial["first"] == trial["second"]:
        raise ValueError(f"{where}: expected two different pictures, got the same as first and second")
    again, milliseconds = trial.get("again"), trial.get("ms")
    if not isinstance(again, bool):
        raise ValueError(f"{where}: again: expected true or false, got {again!r}")
    return Answer(scene, again, trial["first"], trial["second"], _seconds(where, milliseconds))


def _seconds(where: str, milliseconds: Any) -> float:
    """Return a duration in seconds."""
    number = isinstance(milliseconds, int | float) and not isinstance(milliseconds, bool)
    if not number or not math.isfinite(milliseconds) or milliseconds < 0:
        raise ValueError(f"{where}: ms: expected milliseconds, got {milliseconds!r}")
    return float(milliseconds) / 1000


def _expect_all(file: Path, given: Sequence[Answer], key: Key) -> None:
    """Refuse a file that has not exactly what one person is shown."""
    fresh = [answer.scene for answer in given if not answer.again]
    again = [answer.scene for answer in given if answer.again]
    for scenes, number, what in ((fresh, key.scenes_per_person, "scenes"), (again, key.repeat, "repeated scenes")):
        if len(set(scenes)) != len(scenes):
            raise ValueError(f"{file}: expected {number} different {what}, got one of them twice")
        if len(scenes) < number:
            raise ValueError(f"{file}: incomplete, {len(scenes)} of {number} {what}")
        if len(scenes) > number:
            raise ValueError(f"{file}: expected {number} {what}, got {len(scenes)}")
    if not set(again) <= set(fresh):
        raise ValueError(f"{file}: expected repeated scenes that were asked before, got others")
