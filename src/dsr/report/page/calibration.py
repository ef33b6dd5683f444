"""Expected errors of a report page beside the measured ones, over all scenes of a benchmark setting."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dsr.evaluation.results import Run
from dsr.metrics.calibration import error_ratios, measured_errors, squared_error_share
from dsr.report.page.scenes import Result, View, results_of, stored_sample
from dsr.sample import DepthSample

_MOST_PIXELS = 4_000_000
"""About how many pixels of a setting are used; of more, every second, third, and so on."""


def calibration_data(views: Sequence[View]) -> list[dict[str, Any]]:
    """Return how the expected errors of each method that has them agree with the measured ones.

    Args:
        views: the scenes of one setting. Those without ground truth are left out.

    Returns:
        A row per method: ``method``; ``scenes``, their number; ``depth`` and ``angle``, each with the ``ratios`` of
        :func:`dsr.metrics.calibration.error_ratios`, the ``share`` of the squared error in the most confident 80 % of
        the pixels, and the ``least`` possible one; None for a value that is undefined.

    """
    found: dict[str, list[Tensor]] = {}
    step = 0
    for view in views:
        confident = replace(view, runs=tuple(run for run in view.runs if _is_confident(run, view.scene)))
        stored = stored_sample(confident, []) if confident.runs else None
        if stored is None or stored.depth is None or min(stored.depth.shape[-2:]) < 2:
            continue
        step = step or math.ceil(stored.depth.numel() * len(views) / _MOST_PIXELS)
        for result in results_of(confident, stored, []):
            if result.errors is not None:
                found.setdefault(result.label, []).append(_errors(result, result.errors, stored, stored.depth, step))
    return [
        {"method": label, "scenes": len(parts), **_agreement(torch.cat(parts, dim=1))} for label, parts in found.items()
    ]


def _is_confident(run: Run, scene: str) -> bool:
    """Return whether a run has expected errors of a scene; a damaged file has none, and is noted with its pictures."""
    try:
        return run.expected_errors(scene) is not None
    except ValueError:
        return False


def _errors(result: Result, expected: tuple[Tensor, Tensor], stored: DepthSample, truth: Tensor, step: int) -> Tensor:
    """Return expected and measured errors of depth, then of normals, at every ``step``-th pixel: (4, N) float32."""
    depth, angle = measured_errors(result.depth[None], truth.double()[None], stored.camera.rays()[None])
    maps = (expected[0], depth, expected[1], angle)
    return torch.stack([each.flatten()[::step].float() for each in maps])


def _agreement(errors: Tensor) -> dict[str, dict[str, Any]]:
    """Return the values of a row for depth and normals, from (4, N) errors."""
    found = {}
    for name, pairs in zip(("depth", "angle"), errors.split(2), strict=True):
        expected, measured = pairs[:, pairs.isfinite().all(dim=0)]
        found[name] = {
            "ratios": [_finite(ratio) for ratio in error_ratios(expected, measured)],
            "share": _finite(squared_error_share(expected, measured)),
            "least": _finite(squared_error_share(measured, measured)),
        }
    return found


def _finite(value: Tensor) -> float | None:
    """Return a number for JSON."""
    return float(value) if value.isfinite() else None
