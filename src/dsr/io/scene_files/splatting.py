"""Inverse depth for 3D Gaussian Splatting, and its scene where the capture has poses.

graphdeco's `train.py -d depths` reads ``depths/NAME.png`` of 16 bits beside ``images/NAME.*``, divides the values by
65536, multiplies them by the ``scale`` of NAME in ``sparse/0/depth_params.json`` and adds its ``offset``; the result is
compared with the rendered inverse depth, in the unit of the scene (https://github.com/graphdeco-inria/gaussian-splatting,
"Depth regularization"). All frames have one scale here, since a frame whose scale is far from the others' is left out.
The scene itself is COLMAP's text model (https://colmap.github.io/format.html): cameras, world-to-camera transforms with
x right, y down, z forward, and points to start from. Its principal point is counted from the corner of the image.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dsr.io.scene_files.frame import Frame, write_sixteen_bits
from dsr.utils.files import replacing, write_text

_DIVISOR = 65536
_LARGEST = 65535
_POINTS = 100_000
"""Points of all frames together that the optimisation starts from."""


def write_splatting(folder: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write ``images/``, ``depths/`` and ``sparse/0/`` of a scene.

    Without poses ``sparse/0/`` has ``depth_params.json`` alone, whose scale holds for a scene in metres.

    Args:
        folder: is created if it is missing.
        frames: one at least.

    Returns:
        The files.

    Raises:
        ValueError: no frame has any depth.

    """
    nearest = min((_nearest(frame) for frame in frames), default=np.inf)
    if not np.isfinite(nearest):
        raise ValueError("gaussian: expected some depth, got holes alone")
    scale = _DIVISOR / _LARGEST / nearest
    files = []
    for frame in frames:
        files += [folder / "images" / f"{frame.stem}.png", folder / "depths" / f"{frame.stem}.png"]
        with replacing(files[-2]) as temporary:
            shutil.copyfile(frame.colour, temporary)
        inverse = _DIVISOR / (scale * frame.read_depth().astype(np.float64))
        write_sixteen_bits(files[-1], np.nan_to_num(np.rint(inverse), nan=0, posinf=0).astype(np.uint16))
    sparse = folder / "sparse" / "0"
    texts = {"depth_params.json": _parameters(frames, scale)}
    if all(frame.pose is not None for frame in frames):
        texts |= {"cameras.txt": _cameras(frames), "images.txt": _images(frames), "points3D.txt": _points(frames)}
    for name, text in texts.items():
        write_text(sparse / name, text)
    return [*files, *(sparse / name for name in texts)]


def _nearest(frame: Frame) -> float:
    """Return a frame's smallest depth in metres, infinity if it has none."""
    depth = frame.read_depth()
    return float(depth[np.isfinite(depth)].min(initial=np.inf))


def _parameters(frames: Sequence[Frame], scale: float) -> str:
    """Return ``depth_params.json``."""
    return json.dumps({frame.stem: {"scale": scale, "offset": 0.0} for frame in frames}, indent=2) + "\n"


def _cameras(frames: Sequence[Frame]) -> str:
    """Return ``cameras.txt``, a camera for each frame."""
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for number, camera in enumerate((frame.camera for frame in frames), 1):
        values = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
        lines.append(f"{number} PINHOLE {camera.width} {camera.height} " + _numbers(values))
    return "\n".join(lines) + "\n"


def _images(frames: Sequence[Frame]) -> str:
    """Return ``images.txt``: for each frame its pose, and an empty line for the points that it sees."""
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"]
    for number, frame in enumerate(frames, 1):
        pose = _matrix(frame)
        to_camera = pose[:3, :3].T
        turn = Rotation.from_matrix(to_camera).as_quat(canonical=True)[[3, 0, 1, 2]]
        lines += [f"{number} {_numbers((*turn, *(-to_camera @ pose[:3, 3])))} {number} {frame.stem}.png", ""]
    return "\n".join(lines) + "\n"


def _points(frames: Sequence[Frame]) -> str:
    """Return ``points3D.txt``: points of all frames with their colours, on a grid of pixels."""
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    for frame in frames:
        camera, depth = frame.camera, frame.read_depth()
        step = max(1, int(np.ceil(np.sqrt(depth.size * len(frames) / _POINTS))))
        rows, columns = (each.ravel() for each in np.mgrid[0 : camera.height : step, 0 : camera.width : step])
        z = depth[rows, columns].astype(np.float64)
        rays = np.stack(((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(z))), axis=1)
        pose = _matrix(frame)
        points = (rays * z[:, None]) @ pose[:3, :3].T + pose[:3, 3]
        colours = frame.read_colour()[rows, columns]
        for point, colour in zip(points[np.isfinite(z)], colours[np.isfinite(z)], strict=True):
            red, green, blue = colour
            lines.append(f"{len(lines)} {_numbers(point)} {red} {green} {blue} 0")
    return "\n".join(lines) + "\n"


def _matrix(frame: Frame) -> np.ndarray:
    """Return the pose of a frame that has one, (4, 4)."""
    return np.eye(4) if frame.pose is None else frame.pose.numpy()


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers between blanks."""
    return " ".join(f"{value:.9g}" for value in values)
