"""Scores of predictions, from the directory of a run alone: ``scores.csv`` and ``summary.json``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from dsr.evaluation.predict import Evaluation, Outcome, failure_line
from dsr.evaluation.sharing import ALONE, Claims, Workers, share
from dsr.evaluation.store import load_errors, load_prediction, prediction_path, sample_path
from dsr.metrics.alignment import align_errors, align_map
from dsr.metrics.catalogue import Metric, score_image
from dsr.metrics.formats import HEADLINES
from dsr.sample import DepthSample
from dsr.utils.files import replacing, write_text
from dsr.utils.pool import LOST
from dsr.utils.progress import Progress
from dsr.utils.ratios import round_ratio

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
    *,
    alignment: str = "none",
    workers: Workers = ALONE,
) -> pd.DataFrame:
    """Score the predictions in ``folder`` against the samples there; write ``scores.csv`` and ``summary.json``.

    Other processes may do the same in the same directory at the same time: each scene is scored by one of them.

    Args:
        study: the evaluation; its data set is not read.
        metrics: from :func:`dsr.metrics.catalogue.catalogue`.
        outcome: outcome of :func:`predict`; failures and scenes without true depth are added to it.
        illustrate: function that draws a picture of a sample, the predicted depth and its worst-of-four scores.
        alignment: one of :data:`dsr.metrics.alignment.ALIGNMENTS`, of each prediction before it is scored and drawn.
        workers: how many scenes are scored at a time, each in a process of its own.

    Returns:
        The content of ``scores.csv``.

    """
    names = [alignment, *(metric.name for metric in metrics)]
    rows: list[dict[str, Any]] = []
    with Claims(folder) as claims:

        def ready(scene: str) -> _Scored | None:
            return _recorded(claims, scene, _record_key(folder, scene, names))

        def work(scene: str, _: Progress) -> _Scored:
            result = _score_and_illustrate(study, scene, folder, metrics, illustrate, alignment)
            claims.write_record(f"score {scene}", {"key": _record_key(folder, scene, names), **asdict(result)})
            return result

        scored = share(list(outcome.seconds), claims, "score", ready, work, _lost, workers, progress)
        for scene, each in scored.items():
            rows += each.rows
            if each.unscored:
                outcome.unscored.append(scene)
            if each.notes:
                outcome.notes[scene] = each.notes
            if each.failure:
                outcome.failures[scene] = each.failure
        scores = pd.DataFrame(rows, columns=list(SCORE_COLUMNS))
        with replacing(folder / "scores.csv") as temporary:
            scores.to_csv(temporary, index=False)
        write_text(folder / "summary.json", json.dumps(summary(study, scores, outcome, metrics), indent=1) + "\n")
    return scores


@dataclass
class _Scored:
    """The scores of a scene, and what there is to say of it."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    unscored: bool = False
    notes: list[str] = field(default_factory=list)
    failure: str = ""


def _score_and_illustrate(
    study: Evaluation,
    scene: str,
    folder: Path,
    metrics: tuple[Metric, ...],
    illustrate: Callable[[DepthSample, Tensor, Mapping[str, float]], None],
    alignment: str,
) -> _Scored:
    """Score and draw one scene."""
    result = _Scored()
    try:
        sample = DepthSample.load(sample_path(folder, scene))
        if sample.scene != scene:  # its name becomes that of pictures
            raise ValueError(f"{sample_path(folder, scene)}: expected the scene {scene}, got {sample.scene!r:.100}")
        depth = load_prediction(prediction_path(folder, scene))
        if sample.depth is not None and depth.shape != sample.depth.shape:
            came, expected = tuple(depth.shape), tuple(sample.depth.shape)
            raise ValueError(f"{scene}: expected a prediction of shape {expected}, got {came}")
        given, depth = depth, align_map(depth, sample.depth, alignment)
        errors = align_errors(load_errors(prediction_path(folder, scene)), given, depth, alignment)
        result.rows = list(_score_scene(study, sample, depth, errors, metrics))
        result.unscored = sample.depth is None
        result.notes = list(sample.notes)
        illustrate(sample, depth, {row["metric"]: row["value"] for row in result.rows if row["variant"] in HEADLINES})
    except (ValueError, OSError) as error:
        result.failure = failure_line(scene, error)
    return result


def _recorded(claims: Claims, scene: str, key: Sequence[Any]) -> _Scored | None:
    """Return the scores of a scene that another process has recorded; None if there are none of this prediction."""
    record = claims.record(f"score {scene}")
    if record is None or record.pop("key") != list(key):
        return None
    return _Scored(**record)


def _record_key(folder: Path, scene: str, names: Sequence[str]) -> list[Any]:
    """Return what recorded scores are of: the files of a scene, the alignment and the metrics."""
    files = (prediction_path(folder, scene), sample_path(folder, scene))
    try:
        return [[[each.stat().st_mtime_ns, each.stat().st_size] for each in files], list(names)]
    except OSError:
        return [None, list(names)]


def _lost(scene: str) -> _Scored:
    """Return the outcome of a scene whose workers were killed."""
    return _Scored(failure=f"{scene}: {LOST}")


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
    study: Evaluation,
    sample: DepthSample,
    depth: Tensor,
    errors: tuple[Tensor, Tensor] | None,
    metrics: tuple[Metric, ...],
) -> Iterator[dict[str, Any]]:
    """Yield the rows of one scene; none without true depth."""
    if sample.depth is None:
        return
    rays = sample.camera.rays(device=study.device)
    truth = sample.depth.to(study.device, torch.float64)
    regions = {name: region.to(study.device) for name, region in sample.regions.items()}
    stated = None if errors is None else (errors[0].to(study.device), errors[1].to(study.device))
    depth = depth.to(study.device, torch.float64)
    for result in score_image(depth, truth, rays, metrics, sample.unit, regions=regions, errors=stated):
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
