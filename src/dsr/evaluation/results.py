"""Read the directories of evaluations, for tables, figures and pages.

Only files are read: ``scores.csv``, ``summary.json``, ``versions.json``, predictions and stored scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import pandas as pd
from pydantic import BaseModel, ValidationError
from torch import Tensor

from dsr.evaluation.store import load_prediction, prediction_path, sample_path
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import MetricFormat, complete_formats, in_tables
from dsr.sample import DepthSample
from dsr.utils.ratios import as_ratio
from dsr.utils.validation import describe

METHOD_ORDER = (
    "Nearest", "Bilinear", "Bicubic", "Bilateral", "GF", "JBU", "FGS", "Diffusion", "TGV",
    "SRfS", "EG", "PDN", "DG", "DIP", "MSG", "DIP-V", "MSG-V",
)  # fmt: skip
"""Order of the methods: simple ones, then those of the paper in the order of its tables; others follow."""
_DATASET_ORDER = ("simgeo", "icl", "middlebury", "sunrgbd", "tofmark")
_SCORES, _SUMMARY, _VERSIONS = "scores.csv", "summary.json", "versions.json"
_TEXT_COLUMNS = ("dataset", "scene", "downsampling", "method", "metric", "variant")
_NUMBER_COLUMNS = ("scale", "seed", "value", "valid_share")
_NAMES = ("name", "label", "target")
_DIGEST = 8
"""Number of displayed digits of a hash."""
_Content = TypeVar("_Content", bound=BaseModel)


class BenchmarkSetting(NamedTuple):
    """The setting in which methods are compared: a data set, a scale, a degradation."""

    dataset: str
    scale: float
    downsampling: str


@dataclass(frozen=True)
class Run:
    """One run of ``eval.py``: one method on one data set, at one scale, under one degradation, with one seed.

    Args:
        folder: directory of the run.
        dataset, scale, downsampling, seed, method: as in ``scores.csv``; ``downsampling`` includes noise and holes.
        label: displayed name of the method. Runs of a method with different settings have different labels; runs
            that differ only in the seed have the same label.
        scores: rows of ``scores.csv`` for the scenes in ``scenes``, in raw units.
        seconds: computing time by scene.
        settings: the resolved configuration.
        versions: versions of packages, Python and the project.
        scenes: scenes with a prediction.
        unsolved: reason by scene why the method has no solution.
        formats: formats of its metrics that the run stores.

    """

    folder: Path
    dataset: str
    scale: float
    downsampling: str
    seed: int
    method: str
    label: str
    scores: pd.DataFrame
    seconds: Mapping[str, float]
    settings: Mapping[str, Any]
    versions: Mapping[str, Any]
    scenes: tuple[str, ...]
    unsolved: Mapping[str, str] = field(default_factory=dict)
    formats: Mapping[str, MetricFormat] = field(default_factory=dict)

    @property
    def problem(self) -> BenchmarkSetting:
        """The setting of the run."""
        return BenchmarkSetting(self.dataset, self.scale, self.downsampling)

    def prediction(self, scene: str) -> Tensor:
        """Return the predicted depth, (1, H, W) in metres, NaN in holes.

        Raises:
            ValueError: the file is missing or damaged.

        """
        return load_prediction(prediction_path(self.folder, scene))

    def sample(self, scene: str) -> DepthSample:
        """Return the method's input for a scene.

        Raises:
            ValueError: the file is damaged, or missing as in a run of an older dsr.

        """
        return DepthSample.load(sample_path(self.folder, scene))

    def has_sample(self, scene: str) -> bool:
        """Return whether the run stores the method's input for a scene."""
        return sample_path(self.folder, scene).is_file()


