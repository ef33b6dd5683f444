"""Runs of evaluations, for tables, figures and pages; :mod:`dsr.evaluation.run_files` reads them from files."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from torch import Tensor

from dsr.evaluation.store import load_errors, load_prediction, prediction_path, sample_path
from dsr.metrics.alignment import ALIGNMENTS, align_map
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import HEADLINES, MetricFormat, complete_formats, in_tables
from dsr.notes import LIMITS, Assumption
from dsr.sample import DepthSample
from dsr.utils.arrays import array_headers

METHOD_ORDER = (
    "Nearest", "Bilinear", "Bicubic", "Bilateral", "GF", "JBU", "FGS", "Diffusion", "TGV",
    "SRfS", "EG", "PDN", "DG", "DIP", "MSG", "DIP-V", "MSG-V",
)  # fmt: skip
"""Order of the methods: simple ones, then those of the paper in the order of its tables; others follow."""
_DATASET_ORDER = ("simgeo", "icl", "middlebury", "sunrgbd", "tofmark")


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
        notes: remarks on the scores of a scene, by its name.
        truths: identifies its ground truths, by scene.
        truth: identifies its ground truth where other runs have a different one for the same scenes, as in
            ``dataset``; empty otherwise.

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
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)
    truths: Mapping[str, str] = field(default_factory=dict)
    truth: str = ""

    @property
    def problem(self) -> BenchmarkSetting:
        """The setting of the run."""
        return BenchmarkSetting(self.dataset, self.scale, self.downsampling)

    @property
    def alignment(self) -> str:
        """How predictions were aligned to the truth before they were scored, one of ``ALIGNMENTS``."""
        return str(self.settings.get("alignment", "none"))

    @functools.cached_property
    def headlines(self) -> dict[str, dict[str, float]]:
        """The scores by scene and metric in raw units, worst of four lights for metrics of renderings."""
        rows = self.scores[self.scores["variant"].fillna("").isin(HEADLINES)]
        found: dict[str, dict[str, float]] = {}
        for scene, metric, value in zip(rows["scene"], rows["metric"], rows["value"], strict=True):
            found.setdefault(str(scene), {})[str(metric)] = float(value)
        return found

    def size(self, scene: str) -> tuple[int, ...] | None:
        """Return height and width of a scene's prediction in pixels, None without a readable one."""
        try:
            return array_headers(prediction_path(self.folder, scene))["depth"][0]
        except (OSError, ValueError, KeyError):
            return None

    def prediction(self, scene: str) -> Tensor:
        """Return the predicted depth, (1, H, W) in metres, NaN in holes; aligned where it was for its scores."""
        depth = load_prediction(prediction_path(self.folder, scene))
        return depth if self.alignment == "none" else align_map(depth, self.sample(scene).depth, self.alignment)

    def expected_errors(self, scene: str) -> tuple[Tensor, Tensor] | None:
        """Return the expected errors, (1, H, W): depth in metres, normal in degrees; None for a method without them."""
        return load_errors(prediction_path(self.folder, scene))

    def sample(self, scene: str) -> DepthSample:
        """Return the method's input for a scene."""
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
    def warnings(self) -> tuple[Assumption, ...]:
        """Warnings of scenes with the same name but different ground truths."""
        apart: dict[tuple[str, float], dict[str, list[Run]]] = {}
        for run in self.runs:
            if run.truth:
                name = run.dataset.removesuffix(f" ({run.truth})")
                apart.setdefault((name, run.scale), {}).setdefault(run.dataset, []).append(run)
        return tuple(
            Assumption(
                f"{name} x{scale}: the runs have different ground truths for scenes of the same names: listed apart",
                "; ".join(
                    f"{dataset}: {runs[0].folder}{f' and {len(runs) - 1} more' if len(runs) > 1 else ''}"
                    for dataset, runs in of_truth.items()
                ),
                "truths-differ",
                len(of_truth),
            )
            for (name, scale), of_truth in apart.items()
            if len(of_truth) >= LIMITS["truths-differ"]
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """The warnings, the notes, and how predictions were aligned."""
        aligned = alignment_note(self.runs)
        return (*map(str, self.warnings), *self.notes, *([aligned] if aligned else []))

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
        return sorted({run.label for run in self.runs}, key=method_key)

    def problems(self) -> list[BenchmarkSetting]:
        """Return the evaluated settings, in order."""
        return list(dict.fromkeys(run.problem for run in self.runs))

    def of(self, problem: BenchmarkSetting) -> list[Run]:
        """Return the runs of a setting, in order."""
        return [run for run in self.runs if run.problem == problem]

    def by_scene(self, problem: BenchmarkSetting) -> dict[str, list[Run]]:
        """Return the scenes of a setting with the runs that have a prediction of each, in the order of the runs."""
        having: dict[str, list[Run]] = {}
        for run in self.of(problem):
            for scene in run.scenes:
                having.setdefault(scene, []).append(run)
        return having

    def only(self, methods: Sequence[str] = (), datasets: Sequence[str] = (), scales: Sequence[float] = ()) -> Results:
        """Return the runs of some methods (by label), data sets and scales; an empty sequence selects all."""
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


def alignment_note(runs: Sequence[Run]) -> str:
    """Return how predictions of some runs were aligned to the truth before they were scored; empty if none were."""
    labels: dict[str, list[str]] = {}
    for run in runs:
        labels.setdefault(run.alignment, [])
        if run.label not in labels[run.alignment]:
            labels[run.alignment].append(run.label)
    found = [
        f"{', '.join(of)} aligned to the ground truth before scoring, {ALIGNMENTS.get(how, 'unknown')} ({how})"
        for how, of in labels.items()
        if how != "none"
    ]
    return f"{'; '.join(found)}." if found else ""


def one_per_method(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return the run of each label with the lowest seed, in the order of the labels."""
    lowest: dict[str, Run] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        lowest.setdefault(run.label, run)
    return tuple(lowest[label] for label in dict.fromkeys(run.label for run in runs))


def method_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a run's method: its configuration without names and the origin of weights."""
    method = settings.get("method")
    known = method if isinstance(method, Mapping) else {}
    return {key: value for key, value in known.items() if key != "_target_" and not key.startswith("weights_")}


def problem_key(problem: BenchmarkSetting) -> tuple[Any, ...]:
    """Order data sets as the paper does, others after them."""
    return (*_rank(problem.dataset.partition(" (")[0], _DATASET_ORDER), problem)


def method_key(label: str) -> tuple[Any, ...]:
    """Order methods as the paper's tables do, others after them."""
    return (*_rank(label.partition(" (")[0], METHOD_ORDER), label)


def _rank(name: str, order: Sequence[str]) -> tuple[int, str]:
    return (order.index(name), "") if name in order else (len(order), name)
