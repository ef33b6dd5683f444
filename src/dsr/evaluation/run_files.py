"""Read the directories of evaluations, and distinguish runs of equal names.

Only files are read: ``scores.csv``, ``summary.json``, ``versions.json``, predictions and stored scenes.
"""

import io
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import BaseModel, Field

from dsr.evaluation.results import DATASET_ORDER, Results, Run, method_settings, paper_key, prediction_path, sample_path
from dsr.metrics.formats import MetricFormat
from dsr.utils.arrays import array_headers
from dsr.utils.guards import MOST_TABLE, OutsideError, natural_key, read_limited, refusing
from dsr.utils.ratios import as_ratio
from dsr.utils.validation import Number, Whole, parse_model

_SCORES, _SUMMARY, _VERSIONS = "scores.csv", "summary.json", "versions.json"
_TEXT_COLUMNS = ("dataset", "scene", "downsampling", "method", "metric", "variant")
_NUMBER_COLUMNS = ("scale", "seed", "value", "valid_share")
_LARGEST_SCALE = 1e6
_LARGEST_SCORE = 1e100  # whose squares can be added; an infinite score is one of its own
_DIGEST = 8  # displayed digits of a hash


def load_results(paths: Sequence[Path]) -> Results:
    """Read all runs in and below some directories.

    Damaged runs are omitted, and so is the older of two predictions of a scene by the same method. The notes list them.
    """
    runs: list[Run] = []
    notes: list[str] = []
    for folder in _folders(paths):
        try:
            run = read_run(folder)
        except OutsideError:
            raise
        except (ValueError, OSError) as error:
            notes.append(f"left out: {error}")
            continue
        unfit = {scene: problem for scene in run.scenes if (problem := _unfit_prediction(run, scene))}
        notes += [f"left out: {problem}" for problem in unfit.values()]
        runs.append(_without(run, unfit))
    if not runs:
        where = ", ".join(map(str, paths))
        detail = f"; {notes[0]}" if notes else ""
        raise ValueError(f"{where}: expected runs of eval.py (directories with {_SCORES}), found none{detail}")
    runs = _by_truth(_distinguish(runs))
    unsolved = [
        f"{run.label} at x{run.scale} has no solution for {message}"
        for run in runs
        for message in run.unsolved.values()
    ]
    runs, older = _newest(runs)
    if not runs:
        reason = f"; {unsolved[0]}" if unsolved else ""
        raise ValueError(f"{', '.join(map(str, paths))}: expected runs with a prediction, found none{reason}")
    runs.sort(key=lambda run: (paper_key(run.dataset, DATASET_ORDER), run.problem, paper_key(run.label), run.seed))
    return Results(tuple(runs), (*notes, *older, *unsolved))


def _unfit_prediction(run: Run, scene: str) -> str:
    """Return what is wrong with a prediction's type or size; nothing if it is damaged, or without a stored scene."""
    path = prediction_path(run.folder, scene)
    try:
        shape, dtype = array_headers(path)["depth"]
        photo = array_headers(sample_path(run.folder, scene))["rgb"][0] if run.has_sample(scene) else shape
    except (ValueError, OSError, KeyError):
        return ""
    if dtype.kind != "f" or len(shape) != 2:
        return f"{path}: expected floating point depth (height x width), got {dtype} of shape {shape}"
    if shape != photo[:2]:
        expected, came = (" x ".join(map(str, size)) for size in (photo[:2], shape))
        return f"{path}: expected depth of the photo's {expected} pixels, got {came}"
    return ""


def _without(run: Run, scenes: Collection[str]) -> Run:
    if not scenes:
        return run
    kept = tuple(scene for scene in run.scenes if scene not in scenes)
    return replace(run, scenes=kept, scores=run.scores[run.scores["scene"].isin(kept)])


