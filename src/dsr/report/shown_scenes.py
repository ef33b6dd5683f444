"""Scenes of a benchmark setting with one result per method, as figures, pages and studies show them."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from dsr.evaluation.results import BenchmarkSetting, Results, Run
from dsr.sample import DepthSample


@dataclass(frozen=True)
class View:
    """A scene of a benchmark setting and its runs, of each method the one with the lowest seed."""

    problem: BenchmarkSetting
    scene: str
    runs: tuple[Run, ...]

    def __str__(self) -> str:
        dataset, scale, downsampling = self.problem
        return f"{dataset}/{self.scene} x{scale} {downsampling}"


@dataclass(frozen=True)
class Result:
    """The prediction of a run."""

    run: Run
    depth: Tensor  # (1, H, W) float64, metres, NaN in holes
    errors: tuple[Tensor, Tensor] | None  # expected ones of depth in metres and of normals in degrees, (1, H, W)


def views_of(results: Results, problem: BenchmarkSetting) -> list[View]:
    """Return the scenes of a setting that have predictions."""
    found: dict[str, dict[str, Run]] = {}
    for run in results.of(problem):
        for scene in run.scenes:
            lowest = found.setdefault(scene, {})
            lowest[run.label] = min(lowest.get(run.label, run), run, key=lambda each: each.seed)
    return [View(problem, scene, tuple(runs.values())) for scene, runs in found.items()]


def stored_sample(view: View, notes: list[str]) -> DepthSample | None:
    """Return the scene from the first run that has stored it, None if none has; ``notes`` takes the reasons."""
    for run in view.runs:
        if run.has_sample(view.scene):
            try:
                return run.sample(view.scene)
            except ValueError as error:
                notes.append(str(error))
    notes.append(f"{view}: no pictures, because no run has stored photo and input")
    return None


def results_of(view: View, stored: DepthSample, notes: list[str]) -> list[Result]:
    """Return the predictions of the scene's size; ``notes`` takes others, and expected errors that do not fit."""
    size = (1, stored.camera.height, stored.camera.width)

    def expect_size(run: Run, maps: Sequence[Tensor]) -> None:
        for each in maps:
            if tuple(each.shape) != size:
                expected = f"expected maps of the photo's {size[1]} x {size[2]} pixels"
                got = " x ".join(map(str, each.shape[1:]))
                raise ValueError(f"{run.folder}: {view.scene}: {expected}, got {got}; not shown")

    found = []
    for run in view.runs:
        try:
            depth, errors = run.prediction(view.scene), None
            expect_size(run, [depth])
        except (ValueError, OSError) as error:
            notes.append(str(error))
            continue
        try:
            errors = run.expected_errors(view.scene)
            expect_size(run, errors or ())
        except (ValueError, OSError) as error:
            notes.append(str(error))
            errors = None
        found.append(Result(run, depth.double(), errors))
    return found


@dataclass(frozen=True)
class Shown:
    """A scene and its results by method."""

    name: str
    scene: DepthSample
    depths: dict[str, Tensor | None]  # (1, H, W) in metres, None without a result
    scores: dict[str, dict[str, float]]  # by metric, worst of four lights, raw units


def shown_of(view: View, methods: Sequence[str], notes: list[str]) -> Shown | None:
    """Return a scene with the results of some methods, None if no run has stored it; ``notes`` takes what it lacks."""
    stored = stored_sample(view, notes)
    if stored is None:
        return None
    depths = {each.run.label: each.depth for each in results_of(view, stored, notes)}
    scores = {run.label: run.headlines.get(view.scene, {}) for run in view.runs}
    return Shown(view.scene, stored, dict.fromkeys(methods) | depths, {label: {} for label in methods} | scores)
