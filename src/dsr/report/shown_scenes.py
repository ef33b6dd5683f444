"""Scenes of a benchmark setting with the results of all methods, as figures show them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from dsr.evaluation.results import BenchmarkSetting, Results, Run, sample_path
from dsr.geometry.camera import Camera
from dsr.sample import DepthSample
from dsr.utils.arrays import array_headers

_NOT_STORED = "no run has stored its photo and input"


@dataclass(frozen=True)
class Shown:
    """A scene and its results.

    Args:
        name: name of the scene.
        scene: input and ground truth.
        depths: (1, H, W) results in metres by method, None without a result.
        scores: scores by method and metric, worst of four lights, raw units.

    """

    name: str
    scene: DepthSample
    depths: dict[str, Tensor | None]
    scores: dict[str, dict[str, float]]

    def existing(self) -> list[Tensor]:
        """Return the existing results."""
        return [depth for depth in self.depths.values() if depth is not None]


def first_runs(results: Results, problem: BenchmarkSetting) -> dict[str, list[Run]]:
    """Return the runs of a benchmark setting by method, sorted by seed."""
    runs: dict[str, list[Run]] = {}
    for run in results.of(problem):
        runs.setdefault(run.label, []).append(run)
    return {label: sorted(each, key=lambda run: run.seed) for label, each in runs.items()}


def drawable_scenes(
    results: Results, problem: BenchmarkSetting, notes: list[str], *, with_truth: bool = False
) -> list[str]:
    """Return the scenes of a benchmark setting that a run has stored, without reading their pictures.

    Args:
        results: all runs.
        problem: benchmark setting.
        notes: list to which one line is added per scene left out because no run has stored it.
        with_truth: whether scenes without ground truth are left out, too.

    """
    names = []
    for name, runs in results.by_scene(problem).items():
        stored = next((run for run in runs if run.has_sample(name)), None)
        if stored is None:
            _note(notes, f"no figures of {name}: {_NOT_STORED}")
        elif not with_truth or _has_truth(stored, name):
            names.append(name)
    return names


def _has_truth(run: Run, name: str) -> bool:
    """Return whether a stored scene has ground truth; a damaged one may have it elsewhere."""
    try:
        return "depth" in array_headers(sample_path(run.folder, name))
    except (ValueError, OSError):
        return True


def shown_scenes(
    results: Results, problem: BenchmarkSetting, notes: list[str], names: Iterable[str] | None = None
) -> Iterator[Shown]:
    """Yield scenes of a benchmark setting one by one.

    Args:
        results: all runs.
        problem: benchmark setting.
        notes: list to which one line is added per scene or result left out.
        names: names of the scenes; None for all.

    """
    runs = first_runs(results, problem)
    by_scene = results.by_scene(problem)
    for name in by_scene if names is None else names:
        scene = _stored(name, by_scene.get(name, ()), notes)
        if scene is None:
            continue
        depths: dict[str, Tensor | None] = {}
        scores: dict[str, dict[str, float]] = {}
        for label, each in runs.items():
            run = next((run for run in each if name in run.scenes), None)
            depths[label] = None if run is None else _prediction(run, name, scene.camera, notes)
            scores[label] = {} if run is None else run.headlines.get(name, {})
        yield Shown(name, scene, depths, scores)


def _stored(name: str, runs: Sequence[Run], notes: list[str]) -> DepthSample | None:
    """Return the scene from the first run that has stored it."""
    reason = _NOT_STORED
    for run in runs:
        if run.has_sample(name):
            try:
                return run.sample(name)
            except ValueError as error:
                reason = str(error)
    _note(notes, f"no figures of {name}: {reason}")
    return None


def _prediction(run: Run, name: str, camera: Camera, notes: list[str]) -> Tensor | None:
    """Return a result, None if it cannot be drawn."""
    try:
        depth = run.prediction(name)
    except ValueError as error:
        _note(notes, str(error))
        return None
    if tuple(depth.shape) == (1, camera.height, camera.width):
        return depth
    expected, came = (f"{height} x {width}" for height, width in ((camera.height, camera.width), depth.shape[-2:]))
    _note(notes, f"{run.folder}: {name}: expected a result of the photo's {expected} pixels, got {came}; not drawn")
    return None


def _note(notes: list[str], line: str) -> None:
    if line not in notes:
        notes.append(line)
