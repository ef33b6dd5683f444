"""Scenes of a report page: photo, input, results and ground truth as pictures of values.

Over all scenes of a benchmark setting, the expected errors stand beside the measured ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsr.evaluation.results import BenchmarkSetting, Results, Run, one_per_method
from dsr.geometry.camera import Camera
from dsr.geometry.lights import BASIS
from dsr.geometry.surface import normal_mask, shade
from dsr.metrics.calibration import error_ratios, measured_errors, squared_error_share
from dsr.pictures.depth_views import limits_of, normals_seen_by
from dsr.report.page.value_pictures import (
    PictureStore,
    depth_picture,
    error_picture,
    expected_picture,
    mask_picture,
    shading_picture,
)
from dsr.sample import DepthSample

_LEAST_ERROR = 1e-4
"""Minimum limit of the error colours, metres."""
_LEAST_ANGLE = 0.1
"""Minimum of the largest stored angle, degrees."""
_MOST_PIXELS = 4_000_000
"""About how many pixels of a setting are compared with what was expected; of more, every second, third, and so on."""


@dataclass(frozen=True)
class View:
    """A scene of a benchmark setting and its runs, one per method."""

    problem: BenchmarkSetting
    scene: str
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class Result:
    """The prediction of a method.

    Args:
        label: name of the method.
        seed: of the run.
        depth: (1, H, W) in metres, NaN in holes.
        errors: expected errors of depth in metres and of normals in degrees, (1, H, W); None without them.

    """

    label: str
    seed: int | None
    depth: Tensor
    errors: tuple[Tensor, Tensor] | None


def views_of(results: Results, setting: BenchmarkSetting | None = None) -> list[View]:
    """Return the scenes with predictions of a setting, or of all; of several seeds of a method the lowest is used."""
    views: list[View] = []
    for problem in results.problems() if setting is None else [setting]:
        views += [View(problem, scene, one_per_method(runs)) for scene, runs in results.by_scene(problem).items()]
    return views


def scene_data(view: View, pool: PictureStore, notes: list[str]) -> dict[str, Any] | None:
    """Return the data of a scene for the page, and add its pictures to the pool.

    Args:
        view: scene and its runs.
        pool: pool to which the pictures are added.
        notes: list to which omissions and their reasons are added.

    Returns:
        Values that JSON can represent; None if no run has stored the scene.

    """
    stored = stored_sample(view, notes)
    if stored is None:
        return None
    predictions = results_of(view, stored, notes)
    reference = stored.depth if stored.depth is not None else (predictions[0].depth if predictions else stored.depth_lr)
    low, high = limits_of(reference)
    photo, _ = pool.fit(stored.rgb.permute(1, 2, 0).double().numpy())
    data: dict[str, Any] = {
        "scene": view.scene,
        "size": [stored.camera.width, stored.camera.height],
        "notes": list(stored.notes),
        "depth": [low, high],
        "photo": pool.add(np.rint(255 * np.clip(photo, 0, 1)).astype(np.uint8)),
    }
    expected = [each.errors for each in predictions if each.errors is not None]
    largest = None
    if stored.depth is not None:
        largest, data["error"] = _error_limits([each.depth - stored.depth for each in predictions])
    elif expected:  # the colours of expected errors are those of measured ones
        _, data["error"] = _error_limits([depth_error for depth_error, _ in expected])
    if expected:
        depth_errors, angle_errors = zip(*expected, strict=True)
        data["expected"] = {
            "depth": _largest(depth_errors, _LEAST_ERROR),
            "angle": _largest(angle_errors, _LEAST_ANGLE),
        }
    size_lr = f"{stored.camera_lr.width} x {stored.camera_lr.height}"
    surfaces = [
        {"label": "input", "kind": "input", "text": size_lr, **_surface(stored.depth_lr, stored.camera_lr, data, pool)}
    ]
    for each in predictions:
        surface = _surface(each.depth, stored.camera, data, pool)
        if stored.depth is not None and largest is not None:
            surface["error"] = _error(each.depth - stored.depth, largest, pool)
        if each.errors is not None:
            surface["expected"] = _expected(each.depth, each.errors, data["expected"], pool)
        text = "" if each.seed is None else f"seed {each.seed}"
        surfaces.append({"label": each.label, "kind": "method", "text": text, **surface})
    if stored.depth is not None:
        surfaces.append({"label": "truth", "kind": "truth", **_surface(stored.depth, stored.camera, data, pool)})
    return {**data, "surfaces": surfaces}


def stored_sample(view: View, notes: list[str]) -> DepthSample | None:
    """Return the scene from the first run that has stored it, None if none has; ``notes`` takes the reasons."""
    for run in view.runs:
        if run.has_sample(view.scene):
            try:
                return run.sample(view.scene)
            except ValueError as error:
                notes.append(str(error))
    dataset, scale, downsampling = view.problem
    notes.append(
        f"{dataset} x{scale} {downsampling}, {view.scene}: no pictures, because no run has stored photo and input"
    )
    return None


def results_of(view: View, stored: DepthSample, notes: list[str]) -> list[Result]:
    """Return the predictions that have the size of the scene; ``notes`` takes the others."""
    found = []
    for run in view.runs:
        try:
            depth, errors = run.prediction(view.scene), run.expected_errors(view.scene)
        except (ValueError, OSError) as error:
            notes.append(str(error))
            continue
        size = (1, stored.camera.height, stored.camera.width)
        if tuple(depth.shape) != size:
            notes.append(f"{run.folder.name}: {view.scene}: expected a prediction of {size}, got {tuple(depth.shape)}")
            continue
        if errors is not None and not all(tuple(each.shape) == size for each in errors):
            shapes = " and ".join(str(tuple(each.shape)) for each in errors)
            notes.append(f"{run.folder.name}: {view.scene}: expected errors of {size}, got {shapes}")
            errors = None
        found.append(Result(run.label, run.seed, depth.double(), errors))
    return found


def _surface(depth: Tensor, camera: Camera, data: dict[str, Any], pool: PictureStore) -> dict[str, Any]:
    """Store the normals and depth of a map, (1, H, W) in metres."""
    basis = torch.tensor(BASIS, dtype=torch.float64)
    if min(depth.shape[-2:]) < 2:
        shadings = np.full((*depth.shape[-2:], 3), np.nan)
    else:
        shadings = shade(normals_seen_by(camera, depth), basis)[0].permute(1, 2, 0).numpy()
    fitted, normal_valid = pool.fit(shadings)
    metres, depth_valid = pool.fit(depth[0].double().numpy())
    surface = {
        "size": [fitted.shape[1], fitted.shape[0]],
        "normals": pool.add(shading_picture(fitted)),
        "depth": pool.add(depth_picture(metres, *data["depth"])),
    }
    mask = mask_picture(depth_valid, normal_valid)
    return surface if mask is None else {**surface, "mask": pool.add(mask, exact=True)}


def _error(difference: Tensor, largest: float, pool: PictureStore) -> dict[str, str]:
    """Store a signed error, (1, H, W) in metres."""
    values, valid = pool.fit(difference[0].numpy())
    stored = {"values": pool.add(error_picture(values, largest))}
    mask = mask_picture(valid, valid)
    return stored if mask is None else {**stored, "mask": pool.add(mask, exact=True)}


def _expected(
    depth: Tensor, errors: tuple[Tensor, Tensor], largest: Mapping[str, float], pool: PictureStore
) -> dict[str, str]:
    """Store the expected errors, (1, H, W) in metres and degrees, where the depth and its normals are known."""
    known = depth.isfinite()
    valid = {"depth": known, "angle": normal_mask(known) if min(known.shape[-2:]) > 1 else torch.zeros_like(known)}
    stored, fitted = {}, []
    for (name, where), error in zip(valid.items(), errors, strict=True):
        values, inside = pool.fit(error[0].double().numpy(), (where & error.isfinite())[0].numpy())
        stored[name] = pool.add(expected_picture(values, largest[name]))
        fitted.append(inside)
    mask = mask_picture(*fitted)
    return stored if mask is None else {**stored, "mask": pool.add(mask, exact=True)}


def _error_limits(differences: Sequence[Tensor]) -> tuple[float, dict[str, float]]:
    """Return the largest stored error, and the page's error limits; the same for all methods.

    The largest is the 99.9th percentile of the worst method, the limit of the colours the 98th of the median method.
    """
    sizes = _sizes(differences)
    limit = float(np.median([np.percentile(values, 98) for values in sizes])) if sizes else 0.0
    limit = max(limit, _LEAST_ERROR)
    largest = _largest(differences, limit)
    return largest, {"largest": largest, "limit": limit}


def _largest(errors: Sequence[Tensor], least: float) -> float:
    """Return the 99.9th percentile of the errors' sizes for the worst method, at least ``least``."""
    return max([least, *(float(np.percentile(values, 99.9)) for values in _sizes(errors))])


