"""Runs of evaluations, for tables, figures and pages, and the files of their scenes.

``scenes/SCENE.npz`` is the sample that the method was given. ``predictions/SCENE.npz``, see
:mod:`dsr.evaluation.scenes`, is written with it, so that scoring and drawing need only the directory.
``iterations/SCENE.csv`` is the history of a method that iterates. A name that leads out of the run is an OutsideError.
:mod:`dsr.evaluation.run_files` reads runs from their directories.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from dsr.metrics.alignment import ALIGNMENTS, align_map
from dsr.metrics.formats import HEADLINES, MetricFormat, complete_formats, in_tables
from dsr.notes import LIMITS, Assumption
from dsr.sample import DepthSample
from dsr.utils.arrays import array_headers, read_arrays
from dsr.utils.guards import TooLargeError, path_within

if TYPE_CHECKING:
    import pandas as pd

METHOD_ORDER = (
    "Nearest", "Bilinear", "Bicubic", "Bilateral", "GF", "JBU", "FGS", "Diffusion", "TGV",
    "SRfS", "EG", "PDN", "DG", "DIP", "MSG", "DIP-V", "MSG-V",
)  # fmt: skip
"""Order of the methods: simple ones, then those of the paper in the order of its tables; others follow."""
DATASET_ORDER = ("simgeo", "icl", "middlebury", "sunrgbd", "tofmark")
_ERRORS = ("depth_error", "angle_error")
_DAMAGED = "{}: expected a prediction, got a missing or damaged file"


def prediction_path(folder: Path, scene: str, source: str = "") -> Path:
    """Return where a run keeps a scene's prediction; an error blames ``source``, where the scene's name was read."""
    return path_within(folder, scene, source or f"{folder}: scene", "predictions/{}.npz")


def sample_path(folder: Path, scene: str, source: str = "") -> Path:
    """Return where a run keeps the sample of a scene."""
    return path_within(folder, scene, source or f"{folder}: scene", "scenes/{}.npz")


def load_errors(path: Path) -> tuple[Tensor, Tensor] | None:
    """Return the expected errors of a prediction, (1, H, W): depth in metres, normal in degrees; None without them."""
    maps = _read_maps(path, _ERRORS)
    if not maps:
        return None
    if len(maps) < len(_ERRORS):
        raise ValueError(_DAMAGED.format(path))
    return maps["depth_error"].float(), maps["angle_error"].float()


def load_prediction(path: Path) -> Tensor:
    """Return a predicted depth map, (1, H, W) in metres."""
    maps = _read_maps(path, ("depth",))
    if not maps:
        raise ValueError(_DAMAGED.format(path))
    return maps["depth"]


def _read_maps(path: Path, names: tuple[str, ...]) -> dict[str, Tensor]:
    """Return those of some maps of a prediction that there are, (1, H, W)."""
    try:
        maps = {name: torch.from_numpy(array)[None] for name, array in read_arrays(path, names).items()}
    except TooLargeError:
        raise
    except (OSError, TypeError, ValueError) as error:  # torch has no such dtype, among others
        raise ValueError(_DAMAGED.format(path)) from error
    if any(each.ndim != 3 or not each.is_floating_point() for each in maps.values()):
        raise ValueError(_DAMAGED.format(path))
    return maps


class BenchmarkSetting(NamedTuple):
    """The setting in which methods are compared: a data set, a scale, a degradation."""

    dataset: str
    scale: float
    downsampling: str


@dataclass(frozen=True)
class Run:
    """One run of ``eval.py``: one method on one data set, at one scale, under one degradation, with one seed."""

    folder: Path
    dataset: str  # this one and the next four are as in ``scores.csv``
    scale: float
    downsampling: str  # noise and holes included
    seed: int
    method: str
    label: str  # name in tables; it differs between runs whose settings differ, but for the seed
    scores: pd.DataFrame  # rows of ``scores.csv`` for the scenes in ``scenes``, in raw units
    seconds: Mapping[str, float]  # by scene
    settings: Mapping[str, Any]  # the resolved configuration
    versions: Mapping[str, Any]  # of packages, Python and the project
    scenes: tuple[str, ...]  # with a prediction
    unsolved: Mapping[str, str] = field(default_factory=dict)  # why the method has no solution, by scene
    formats: Mapping[str, MetricFormat] = field(default_factory=dict)  # of its metrics, as stored in the run
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)  # on the scores of a scene
    truths: Mapping[str, str] = field(default_factory=dict)  # identify the ground truths, by scene
    truth: str = ""  # identifies the ground truths if other runs have different ones, as in ``dataset``

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
    """Any number of runs, ordered by data set, scale, degradation, method as in the paper's tables, and seed."""

    runs: tuple[Run, ...]
    notes: tuple[str, ...] = ()  # omitted data and reasons

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
        """All scores in one table, with ``label`` and ``run`` besides the columns of ``scores.csv``."""
        import pandas as pd  # noqa: PLC0415 - dsr upsample, which reads expected errors, needs none

        parts = [run.scores.assign(dataset=run.dataset, label=run.label, run=str(run.folder)) for run in self.runs]
        return pd.concat(parts, ignore_index=True)

    @property
    def formats(self) -> dict[str, MetricFormat]:
        """The formats of the metrics that tables show, in the order of the columns.

        Metrics that neither this installation nor a run describes show their raw values under their own names.
        """
        from dsr.metrics.catalogue import KNOWN_FORMATS  # noqa: PLC0415 - which imports scipy.spatial; as above

        names = dict.fromkeys(str(name) for run in self.runs for name in run.scores["metric"].unique())
        return in_tables(complete_formats(names, KNOWN_FORMATS, *(run.formats for run in self.runs)))

    def methods(self) -> list[str]:
        """Return the labels of the methods, in order."""
        return sorted({run.label for run in self.runs}, key=paper_key)

    def problems(self) -> list[BenchmarkSetting]:
        """Return the evaluated settings, in order."""
        return list(dict.fromkeys(run.problem for run in self.runs))

    def of(self, problem: BenchmarkSetting) -> list[Run]:
        """Return the runs of a setting, in order."""
        return [run for run in self.runs if run.problem == problem]

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


def method_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a run's method: its configuration without names and the origin of weights."""
    method = settings.get("method")
    known = method if isinstance(method, Mapping) else {}
    return {key: value for key, value in known.items() if key != "_target_" and not key.startswith("weights_")}


def paper_key(label: str, order: Sequence[str] = METHOD_ORDER) -> tuple[int, str, str]:
    """Return a key that orders methods, or data sets, as the paper's tables do, and others after them."""
    name, _, _ = label.partition(" (")
    return (order.index(name), "", label) if name in order else (len(order), name, label)
