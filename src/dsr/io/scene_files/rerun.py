"""A recording for the viewer of rerun: colour, depth and poses on a timeline of frames.

Axes are the camera's, x right, y down, z forward (``RDF`` in rerun), units are metres. The library is the extra
``rerun``, https://rerun.io/docs.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dsr.io.scene_files.frame import Frame
from dsr.utils.files import replacing

_TIMELINE = "frame"


def write_rerun(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write a recording ``.rrd``: for each frame the entities ``camera``, ``camera/rgb`` and ``camera/depth``.

    Args:
        path: the file.
        frames: one at least; those without a pose stand at the origin.

    Returns:
        The file.

    Raises:
        ValueError: the library is not installed.

    """
    try:
        rerun = importlib.import_module("rerun")
    except ImportError as error:
        raise ValueError("rerun: expected the library rerun-sdk, which `pip install dsr[rerun]` installs") from error
    recording = rerun.RecordingStream("dsr")
    with replacing(path) as temporary:
        recording.save(str(temporary))
        recording.log("/", rerun.ViewCoordinates.RDF, static=True)
        for number, frame in enumerate(frames):
            camera = frame.camera
            recording.set_time(_TIMELINE, sequence=number)
            pose = np.eye(4) if frame.pose is None else frame.pose.numpy()
            recording.log("camera", rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            matrix = [[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]]
            size = [camera.width, camera.height]
            view = rerun.Pinhole(image_from_camera=matrix, resolution=size, camera_xyz=rerun.ViewCoordinates.RDF)
            recording.log("camera", view)
            recording.log("camera/rgb", rerun.Image(frame.read_colour()).compress(jpeg_quality=95))
            recording.log("camera/depth", rerun.DepthImage(np.nan_to_num(frame.read_depth()), meter=1.0))
        recording.flush()
        recording.disconnect()
    return [path]
