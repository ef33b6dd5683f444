"""Scenes of a report page: photo, input, results and ground truth as 8-bit pictures of values.

The page computes renderings, colours and readouts itself from stored values:

- Normals are stored as unclipped shadings under the orthonormal directions :data:`dsr.geometry.lights.BASIS`, which
  determine those under any light. A value s in [-1, 1] is stored as 255 (s + 1) / 2; the three maps are side by side.
- Depth is stored linearly between two limits.
- The error is sign(q - 128) (q - 128)^2 / 127^2 times the largest error, so that small errors have small steps.
- Expected errors, which have no sign, are q^2 / 255^2 times the largest one.
- The valid mask is a separate picture.

Over all scenes of a benchmark setting, the expected errors stand beside the measured ones.
"""

import base64
import contextlib
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.evaluation.results import BenchmarkSetting, Results
from dsr.geometry.camera import Camera
from dsr.geometry.lights import BASIS
from dsr.geometry.surface import normal_mask, shade
from dsr.metrics.calibration import error_ratios, measured_errors, squared_error_share
from dsr.pictures.depth_views import limits_of, normals_seen_by, reduced
from dsr.report.shown_scenes import View, results_of, stored_sample, views_of
from dsr.sample import DepthSample

_LEAST_ERROR = 1e-4  # minimum limit of the error colours, metres
_LEAST_ANGLE = 0.1  # minimum of the largest stored angle, degrees
# About how many pixels of a setting are compared with what was expected; of more, every second, third, and so on
_MOST_PIXELS = 4_000_000
# Values of a mask: missing; valid depth without a normal; valid depth and normal
NOTHING_VALID, DEPTH_VALID, ALL_VALID = 0, 128, 255
# A third of the time of zlib's level 6 for 8 % more bytes, a fifteenth of that of lossless WebP
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)


