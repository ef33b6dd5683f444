"""The first pass of an evaluation: predictions to files. The second one scores them, see :mod:`dsr.evaluation.score`.

A prediction is ``predictions/SCENE.npz``: ``depth`` (H, W) in metres, NaN where missing; ``config``, a JSON text of all
that it depends on; and the ``seconds`` that it took. The sample that it was made from lies beside it, see
:mod:`dsr.evaluation.store`. A prediction whose stored config is the requested one is not made again, so an interrupted
run continues where it stopped. One scene that fails, or that the method has no solution for, does not keep the others
from their results.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from dsr.data.base import SceneSource
from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.degradation.holes import Holes
from dsr.degradation.noise import Noise
from dsr.evaluation.store import iterations_path, prediction_path, sample_path
from dsr.methods.base import Iterative, NoSolutionError, Upsampler
from dsr.sample import DepthSample
from dsr.utils.console import one_line
from dsr.utils.files import read_arrays, replacing
from dsr.utils.progress import SILENT, Progress


@dataclass(frozen=True)
class Evaluation:
    """What is evaluated: one method on one data set under one downsampling model.

    Args:
        source: the data set.
        downsampling: the model.
        downsampling_name: as in ``scores.csv``.
        scale: the upsampling factor.
        method: the method.
        method_name: as in ``scores.csv``.
        seed: of whatever is random.
        config: all that the predictions depend on besides the scene, as plain values; stored with each.
        device: where predictions and scores are computed.
        noise: of the low-resolution maps.
        holes: where values are missing in the low-resolution maps.
        label: the method's name for readers; empty where that is ``method_name``.

    """

    source: SceneSource
    downsampling: Downsampling | Measured
    downsampling_name: str
    scale: int
    method: Upsampler
    method_name: str
    seed: int
    config: Mapping[str, Any]
    device: torch.device = field(default=torch.device("cpu"))
    noise: Noise | None = None
    holes: Holes | None = None
    label: str = ""

    def sample(self, scene: str) -> DepthSample:
        """Return what the method is given of a scene.

        Raises:
            ValueError: the scene's files are not as they should be.

        """
        loaded = self.source.load(scene)
        kind = self.method.range_type
        return make_sample(loaded, self.scale, self.downsampling, kind, self.noise, self.seed, self.holes)

    def stored_config(self, scene: str) -> dict[str, Any]:
        """Return what a prediction of this scene depends on."""
        return {**self.config, "scene": scene, "scene_content": self.source.fingerprint(scene)}


@dataclass
class Outcome:
    """What a pass over the scenes led to.

    Args:
        made, reused: scenes whose prediction was computed, and those where it was found on disk.
        failures: scene and what was wrong, one line each.
        unsolved: scene and why the method has no solution for it, one line each.
        notes: scene and what readers of the scores should know.
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
    """A prediction on disk was made from something else, and nobody allowed to overwrite it."""


def predict(study: Evaluation, folder: Path, progress: Progress = SILENT, *, overwrite: bool = False) -> Outcome:
    """Write the sample and the prediction of every scene that has none yet.

    Args:
        study: what to evaluate.
        folder: the run's directory.
        progress: shows the scenes that are done, and the method's steps within a scene.
        overwrite: whether predictions on disk are made anew, whatever they came from.

    Raises:
        StalePredictionError: a prediction of another configuration is there and ``overwrite`` is not set.

    """
    outcome = Outcome()
    for scene in progress.track(study.source.scenes(), "predict"):
        path = prediction_path(folder, scene)
        try:
            config = study.stored_config(scene)
            seconds = None if overwrite else _seconds_of_current(path, config)
            if seconds is None:
                outcome.seconds[scene] = _predict_scene(study, scene, folder, config, progress)
                outcome.made.append(scene)
            else:
                if not sample_path(folder, scene).is_file():
                    study.sample(scene).save(sample_path(folder, scene))
                outcome.seconds[scene] = seconds
                outcome.reused.append(scene)
        except StalePredictionError:
            raise
        except NoSolutionError as error:
            outcome.unsolved[scene] = failure_line(scene, error)
            path.unlink(missing_ok=True)
        except (ValueError, OSError) as error:
            outcome.failures[scene] = failure_line(scene, error)
    return outcome


def failure_line(scene: str, error: BaseException) -> str:
    """Return an error's message on one line that names the scene."""
    message = one_line(error)
    named = re.search(rf"(^|[/\\]){re.escape(scene)}[/\\:.]", message)  # first, or in a path
    return message if named else f"{scene}: {message}"


def _seconds_of_current(path: Path, config: Mapping[str, Any]) -> float | None:
    """Return how long the prediction on disk took if it was made from ``config``; None if there is none."""
    try:
        arrays = read_arrays(path)
        stored, seconds = dict(json.loads(str(arrays["config"]))), float(arrays["seconds"])
    except FileNotFoundError:
        return None
    except (OSError, KeyError, ValueError, TypeError):
        raise StalePredictionError(f"{path}: damaged; overwrite=true makes it anew") from None
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
    depth = _answer(study.method, sample, progress)
    seconds = time.perf_counter() - start
    expected = (1, sample.camera.height, sample.camera.width)
    if tuple(depth.shape) != expected:
        raise ValueError(f"{scene}: {study.method_name} gave depth of shape {tuple(depth.shape)}, expected {expected}")
    if isinstance(study.method, Iterative):
        with replacing(iterations_path(folder, scene)) as temporary:
            pd.DataFrame(study.method.history).to_csv(temporary, index=False)
    sample.save(sample_path(folder, scene))
    with replacing(prediction_path(folder, scene)) as temporary:
        np.savez_compressed(
            temporary, depth=depth[0].cpu().numpy(), config=json.dumps(dict(config), sort_keys=True), seconds=seconds
        )
    return seconds


def _answer(method: Upsampler, sample: DepthSample, progress: Progress) -> Tensor:
    """Return a method's depth, and show its steps."""
    with progress.task("steps") as step:
        return method(sample, step)
