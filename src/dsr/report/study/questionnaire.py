"""The page of a study, one self-contained HTML file, from runs, and the key that maps its pictures to methods."""

import base64
import hashlib
import io
import json
from collections.abc import Sequence
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
from dsr.report.study.files import KEY_NAME, PAGE_VERSION, Candidate, Key, Trial, read_key, write_key
from dsr.utils.files import expect_targets, write_text
from dsr.utils.progress import SILENT, Progress
from dsr.utils.ratios import as_ratio

PAGE_NAME = "index.html"
_DIGITS = 12  # digits of a hash that make an id
_FEWEST = 2  # minimum number of methods in a question


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
    """Write the page ``index.html`` and the key ``key.json`` of a study into a directory.

    Another study in it, whose answers can then no longer be collected, is replaced only if ``overwrite``.
    """
    choice = choice or Choice()
    expect_targets(folder, (KEY_NAME, PAGE_NAME))
    selected = _select(results, choice)
    for name, text in (("title", choice.title), ("send-to", choice.send_to)):
        for label in selected.methods():
            if label and label.casefold() in text.casefold():
                raise ValueError(f"{name}: expected words without the methods' names, got {label!r} in {text!r}")
    notes = list(results.notes)
    scenes, trials = _questions(selected, choice, progress, notes)
    if not scenes:
        detail = f"; {notes[-1]}" if notes else ""
        raise ValueError(f"study: expected a scene with its ground truth and {_FEWEST} methods, found none{detail}")
    per_person = len(scenes) if choice.scenes_per_person is None else choice.scenes_per_person
    repeat = choice.repeat or 0
    for what, value, low, high in (
        ("scenes per person", per_person, 1, len(scenes)),
        ("repeat", repeat, 0, per_person),
    ):
        if not low <= value <= high:
            raise ValueError(f"{what}: expected {low} to {high}, got {value}")
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


def _select(results: Results, choice: Choice) -> Results:
    """Return the runs that are chosen; each value in the choice has to occur in a run."""
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
    runs = (run for run in results.runs if not choice.scales or run.scale in choice.scales)
    runs = (run for run in runs if not choice.downsamplings or run.downsampling in choice.downsamplings)
    runs = (run for run in runs if not choice.methods or not {run.label, run.method}.isdisjoint(choice.methods))
    return Results(tuple(runs))


def _questions(
    results: Results, choice: Choice, progress: Progress, notes: list[str]
) -> tuple[list[dict[str, Any]], dict[str, Trial]]:
    """Return the page's scenes by ids, which reveal no name, and the key's trials; ``notes`` takes what is left out."""
    views = [view for problem in results.problems() for view in views_of(results, problem)]
    views = [view for view in views if not choice.scenes or view.scene in choice.scenes]
    scenes: list[dict[str, Any]] = []
    trials: dict[str, Trial] = {}
    for view in progress.track(views, "draw", label=lambda view: view.scene):
        drawn = _draw(view, choice.light, notes)
        if drawn is None:
            continue
        missing = sorted({run.label for run in results.of(view.problem)} - {run.label for run in view.runs})
        notes += [f"{view}: without {', '.join(missing)}, which has no prediction of it"] if missing else []
        truth, size, pictures = drawn
        scene_id = _hash(str(len(scenes)).encode(), truth, *sorted(picture for _, picture in pictures))
        images, candidates = {}, {}
        for number, (run, picture) in enumerate(pictures):
            name = _hash(scene_id.encode(), picture, str(number).encode())
            images[name] = base64.b64encode(picture).decode()
            candidates[name] = Candidate(run.label, run.method, str(run.folder))
        shown = {"truth": base64.b64encode(truth).decode(), "images": dict(sorted(images.items()))}
        scenes.append({"id": scene_id, "width": size[0], "height": size[1], **shown})
        dataset, scale, downsampling = view.problem
        trials[scene_id] = Trial(dataset, view.scene, scale, downsampling, candidates)
    return sorted(scenes, key=lambda scene: str(scene["id"])), trials


def _draw(view: View, light: str, notes: list[str]) -> tuple[bytes, tuple[int, int], list[tuple[Run, bytes]]] | None:
    """Draw the truth, of a width and height, and each run's result as PNG; None, with a note, if it is no question."""
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
        pictures.append((result.run, picture))
    return grey_png(truth, valid), (valid.shape[1], valid.shape[0]), pictures


def grey_png(shades: np.ndarray, valid: np.ndarray) -> bytes:
    """Encode (H, W) shades in [0, 1] as an 8-bit PNG: black is level 1, white 255, and not ``valid`` is transparent."""
    levels = np.where(valid & np.isfinite(shades), 1 + np.rint(254 * shades), 0)
    content = io.BytesIO()
    Image.fromarray(levels.astype(np.uint8)).save(content, "PNG", transparency=0, compress_level=9)
    return content.getvalue()


def _hash(*parts: bytes) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()[:_DIGITS]
