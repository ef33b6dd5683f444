"""The page of a study, one self-contained HTML file, from runs, and the key that maps its pictures to methods."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dsr.evaluation.results import BenchmarkSetting, Results, Run, one_per_method
from dsr.pictures.depth_views import rendering
from dsr.report.html_page import asset, fill, json_text, policy
from dsr.report.study import Choice
from dsr.report.study.key import KEY_NAME, PAGE_VERSION, Candidate, Key, Trial, read_key, write_key
from dsr.utils.files import expect_targets, write_text
from dsr.utils.progress import SILENT, Progress
from dsr.utils.ratios import as_ratio

PAGE_NAME = "index.html"
_DIGITS = 12
"""Digits of a hash that make an id."""
_FEWEST = 2
"""Minimum number of methods in a question."""


@dataclass(frozen=True)
class Question:
    """A scene and the runs to compare on it, in the order of the results."""

    problem: BenchmarkSetting
    scene: str
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class _Drawn:
    """The pictures of a question: PNGs of the ground truth and of each run in order, their width and height."""

    question: Question
    truth: bytes = b""
    pictures: tuple[bytes, ...] = ()
    size: tuple[int, int] = (0, 0)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Built:
    """A study that was written.

    Args:
        page: path of the page.
        key: content of the key file beside the page.
        notes: omissions and remarks, one line each.

    """

    page: Path
    key: Key
    notes: tuple[str, ...] = field(default=())


def build_study(
    results: Results,
    folder: Path,
    choice: Choice | None = None,
    progress: Progress = SILENT,
    *,
    overwrite: bool = False,
) -> Built:
    """Write the page ``index.html`` and the key ``key.json`` of a study.

    Args:
        results: runs to compare.
        folder: output directory, created if missing.
        choice: selection of the questions.
        progress: shows the scenes that are drawn.
        overwrite: whether to replace another study in the directory; its answers can then no longer be collected.

    Raises:
        ValueError: nothing is left to compare, the choice names a value that no run has, a file is damaged, the title
            contains the name of a method, or the directory holds another study.
        TargetError: a link, a device, a pipe or a socket is in the place of the key or the page.

    """
    choice = choice or Choice()
    expect_targets(folder, (KEY_NAME, PAGE_NAME))
    questions, notes = _questions(results, choice)
    labels = {run.label for question in questions for run in question.runs}
    _expect_blind(choice, labels)
    drawn = [
        _draw(question, choice.light)
        for question in progress.track(questions, "draw", label=lambda question: question.scene)
    ]
    notes += [note for each in drawn for note in each.notes]
    scenes, trials = _with_ids([each for each in drawn if each.pictures])
    if not scenes:
        raise ValueError(f"study: expected a scene with its ground truth, found none; {notes[-1]}")
    per_person = _within("scenes per person", choice.scenes_per_person, 1, len(scenes), len(scenes))
    repeat = _within("repeat", choice.repeat, 0, per_person, 0)
    asked: dict[str, Any] = {"perPerson": per_person, "repeat": repeat, "scenes": scenes}
    study = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:_DIGITS]
    key = Key(study, choice.light, per_person, repeat, trials)
    path = folder / KEY_NAME
    if not overwrite and path.exists() and read_key(path).study != study:
        where = "take another directory or --overwrite"
        raise ValueError(f"{path}: expected no other study, whose answers need this key, got one; {where}")
    content = {"study": study, "page": PAGE_VERSION, **asked}
    write_key(path, key)
    write_text(folder / PAGE_NAME, _page_of(content, choice))
    return Built(folder / PAGE_NAME, key, tuple(notes))


def _questions(results: Results, choice: Choice) -> tuple[list[Question], list[str]]:
    """Return the questions, and notes on the scenes left out."""
    _expect_existing(results, choice)
    notes = list(results.notes)
    selected = Results(tuple(run for run in results.runs if _is_selected(run, choice)))
    questions = []
    for problem in selected.problems():
        all_labels = {run.label for run in selected.of(problem)}
        for scene, runs in selected.by_scene(problem).items():
            if choice.scenes and scene not in choice.scenes:
                continue
            place = f"{problem.dataset}/{scene} x{problem.scale} {problem.downsampling}"
            shown = one_per_method(runs)
            reason = _reason_to_skip(shown, scene)
            if reason:
                notes.append(f"left out: {place}: {reason}")
                continue
            missing = sorted(all_labels - {run.label for run in shown})
            notes += [f"{place}: without {', '.join(missing)}, which has no prediction of it"] if missing else []
            questions.append(Question(problem, scene, shown))
    if not questions:
        detail = f"; {notes[-1]}" if notes else ""
        raise ValueError(f"study: expected a scene with its ground truth and {_FEWEST} methods, found none{detail}")
    return questions, notes


def _is_selected(run: Run, choice: Choice) -> bool:
    """Return whether a run is selected."""
    return (
        (not choice.scales or run.scale in choice.scales)
        and (not choice.downsamplings or run.downsampling in choice.downsamplings)
        and (not choice.methods or run.label in choice.methods or run.method in choice.methods)
    )


def _expect_existing(results: Results, choice: Choice) -> None:
    """Check that each value in the choice occurs in a run."""
    available: dict[str, tuple[Sequence[Any], set[Any]]] = {
        "scale": (tuple(map(as_ratio, choice.scales)), {run.scale for run in results.runs}),
        "downsampling": (choice.downsamplings, {run.downsampling for run in results.runs}),
        "method": (choice.methods, {name for run in results.runs for name in (run.label, run.method)}),
        "scene": (choice.scenes, {scene for run in results.runs for scene in run.scenes}),
    }
    for what, (asked, existing) in available.items():
        for name in asked:
            if name not in existing:
                raise ValueError(f"{what}: expected one of {', '.join(map(str, sorted(existing)))}, got {name!r}")


def _reason_to_skip(runs: Sequence[Run], scene: str) -> str | None:
    """Return the reason to leave out a scene, None if it can be shown."""
    if len(runs) < _FEWEST:
        return f"only {', '.join(run.label for run in runs)} has a prediction of it"
    if not any(run.has_sample(scene) for run in runs):
        return "no run has kept the scene itself; a newer dsr keeps it, with overwrite=true"
    return None


def _expect_blind(choice: Choice, labels: Iterable[str]) -> None:
    """Check that the texts of the page do not contain the name of a method."""
    for name, text in (("title", choice.title), ("send-to", choice.send_to)):
        for label in labels:
            if label and label.casefold() in text.casefold():
                raise ValueError(f"{name}: expected words without the methods' names, got {label!r} in {text!r}")


def _draw(question: Question, light: str) -> _Drawn:
    """Draw the pictures of a question; none for a scene without ground truth."""
    problem = question.problem
    place = f"{problem.dataset}/{question.scene} x{problem.scale} {problem.downsampling}"
    scene = next(run for run in question.runs if run.has_sample(question.scene)).sample(question.scene)
    if scene.depth is None:
        return _Drawn(question, notes=(f"left out: {place}: no ground truth",))
    truth = rendering(scene.depth, scene.camera, light)
    valid = np.isfinite(truth)
    pictures: dict[bytes, str] = {}
    notes = []
    shown = []
    for run in question.runs:
        depth = run.prediction(question.scene)
        if depth.shape != scene.depth.shape:
            sizes = [" x ".join(map(str, reversed(each.shape[-2:]))) for each in (scene.depth, depth)]
            raise ValueError(
                f"{run.folder}: prediction of {question.scene}: expected {sizes[0]} pixels, got {sizes[1]}"
            )
        picture = grey_png(rendering(depth, scene.camera, light), valid)
        if pictures.setdefault(picture, run.label) != run.label:
            notes.append(f"{place}: {pictures[picture]} and {run.label} look exactly the same")
        shown.append(picture)
    return _Drawn(question, grey_png(truth, valid), tuple(shown), (valid.shape[1], valid.shape[0]), tuple(notes))


def grey_png(shades: np.ndarray, valid: np.ndarray) -> bytes:
    """Encode an 8-bit PNG: black is level 1, white is 255, and missing pixels are level 0 and transparent.

    Args:
        shades: (H, W) in [0, 1], NaN where undefined.
        valid: (H, W) bool mask of the pixels to show.

    """
    levels = np.where(valid & np.isfinite(shades), 1 + np.rint(254 * shades), 0)
    content = io.BytesIO()
    Image.fromarray(levels.astype(np.uint8)).save(content, "PNG", transparency=0, compress_level=9)
    return content.getvalue()


def _with_ids(drawn: Sequence[_Drawn]) -> tuple[list[dict[str, Any]], dict[str, Trial]]:
    """Return the scenes of the page, ordered by id, and the trials of the key.

    Ids are hashes of pictures, so neither the ids nor the order on the page reveal a name.
    """
    scenes, trials = [], {}
    for number, each in enumerate(drawn):
        scene_id = _hash(str(number).encode(), each.truth, *sorted(each.pictures))
        ids = [_hash(scene_id.encode(), picture, str(i).encode()) for i, picture in enumerate(each.pictures)]
        images = {name: _text(picture) for name, picture in zip(ids, each.pictures, strict=True)}
        width, height = each.size
        truth = _text(each.truth)
        scenes.append(
            {"id": scene_id, "width": width, "height": height, "truth": truth, "images": dict(sorted(images.items()))}
        )
        named = {
            name: Candidate(run.label, run.method, str(run.folder))
            for name, run in zip(ids, each.question.runs, strict=True)
        }
        problem = each.question.problem
        trials[scene_id] = Trial(problem.dataset, each.question.scene, problem.scale, problem.downsampling, named)
    return sorted(scenes, key=lambda scene: str(scene["id"])), trials


def _page_of(content: Mapping[str, Any], choice: Choice) -> str:
    """Return the page's HTML, with the data of ``study.js``: study id, scenes per participant, scenes and pictures."""
    style, script = asset("study.css"), asset("study.js")
    parts = {
        "POLICY": policy(style, script, "data:"),
        "TITLE": html.escape(choice.title),
        "SEND_TO": html.escape(choice.send_to),
        "STYLE": style,
        "SCRIPT": script,
        "DATA": json_text(content),
    }
    return fill("study.html", parts)


def _hash(*parts: bytes) -> str:
    """Return the id of some bytes."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()[:_DIGITS]


def _text(png: bytes) -> str:
    return base64.b64encode(png).decode()


def _within(what: str, value: int | None, low: int, high: int, default: int) -> int:
    """Return the value if it is within a range, or the default for None."""
    if value is None:
        return default
    if not low <= value <= high:
        raise ValueError(f"{what}: expected {low} to {high}, got {value}")
    return value
