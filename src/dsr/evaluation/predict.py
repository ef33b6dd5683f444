"""The first pass of an evaluation: predictions to files. The second one scores them, see :mod:`dsr.evaluation.score`.

A prediction is ``predictions/SCENE.npz``: ``depth`` (H, W) in metres, NaN where missing; from a method that says how
sure it is its expected absolute errors, ``depth_error`` in metres and ``angle_error`` of the normal in degrees;
``config``, a JSON text of all settings that it depends on; and ``seconds``, its computing time. Infinite, zero and
negative depths are stored as they come and count as missing; a prediction without any other fails. Its sample is stored
too, see :mod:`dsr.evaluation.store`. Predictions whose stored config equals the requested one are reused, so an
interrupted run continues where it stopped. A scene that fails, or without a solution, does not affect the others.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from dsr.data.scene_source import SceneSource
from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.degradation.holes import Holes
from dsr.degradation.noise import Noise
from dsr.evaluation.sharing import ALONE, Claims, Workers, share
from dsr.evaluation.store import iterations_path, prediction_path, sample_path
from dsr.methods.base import Method, NoSolutionError, expect_some_depth
from dsr.sample import DepthSample
from dsr.utils.arrays import read_arrays
from dsr.utils.console import one_line
from dsr.utils.files import look_anew, replacing
from dsr.utils.guards import parse_json
from dsr.utils.memory import refusing_excess
from dsr.utils.pool import LOST
from dsr.utils.progress import SILENT, Progress


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one method on one data set with one downsampling model.

    Args:
        source: the data set.
        downsampling: the model.
        downsampling_name: as in ``scores.csv``.
        scale: the upsampling factor.
        method: the method.
        method_name: as in ``scores.csv``.
        seed: seed of all random numbers.
        config: settings that the predictions depend on besides the scene, as plain values; stored with each.
        device: device of the predictions and scores.
        noise: noise of the low-resolution maps.
        holes: holes of the low-resolution maps.
        label: displayed name of the method; empty for ``method_name``.

    """

    source: SceneSource
    downsampling: Downsampling | Measured
    downsampling_name: str
    scale: float
    method: Method
    method_name: str
    seed: int
    config: Mapping[str, Any]
    device: torch.device = field(default=torch.device("cpu"))
    noise: Noise | None = None
    holes: Holes | None = None
    label: str = ""

    def sample(self, scene: str) -> DepthSample:
        """Return the method's input for a scene.

        Raises:
            ValueError: a file of the scene is invalid.

        """
        loaded = self.source.load(scene)
        kind = self.method.range_type
        sample = make_sample(loaded, self.scale, self.downsampling, kind, self.noise, self.seed, self.holes)
        note = self.method.describe(sample)
        return replace(sample, notes=(*sample.notes, note)) if note else sample

    def stored_config(self, scene: str) -> dict[str, Any]:
        """Return the settings that a prediction of this scene depends on."""
        content = self.method.content(self.source.name, scene, self.scale)
        own = {} if content is None else {"method_content": content}
        return {**self.config, "scene": scene, "scene_content": self.source.fingerprint(scene), **own}


@dataclass
class Outcome:
    """The outcome of a pass over the scenes.

    Args:
        made, reused: scenes whose prediction was computed, and scenes whose stored prediction was reused.
        failures: error message by scene, one line each.
        unsolved: reason by scene why the method has no solution, one line each.
        notes: notes on the scores by scene.
        seconds: computing time per scene.
        unscored: scenes without a high-resolution depth map to compare with.

    """

    made: list[str] = field(default_factory=list)
    reused: list[str] = field(default_factory=list)
    failures: dict[str, str] = field(default_factory=dict)
    unsolved: dict[str, str] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    unscored: list[str] = field(default_factory=list)


class StalePredictionError(ValueError):
    """A stored prediction has other settings, and overwriting is not enabled."""


@dataclass(frozen=True)
class _Predicted:
    """What became of a scene: its computing time, or why there is no prediction, in one line."""

    seconds: float = math.nan
    reused: bool = False
    failure: str = ""
    unsolved: str = ""


def predict(
    study: Evaluation,
    folder: Path,
    progress: Progress = SILENT,
    *,
    overwrite: bool = False,
    workers: Workers = ALONE,
) -> Outcome:
    """Write the samples and predictions of all scenes without one.

    Other processes may do the same in the same directory at the same time: each scene is predicted by one of them.

    Args:
        study: evaluation to run.
        progress: display of the completed scenes, and of the method's steps within a scene.
        overwrite: whether stored predictions are recomputed, but for those that another process stores meanwhile.
        workers: how many scenes are predicted at a time, each in a process of its own.

    Raises:
        StalePredictionError: a stored prediction has another configuration and ``overwrite`` is not set.

    """
    with Claims(folder) as claims:
        since = claims.now() if overwrite else -math.inf

        def ready(scene: str) -> _Predicted | None:
            look_anew(prediction_path(folder, scene).parent)
            return _attempt(study, scene, folder, lambda config: _reuse(study, scene, folder, config, since))

        def work(scene: str, steps: Progress) -> _Predicted:
            def compute(config: Mapping[str, Any]) -> _Predicted:
                return _Predicted(_predict_scene(study, scene, folder, config, steps))

            result = _attempt(study, scene, folder, compute)
            assert result is not None  # noqa: S101 - only reusing may find nothing
            return result

        scenes = study.source.scenes()
        found = share(scenes, claims, "predict", ready, work, _lost, workers, progress)
    return _outcome(found)


