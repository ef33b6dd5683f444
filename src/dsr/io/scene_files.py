"""Frames as other programs read them: Open3D, nerfstudio's ``transforms.json``, 3D Gaussian Splatting, and rerun.

dsr's cameras have x right, y down, z forward, and pixel centres at integers, as Open3D's have; the others count the
principal point from the corner of the image, half a pixel more.
"""

import importlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.poses import quaternion_of
from dsr.io.depth_files import read_depth_file
from dsr.io.exports import as_bytes, world_comment, write_ply
from dsr.io.images import read_pixels
from dsr.io.photos import encode_png, to_jpeg, write_png
from dsr.io.trajectories import check_pose
from dsr.notes import Assumption
from dsr.utils.files import replacing, write_text
from dsr.utils.guards import pixels_beside, refusing
from dsr.utils.versions import how_to_install

_Value = TypeVar("_Value")
RGBD = ("color.png", "depth.png", "intrinsic.json")
_MILLIMETRES, _STEPS = 1000, 65535  # of a metre, and of 16 bits
_POINTS = 100_000  # of all frames together, from which an optimisation starts


@dataclass(frozen=True)
class Frame:
    """A photo and a depth map of one size."""

    name: str  # perhaps with folders: kitchen/000012
    camera: Camera
    pose: Tensor | None  # (4, 4) float64 camera to world in metres; None if it is not known
    colour: Path  # an 8-bit PNG
    depth: Path  # a file of (H, W) orthogonal depth in metres, NaN in holes
    up: str = ""  # the axis of the world that points up, one of dsr.io.frames.UPS
    time: float | None = None  # in seconds

    @property
    def stem(self) -> str:
        """The name as that of a file."""
        return self.name.replace("/", "_")

    @property
    def matrix(self) -> np.ndarray:
        """The pose, (4, 4); a frame without one stands at the origin."""
        return np.eye(4) if self.pose is None else self.pose.numpy()

    def read_depth(self) -> np.ndarray:
        """Return the depth, (H, W) float32 in metres, NaN in holes."""
        values = read_depth_file(self.depth, pixels_beside(self.camera.height, self.camera.width))
        if values.shape != (self.camera.height, self.camera.width):
            size = f"{self.camera.height} x {self.camera.width}"
            raise ValueError(f"{self.depth}: expected depth of {size} pixels (height x width), got {values.shape}")
        return values.astype(np.float32)

    def read_colour(self) -> np.ndarray:
        """Return the photo, (H, W, 3) uint8, red first."""
        most = pixels_beside(self.camera.height, self.camera.width)
        return read_pixels(self.colour, cv2.IMREAD_COLOR, most)[..., ::-1]


def parse_pose(where: str, value: object) -> Tensor | None:
    """Return a camera-to-world transform, (4, 4) float64, that JSON holds as a list of lists; None for none."""
    if value is None:
        return None
    with refusing(f"{where}: expected a rigid transform of 4 x 4 numbers, got {value}", TypeError, ValueError):
        return torch.from_numpy(check_pose(where, np.array(value, dtype=np.float64)))


def _common(values: Sequence[_Value]) -> _Value | None:
    """Return what all frames have, or None if they differ."""
    return values[0] if len(set(values)) == 1 else None


def to_millimetres(depth: np.ndarray) -> tuple[np.ndarray, int]:
    """Return depth in metres as whole millimetres, (H, W) uint16 with 0 in holes, and how many pixels are too far.

    Depth of 65.535 m and more does not fit, and becomes a hole.
    """
    values = np.rint(depth.astype(np.float64) * _MILLIMETRES)
    fits = (values > 0) & (values <= _STEPS)
    return np.where(fits, values, 0).astype(np.uint16), int((values > _STEPS).sum())


def expect_poses(part: str, known: Mapping[str, bool]) -> None:
    """Refuse frames, by name with whether they have a pose, of which one has none; a single one needs none."""
    missing = [name for name, has in known.items() if not has]
    if missing and len(known) > 1:
        raise ValueError(
            f"{part}: expected a pose of each frame, got none for {len(missing)} of {len(known)}, such as "
            f"{missing[0]}; --poses gives them"
        )


def _write_pictures(folder: Path, kinds: tuple[str, str], frame: Frame, values: np.ndarray) -> list[Path]:
    """Write the photo and values of the depth, (H, W) uint16, of a frame into two folders, and return the files."""
    photo, depth = (folder / kind / f"{frame.stem}.png" for kind in kinds)
    with replacing(photo) as temporary:
        shutil.copyfile(frame.colour, temporary)
    write_png(depth, values)
    return [photo, depth]


