"""Scenes of a report page: photo, input, results and ground truth as pictures of values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from dsr.evaluation.results import BenchmarkSetting, Results, Run, one_per_method
from dsr.geometry.camera import Camera
from dsr.geometry.shading import lights, shade
from dsr.report.page.encoding import Pool, depth_picture, error_picture, mask_picture, shading_picture
from dsr.sample import DepthSample
from dsr.viz.panels import limits_of, normals_seen_by

_LEAST_ERROR = 1e-4
"""Minimum limit of the error colours, metres."""


@dataclass(frozen=True)
class View:
    """A scene of a benchmark setting and its runs, one per method."""

    problem: BenchmarkSetting
    scene: str
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class _Result:
    """The prediction of a method, (1, H, W) in metres."""

    label: str
    seed: int | None
    depth: Tensor


def views_of(results: Results) -> list[View]:
    """Return all scenes with predictions, by setting; of several seeds of a method the lowest is used."""
    views: list[View] = []
    for problem in results.problems():
        runs = results.of(problem)
        scenes = dict.fromkeys(scene for run in runs for scene in run.scenes)
        views += [
            View(problem, scene, one_per_method([run for run in runs if scene in run.scenes])) for scene in scenes
        ]
    return views


def scene_data(view: View, pool: Pool, notes: list[str]) -> dict[str, Any] | None:
    """Return the data of a scene for the page, and add its pictures to the pool.

    Args:
        view: scene and its runs.
        pool: pool to which the pictures are added.
        notes: list to which omissions and their reasons are added.

    Returns:
        Values that JSON can represent; None if no run has stored the scene.

    """
    stored = _stored(view, notes)
    if stored is None:
        return None
    predictions = _results(view, stored, notes)
    reference = stored.depth if stored.depth is not None else (predictions[0].depth if predictions else stored.depth_lr)
    low, high = limits_of(reference)
    data: dict[str, Any] = {
        "scene": view.scene,
        "size": [stored.camera.width, stored.camera.height],
        "notes": list(stored.notes),
        "depth": [low, high],
        "photo": _photo(stored.rgb, pool),
    }
    largest = None
    if stored.depth is not None:
        largest, data["error"] = _error_limits([each.depth - stored.depth for each in predictions])
    size_lr = f"{stored.camera_lr.width} x {stored.camera_lr.height}"
    surfaces = [
        {"label": "input", "kind": "input", "text": size_lr, **_surface(stored.depth_lr, stored.camera_lr, data, pool)}
    ]
    for each in predictions:
        surface = _surface(each.depth, stored.camera, data, pool)
        if stored.depth is not None and largest is not None:
            surface["error"] = _error(each.depth - stored.depth, largest, pool)
        text = "" if each.seed is None else f"seed {each.seed}"
        surfaces.append({"label": each.label, "kind": "method", "text": text, **surface})
    if stored.depth is not None:
        surfaces.append({"label": "truth", "kind": "truth", **_surface(stored.depth, stored.camera, data, pool)})
    return {**data, "surfaces": surfaces}


def _stored(view: View, notes: list[str]) -> DepthSample | None:
    """Return the scene from the first run that has stored it."""
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


def _results(view: View, stored: DepthSample, notes: list[str]) -> list[_Result]:
    """Return the predictions that have the size of the scene."""
    found = []
    for run in view.runs:
        try:
            depth = run.prediction(view.scene)
        except (ValueError, OSError) as error:
            notes.append(str(error))
            continue
        size = (1, stored.camera.height, stored.camera.width)
        if tuple(depth.shape) != size:
            notes.append(f"{run.folder.name}: {view.scene}: expected a prediction of {size}, got {tuple(depth.shape)}")
            continue
        found.append(_Result(run.label, run.seed, depth.double()))
    return found


def _photo(rgb: Tensor, pool: Pool) -> str:
    """Store a photo, (3, H, W) in [0, 1]."""
    values, _ = pool.fit(rgb.permute(1, 2, 0).double().numpy())
    return pool.add(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8))


def _surface(depth: Tensor, camera: Camera, data: dict[str, Any], pool: Pool) -> dict[str, Any]:
    """Store the normals and depth of a map, (1, H, W) in metres."""
    basis = lights()[:3]
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


def _error(difference: Tensor, largest: float, pool: Pool) -> dict[str, str]:
    """Store a signed error, (1, H, W) in metres."""
    values, valid = pool.fit(difference[0].numpy())
    stored = {"values": pool.add(error_picture(values, largest))}
    mask = mask_picture(valid, valid)
    return stored if mask is None else {**stored, "mask": pool.add(mask, exact=True)}


def _error_limits(differences: Sequence[Tensor]) -> tuple[float, dict[str, float]]:
    """Return the largest stored error, and the page's error limits; the same for all methods.

    The largest is the 99.9th percentile of the worst method, the limit of the colours the 98th of the median method.
    """
    sizes = [difference[difference.isfinite()].abs().numpy() for difference in differences]
    sizes = [values for values in sizes if values.size]
    largest = max((float(np.percentile(values, 99.9)) for values in sizes), default=0.0)
    limit = float(np.median([np.percentile(values, 98) for values in sizes])) if sizes else 0.0
    limit = max(limit, _LEAST_ERROR)
    largest = max(largest, limit)
    return largest, {"largest": largest, "limit": limit}
