"""Scenes of a benchmark setting with the results of all methods, as shown in figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from dsr.evaluation.results import BenchmarkSetting, Results, Run
from dsr.evaluation.store import sample_path
from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.shading import lights, shade
from dsr.sample import DepthSample
from dsr.utils.arrays import array_headers
from dsr.viz.panels import Window, normals_seen_by, strongest_window

_DETAIL = 5
"""The side of a detail is 1/5 of the shorter side of the picture."""
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


def scene_names(runs: dict[str, list[Run]]) -> list[str]:
    """Return the scenes with a result of at least one method, in the order of the runs."""
    return list(dict.fromkeys(scene for each in runs.values() for run in each for scene in run.scenes))


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
    runs = first_runs(results, problem)
    ordered = [run for each in runs.values() for run in each]
    names = []
    for name in scene_names(runs):
        stored = next((run for run in ordered if run.has_sample(name)), None)
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
    for name in scene_names(runs) if names is None else names:
        scene = _stored(name, [run for each in runs.values() for run in each], notes)
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


def rendering(depth: Tensor, camera: Camera, light: str) -> np.ndarray:
    """Render a depth map, (1, H, W), under one light: (H, W) in [0, 1], NaN where undefined.

    Raises:
        ValueError: there is no such light.

    """
    if light not in LIGHT_NAMES:
        raise ValueError(f"light: expected one of {', '.join(LIGHT_NAMES)}, got {light!r}")
    if min(depth.shape[-2:]) < 2:
        return np.full(tuple(depth.shape[-2:]), np.nan)
    direction = lights()[LIGHT_NAMES.index(light)][None]
    return shade(normals_seen_by(camera, depth), direction)[0, 0].clamp(0, 1).numpy()


def details_of(pictures: Sequence[np.ndarray], truth: np.ndarray | None, grain: int, count: int = 2) -> list[Window]:
    """Find square windows in which results differ most, on average, from the ground truth or else from their mean.

    Args:
        pictures: renderings of the results, (H, W), NaN where undefined.
        truth: rendering of the ground truth, (H, W), NaN where undefined; None without one.
        grain: pixels in a block; windows consist of whole blocks, at a whole scale factor of pixels of the input.
        count: maximum number of windows, which do not overlap.

    """
    if not pictures:
        return []
    stack = np.nan_to_num(np.stack(pictures))
    difference = np.abs(stack - (stack.mean(axis=0) if truth is None else truth)).mean(axis=0)
    height, width = (side // grain for side in difference.shape)
    blocks = np.nan_to_num(difference)[: height * grain, : width * grain].reshape(height, grain, width, grain)
    side = max(round(min(height, width) / _DETAIL), 1)
    windows: list[Window] = []
    for _ in range(count):
        window = strongest_window(blocks.mean(axis=(1, 3)), side, side, windows)
        if window is not None:
            windows.append(window)
    return [Window(*(grain * value for value in window)) for window in windows]
