"""Warnings of an implausible camera, baseline or distances of a picture, by the rules of ``dsr doctor``."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from dsr.geometry.camera import Camera, RangeType
from dsr.geometry.plausible import implausible_distance, judge_camera, plausible_baseline
from dsr.notes import Assumption
from dsr.utils.progress import show_length

_SAMPLE = 100_000
"""Largest number of pixels that percentiles are taken of."""


def doubt_camera(camera: Camera, whose: str, size_lr: tuple[int, int] | None = None) -> list[Assumption]:
    """Return warnings of a camera.

    Args:
        camera: the camera.
        whose: what it is, such as ``camera``.
        size_lr: (height, width) of the depth map, whose intrinsics may have been given for the photo's.

    """
    found = (each for each in judge_camera(camera, size_lr) if each.level != "note")
    return [
        Assumption(f"{whose}: {each.kind}", f"{each.message}; {each.advice}", each.code, each.value) for each in found
    ]


def doubt_depth(depth_lr: Tensor, camera: Camera, range_type: RangeType) -> list[Assumption]:
    """Return warnings of distances that no room or table has, and of a baseline that no two cameras have.

    Args:
        depth_lr: (1, h, w) orthogonal depth in metres, NaN in holes.
        camera: that of its pixels.
        range_type: what it was read as; a strange baseline is right if disparities become plausible depth with it.

    """
    known = depth_lr[depth_lr.isfinite()]
    known = known[:: -(-known.numel() // _SAMPLE)]
    low, high = np.percentile(known.numpy(), (1, 99)).tolist()
    code, doubts = implausible_distance(low, high), []
    baseline = camera.baseline
    if baseline is not None and not plausible_baseline(baseline) and (range_type != "disparity" or code is not None):
        text = f"the baseline is {show_length(baseline)}: --baseline is in metres, between the two cameras of a pair"
        doubts.append(Assumption(text, "", "baseline-short" if baseline < 1 else "baseline-long", baseline))
    if code is not None:
        cure = "--baseline, --depth-unit and the camera set it" if range_type == "disparity" else "--depth-unit sets it"
        text = f"the depth is {'nearer' if code == 'depth-near' else 'farther'} than any depth camera measures; {cure}"
        doubts.append(
            Assumption(text, f"{show_length(low)} to {show_length(high)}", code, high if code == "depth-near" else low)
        )
    return doubts
