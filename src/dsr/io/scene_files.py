"""Frames with one picture of colour and depth each, as other programs read them.

``transforms.json`` with depth, as nerfstudio and the programs around instant-ngp read it.

Axes of a camera are those of OpenGL, x right, y up, z backwards, so that the second and third column of dsr's
camera-to-world transform change their signs. The world stays as it is, so ``applied_transform`` is the identity:
nerfstudio turns it upright itself, and its versions differ in whether the points of ``ply_file_path`` are meant before
or after that transform (nerfstudio-project/nerfstudio, nerfstudio/data/dataparsers/nerfstudio_dataparser.py). Names of
files differ, as it finds reduced pictures by the name alone. The principal point is counted from the corner of the
image, half a pixel more than dsr's. ``depth_file_path`` is a 16-bit PNG in millimetres, 0 in holes, its default unit;
``depth_unit_scale_factor`` says so to other readers, as nerfstudio takes it from its own options.

Inverse depth for 3D Gaussian Splatting, and its scene where the capture has poses.

graphdeco's `train.py -d depths` reads ``depths/NAME.png`` of 16 bits beside ``images/NAME.*``, divides the values by
65536, multiplies them by the ``scale`` of NAME in ``sparse/0/depth_params.json`` and adds its ``offset``; the result is
compared with the rendered inverse depth, in the unit of the scene
(https://github.com/graphdeco-inria/gaussian-splatting, "Depth regularization"). All frames have one scale here, since a
frame whose scale is far from the others' is left out. The scene itself is COLMAP's text model
(https://colmap.github.io/format.html): cameras, world-to-camera transforms with x right, y down, z forward, and points
to start from. Its principal point is counted from the corner of the image.

A recording for the viewer of rerun: colour, depth and poses on a timeline of frames.

A camera's axes are x right, y down, z forward (``RDF`` in rerun). The world's are said as far as the capture says which
one points up: ``RUB`` with y up, ``RFU`` with z up, else ``RDF``. Photos are JPEG, depth is 16-bit PNG in millimetres
with ``meter``, the units of a metre (rerun-io/rerun, re_sdk_types/definitions/rerun/components/depth_meter.fbs). The
library is the extra ``rerun``, https://rerun.io/docs.
"""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.poses import is_rotation, quaternion_of
from dsr.io.depth_files import read_depth_file
from dsr.io.exports import world_comment, write_ply
from dsr.io.images import read_pixels
from dsr.io.photos import encode_png, to_jpeg, write_png
from dsr.utils.files import replacing, write_text
from dsr.utils.guards import pixels_beside, refusing
from dsr.utils.versions import how_to_install

RGBD = ("color.png", "depth.png", "intrinsic.json")
SCENE = "nerfstudio"
"""Folder of what ``transforms.json`` names."""
MILLIMETRES = 1000
MOST_MILLIMETRES = 65535
_RIGID = 1e-3
"""Largest difference of R R' from the identity."""

_DIVISOR = 65536
_LARGEST = 65535
_POINTS = 100_000
"""Points of all frames together that the optimisation starts from."""

_TIMELINE, _CLOCK = "frame", "time"
_AXES = {"": "RDF", "y": "RUB", "z": "RFU"}
"""Of the world in rerun, by what points up."""
_EPOCH = 1e9
"""Times from here on are seconds since 1970, smaller ones count from the start of a device or a recording."""
_QUALITY = 95


@dataclass(frozen=True)
class Frame:
    """A photo and a depth map of one size.

    Args:
        name: the frame's, perhaps with folders: ``kitchen/000012``.
        camera: of the pixels.
        pose: (4, 4) float64 camera-to-world transform in metres, of a camera with x right, y down, z forward; None if
            it is not known.
        colour: an 8-bit PNG.
        depth: a file of (H, W) orthogonal depth in metres, NaN in holes.
        up: the axis of the world that points up, one of :data:`dsr.io.frames.UPS`.
        time: of the frame in seconds; None if it is not known.

    """

    name: str
    camera: Camera
    pose: Tensor | None
    colour: Path
    depth: Path
    up: str = ""
    time: float | None = None

    @property
    def stem(self) -> str:
        """The name as that of a file."""
        return self.name.replace("/", "_")

    def read_depth(self) -> np.ndarray:
        """Return the depth, (H, W) float32 in metres, NaN in holes.

        Raises:
            ValueError: the file is damaged, or not of the camera's size.

        """
        values = read_depth_file(self.depth, pixels_beside(self.camera.height, self.camera.width))
        if values.shape != (self.camera.height, self.camera.width):
            size = f"{self.camera.height} x {self.camera.width}"
            raise ValueError(f"{self.depth}: expected depth of {size} pixels (height x width), got {values.shape}")
        return values.astype(np.float32)

    def read_colour(self) -> np.ndarray:
        """Return the photo, (H, W, 3) uint8, red first.

        Raises:
            ValueError: the file is damaged.

        """
        most = pixels_beside(self.camera.height, self.camera.width)
        return read_pixels(self.colour, cv2.IMREAD_COLOR, most)[..., ::-1]