def _outcome(found: Mapping[str, _Predicted]) -> Outcome:
    """Return what became of all scenes."""
    outcome = Outcome()
    for scene, each in found.items():
        if each.failure:
            outcome.failures[scene] = each.failure
        elif each.unsolved:
            outcome.unsolved[scene] = each.unsolved
        else:
            outcome.seconds[scene] = each.seconds
            (outcome.reused if each.reused else outcome.made).append(scene)
    return outcome


def _attempt(
    study: Evaluation, scene: str, folder: Path, function: Callable[[Mapping[str, Any]], _Predicted | None]
) -> _Predicted | None:
    """Return what a function of a scene's settings returns, or what became of the scene instead."""
    try:
        with refusing_excess():
            return function(study.stored_config(scene))
    except StalePredictionError:
        raise
    except NoSolutionError as error:
        prediction_path(folder, scene).unlink(missing_ok=True)
        return _Predicted(unsolved=failure_line(scene, error))
    except (ValueError, OSError) as error:
        return _Predicted(failure=failure_line(scene, error))


def _reuse(study: Evaluation, scene: str, folder: Path, config: Mapping[str, Any], since: float) -> _Predicted | None:
    """Return the outcome of a stored prediction, which then has a sample, too; None if there is none.

    A prediction from before the time ``since`` counts as none, unless that is minus infinity.
    """
    path = prediction_path(folder, scene)
    if since > -math.inf and (not path.is_file() or path.stat().st_mtime <= since):
        return None
    seconds = _seconds_of_current(path, config)
    if seconds is None:
        return None
    if not sample_path(folder, scene).is_file():
        study.sample(scene).save(sample_path(folder, scene))
    return _Predicted(seconds, reused=True)


def _lost(scene: str) -> _Predicted:
    """Return the outcome of a scene whose workers were killed."""
    return _Predicted(failure=f"{scene}: {LOST}")


def failure_line(scene: str, error: BaseException) -> str:
    """Return an error message as one line that names the scene."""
    message = one_line(error)
    named = re.search(rf"(^|[/\\]){re.escape(scene)}[/\\:.]", message)  # first, or in a path
    return message if named else f"{scene}: {message}"


def _seconds_of_current(path: Path, config: Mapping[str, Any]) -> float | None:
    """Return the computing time of the stored prediction if its config is ``config``; None if there is none."""
    try:
        arrays = read_arrays(path)
        stored, seconds = dict(parse_json(str(arrays["config"]), finite=False)), float(arrays["seconds"])
    except FileNotFoundError:
        return None
    except (OSError, KeyError, ValueError, TypeError):
        raise StalePredictionError(f"{path}: damaged; overwrite=true makes it again") from None
    wanted = json.loads(json.dumps(config))
    if stored == wanted:
        return seconds
    changed = sorted(key for key in stored.keys() | wanted.keys() if stored.get(key) != wanted.get(key))
    raise StalePredictionError(
        f"{path}: made with another {', '.join(changed)}; overwrite=true replaces it, another output_dir keeps it"
    )


def _predict_scene(study: Evaluation, scene: str, folder: Path, config: Mapping[str, Any], progress: Progress) -> float:
    """Compute one prediction; write it, its sample and the iteration's history; return the method's seconds."""
    sample = study.sample(scene)
    start = time.perf_counter()
    with progress.task("steps") as step:
        surface = study.method.surface(sample, step)
    seconds = time.perf_counter() - start
    depth = surface.depth
    expected = (1, sample.camera.height, sample.camera.width)
    if tuple(depth.shape) != expected:
        raise ValueError(f"{scene}: {study.method_name} gave depth of shape {tuple(depth.shape)}, expected {expected}")
    expect_some_depth(depth, f"{scene}: {study.method_name}")
    if study.method.history is not None:
        with replacing(iterations_path(folder, scene)) as temporary:
            pd.DataFrame(study.method.history).to_csv(temporary, index=False)
    sample.save(sample_path(folder, scene))
    with replacing(prediction_path(folder, scene)) as temporary:
        np.savez_compressed(
            temporary,
            allow_pickle=False,
            depth=depth[0].cpu().numpy(),
            config=json.dumps(dict(config), sort_keys=True),
            seconds=seconds,
            **surface.error_arrays(),
        )
    return seconds
