"""Evaluate scenes: predict each unless its prediction is there, score the stored prediction, and write the tables.

A prediction is ``predictions/SCENE.npz``: ``depth`` (H, W) in metres, NaN where missing; from a method that states how
sure it is its expected absolute errors, ``depth_error`` in metres and ``angle_error`` of the normal in degrees;
``config``, a JSON text of all settings that it depends on; and ``seconds``, its computing time. Infinite, zero and
negative depths are stored as they come and count as missing; a prediction without any other fails. A prediction whose
stored config equals the requested one is reused, so that an interrupted run continues where it stopped.
"""

import json
import math
import re
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from dsr.data.scene_source import SceneSource
from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.degradation.holes import Holes
from dsr.degradation.noise import Noise
from dsr.evaluation.results import load_errors, load_prediction, prediction_path, sample_path
from dsr.methods.base import Method, NoSolutionError, expect_some_depth
from dsr.metrics.alignment import align_errors, align_map
from dsr.metrics.catalogue import Metric, score_image
from dsr.metrics.formats import HEADLINES
from dsr.sample import DepthSample
from dsr.utils.arrays import read_arrays
from dsr.utils.configuration import ConfigError
from dsr.utils.console import one_line
from dsr.utils.files import replacing, write_text
from dsr.utils.guards import parse_json, path_within, refusing_excess
from dsr.utils.progress import SILENT, Progress
from dsr.utils.ratios import round_ratio

SCORE_COLUMNS = (
    "dataset", "scene", "scale", "downsampling", "method", "seed", "metric", "variant", "value", "valid_share",
)  # fmt: skip
# Draws a picture of a sample, the predicted depth with its expected errors, if any, and its worst-of-four scores
Illustrate = Callable[[DepthSample, Tensor, tuple[Tensor, Tensor] | None, Mapping[str, float]], None]


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one method on one data set."""

    folder: Path  # of the run
    source: SceneSource
    downsampling: Downsampling | Measured
    downsampling_name: str  # as in ``scores.csv``, like the method's
    scale: float
    method: Method
    method_name: str
    seed: int
    config: Mapping[str, Any]  # settings that the predictions depend on besides the scene, as plain values
    metrics: tuple[Metric, ...]
    device: torch.device = field(default=torch.device("cpu"))
    noise: Noise | None = None
    holes: Holes | None = None
    alignment: str = "none"  # of each prediction before it is scored and drawn
    label: str = ""  # name in tables; empty for ``method_name``
    illustrate: Illustrate = lambda *_: None
    turns: threading.Lock = field(default_factory=threading.Lock)  # for threads, which predict one at a time
    ended: threading.Event = field(default_factory=threading.Event)  # after an interruption: no prediction begins

    def sample(self, scene: str) -> DepthSample:
        """Return the method's input for a scene; a ValueError if a file of the scene is invalid."""
        loaded = self.source.load(scene)
        kind = self.method.range_type
        sample = make_sample(loaded, self.scale, self.downsampling, kind, self.noise, self.seed, self.holes)
        note = self.method.describe(sample)
        return replace(sample, notes=(*sample.notes, note)) if note else sample


@dataclass
class SceneResult:
    """What came of a scene: its computing time and scores, or one line that says why there is no prediction."""

    seconds: float = math.nan
    reused: bool = False
    failure: str = ""
    unsolved: str = ""
    rows: list[tuple[Any, ...]] = field(default_factory=list)  # of ``scores.csv``
    notes: tuple[str, ...] = ()
    truth: str | None = ""  # identifies the ground truth; None for a scene without


class StalePredictionError(ConfigError):
    """A stored prediction has other settings, and overwriting is not enabled."""


def evaluate_scene(study: Evaluation, scene: str, since: float = -math.inf, progress: Progress = SILENT) -> SceneResult:
    """Predict a scene unless a prediction later than ``since`` is there, then score and draw the stored one."""
    result = SceneResult()
    path = prediction_path(study.folder, scene)
    try:
        with refusing_excess():
            content = study.method.content(study.source.name, scene, study.scale)
            own = {} if content is None else {"method_content": content}
            config = {**study.config, "scene": scene, "scene_content": study.source.fingerprint(scene), **own}
            config = json.loads(json.dumps(config))  # as a stored one comes back
            result.reused = path.is_file() and path.stat().st_mtime > since
            result.seconds = (
                _stored_seconds(path, config) if result.reused else _predict(study, scene, config, progress)
            )
            if not sample_path(study.folder, scene).is_file():
                study.sample(scene).save(sample_path(study.folder, scene))
            _score(study, scene, result)
    except StalePredictionError:
        raise
    except NoSolutionError as error:
        path.unlink(missing_ok=True)
        result.unsolved = failure_line(scene, error)
    except (ValueError, OSError) as error:
        result.failure = failure_line(scene, error)
    return result


def failure_line(scene: str, error: BaseException) -> str:
    """Return an error message as one line that names the scene."""
    message = one_line(error)
    named = re.search(rf"(^|[/\\]){re.escape(scene)}[/\\:.]", message)  # first, or in a path
    return message if named else f"{scene}: {message}"


def _stored_seconds(path: Path, config: Mapping[str, Any]) -> float:
    """Return the computing time of a stored prediction, whose config has to be the given one."""
    try:
        arrays = read_arrays(path)
        stored, seconds = dict(parse_json(str(arrays["config"]), finite=False)), float(arrays["seconds"])
    except (OSError, KeyError, ValueError, TypeError):
        raise StalePredictionError(f"{path}: damaged; overwrite=true makes it again") from None
    changed = sorted(key for key in stored.keys() | config.keys() if stored.get(key) != config.get(key))
    if changed:
        raise StalePredictionError(
            f"{path}: made with another {', '.join(changed)}; overwrite=true replaces it, another output_dir keeps it"
        )
    return seconds


