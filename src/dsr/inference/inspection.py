"""Inspect a depth map: whether it was enlarged before, whether it is noisy, and which method suits it."""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling
from dsr.geometry.camera import Camera
from dsr.inference.planning import OWN_SIZE, USUAL_SCALE
from dsr.methods.noise import estimate_noise, normal_noise_deg

CLEAN, NOISY = "facets", "msg_v_noisy"
LARGEST_TILT = 8.0
"""Degrees; a depth map is noisy if its noise tilts the normals by more."""
_LARGEST_BLOCK = 16
_SCALES_OF_NOISY = (None, 4, 16)
_LARGEST_RATIO = 4.2


def suited_method(depth: Tensor, camera: Camera, scale: int | None = None) -> str:
    """Return the network for a depth map: one that was trained on noisy depth where the map is noisy.

    RMSE_v on Lucy and Plant at x4, by how many degrees the noise tilts the low-resolution map's normals
    (:func:`dsr.methods.noise.normal_noise_deg`):

    | tilt | 2, 2 | 7, 5 | 12, 9 | 22, 17 | 37, 30 |
    | --- | --- | --- | --- | --- | --- |
    | facets | 0.088, 0.166 | 0.109, 0.171 | 0.155, 0.187 | 0.246, 0.235 | 0.363, 0.326 |
    | msg_v_noisy | 0.127, 0.173 | 0.128, 0.173 | 0.130, 0.174 | 0.138, 0.177 | 0.155, 0.183 |

    Args:
        depth: (1, h, w) orthogonal depth in metres, NaN in holes.
        camera: the photo's.
        scale: the requested factor; the noisy network upsamples by 4, once or twice.

    """
    depth_lr = _low_resolution(depth, camera, scale)
    ratio = max(camera.height / depth_lr.shape[-2], camera.width / depth_lr.shape[-1])
    if scale not in _SCALES_OF_NOISY or ratio > _LARGEST_RATIO:
        return CLEAN
    tilt = normal_noise_deg(estimate_noise(depth_lr[None]), camera.rescale(depth_lr.shape[-1], depth_lr.shape[-2]))
    return NOISY if tilt > LARGEST_TILT else CLEAN


def _low_resolution(depth: Tensor, camera: Camera, scale: int | None) -> Tensor:
    """Return approximately the low-resolution map that a network will be given."""
    height, width = depth.shape[-2:]
    if camera.height > OWN_SIZE * height or camera.width > OWN_SIZE * width:
        return depth
    block = enlarged_by(depth)
    if block > 1:
        return depth[:, ::block, ::block]
    factor = scale or USUAL_SCALE
    if min(height, width) < factor:
        return depth
    inside = depth[:, : height - height % factor, : width - width % factor]
    return Downsampling("box")(inside.reciprocal(), factor).reciprocal()


def enlarged_by(values: Tensor) -> int:
    """Return the factor by which a map, (..., H, W), was enlarged by repeating pixels; 1 for none."""
    filled = values.nan_to_num(nan=-1.0)
    if bool((filled == filled.flatten()[0]).all()):
        return 1
    for block in range(_LARGEST_BLOCK, 1, -1):
        one = filled[..., ::block, ::block]
        if all(
            torch.equal(
                filled[..., i::block, j::block],
                one[..., : _count(filled, -2, i, block), : _count(filled, -1, j, block)],
            )
            for i in range(block)
            for j in range(block)
        ):
            return block
    return 1


def _count(values: Tensor, dim: int, start: int, step: int) -> int:
    """Return the length of ``values[start::step]`` along ``dim``."""
    return len(range(start, values.shape[dim], step))