def parse_pose(where: str, value: object) -> Tensor | None:
    """Return a camera-to-world transform, (4, 4) float64, that a file holds as a list of lists; None for none.

    Args:
        where: the file and the key, for the message.
        value: what the file holds there.

    Raises:
        ValueError: it is no rigid transform.

    """
    if value is None:
        return None
    try:
        pose = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        pose = torch.empty(0, dtype=torch.float64)
    rigid = pose.shape == (4, 4) and bool(pose.isfinite().all()) and pose[3].tolist() == [0, 0, 0, 1]
    if not rigid or not is_rotation(pose[:3, :3].numpy(), _RIGID):
        raise ValueError(f"{where}: expected a rigid transform of 4 x 4 numbers, got {value}")
    return pose


def one_camera(frames: Sequence[Frame]) -> Camera | None:
    """Return the camera of all frames, or None if they differ."""
    cameras = {frame.camera for frame in frames}
    return cameras.pop() if len(cameras) == 1 else None


def common_up(frames: Sequence[Frame]) -> str:
    """Return the axis that points up in the world of all frames, or "" if they differ."""
    ups = {frame.up for frame in frames}
    return ups.pop() if len(ups) == 1 else ""


def to_millimetres(depth: np.ndarray) -> tuple[np.ndarray, int]:
    """Return depth in metres as whole millimetres, (H, W) uint16 with 0 in holes, and how many pixels are too far.

    Depth of 65.535 m and more does not fit, and becomes a hole.
    """
    values = np.rint(depth.astype(np.float64) * MILLIMETRES)
    fits = (values > 0) & (values <= MOST_MILLIMETRES)
    return np.where(fits, values, 0).astype(np.uint16), int((values > MOST_MILLIMETRES).sum())