def write_rgbd(folder: Path, rgb: Tensor, depth: Tensor, camera: Camera) -> list[Assumption]:
    """Write ``color.png``, ``depth.png`` and ``intrinsic.json`` of one frame; note pixels that are too far for 16 bits.

    ``rgb``: (3, H, W) in [0, 1]. ``depth``: (1, H, W) in metres, NaN in holes.
    """
    millimetres, lost = to_millimetres(depth[0].cpu().numpy())
    write_png(folder / RGBD[0], np.ascontiguousarray(as_bytes(rgb).transpose(1, 2, 0)[..., ::-1]))
    write_png(folder / RGBD[1], millimetres)
    _write_intrinsics(folder / RGBD[2], camera)
    if not lost:
        return []
    return [Assumption(f"{folder.name}/{RGBD[1]}: what is beyond 65.5 m is written as a hole", f"{lost} pixels")]


def write_open3d(folder: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write a folder as Open3D expects it, with a PNG for each frame in ``color/`` and ``depth/``.

    ``intrinsic.json`` is the camera, or ``intrinsics/`` that of each frame if they differ. ``trajectory.log`` has the
    poses, if all frames have one.
    """
    files, rows = list[Path](), list[str]()
    for number, frame in enumerate(frames):
        files += _write_pictures(folder, ("color", "depth"), frame, to_millimetres(frame.read_depth())[0])
        rows.append(f"{number} {number} {number + 1}\n")
        rows += (" ".join(f"{value:.12g}" for value in row) + "\n" for row in frame.matrix)
    cameras = {f"intrinsics/{frame.stem}.json": frame.camera for frame in frames}
    if (camera := _common([frame.camera for frame in frames])) is not None:
        cameras = {RGBD[2]: camera}
    for name, each in cameras.items():
        files.append(folder / name)
        _write_intrinsics(files[-1], each)
    if all(frame.pose is not None for frame in frames):
        files.append(folder / "trajectory.log")
        write_text(files[-1], "".join(rows))
    return files


def _write_intrinsics(path: Path, camera: Camera) -> None:
    """Write Open3D's JSON of a camera."""
    matrix = [camera.fx, 0.0, 0.0, 0.0, camera.fy, 0.0, camera.cx, camera.cy, 1.0]
    entries = {"width": camera.width, "height": camera.height, "intrinsic_matrix": matrix}
    write_text(path, json.dumps(entries, indent=2) + "\n")


def write_transforms(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write ``transforms.json``, and beside it ``nerfstudio/`` with ``images/``, ``depths/`` and ``points.ply``.

    Its cameras have the axes of OpenGL, x right, y up, z backwards. The world stays as it is, so ``applied_transform``
    is the identity: nerfstudio turns it upright itself, and its versions differ in whether the points of
    ``ply_file_path`` are meant before or after that transform (nerfstudio/data/dataparsers/nerfstudio_dataparser.py).
    Names of files differ, as it finds reduced pictures by the name alone. It takes the unit of depth from its options,
    millimetres by default; ``depth_unit_scale_factor`` states it for other readers.
    """
    expect_poses("nerfstudio", {frame.name: frame.pose is not None for frame in frames})
    camera, folder = _common([frame.camera for frame in frames]), path.parent / "nerfstudio"
    points = folder / "points.ply"
    write_ply(points, *_sparse(frames), frame=world_comment(_common([frame.up for frame in frames]) or ""))
    files, entries = list[Path](), list[dict[str, Any]]()
    for frame in frames:
        pictures = _write_pictures(folder, ("images", "depths"), frame, to_millimetres(frame.read_depth())[0])
        photo, depth = (each.relative_to(path.parent).as_posix() for each in pictures)
        own = {} if camera is not None else _intrinsics(frame.camera)
        pose = (frame.matrix * [1, -1, -1, 1]).tolist()
        entries.append({"file_path": photo, "depth_file_path": depth, **own, "transform_matrix": pose})
        files += pictures
    content = {
        "camera_model": "OPENCV",
        **({} if camera is None else _intrinsics(camera)),
        "depth_unit_scale_factor": 1 / _MILLIMETRES,
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": points.relative_to(path.parent).as_posix(),
        "frames": entries,
    }
    write_text(path, json.dumps(content, indent=2) + "\n")
    return [path, *files, points]


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
    """Write ``images/``, ``depths/`` and ``sparse/0/`` of a scene for graphdeco's ``train.py -d depths``.

    It divides the 16-bit values of ``depths/NAME.png`` by 65536, multiplies them by the ``scale`` of NAME in
    ``sparse/0/depth_params.json`` and compares them with the rendered inverse depth
    (https://github.com/graphdeco-inria/gaussian-splatting, "Depth regularization"). All frames have one scale, as a
    frame whose scale is far from the others' is left out. The scene is COLMAP's text model
    (https://colmap.github.io/format.html); a single frame without a pose has none.
    """
    expect_poses("gaussian", {frame.name: frame.pose is not None for frame in frames})
    nearest = min(float(np.fmin.reduce(frame.read_depth(), axis=None, initial=np.inf)) for frame in frames)
    if not np.isfinite(nearest):
        raise ValueError("gaussian: expected some depth, got holes alone")
    scale = 65536 / _STEPS / nearest
    files = list[Path]()
    for frame in frames:
        inverse = np.rint(65536 / (scale * frame.read_depth().astype(np.float64)))
        values = np.nan_to_num(inverse, nan=0, posinf=0).astype(np.uint16)
        files += _write_pictures(folder, ("images", "depths"), frame, values)
    parameters = {frame.stem: {"scale": scale, "offset": 0.0} for frame in frames}
    texts = {"depth_params.json": json.dumps(parameters, indent=2) + "\n"}
    if all(frame.pose is not None for frame in frames):
        texts |= _colmap_model(frames)
    for name, text in texts.items():
        files.append(folder / "sparse" / "0" / name)
        write_text(files[-1], text)
    return files


def _colmap_model(frames: Sequence[Frame]) -> dict[str, str]:
    """Return the files of COLMAP's text model: a camera and an image for each frame, and points."""
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"]
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    for number, frame in enumerate(frames, 1):
        camera, to_camera = frame.camera, frame.matrix[:3, :3].T
        values = camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5
        cameras.append(f"{number} PINHOLE {camera.width} {camera.height} {_numbers(values)}")
        transform = *quaternion_of(to_camera)[[3, 0, 1, 2]], *(-to_camera @ frame.matrix[:3, 3])
        images += [f"{number} {_numbers(transform)} {number} {frame.stem}.png", ""]  # an empty line: points it sees
    for number, (point, (red, green, blue)) in enumerate(zip(*_sparse(frames), strict=True), 1):
        points.append(f"{number} {_numbers(point)} {red} {green} {blue} 0")
    lines = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {name: "\n".join(each) + "\n" for name, each in lines.items()}


def _sparse(frames: Sequence[Frame]) -> tuple[np.ndarray, np.ndarray]:
    """Return points of all frames in the world, (N, 3), and their colours, (N, 3) uint8, on a grid of pixels."""
    points, colours = [], []
    for frame in frames:
        camera, depth = frame.camera, frame.read_depth()
        step = max(1, int(np.ceil(np.sqrt(depth.size * len(frames) / _POINTS))))
        rows, columns = (each.ravel() for each in np.mgrid[0 : camera.height : step, 0 : camera.width : step])
        z = depth[rows, columns].astype(np.float64)
        rays = np.stack(((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(z))), axis=1)
        pose, known = frame.matrix, np.isfinite(z)
        points.append((rays * z[:, None])[known] @ pose[:3, :3].T + pose[:3, 3])
        colours.append(frame.read_colour()[rows, columns][known])
    return np.concatenate(points), np.concatenate(colours)


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers between blanks."""
    return " ".join(f"{value:.9g}" for value in values)


def write_rerun(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write a recording ``.rrd``: for each frame the entities ``camera``, ``camera/rgb`` and ``camera/depth``.

    They are on the timeline ``frame``, by number, and on ``time`` if all frames have one. Cameras have the axes RDF;
    the world's are known as far as it is known which one points up. The library is the extra ``rerun``.
    """
    with refusing(f"rerun: expected the library rerun-sdk; {how_to_install('rerun')}", ImportError):
        rerun = importlib.import_module("rerun")
    recording = rerun.RecordingStream("dsr")
    with replacing(path) as temporary:
        recording.save(str(temporary))
        axes = {"": "RDF", "y": "RUB", "z": "RFU"}[_common([frame.up for frame in frames]) or ""]
        recording.log("/", getattr(rerun.ViewCoordinates, axes), static=True)
        timed = all(frame.time is not None for frame in frames)
        for number, frame in enumerate(frames):
            camera = frame.camera
            recording.set_time("frame", sequence=number)
            if timed and frame.time is not None:
                kind = "timestamp" if frame.time >= 1e9 else "duration"  # seconds since 1970, or since a device's start
                recording.set_time("time", **{kind: frame.time})
            pose = frame.matrix
            recording.log("camera", rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            matrix = [[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]]
            size = [camera.width, camera.height]
            view = rerun.Pinhole(image_from_camera=matrix, resolution=size, camera_xyz=rerun.ViewCoordinates.RDF)
            recording.log("camera", view)
            photo = to_jpeg(frame.read_colour(), max(size), 95)
            recording.log("camera/rgb", rerun.EncodedImage(contents=photo, media_type="image/jpeg"))
            depth = encode_png(to_millimetres(frame.read_depth())[0])
            image = rerun.EncodedDepthImage(depth, media_type="image/png", meter=float(_MILLIMETRES))
            recording.log("camera/depth", image)
        recording.flush()
        recording.disconnect()
    return [path]