def _predict(study: Evaluation, scene: str, config: Mapping[str, Any], progress: Progress) -> float:
    """Compute one prediction; write it, its sample and the iteration's history; return the method's seconds."""
    sample = study.sample(scene)
    with study.turns, progress.task("steps") as step:
        if study.ended.is_set():
            raise CancelledError
        start = time.perf_counter()
        surface = study.method.surface(sample, step)
        seconds, history = time.perf_counter() - start, study.method.history
    depth = surface.depth
    expected = (1, sample.camera.height, sample.camera.width)
    if tuple(depth.shape) != expected:
        raise ValueError(f"{scene}: {study.method_name} gave depth of shape {tuple(depth.shape)}, expected {expected}")
    expect_some_depth(depth, f"{scene}: {study.method_name}")
    if history is not None:
        with replacing(path_within(study.folder, scene, f"{study.folder}: scene", "iterations/{}.csv")) as temporary:
            pd.DataFrame(history).to_csv(temporary, index=False)
    sample.save(sample_path(study.folder, scene))
    with replacing(prediction_path(study.folder, scene)) as temporary:
        np.savez_compressed(
            temporary,
            allow_pickle=False,
            depth=depth[0].cpu().numpy(),
            config=json.dumps(config, sort_keys=True),
            seconds=seconds,
            **surface.error_arrays(),
        )
    return seconds


def _score(study: Evaluation, scene: str, result: SceneResult) -> None:
    """Score and draw the stored prediction of a scene, from the files of the run alone."""
    path = sample_path(study.folder, scene)
    sample, given = DepthSample.load(path), load_prediction(prediction_path(study.folder, scene))
    if sample.scene != scene:  # its name becomes that of pictures
        raise ValueError(f"{path}: expected the scene {scene}, got {sample.scene!r:.100}")
    truth = sample.depth
    if truth is not None and given.shape != truth.shape:
        came, expected = tuple(given.shape), tuple(truth.shape)
        raise ValueError(f"{scene}: expected a prediction of shape {expected}, got {came}")
    depth = align_map(given, truth, study.alignment)
    errors = load_errors(prediction_path(study.folder, scene))
    errors = align_errors(errors, given, depth, study.alignment)
    result.notes = tuple(sample.notes)
    result.truth = None if truth is None else f"{zlib.crc32(truth.numpy().tobytes()):08x}"
    headlines = {}
    if truth is not None:
        scores = list(
            score_image(
                depth.to(study.device, torch.float64),
                truth.to(study.device, torch.float64),
                sample.camera.rays(device=study.device),
                study.metrics,
                sample.unit,
                regions={name: region.to(study.device) for name, region in sample.regions.items()},
                errors=None if errors is None else (errors[0].to(study.device), errors[1].to(study.device)),
                measured=sample.depth_lr.to(study.device, torch.float64) if study.alignment == "none" else None,
            )
        )
        about = (sample.dataset, sample.scene, round_ratio(sample.scale), study.downsampling_name, study.method_name,
                 study.seed)  # fmt: skip
        result.rows = [(*about, each.metric, each.variant, each.value, each.valid_share) for each in scores]
        headlines = {each.metric: each.value for each in scores if each.variant in HEADLINES}
    study.illustrate(sample, depth, errors, headlines)


def write_tables(study: Evaluation, results: Mapping[str, SceneResult]) -> pd.DataFrame:
    """Write ``scores.csv`` and ``summary.json`` of the results by scene; return the content of ``scores.csv``."""
    rows = [row for each in results.values() for row in each.rows]
    scores = pd.DataFrame(rows, columns=list(SCORE_COLUMNS))
    with replacing(study.folder / "scores.csv") as temporary:
        scores.to_csv(temporary, index=False)
    there = {scene: each for scene, each in results.items() if not math.isnan(each.seconds)}
    summary = {
        "dataset": study.source.name,
        "scale": round_ratio(study.scale),
        "downsampling": study.downsampling_name,
        "method": study.method_name,
        "label": study.label or study.method_name,
        "seed": study.seed,
        "scenes": scores["scene"].nunique(),
        "mean": headline_means(scores),
        "seconds": {scene: each.seconds for scene, each in there.items()},
        "predicted": [scene for scene, each in there.items() if not each.reused],
        "reused": [scene for scene, each in there.items() if each.reused],
        "without_truth": [scene for scene, each in results.items() if each.truth is None],
        "notes": {scene: list(each.notes) for scene, each in results.items() if each.notes},
        "failures": {scene: each.failure for scene, each in results.items() if each.failure},
        "unanswered": {scene: each.unsolved for scene, each in results.items() if each.unsolved},
        "metrics": {metric.name: asdict(metric.format) for metric in study.metrics},
        "truths": {scene: each.truth for scene, each in results.items() if each.truth},
    }
    write_text(study.folder / "summary.json", json.dumps(summary, indent=1) + "\n")
    return scores


def headline_means(scores: pd.DataFrame) -> dict[str, float]:
    """Return each metric's mean over the scenes, of the worst of four lights for metrics of renderings."""
    worst = scores[scores["variant"].isin(HEADLINES)]
    means = worst.groupby("metric", sort=False)["value"].mean()
    return {str(name): float(value) for name, value in means.items()}