def write_transforms(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write ``transforms.json``, and beside it ``nerfstudio/`` with ``images/``, ``depths/`` and ``points.ply``.

    Args:
        path: the file.
        frames: one at least; a single one without a pose stands at the origin.

    Returns:
        The files.

    Raises:
        ValueError: one of several frames has no pose.

    """
    expect_poses("nerfstudio", {frame.name: frame.pose is not None for frame in frames})
    camera, folder = one_camera(frames), path.parent / SCENE
    files = [folder / kind / f"{frame.stem}.png" for frame in frames for kind in ("images", "depths")]
    for frame, photo, depth in zip(frames, files[::2], files[1::2], strict=True):
        with replacing(photo) as temporary:
            shutil.copyfile(frame.colour, temporary)
        write_png(depth, to_millimetres(frame.read_depth())[0])
    files.append(folder / "points.ply")
    write_ply(files[-1], *_sparse(frames), frame=world_comment(common_up(frames)))
    entries: dict[str, Any] = {"camera_model": "OPENCV", **({} if camera is None else _intrinsics(camera))}
    entries["depth_unit_scale_factor"] = 1 / MILLIMETRES
    entries["applied_transform"] = np.eye(4)[:3].tolist()
    names = [file.relative_to(path.parent).as_posix() for file in files]
    entries["ply_file_path"] = names[-1]
    entries["frames"] = []
    for frame, photo_name, depth_name in zip(frames, names[:-1:2], names[1:-1:2], strict=True):
        pose = torch.eye(4, dtype=torch.float64) if frame.pose is None else frame.pose
        entries["frames"].append(
            {
                "file_path": photo_name,
                "depth_file_path": depth_name,
                **({} if camera is not None else _intrinsics(frame.camera)),
                "transform_matrix": (pose * pose.new_tensor([1, -1, -1, 1])).tolist(),  # of OpenGL's camera frame
            }
        )
    write_text(path, json.dumps(entries, indent=2) + "\n")
    return [path, *files]


def expect_poses(part: str, known: Mapping[str, bool]) -> None:
    """Check that each frame has a pose; a single one needs none.

    Args:
        part: name of what needs them.
        known: whether a frame has one, by its name.

    Raises:
        ValueError: one of several frames has none.

    """
    missing = [name for name, has in known.items() if not has]
    if missing and len(known) > 1:
        raise ValueError(
            f"{part}: expected a pose of each frame, got none for {len(missing)} of {len(known)}, such as "
            f"{missing[0]}; --poses gives them"
        )


def _intrinsics(camera: Camera) -> dict[str, float]:
    """Return the camera's entries."""
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def write_splatting(folder: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write ``images/``, ``depths/`` and ``sparse/0/`` of a scene.

    Of a single frame without a pose ``sparse/0/`` has ``depth_params.json`` alone, for a scene in metres.

    Args:
        folder: is created if it is missing.
        frames: one at least.

    Returns:
        The files.

    Raises:
        ValueError: no frame has any depth, or one of several has no pose.

    """
    expect_poses("gaussian", {frame.name: frame.pose is not None for frame in frames})
    depths = (frame.read_depth() for frame in frames)
    nearest = min((float(depth[np.isfinite(depth)].min(initial=np.inf)) for depth in depths), default=np.inf)
    if not np.isfinite(nearest):
        raise ValueError("gaussian: expected some depth, got holes alone")
    scale = _DIVISOR / _LARGEST / nearest
    files = []
    for frame in frames:
        files += [folder / "images" / f"{frame.stem}.png", folder / "depths" / f"{frame.stem}.png"]
        with replacing(files[-2]) as temporary:
            shutil.copyfile(frame.colour, temporary)
        inverse = _DIVISOR / (scale * frame.read_depth().astype(np.float64))
        write_png(files[-1], np.nan_to_num(np.rint(inverse), nan=0, posinf=0).astype(np.uint16))
    sparse = folder / "sparse" / "0"
    parameters = {frame.stem: {"scale": scale, "offset": 0.0} for frame in frames}
    texts = {"depth_params.json": json.dumps(parameters, indent=2) + "\n"}
    if all(frame.pose is not None for frame in frames):
        texts |= {"cameras.txt": _cameras(frames), "images.txt": _images(frames), "points3D.txt": _points(frames)}
    for name, text in texts.items():
        write_text(sparse / name, text)
    return [*files, *(sparse / name for name in texts)]


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
        turn = quaternion_of(to_camera)[[3, 0, 1, 2]]
        lines += [f"{number} {_numbers((*turn, *(-to_camera @ pose[:3, 3])))} {number} {frame.stem}.png", ""]
    return "\n".join(lines) + "\n"


def _points(frames: Sequence[Frame]) -> str:
    """Return ``points3D.txt``."""
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    for number, (point, (red, green, blue)) in enumerate(zip(*_sparse(frames), strict=True), 1):
        lines.append(f"{number} {_numbers(point)} {red} {green} {blue} 0")
    return "\n".join(lines) + "\n"


def _sparse(frames: Sequence[Frame]) -> tuple[np.ndarray, np.ndarray]:
    """Return points of all frames in the world, (N, 3), and their colours, (N, 3) uint8, on a grid of pixels."""
    points, colours = [], []
    for frame in frames:
        camera, depth = frame.camera, frame.read_depth()
        step = max(1, int(np.ceil(np.sqrt(depth.size * len(frames) / _POINTS))))
        rows, columns = (each.ravel() for each in np.mgrid[0 : camera.height : step, 0 : camera.width : step])
        z = depth[rows, columns].astype(np.float64)
        rays = np.stack(((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(z))), axis=1)
        pose, known = _matrix(frame), np.isfinite(z)
        points.append((rays * z[:, None])[known] @ pose[:3, :3].T + pose[:3, 3])
        colours.append(frame.read_colour()[rows, columns][known])
    return np.concatenate(points), np.concatenate(colours)


def _matrix(frame: Frame) -> np.ndarray:
    """Return the pose of a frame that has one, (4, 4)."""
    return np.eye(4) if frame.pose is None else frame.pose.numpy()


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers between blanks."""
    return " ".join(f"{value:.9g}" for value in values)


def write_rerun(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write a recording ``.rrd``: for each frame the entities ``camera``, ``camera/rgb`` and ``camera/depth``.

    They are on the timeline ``frame``, by number, and on ``time`` if all frames have one.

    Args:
        frames: one at least; those without a pose stand at the origin.

    Returns:
        The file.

    Raises:
        ValueError: the library is not installed.

    """
    with refusing(f"rerun: expected the library rerun-sdk; {how_to_install('rerun')}", ImportError):
        rerun = importlib.import_module("rerun")
    recording = rerun.RecordingStream("dsr")
    with replacing(path) as temporary:
        recording.save(str(temporary))
        recording.log("/", getattr(rerun.ViewCoordinates, _AXES[common_up(frames)]), static=True)
        timed = all(frame.time is not None for frame in frames)
        for number, frame in enumerate(frames):
            camera = frame.camera
            recording.set_time(_TIMELINE, sequence=number)
            if timed and frame.time is not None:
                kind = "timestamp" if frame.time >= _EPOCH else "duration"
                recording.set_time(_CLOCK, **{kind: frame.time})
            pose = np.eye(4) if frame.pose is None else frame.pose.numpy()
            recording.log("camera", rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            matrix = [[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]]
            size = [camera.width, camera.height]
            view = rerun.Pinhole(image_from_camera=matrix, resolution=size, camera_xyz=rerun.ViewCoordinates.RDF)
            recording.log("camera", view)
            photo = to_jpeg(frame.read_colour(), max(size), _QUALITY)
            recording.log("camera/rgb", rerun.EncodedImage(contents=photo, media_type="image/jpeg"))
            depth = encode_png(to_millimetres(frame.read_depth())[0])
            image = rerun.EncodedDepthImage(depth, media_type="image/png", meter=float(MILLIMETRES))
            recording.log("camera/depth", image)
        recording.flush()
        recording.disconnect()
    return [path]