def _folders(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield the directories of runs in and below the paths, each once."""
    seen = set()
    for path in paths:
        if not path.is_dir():
            raise ValueError(f"{path}: expected a directory with runs of eval.py, there is none")
        for file in sorted(path.rglob(_SUMMARY), key=natural_key):
            if file.resolve() not in seen and (file.parent / _SCORES).is_file():
                seen.add(file.resolve())
                yield file.parent


def read_run(folder: Path) -> Run:
    """Return one run, with the label that it has by itself."""
    summary = parse_model(_Summary, read_limited(folder / _SUMMARY), folder / _SUMMARY)
    versions = parse_model(_Versions, read_limited(folder / _VERSIONS), folder / _VERSIONS)
    settings = versions.identity.model_dump(exclude_unset=True)
    scores = _read_scores(folder / _SCORES)
    names = [(f"{folder / _SUMMARY}: seconds", scene) for scene in summary.seconds]
    first = scores["scene"].drop_duplicates()
    names += [(f"{folder / _SCORES}: line {row + 2}", scene) for row, scene in first.items()]
    for source, scene in names:
        prediction_path(folder, scene, source)
        sample_path(folder, scene, source)
    dataset = str(scores["dataset"].iloc[0]) if len(scores) else summary.dataset
    scenes = tuple(scene for scene in summary.seconds if prediction_path(folder, scene).is_file())
    scores = scores[scores["scene"].isin(scenes)]
    own = {"scores": scores, "settings": settings, "versions": versions.model_extra or {}, "scenes": scenes}
    return Run(folder, **{**dict(summary), "dataset": dataset, "scale": as_ratio(summary.scale), **own})


class _Summary(BaseModel, strict=True, allow_inf_nan=False):
    """The content of ``summary.json``, by the names of :class:`~dsr.evaluation.results.Run`."""

    dataset: str
    scale: Annotated[Number, Field(ge=1, le=_LARGEST_SCALE)]
    downsampling: str
    method: str
    seed: Annotated[Whole, Field(ge=0)]
    seconds: dict[str, Annotated[Number, Field(ge=0)]]
    label: str
    unsolved: Annotated[dict[str, str], Field(alias="unanswered")] = {}
    formats: Annotated[dict[str, MetricFormat], Field(alias="metrics")] = {}
    notes: dict[str, list[str]] = {}
    truths: dict[str, str] = {}


class _Identity(BaseModel, extra="allow", strict=True):
    """A run's settings; those of its groups that are read have keys."""

    method: dict[str, Any] = {}
    dataset: dict[str, Any] = {}
    downsampling: dict[str, Any] = {}


class _Versions(BaseModel, extra="allow"):
    """``versions.json``: versions of packages, Python and the project, and the run's settings."""

    identity: _Identity = _Identity()


def _read_scores(path: Path) -> pd.DataFrame:
    content = io.BytesIO(read_limited(path, MOST_TABLE))
    expected = f"{path}: expected a run's scores, got a damaged or foreign file"
    with refusing(expected, ValueError, KeyError, OverflowError, pd.errors.ParserError):
        scores = pd.read_csv(
            content,
            usecols=[*_TEXT_COLUMNS, *_NUMBER_COLUMNS],
            dtype=dict.fromkeys(_TEXT_COLUMNS, str),
            keep_default_na=False,
            na_values={name: [""] for name in _NUMBER_COLUMNS},
        )
        scores = scores[[*_TEXT_COLUMNS, *_NUMBER_COLUMNS]]
        if any(scores[name].dtype == bool for name in _NUMBER_COLUMNS):
            raise ValueError("true is no number")
        scores = scores.astype({"seed": int, "value": float, "valid_share": float})
        scores["scale"] = pd.to_numeric(scores["scale"])
        if not scores["scale"].between(1, _LARGEST_SCALE).all() or not scores["seed"].between(0, 2**63 - 1).all():
            raise ValueError("a scale or seed is none")
    unlike = scores["value"][scores["value"].abs().between(_LARGEST_SCORE, math.inf, inclusive="neither")]
    if len(unlike):
        where, came = unlike.index[0] + 2, unlike.iloc[0]
        raise ValueError(f"{path}: line {where}: value: expected at most {_LARGEST_SCORE:g}, got {came:g}")
    return scores


def _distinguish(runs: Sequence[Run]) -> list[Run]:
    """Append the differing settings to equal labels and data sets' names of runs, as in "MSG-V (ensemble=1)"."""
    methods = [method_settings(run.settings) | {"alignment": run.settings.get("alignment")} for run in runs]
    for found, run in zip(methods, runs, strict=True):
        for key, name in (("weights_sha256", "weights"), ("precision", "precision")):
            if run.settings.get(key) is not None:
                found[name] = str(run.settings[key])[:_DIGEST]
    datasets = [{**run.settings.get("dataset", {}), "root": None, "scenes": None, "_target_": None} for run in runs]
    labels = _distinguishing_suffixes([(run.label, run.scale) for run in runs], methods)
    names = _distinguishing_suffixes([(run.dataset, 0) for run in runs], datasets)
    return [
        replace(run, label=run.label + label, dataset=run.dataset + name)
        for run, label, name in zip(runs, labels, names, strict=True)
    ]


def _by_truth(runs: Sequence[Run]) -> list[Run]:
    """Mark data sets of runs with different truths of the same scenes by a hash, as in "garden (truth 5f3c01ab)"."""
    namesakes: dict[tuple[str, float], list[Run]] = {}
    for run in runs:
        namesakes.setdefault((run.dataset, run.scale), []).append(run)
    marks: dict[Path, str] = {}
    for same in namesakes.values():
        groups: list[dict[str, str]] = []  # truths by scene that belong together
        chosen: dict[Path, dict[str, str]] = {}
        for run in same:
            own = {scene: run.truths[scene] for scene in run.scenes if scene in run.truths}
            if own:
                fitting = (each for each in groups if all(each.get(scene, own[scene]) == own[scene] for scene in own))
                group = next(fitting, None)
                if group is None:
                    groups.append(group := {})
                group |= {**own, **group}
                chosen[run.folder] = group
        if len(groups) > 1:
            marks |= {run.folder: "truth unknown" for run in same}
            marks |= {folder: f"truth {next(iter(group.values()))}" for folder, group in chosen.items()}
    return [
        replace(run, dataset=f"{run.dataset} ({marks[run.folder]})", truth=marks[run.folder])
        if run.folder in marks
        else run
        for run in runs
    ]


def _distinguishing_suffixes(names: Sequence[Any], settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a suffix for each name, such as " (ensemble=1)": the settings in which equal names differ."""
    suffixes = []
    for name, own in zip(names, settings, strict=True):
        others = [other for same, other in zip(names, settings, strict=True) if same == name]
        keys = [key for key in own if any(other.get(key) != own[key] for other in others)]
        text = ", ".join(f"{key}={own[key]}" for key in keys if own[key] is not None)
        suffixes.append(f" ({text})" if text else "")
    return suffixes


def _newest(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Remove scenes that a newer run of the same method has too; return the runs and notes on removed scenes."""
    kept: list[Run] = []
    notes = []
    taken: dict[tuple[Any, ...], Path] = {}
    for run in sorted(runs, key=lambda each: (each.folder / _SCORES).stat().st_mtime, reverse=True):
        keys = {scene: (run.problem, run.label, run.seed, scene) for scene in run.scenes}
        again = [scene for scene, key in keys.items() if key in taken]
        if again:
            newer = taken[keys[again[0]]]
            notes.append(f"left out: {run.folder}: {', '.join(again)}; {newer} is newer and of the same settings")
        fresh = _without(run, again)
        taken |= {keys[scene]: run.folder for scene in fresh.scenes}
        if fresh.scenes:
            kept.append(fresh)
    return kept, notes