def _sizes(errors: Sequence[Tensor]) -> list[np.ndarray]:
    """Return the sizes of the known errors of each map that has any."""
    sizes = [error[error.isfinite()].abs().numpy() for error in errors]
    return [values for values in sizes if values.size]


def calibration_data(results: Results, problem: BenchmarkSetting) -> list[dict[str, Any]]:
    """Return how the expected errors of each method that has them agree with the measured ones.

    Args:
        results: all runs.
        problem: the setting. Its scenes without ground truth are left out.

    Returns:
        A row per method: ``method``; ``scenes``, the number of scenes that all of them have; ``depth`` and ``angle``,
        each with the ``ratios`` of :func:`dsr.metrics.calibration.error_ratios`, the ``share`` of the squared error in
        the most confident 80 % of the pixels, and the ``least`` possible one; None for a value that is undefined.

    """
    found: dict[str, dict[str, Tensor]] = {}
    step, views = 0, views_of(results, problem)
    for view in views:
        confident = replace(view, runs=tuple(run for run in view.runs if _is_confident(run, view.scene)))
        stored = stored_sample(confident, []) if confident.runs else None
        if stored is None or stored.depth is None or min(stored.depth.shape[-2:]) < 2:
            continue
        step = step or math.ceil(stored.depth.numel() * len(views) / _MOST_PIXELS)
        for result in results_of(confident, stored, []):
            if result.errors is not None:
                errors = _errors(result, result.errors, stored, stored.depth, step)
                found.setdefault(result.label, {})[view.scene] = errors
    shared = [scene for scene in next(iter(found.values()), ()) if all(scene in of for of in found.values())]
    return [
        {"method": label, "scenes": len(shared), **_agreement(torch.cat([of[scene] for scene in shared], dim=1))}
        for label, of in found.items()
        if shared
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