@dataclass
class PictureStore:
    """Pictures by name, each stored once, as lossless PNG in base64."""

    longest: int  # maximum longer side, pixels; larger pictures are reduced
    pictures: dict[str, str] = field(default_factory=dict)
    reduced: bool = False

    def add(self, picture: np.ndarray) -> str:
        """Encode an 8-bit picture, (H, W, 1) or (H, W, 3) RGB, and return its name."""
        _, content = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]), _PNG)
        name = "p" + hashlib.sha256(content.tobytes()).hexdigest()[:16]
        self.pictures[name] = base64.b64encode(content.tobytes()).decode("ascii")
        return name

    def fit(self, values: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Reduce (C, H, W) values by averaging valid ones; return (h, w, C), 0 where invalid, and the valid mask."""
        fitted = reduced(values.double(), self.longest)
        self.reduced |= fitted.shape != values.shape
        valid = fitted.isfinite().all(dim=0)
        return torch.where(valid, fitted, 0).permute(1, 2, 0).numpy(), valid.numpy()


# Data of a scene (None for a scene without pictures), its pictures, and notes
Encoded = tuple[dict[str, Any] | None, PictureStore, list[str]]


def encode_scene(longest: int, results: Results, place: tuple[BenchmarkSetting, str]) -> Encoded:
    """Return the data of a scene of a setting for the page, with pictures of at most ``longest`` pixels."""
    problem, scene = place
    view = next(view for view in views_of(results, problem) if view.scene == scene)
    pool, notes = PictureStore(longest), list[str]()
    stored = stored_sample(view, notes)
    return None if stored is None else _scene_data(view, stored, pool, notes), pool, notes


def _scene_data(view: View, stored: DepthSample, pool: PictureStore, notes: list[str]) -> dict[str, Any]:
    """Return the data of a scene; its pictures are added to the pool."""
    predictions = results_of(view, stored, notes)
    reference = stored.depth if stored.depth is not None else (predictions[0].depth if predictions else stored.depth_lr)
    low, high = limits_of(reference)
    photo, _ = pool.fit(stored.rgb)
    data: dict[str, Any] = {
        "scene": view.scene,
        "size": [stored.camera.width, stored.camera.height],
        "notes": list(stored.notes),
        "depth": [low, high],
        "photo": pool.add(np.rint(255 * np.clip(photo, 0, 1)).astype(np.uint8)),
    }
    expected = [each.errors for each in predictions if each.errors is not None]
    differences = [depth_error for depth_error, _ in expected]  # whose colours are those of measured ones
    if stored.depth is not None:
        differences = [each.depth - stored.depth for each in predictions]
    if stored.depth is not None or expected:
        # The same for all methods: the largest is the 99.9th percentile of the worst, the limit of the colours the 98th
        # of the median one.
        usual = _percentiles(differences, 98)
        limit = max(float(np.median(usual)) if usual.size else 0.0, _LEAST_ERROR)
        data["error"] = {"largest": max([limit, *_percentiles(differences, 99.9).tolist()]), "limit": limit}
    if expected:
        depth_errors, angle_errors = zip(*expected, strict=True)
        data["expected"] = {
            "depth": max([_LEAST_ERROR, *_percentiles(depth_errors, 99.9).tolist()]),
            "angle": max([_LEAST_ANGLE, *_percentiles(angle_errors, 99.9).tolist()]),
        }
    size_lr = f"{stored.camera_lr.width} x {stored.camera_lr.height}"
    surfaces = [
        {"label": "input", "kind": "input", "text": size_lr, **_surface(stored.depth_lr, stored.camera_lr, data, pool)}
    ]
    for each in predictions:
        surface = _surface(each.depth, stored.camera, data, pool)
        if stored.depth is not None:
            surface["error"] = _error(each.depth - stored.depth, data["error"]["largest"], pool)
        if each.errors is not None:
            surface["expected"] = _expected(each.depth, each.errors, data["expected"], pool)
        surfaces.append({"label": each.run.label, "kind": "method", "text": f"seed {each.run.seed}", **surface})
    if stored.depth is not None:
        surfaces.append({"label": "truth", "kind": "truth", **_surface(stored.depth, stored.camera, data, pool)})
    return {**data, "surfaces": surfaces}


def _surface(depth: Tensor, camera: Camera, data: dict[str, Any], pool: PictureStore) -> dict[str, Any]:
    """Store the normals and depth of a map, (1, H, W) in metres."""
    basis = torch.tensor(BASIS, dtype=torch.float64)
    shadings = torch.full((3, *depth.shape[-2:]), torch.nan)
    if min(depth.shape[-2:]) > 1:
        shadings = shade(normals_seen_by(camera, depth), basis)[0]
    fitted, normal_valid = pool.fit(shadings)
    levels = np.rint((np.clip(fitted, -1, 1) + 1) * 127.5).astype(np.uint8)
    metres, depth_valid = pool.fit(depth)
    low, high = data["depth"]
    surface = {
        "size": [fitted.shape[1], fitted.shape[0]],
        "normals": pool.add(np.concatenate(np.split(levels, 3, axis=-1), axis=1)),
        "depth": pool.add(np.rint(255 * np.clip((metres - low) / (high - low), 0, 1)).astype(np.uint8)),
    }
    return surface | _mask(depth_valid, normal_valid, pool)


def _mask(depth_valid: np.ndarray, normal_valid: np.ndarray, pool: PictureStore) -> dict[str, str]:
    """Store the mask of a picture, if some of its pixels are invalid."""
    if depth_valid.all() and normal_valid.all():
        return {}
    levels = np.where(normal_valid & depth_valid, ALL_VALID, DEPTH_VALID)
    return {"mask": pool.add(np.where(depth_valid, levels, NOTHING_VALID).astype(np.uint8)[..., None])}


def _error(difference: Tensor, largest: float, pool: PictureStore) -> dict[str, str]:
    """Store a signed error, (1, H, W) in metres."""
    values, valid = pool.fit(difference)
    relative = np.clip(values / largest, -1, 1)
    levels = 128 + np.rint(127 * np.sign(relative) * np.sqrt(np.abs(relative)))
    return {"values": pool.add(levels.astype(np.uint8))} | _mask(valid, valid, pool)


def _expected(
    depth: Tensor, errors: tuple[Tensor, Tensor], largest: Mapping[str, float], pool: PictureStore
) -> dict[str, str]:
    """Store the expected errors, (1, H, W) in metres and degrees, where the depth and its normals are known."""
    known = depth.isfinite()
    normals_known = normal_mask(known) if min(known.shape[-2:]) > 1 else torch.zeros_like(known)
    stored, valid = {}, {}
    for name, error, there in (("depth", errors[0], known), ("angle", errors[1], normals_known)):
        values, valid[name] = pool.fit(torch.where(there, error, torch.nan))
        stored[name] = pool.add(np.rint(255 * np.sqrt(np.clip(values / largest[name], 0, 1))).astype(np.uint8))
    return stored | _mask(valid["depth"], valid["angle"], pool)


def _percentiles(errors: Sequence[Tensor], share: float) -> np.ndarray:
    """Return a percentile of the sizes of the known errors of each map that has any."""
    sizes = [error[error.isfinite()].abs().numpy() for error in errors]
    return np.array([np.percentile(values, share) for values in sizes if values.size])


def calibration_data(results: Results, problem: BenchmarkSetting) -> list[dict[str, Any]]:
    """Return how the expected errors of each method that has them agree with the measured ones.

    Each row has ``method``; ``scenes``, the number of scenes with ground truth that all of them have; ``depth`` and
    ``angle``, each with the ``ratios`` of :func:`dsr.metrics.calibration.error_ratios`, the ``share`` of the squared
    error in the most confident 80 % of the pixels, and the ``least`` possible one; None for an undefined value.
    """
    found: dict[str, dict[str, Tensor]] = {}
    step, views = 0, views_of(results, problem)
    for view in views:
        runs = []  # with expected errors of the scene
        for run in view.runs:
            with contextlib.suppress(ValueError):  # a damaged file has none, and is noted with its pictures
                runs += [run] if run.expected_errors(view.scene) is not None else []
        confident = replace(view, runs=tuple(runs))
        stored = stored_sample(confident, []) if runs else None
        if stored is None or stored.depth is None or min(stored.depth.shape[-2:]) < 2:
            continue
        step = step or math.ceil(stored.depth.numel() * len(views) / _MOST_PIXELS)
        for result in results_of(confident, stored, []):
            if result.errors is not None:
                truth = stored.depth.double()[None]
                depth, angle = measured_errors(result.depth[None], truth, stored.camera.rays()[None])
                maps = (result.errors[0], depth, result.errors[1], angle)
                errors = torch.stack([each.flatten()[::step].float() for each in maps])
                found.setdefault(result.run.label, {})[view.scene] = errors
    shared = [scene for scene in next(iter(found.values()), ()) if all(scene in of for of in found.values())]
    return [
        {"method": label, "scenes": len(shared), **_agreement(torch.cat([of[scene] for scene in shared], dim=1))}
        for label, of in found.items()
        if shared
    ]


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
    return float(value) if value.isfinite() else None
