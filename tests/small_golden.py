"""A small scene of the project with its low-resolution maps, results and scores: ``python tests/small_golden.py``.

Everything is computed by NumPy, SciPy and scikit-image, nothing by the package: a wall, a floor and a ball that are
traced in closed form, their block means, the spline through these, and the metrics of :mod:`reference_metrics`.
"""

import json
from pathlib import Path

import numpy as np
from reference_metrics import Array, Intrinsics, Reference
from scipy import ndimage

FOLDER = Path(__file__).resolve().parent / "golden" / "small"
INTRINSICS = Intrinsics(80.0, 76.0, 30.2, 33.1)
SIZE = 64


def trace() -> tuple[Array, Array]:
    """Return the depth of the scene in metres, (64, 64), and its photo, (64, 64, 3) uint8."""
    rays = INTRINSICS.rays(SIZE, SIZE)
    wall = 3.2 / (rays @ np.array([0.2, 0.0, 1.0]))
    downward = rays[..., 1]
    floor = np.where(downward > 0, 0.7 / np.where(downward > 0, downward, 1.0), np.inf)
    centre = np.array([0.1, 0.15, 2.2])
    along, squared = rays @ centre, (rays**2).sum(axis=-1)
    root = along**2 - squared * (centre @ centre - 0.45**2)
    ball = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / squared, np.inf)
    depths = np.stack((wall, floor, ball))
    depth, body = depths.min(axis=0), depths.argmin(axis=0)
    x, _, z = np.moveaxis(depth[..., None] * rays, -1, 0)
    checks = (np.floor(4 * x) + np.floor(4 * z)) % 2
    colours = np.array([[180, 170, 150], [120, 90, 60], [60, 110, 190]])[body]
    return depth.astype(np.float32), (colours - 30 * checks[..., None]).astype(np.uint8)


def block_means(depth: Array, scale: int) -> Array:
    """Return the low-resolution perspective depth: means over blocks."""
    lengths = np.linalg.norm(INTRINSICS.rays(SIZE, SIZE), axis=-1)
    blocks = (depth.astype(np.float64) * lengths).reshape(SIZE // scale, scale, SIZE // scale, scale)
    return blocks.mean(axis=(1, 3))


def upsample(low_resolution: Array, scale: int) -> Array:
    """Return the orthogonal depth of the cubic spline through perspective depths."""
    perspective = ndimage.zoom(low_resolution, scale, order=3, grid_mode=True, mode="nearest")
    return perspective / np.linalg.norm(INTRINSICS.rays(SIZE, SIZE), axis=-1)


def write(folder: Path) -> None:
    """Write the scene, the maps and the scores."""
    depth, rgb = trace()
    arrays: dict[str, Array] = {}
    for scale in (4, 8):
        low_resolution = block_means(depth, scale)
        arrays[f"perspective_x{scale}"] = low_resolution
        arrays[f"bicubic_x{scale}"] = upsample(low_resolution, scale).astype(np.float32)
    random = np.random.default_rng(0)
    incomplete = (depth + 0.01 * random.normal(size=depth.shape)).astype(np.float32)
    incomplete[random.random(depth.shape) < 0.02] = np.nan
    incomplete[20:27, 30:36] = np.nan
    arrays["incomplete"] = incomplete
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(folder / "maps.npz", depth=depth, rgb=rgb, **arrays)
    scores = {
        name: Reference(arrays[name].astype(np.float64), depth.astype(np.float64), INTRINSICS).all_metrics()
        for name in ("bicubic_x4", "bicubic_x8", "incomplete")
    }
    (folder / "metrics.json").write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(FOLDER)
