"""The result of a check, and the arrays that the checks examine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from torch.nn import functional

from dsr.sample import Scene

Level = Literal["ok", "note", "warning", "problem"]
LEVELS: tuple[Level, ...] = get_args(Level)
"""From the best to the worst; ``warning`` and ``problem`` mean that the scene is probably wrong."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """A finding of one check.

    Args:
        check: name of the check.
        level: severity.
        message: measured values, with units.
        advice: recommended action; empty for none.

    """

    check: str
    level: Level
    message: str
    advice: str = ""


def worst(findings: list[Finding]) -> Level:
    """Return the worst level; ``ok`` without findings."""
    return max((finding.level for finding in findings), key=LEVELS.index, default="ok")


def with_depth(scene: Scene) -> Scene:
    """Return the scene at the resolution of its high-resolution depth, else of its largest measured map."""
    if scene.depth is not None:
        return scene
    depth = scene.measured[min(scene.measured)]
    height, width = depth.shape[-2:]
    camera, ratio = scene.camera.reduce(width, height), scene.camera.ratio_to(width, height)
    rgb = scene.rgb[:, : camera.height * ratio, : camera.width * ratio] if isinstance(ratio, int) else scene.rgb
    rgb = functional.interpolate(rgb[None], (height, width), mode="area")[0]
    return replace(scene, rgb=rgb.clamp(0, 1), camera=camera, depth=depth, measured={})


def metres(scene: Scene) -> Array:
    """Return a scene's high-resolution depth, (H, W) float64 in metres, NaN in holes."""
    if scene.depth is None:
        raise ValueError(f"{scene.name}: expected high-resolution depth, there is none; see with_depth")
    depth: Array = scene.depth[0].double().numpy()
    return depth
