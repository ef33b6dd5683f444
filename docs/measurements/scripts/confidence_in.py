# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Measure three uses of a confidence map: none, holes in place of unsure pixels, and the noise of each level given.

    python docs/measurements/scripts/confidence_in.py [--scenes DIR] [--scale 8] [--seed 1]

``DIR`` has ``lucy`` and ``plant``. Their maps, box means, get noise whose standard deviation depends on the confidence:
a fifth of the pixels, in patches, is of level 0, three tenths of level 1, and the rest of level 2. The noise of a level
is measured as ``method=facets`` could: the median absolute difference of its pixels to the result without confidence.
Each row is a scene, the noise of level 2 in mm, that of levels 1 and 0 over it, and over how many pixels noise is
smoothed; then, for each use, the mean absolute error of depth in mm (at most 50 a pixel) and of normals in degrees.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, relative_error
from dsr.geometry.camera import Camera, from_range
from dsr.geometry.surface import depth_to_normals
from dsr.io.cameras import read_camera
from dsr.io.images import read_rgb
from dsr.methods.networks.facets_method import AnyMap
from dsr.methods.recipe import Run, read_recipe
from dsr.sample import DepthSample
from dsr.utils.compute_device import fast_precision

CASES = ((0.005, 2.0, 5.0, 0.0), (0.005, 2.0, 5.0, 1.0), (0.003, 3.0, 10.0, 0.0), (0.01, 1.0, 3.0, 1.0))
"""Noise of level 2 in metres, that of levels 1 and 0 over it, and over how many pixels noise is smoothed."""


class Scene(NamedTuple):
    """A scene: (3, H, W) photo, (1, H, W) depth in metres, and the camera."""

    rgb: Tensor
    depth: Tensor
    camera: Camera


def read_scene(folder: Path) -> Scene:
    """Return a scene of ``rgb.png``, ``disparity.npy`` and ``camera.json``."""
    rgb = torch.from_numpy(read_rgb(folder / "rgb.png").transpose(2, 0, 1).copy()).float() / 255
    camera = read_camera(folder / "camera.json").camera
    disparity = torch.from_numpy(np.load(folder / "disparity.npy").astype(np.float32))[None]
    return Scene(rgb, from_range(disparity, camera, "disparity"), camera)


def make_noise(shape: tuple[int, ...], smooth: float, rng: np.random.Generator) -> np.ndarray:
    """Return noise of standard deviation 1, smoothed over some pixels."""
    noise = rng.standard_normal(shape)
    noise = gaussian_filter(noise, smooth) if smooth else noise
    return noise / noise.std()


def errors(depth: Tensor, scene: Scene) -> tuple[float, float]:
    """Return the mean absolute errors of depth in mm and of normals in degrees."""
    rays = scene.camera.rays()
    found, truth = (depth_to_normals(each.double(), rays) for each in (depth, scene.depth))
    angles = torch.rad2deg(torch.acos((found * truth).sum(0).clamp(-1, 1)))
    distances = (depth - scene.depth).abs().clamp(max=0.05)
    return 1e3 * float(distances.mean()), float(angles[angles.isfinite()].mean())


def uses(scene: Scene, depth_lr: Tensor, levels: Tensor, method: AnyMap, scale: int) -> Mapping[str, Tensor]:
    """Return the high-resolution depth of each use of the levels, (1, h, w)."""
    camera_lr = scene.camera.downscale(scale)
    sample = DepthSample("confidence", "depth", scene.rgb, depth_lr, scene.camera, camera_lr, scale)
    holes = depth_lr.masked_fill(levels == 0, torch.nan)
    plain = method.surface(sample).depth
    error, known = relative_error(depth_lr.reciprocal()[None], plain.reciprocal()[None])
    noise = torch.zeros_like(error)
    for level in levels.unique():
        here = (levels == level)[None]
        noise[here] = error[here & (known > 0)].abs().median() / 0.6745
    answer = method._answer  # the way past the estimate, to give a noise of each pixel
    try:
        method._answer = lambda rgb, inverse, _, progress: answer(rgb, inverse, noise, progress)  # type: ignore[method-assign]
        hinted = method.surface(sample).depth
    finally:
        method._answer = answer  # type: ignore[method-assign]
    sample = DepthSample("confidence", "depth", scene.rgb, holes, scene.camera, camera_lr, scale)
    return {"not used": plain, "holes": method.surface(sample).depth, "noise given": hinted}


def main() -> None:
    """Print a row for each scene and kind of noise."""
    shared = Path(os.environ.get("DSR_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=shared / "scenes")
    parser.add_argument("--scale", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    method = read_recipe("facets").build(options.scale, Run(precision=fast_precision(torch.device("cpu"))))
    assert isinstance(method, AnyMap)  # noqa: S101 - for the type checker
    for name in ("lucy", "plant"):
        scene = read_scene(options.scenes / name)
        clean = Downsampling("box")(scene.depth.reciprocal(), options.scale).reciprocal()
        for deviation, middle, low, smooth in CASES:
            rng = np.random.default_rng(options.seed)
            patches = make_noise(tuple(clean.shape[1:]), 4, rng)
            levels = torch.from_numpy(np.searchsorted(np.quantile(patches, (0.2, 0.5)), patches))[None]
            scales = torch.tensor([low, middle, 1.0])[levels] * deviation
            noise = torch.from_numpy(make_noise(tuple(clean.shape[1:]), smooth, rng))[None]
            found = uses(scene, (clean + scales * noise).float(), levels, method, options.scale)
            figures = {use: errors(depth, scene) for use, depth in found.items()}
            row = "; ".join(f"{use} {mm:.2f} mm {degrees:.2f}" for use, (mm, degrees) in figures.items())
            print(f"{name} {1e3 * deviation:g} mm x{middle:g} x{low:g} smoothed {smooth:g}: {row}", flush=True)


if __name__ == "__main__":
    main()
