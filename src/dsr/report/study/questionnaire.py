"""The page of a study, one self-contained HTML file, from runs, and the key that maps its pictures to methods."""

from __future__ import annotations

import base64
import hashlib
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dsr.evaluation.results import Results, Run
from dsr.pictures.depth_views import rendering
from dsr.report.html_page import asset, fill, json_text, policy
from dsr.report.shown_scenes import View, results_of, stored_sample, views_of
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
class _Question:
    """A scene with its pictures as PNG: that of the ground truth, and one of each result."""

    view: View
    runs: tuple[Run, ...]
    truth: bytes
    pictures: tuple[bytes, ...]
    size: tuple[int, int]  # width and height


@dataclass(frozen=True)
class Built:
    """A study that was written."""

    page: Path
    key: Key  # content of the key file beside the page
    notes: tuple[str, ...] = field(default=())  # omissions and remarks


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
    _expect_existing(results, choice)
    selected = Results(tuple(run for run in results.runs if _is_selected(run, choice)))
    _expect_blind(choice, selected.methods())
    views = [view for problem in selected.problems() for view in views_of(selected, problem)]
    views = [view for view in views if not choice.scenes or view.scene in choice.scenes]
    notes = list(results.notes)
    questions = []
    for view in progress.track(views, "draw", label=lambda view: view.scene):
        question = _draw(view, choice.light, notes)
        if question is not None:
            questions.append(question)
            missing = sorted({run.label for run in selected.of(view.problem)} - {run.label for run in view.runs})
            notes += [f"{view}: without {', '.join(missing)}, which has no prediction of it"] if missing else []
    if not questions:
        detail = f"; {notes[-1]}" if notes else ""
        raise ValueError(f"study: expected a scene with its ground truth and {_FEWEST} methods, found none{detail}")
    scenes, trials = _with_ids(questions)
    per_person = _within("scenes per person", choice.scenes_per_person, 1, len(scenes), len(scenes))
    repeat = _within("repeat", choice.repeat, 0, per_person, 0)
    asked: dict[str, Any] = {"perPerson": per_person, "repeat": repeat, "scenes": scenes}
    study = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:_DIGITS]
    key = Key(study, choice.light, per_person, repeat, trials)
    path = folder / KEY_NAME
    if not overwrite and path.exists() and read_key(path).study != study:
        where = "take another directory or --overwrite"
        raise ValueError(f"{path}: expected no other study, whose answers need this key, got one; {where}")
    write_key(path, key)
    style, script = asset("study.css"), asset("study.js")
    parts = {
        "POLICY": policy(style, script, "data:"),
        "TITLE": choice.title,
        "SEND_TO": choice.send_to,
        "STYLE": style,
        "SCRIPT": script,
        "DATA": json_text({"study": study, "page": PAGE_VERSION, **asked}),
    }
    write_text(folder / PAGE_NAME, fill("study.html", parts))
    return Built(folder / PAGE_NAME, key, tuple(notes))


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


def _expect_blind(choice: Choice, labels: Iterable[str]) -> None:
    """Check that the texts of the page do not contain the name of a method."""
    for name, text in (("title", choice.title), ("send-to", choice.send_to)):
        for label in labels:
            if label and label.casefold() in text.casefold():
                raise ValueError(f"{name}: expected words without the methods' names, got {label!r} in {text!r}")


def _draw(view: View, light: str, notes: list[str]) -> _Question | None:
    """Draw the pictures of a question; None for a scene that cannot be one, for which ``notes`` takes the reason."""
    if len(view.runs) < _FEWEST:
        notes.append(f"left out: {view}: only {view.runs[0].label} has a prediction of it")
        return None
    scene = stored_sample(view, notes)
    if scene is None:
        return None
    if scene.depth is None:
        notes.append(f"left out: {view}: no ground truth")
        return None
    reasons: list[str] = []
    results = results_of(view, scene, reasons)
    if len(results) < _FEWEST:
        notes.append(f"left out: {view}: {'; '.join(reasons)}")
        return None
    notes += reasons
    truth = rendering(scene.depth, scene.camera, light)
    valid = np.isfinite(truth)
    labels: dict[bytes, str] = {}
    pictures = []
    for result in results:
        picture = grey_png(rendering(result.depth, scene.camera, light), valid)
        label = result.run.label
        if labels.setdefault(picture, label) != label:
            notes.append(f"{view}: {labels[picture]} and {label} look exactly the same")
        pictures.append(picture)
    runs = tuple(result.run for result in results)
    return _Question(view, runs, grey_png(truth, valid), tuple(pictures), (valid.shape[1], valid.shape[0]))


def grey_png(shades: np.ndarray, valid: np.ndarray) -> bytes:
    """Encode (H, W) shades in [0, 1] as an 8-bit PNG: black is level 1, white 255, and not ``valid`` is transparent."""
    levels = np.where(valid & np.isfinite(shades), 1 + np.rint(254 * shades), 0)
    content = io.BytesIO()
    Image.fromarray(levels.astype(np.uint8)).save(content, "PNG", transparency=0, compress_level=9)
    return content.getvalue()


def _with_ids(questions: Sequence[_Question]) -> tuple[list[dict[str, Any]], dict[str, Trial]]:
    """Return the scenes of the page, ordered by id, and the trials of the key.

    Ids are hashes of pictures, so neither the ids nor the order on the page reveal a name.
    """
    scenes, trials = [], {}
    for number, each in enumerate(questions):
        scene_id = _hash(str(number).encode(), each.truth, *sorted(each.pictures))
        ids = [_hash(scene_id.encode(), picture, str(i).encode()) for i, picture in enumerate(each.pictures)]
        images = {name: _text(picture) for name, picture in zip(ids, each.pictures, strict=True)}
        width, height = each.size
        scenes.append(
            {
                "id": scene_id,
                "width": width,
                "height": height,
                "truth": _text(each.truth),
                "images": dict(sorted(images.items())),
            }
        )
        named = {
            name: Candidate(run.label, run.method, str(run.folder)) for name, run in zip(ids, each.runs, strict=True)
        }
        dataset, scale, downsampling = each.view.problem
        trials[scene_id] = Trial(dataset, each.view.scene, scale, downsampling, named)
    return sorted(scenes, key=lambda scene: str(scene["id"])), trials


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
