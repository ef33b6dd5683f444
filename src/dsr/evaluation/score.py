"""Scores of predictions, from the directory of a run alone: ``scores.csv`` and ``summary.json``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from dsr.evaluation.predict import Evaluation, Outcome, failure_line
from dsr.evaluation.store import load_prediction, prediction_path, sample_path
from dsr.metrics.catalogue import Metric, score_image
from dsr.metrics.formats import HEADLINES
from dsr.sample import DepthSample
from dsr.utils.files import replacing, write_text
from dsr.utils.progress import Progress
from dsr.utils.ratios import round_ratio
from dsr.utils.tables import guarded

SCORE_COLUMNS = (
    "dataset",
    "scene",
    "scale",
    "downsampling",
    "method",
    "seed",
    "metric",
    "variant",
    "value",
    "valid_share",
)


def score(
    study: Evaluation,
    folder: Path,
    metrics: tuple[Metric, ...],
    outcome: Outcome,
    progress: Progress,
    illustrate: Callable[[DepthSample, Tensor, Mapping[str, float]], None],
) -> pd.DataFrame:
    """Score the predictions in ``folder`` against the samples there; write ``scores.csv`` and ``summary.json``.

    Args:
        study: the evaluation; its data set is not read.
        folder: directory of the run.
        metrics: from :func:`dsr.metrics.catalogue.catalogue`.
        outcome: outcome of :func:`predict`; failures and scenes without true depth are added to it.
        progress: display of the completed scenes.
        illustrate: function that draws a picture of a sample, the predicted depth and its worst-of-four scores.

    Returns:
        The content of ``scores.csv``.

    """
    rows: list[dict[str, Any]] = []
    for scene in progress.track(outcome.seconds, "score"):
        try:
            sample = DepthSample.load(sample_path(folder, scene))
            depth = load_prediction(prediction_path(folder, scene))
            new = list(_score_scene(study, sample, depth, metrics))
            rows += new
            if sample.depth is None:
                outcome.unscored.append(scene)
            if sample.notes:
                outcome.notes[scene] = list(sample.notes)
            illustrate(sample, depth, {row["metric"]: row["value"] for row in new if row["variant"] in HEADLINES})
        except (ValueError, OSError) as error:
            outcome.failures[scene] = failure_line(scene, error)
    scores = pd.DataFrame(rows, columns=list(SCORE_COLUMNS))
    with replacing(folder / "scores.csv") as temporary:
        guarded(scores).to_csv(temporary, index=False)
    write_text(folder / "summary.json", json.dumps(summary(study, scores, outcome, metrics), indent=1) + "\n")
    return scores


def summary(study: Evaluation, scores: pd.DataFrame, outcome: Outcome, metrics: Sequence[Metric]) -> dict[str, Any]:
    """Return each metric's mean over the scenes (of the worst of four lights, if any) and the outcome of the run."""
    worst = scores[scores["variant"].isin(HEADLINES)]
    means = worst.groupby("metric", sort=False)["value"].mean()
    return {
        "dataset": study.source.name,
        "scale": round_ratio(study.scale),
        "downsampling": study.downsampling_name,
        "method": study.method_name,
        "label": study.label or study.method_name,
        "seed": study.seed,
        "scenes": scores["scene"].nunique(),
        "mean": {str(name): float(value) for name, value in means.items()},
        "seconds": outcome.seconds,
        "predicted": outcome.made,
        "reused": outcome.reused,
        "without_truth": outcome.unscored,
        "notes": outcome.notes,
        "failures": outcome.failures,
        "unanswered": outcome.unsolved,
        "metrics": {metric.name: asdict(metric.format) for metric in metrics},
    }


def _score_scene(
    study: Evaluation, sample: DepthSample, depth: Tensor, metrics: tuple[Metric, ...]
) -> Iterator[dict[str, Any]]:
    """Yield the rows of one scene; none without true depth."""
    if sample.depth is None:
        return
    if depth.shape != sample.depth.shape:
        came, expected = tuple(depth.shape), tuple(sample.depth.shape)
        raise ValueError(f"{sample.scene}: expected a prediction of shape {expected}, got {came}")
    rays = sample.camera.rays(device=study.device)
    truth = sample.depth.to(study.device, torch.float64)
    for result in score_image(depth.to(study.device, torch.float64), truth, rays, metrics, sample.unit):
        yield {
            "dataset": sample.dataset,
            "scene": sample.scene,
            "scale": round_ratio(sample.scale),
            "downsampling": study.downsampling_name,
            "method": study.method_name,
            "seed": study.seed,
            "metric": result.metric,
            "variant": result.variant,
            "value": result.value,
            "valid_share": result.valid_share,
        }
