"""What a check says, and the arrays that every check looks at."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from torch.nn import functional

from dsr.sample import Scene

Level = Literal["ok", "note", "warning", "problem"]
LEVELS: tuple[Level, ...] = get_args(Level)
"""From the best to the worst; from ``warning`` on something looks wrong."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Args:
        check: its name.
        level: how bad it is.
        message: what was measured, with units.
        advice: what to do; empty where there is nothing to do.

    """

    check: str
    level: Level
    message: str
    advice: str = ""


def worst(findings: list[Finding]) -> Level:
    """Return the worst level, ``ok`` where there is no finding."""
    return max((finding.level for finding in findings), key=LEVELS.index, default="ok")


def with_depth(scene: Scene) -> Scene:
    """Return the scene at the resolution of the depth to examine: of the HR one, else of the finest measured one."""
    if scene.depth is not None:
        return scene
    factor = min(scene.measured)
    depth, camera = scene.measured[factor], scene.camera.downscale(factor)
    photo = functional.avg_pool2d(scene.rgb[:, : camera.height * factor, : camera.width * factor][None], factor)[0]
    return replace(scene, rgb=photo.clamp(0, 1), camera=camera, depth=depth, measured={})


def metres(scene: Scene) -> Array:
    """Return a scene's high-resolution depth, (H, W) float64 in metres, NaN in holes.

    Raises:
        ValueError: it has none.

    """
    if scene.depth is None:
        raise ValueError(f"{scene.name}: expected high-resolution depth, there is none; see with_depth")
    depth: Array = scene.depth[0].double().numpy()
    return depth


def length(value: float) -> str:
    """Return positive metres as a text of a fitting unit."""
    if value >= 1e3:
        return f"{value / 1e3:.3g} km"
    return f"{value:.3g} m" if value >= 0.1 else f"{value * 1e3:.3g} mm"