@dataclass(frozen=True)
class Results:
    """Any number of runs.

    Args:
        runs: ordered by data set, scale, degradation, and then by method as in the paper's tables, and seed.
        notes: omitted data and reasons.

    """

    runs: tuple[Run, ...]
    notes: tuple[str, ...] = ()

    @property
    def scores(self) -> pd.DataFrame:
        """All scores in one table, with the columns ``label`` and ``run`` besides those of ``scores.csv``."""
        parts = [run.scores.assign(label=run.label, run=str(run.folder)) for run in self.runs]
        return pd.concat(parts, ignore_index=True)

    @property
    def formats(self) -> dict[str, MetricFormat]:
        """See :func:`formats_of`."""
        return formats_of(self.runs)

    def methods(self) -> list[str]:
        """Return the labels of the methods, in order."""
        return sorted({run.label for run in self.runs}, key=_method_key)

    def problems(self) -> list[BenchmarkSetting]:
        """Return the evaluated settings, in order."""
        return list(dict.fromkeys(run.problem for run in self.runs))

    def of(self, problem: BenchmarkSetting) -> list[Run]:
        """Return the runs of a setting, in order."""
        return [run for run in self.runs if run.problem == problem]

    def only(self, methods: Sequence[str] = (), datasets: Sequence[str] = (), scales: Sequence[float] = ()) -> Results:
        """Return the runs of some methods (by label), data sets and scales; an empty sequence selects all.

        Raises:
            ValueError: no run has a requested value, or none has all of them.

        """
        runs = self.runs
        for name, key, wanted in (("methods", "label", methods), ("datasets", "dataset", datasets),
                                    ("scales", "scale", scales)):  # fmt: skip
            there = list(dict.fromkeys(getattr(run, key) for run in self.runs))
            for value in wanted:
                if value not in there:
                    raise ValueError(f"{name}: expected some of {', '.join(map(str, there))}, got {value}")
            runs = tuple(run for run in runs if not wanted or getattr(run, key) in wanted)
        if not runs:
            raise ValueError("methods, datasets, scales: expected a run that fits all of them, there is none")
        return Results(runs, self.notes)


def formats_of(runs: Sequence[Run]) -> dict[str, MetricFormat]:
    """Return the formats of the metrics that tables of some runs show, in the order of the columns.

    Metrics that neither this installation nor a run describes show their raw values under their own names.
    """
    names = dict.fromkeys(str(name) for run in runs for name in run.scores["metric"].unique())
    return in_tables(complete_formats(names, KNOWN_FORMATS, *(run.formats for run in runs)))


