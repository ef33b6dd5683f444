"""Renderings of a result beside those of the true depth, for logs."""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.geometry.shading import render
from dsr.geometry.surface import depth_to_normals


def comparison(depth: Tensor, truth: Tensor | None, rays: Tensor) -> Tensor:
    """Return an image of the renderings of a result beside those of the true depth; holes are black.

    Args:
        depth: (1, 1, H, W) in metres.
        truth: true depth, (1, 1, H, W) in metres, or None.
        rays: (1, 3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.

    Returns:
        (1, 2 H, 3 W) in [0, 1]: the renderings of the result and of the truth, and twice their difference; under the
        first light, and below them under the last. Without true depth only the result, (1, 2 H, W).

    """
    result = render(depth_to_normals(depth, rays))[0]  # (4, H, W)
    columns = [result]
    if truth is not None:
        real = render(depth_to_normals(truth, rays))[0]
        columns += [real, (2 * (result - real).abs()).clamp(max=1)]
    rows = [torch.cat([each[light] for each in columns], dim=-1) for light in (0, -1)]
    return torch.cat(rows, dim=-2)[None].nan_to_num(0).float().cpu()
