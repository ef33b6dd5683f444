"""Rigs of a photo camera and a depth camera elsewhere: files that describe them, and depth in the photo's view."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.poses import Matrix
from dsr.geometry.warping import registered_camera, warp_depth
from dsr.io.cameras import read_any_camera
from dsr.io.encoding import Assumption
from dsr.io.photos import Size, same_aspect
from dsr.io.poses import read_transform
from dsr.io.reading import RigFiles


class Rig(NamedTuple):
    """A depth camera, of the depth map's pixels, and the transform from its frame to the photo camera's, metres."""

    camera: Camera
    transform: Matrix


def read_rig(files: RigFiles, size_lr: Size, baseline: float | None) -> Rig:
    """Read the description of a rig.

    Args:
        files: the files.
        size_lr: height and width of the depth map.
        baseline: distance in metres between the two cameras of disparities, if the map has such.

    Raises:
        ValueError: a file is missing or damaged, or the camera is one of another aspect than the depth map.

    """
    height, width = size_lr
    content = read_any_camera(files.camera)
    if isinstance(content, np.ndarray):
        camera = Camera(width, height, content[0, 0], content[1, 1], content[0, 2], content[1, 2], baseline)
    else:
        camera = content.camera
        if not same_aspect((camera.height, camera.width), size_lr):
            raise ValueError(
                f"{files.camera}: the camera is of {camera.width} x {camera.height} pixels (width x height), the depth "
                f"map has {width} x {height}, another aspect"
            )
        camera = camera.rescale(width, height)
    own = camera.baseline if baseline is None else baseline
    camera = Camera(width, height, camera.fx, camera.fy, camera.cx, camera.cy, own, camera.doffs)
    return Rig(camera, read_transform(files.extrinsics))


def to_photo(depth_lr: Tensor, rig: Rig, photo: Camera) -> tuple[Tensor, Assumption]:
    """Return a depth camera's map as the photo's camera sees it, and a note.

    Args:
        depth_lr: (1, h, w) orthogonal depth in metres, NaN in holes.
        rig: the depth camera.
        photo: the photo's camera.

    Returns:
        (1, h', w') as fine as the depth map is, in the photo's field of view.

    Raises:
        ValueError: the photo shows nothing of the map.

    """
    target = registered_camera(rig.camera, photo)
    warped = warp_depth(depth_lr[None], rig.camera, torch.from_numpy(rig.transform)[None], target)[0]
    if not bool(warped.isfinite().any()):
        raise ValueError(
            "--extrinsics: expected the transform from the depth camera's frame to the photo camera's, in metres; with "
            "this one the photo shows nothing of the depth map"
        )
    holes = f"{target.width} x {target.height}, {float(warped.isnan().float().mean()):.1%} holes"
    return warped, Assumption("the depth map is warped into the photo's view", holes)