def one_per_method(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return the run of each label with the lowest seed, in the order of the labels."""
    lowest: dict[str, Run] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        lowest.setdefault(run.label, run)
    return tuple(lowest[label] for label in dict.fromkeys(run.label for run in runs))


def load_results(paths: Sequence[Path]) -> Results:
    """Read all runs in and below some directories.

    Damaged runs are omitted, and so is the older of two predictions of a scene by the same method. The notes list them.

    Raises:
        ValueError: a path is not a directory, or there is no readable run.

    """
    runs: list[Run] = []
    notes: list[str] = []
    for folder in _folders(paths):
        try:
            runs.append(read_run(folder))
        except ValueError as error:
            notes.append(f"left out: {error}")
    if not runs:
        where = ", ".join(map(str, paths))
        detail = f"; {notes[0]}" if notes else ""
        raise ValueError(f"{where}: expected runs of eval.py (directories with {_SCORES}), found none{detail}")
    runs = _distinguish(runs)
    unsolved = [
        f"{run.label} at x{run.scale} has no solution for {message}"
        for run in runs
        for message in run.unsolved.values()
    ]
    runs, older = _newest(runs)
    if not runs:
        reason = f"; {unsolved[0]}" if unsolved else ""
        raise ValueError(f"{', '.join(map(str, paths))}: expected runs with a prediction, found none{reason}")
    runs.sort(key=lambda run: (_problem_key(run.problem), _method_key(run.label), run.seed))
    return Results(tuple(runs), (*notes, *older, *unsolved))


def _folders(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield the directories of runs in and below the paths, each once."""
    seen = set()
    for path in paths:
        if not path.is_dir():
            raise ValueError(f"{path}: expected a directory with runs of eval.py, there is none")
        for file in sorted(path.rglob(_SUMMARY)):
            if file.resolve() not in seen and (file.parent / _SCORES).is_file():
                seen.add(file.resolve())
                yield file.parent


def read_run(folder: Path) -> Run:
    """Return one run, with the label that it has by itself.

    Raises:
        ValueError: a file of the directory is missing or damaged.

    """
    summary, versions = _read(_Summary, folder / _SUMMARY), _read(_Versions, folder / _VERSIONS)
    settings = versions.identity
    scores = _read_scores(folder / _SCORES)
    method = settings.get("method")
    label = summary.label or (method.get("label") if isinstance(method, Mapping) else None) or summary.method
    dataset = str(scores["dataset"].iloc[0]) if len(scores) else summary.dataset
    scenes = tuple(scene for scene in summary.seconds if prediction_path(folder, scene).is_file())
    scores = scores[scores["scene"].isin(scenes)]
    about = (folder, dataset, as_ratio(summary.scale), summary.downsampling, summary.seed, summary.method, str(label))
    return Run(
        *about,
        scores,
        summary.seconds,
        settings,
        versions.model_extra or {},
        scenes,
        summary.unanswered,
        summary.metrics,
    )


class _Summary(BaseModel):
    """The content of ``summary.json``; runs of earlier versions lack the keys with defaults."""

    dataset: str
    scale: float
    downsampling: str
    method: str
    seed: int
    seconds: dict[str, float]
    label: str | None = None
    unanswered: dict[str, str] = {}
    metrics: dict[str, MetricFormat] = {}


class _Versions(BaseModel, extra="allow"):
    """``versions.json``: versions of packages, Python and the project, and the run's settings."""

    identity: dict[str, Any] = {}


def _read(kind: type[_Content], path: Path) -> _Content:
    """Read and check a JSON file of a run."""
    try:
        return kind.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ValueError(f"{path}: expected a run's JSON, got {error.strerror or error}") from error
    except ValidationError as error:
        raise ValueError(f"{path}: {describe(error)}") from error


def _read_scores(path: Path) -> pd.DataFrame:
    """Return a run's ``scores.csv``; an empty variant is ""."""
    try:
        missing = {name: [""] for name in _NUMBER_COLUMNS}
        scores = pd.read_csv(path, dtype=dict.fromkeys(_TEXT_COLUMNS, str), keep_default_na=False, na_values=missing)
        scores = scores[[*_TEXT_COLUMNS, *_NUMBER_COLUMNS]].astype({"seed": int, "value": float})
        scores["scale"] = pd.to_numeric(scores["scale"])
    except (OSError, ValueError, KeyError, pd.errors.ParserError) as error:
        raise ValueError(f"{path}: expected a run's scores, got a damaged or foreign file") from error
    return scores


def _distinguish(runs: Sequence[Run]) -> list[Run]:
    """Append the differing settings to equal labels and data sets' names of runs.

    Examples: "MSG-V (ensemble=1)", "middlebury (size=256)".
    """
    methods = [_identity_of_method(run.settings) for run in runs]
    datasets = [{**run.settings.get("dataset", {}), "root": None, "scenes": None, "target": None} for run in runs]
    labels = _distinguishing_suffixes([(run.label, run.scale) for run in runs], methods)
    names = _distinguishing_suffixes([(run.dataset, 0) for run in runs], datasets)
    return [
        replace(run, label=run.label + label, dataset=run.dataset + name)
        for run, label, name in zip(runs, labels, names, strict=True)
    ]


def method_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a run's method: its configuration without names and the origin of weights."""
    method = settings.get("method")
    known = method if isinstance(method, Mapping) else {}
    return {key: value for key, value in known.items() if key not in _NAMES and not key.startswith("weights_")}


def _identity_of_method(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that distinguish methods of one label: parameters, weights, precision."""
    found = method_settings(settings)
    for key, name in (("weights_sha256", "weights"), ("precision", "precision")):
        if settings.get(key) is not None:
            found[name] = str(settings[key])[:_DIGEST]
    return found


def _distinguishing_suffixes(names: Sequence[Any], settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a suffix for each name, such as " (ensemble=1)": the settings in which equal names differ."""
    added = []
    for name, own in zip(names, settings, strict=True):
        others = [other for theirs, other in zip(names, settings, strict=True) if theirs == name]
        keys = [key for key in own if any(other.get(key) != own[key] for other in others)]
        text = ", ".join(f"{key}={own[key]}" for key in keys if own[key] is not None)
        added.append(f" ({text})" if text else "")
    return added


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
        scenes = tuple(scene for scene in run.scenes if scene not in again)
        taken |= {keys[scene]: run.folder for scene in scenes}
        if scenes:
            kept.append(replace(run, scenes=scenes, scores=run.scores[run.scores["scene"].isin(scenes)]))
    return kept, notes


def _problem_key(problem: BenchmarkSetting) -> tuple[Any, ...]:
    """Order data sets as the paper does, others after them."""
    return (*_rank(problem.dataset.partition(" (")[0], _DATASET_ORDER), problem)


def _method_key(label: str) -> tuple[Any, ...]:
    """Order methods as the paper's tables do, others after them."""
    return (*_rank(label.partition(" (")[0], METHOD_ORDER), label)


def _rank(name: str, order: Sequence[str]) -> tuple[int, str]:
    return (order.index(name), "") if name in order else (len(order), name)
