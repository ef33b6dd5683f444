"""A picture of a result's renderings beside the truth's, for logs."""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.geometry.shading import render
from dsr.geometry.surface import depth_to_normals


def comparison(depth: Tensor, truth: Tensor | None, rays: Tensor) -> Tensor:
    """Return a picture of a result beside the truth, holes black.

    Args:
        depth: (1, 1, H, W) in metres.
        truth: likewise; None where it is not known.
        rays: (1, 3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.

    Returns:
        (1, 2 H, 3 W) in [0, 1]: the renderings of the result and of the truth, and twice their difference; under the
        first light, and below under the last. Without a truth (1, 2 H, W), the result's alone.

    """
    result = render(depth_to_normals(depth, rays))[0]  # (4, H, W)
    columns = [result]
    if truth is not None:
        real = render(depth_to_normals(truth, rays))[0]
        columns += [real, (2 * (result - real).abs()).clamp(max=1)]
    rows = [torch.cat([each[light] for each in columns], dim=-1) for light in (0, -1)]
    return torch.cat(rows, dim=-2)[None].nan_to_num(0).float().cpu()
