"""A small scene of the project, traced in closed form: a wall, a floor and a ball."""

import numpy as np
from reference_metrics import Array, Intrinsics

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
