"""Frames as other programs read them: Open3D, nerfstudio's ``transforms.json``, 3D Gaussian Splatting, and rerun.

dsr's cameras have x right, y down, z forward, and pixel centres at integers, as Open3D's have; the others count the
principal point from the corner of the image, half a pixel more.
"""

import importlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.io.exports import as_bytes, world_comment, write_normals, write_ply
from dsr.io.photos import encode_png, to_jpeg, write_png
from dsr.io.posed_frames import Frame, colmap_model, initial_gaussians, sample_points
from dsr.notes import Assumption
from dsr.utils.files import replacing, write_text

_Value = TypeVar("_Value")
NORMALS = "normals_from_pretrain"  # a folder that dn-splatter looks for
RGBD = ("color.png", "depth.png", "intrinsic.json")
_MILLIMETRES, _STEPS = 1000, 65535  # of a metre, and of 16 bits


def _common(values: Sequence[_Value]) -> _Value | None:
    """Return what all frames have, or None if they differ."""
    return values[0] if len(set(values)) == 1 else None


def to_millimetres(depth: np.ndarray) -> tuple[np.ndarray, int]:
    """Return depth in metres as millimetres, (H, W) uint16, 0 in holes and beyond 65.535 m, and how many are beyond."""
    values = np.rint(depth.astype(np.float64) * _MILLIMETRES)
    fits = (values > 0) & (values <= _STEPS)
    return np.where(fits, values, 0).astype(np.uint16), int((values > _STEPS).sum())


def _write_pictures(
    folder: Path, kinds: tuple[str, str], frame: Frame, values: np.ndarray, known: np.ndarray | None = None
) -> list[Path]:
    """Write a frame's photo, values of its depth, (H, W) uint16, and a mask if some are ``known``; return the files."""
    photo, depth, mask = (folder / kind / f"{frame.stem}.png" for kind in (*kinds, "masks"))
    with replacing(photo) as temporary:
        shutil.copyfile(frame.colour, temporary)
    write_png(depth, values)
    if known is None:
        return [photo, depth]
    write_png(mask, np.where(known, 255, 0).astype(np.uint8))
    return [photo, depth, mask]


def _have_holes(frames: Sequence[Frame]) -> bool:
    """Return whether a frame has holes; programs expect a mask of each frame or of none."""
    return any(bool(np.isnan(frame.read_depth()).any()) for frame in frames)


def write_rgbd(folder: Path, rgb: Tensor, depth: Tensor, camera: Camera) -> list[Assumption]:
    """Write ``color.png``, ``depth.png`` and ``intrinsic.json``; note pixels that are too far for 16 bits."""
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
    matrix = [camera.fx, 0.0, 0.0, 0.0, camera.fy, 0.0, camera.cx, camera.cy, 1.0]
    entries = {"width": camera.width, "height": camera.height, "intrinsic_matrix": matrix}
    write_text(path, json.dumps(entries, indent=2) + "\n")


def write_transforms(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write ``transforms.json``, ``nerfstudio/`` with photos, depth, masks and points, and ``normals_from_pretrain/``.

    Its cameras have the axes of OpenGL, x right, y up, z backwards. The world stays as it is, so ``applied_transform``
    is the identity: nerfstudio turns it upright itself, and its versions differ in whether the points of
    ``ply_file_path`` are meant before or after that transform (nerfstudio/data/dataparsers/nerfstudio_dataparser.py).
    Names of files differ, as it finds reduced pictures by the name alone. It takes the unit of depth from its options,
    millimetres by default; ``depth_unit_scale_factor`` states it for other readers. dn-splatter finds normals by their
    folder, in the colours of :func:`dsr.io.exports.write_normals` (dn_splatter/data/dn_dataset.py, ``omnidata``).
    """
    camera, folder = _common([frame.camera for frame in frames]), path.parent / "nerfstudio"
    points, (sampled, _) = folder / "points.ply", sample_points(frames)
    up = world_comment(_common([frame.up for frame in frames]) or "")
    write_ply(points, sampled.places, sampled.colours, frame=up)
    masked, files, entries = _have_holes(frames), list[Path](), list[dict[str, Any]]()
    for frame in frames:
        depth, keys = frame.read_depth(), ("file_path", "depth_file_path", "mask_path")
        known = ~np.isnan(depth) if masked else None
        own = _write_pictures(folder, ("images", "depths"), frame, to_millimetres(depth)[0], known)
        normals = path.parent / NORMALS / own[0].name
        write_normals(normals, torch.from_numpy(depth)[None], frame.camera)
        named = {**dict(zip(keys, own, strict=False)), "normal_file_path": normals}
        entry = {key: each.relative_to(path.parent).as_posix() for key, each in named.items()}
        pose = (frame.matrix * [1, -1, -1, 1]).tolist()
        lens = {} if camera is not None else _intrinsics(frame.camera)
        entries.append({**entry, **lens, "transform_matrix": pose})
        files += named.values()
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
    """Write ``images/``, ``depths/``, ``masks/``, ``sparse/0/`` and ``gaussians.ply`` for graphdeco's ``train.py``.

    With ``-d depths`` it divides the 16-bit values of ``depths/NAME.png`` by 65536, multiplies them by the ``scale`` of
    NAME in ``sparse/0/depth_params.json`` and compares them with the rendered inverse depth
    (https://github.com/graphdeco-inria/gaussian-splatting, "Depth regularization"). All frames have one scale, as a
    frame whose scale is far from the others' is left out. It masks no depth; hierarchical-3d-gaussians of the same
    authors does, with ``--alpha_masks masks`` (its scene/cameras.py). The scene is COLMAP's binary model, which both
    look for first; a single frame without a pose has none.
    """
    nearest = min(float(np.fmin.reduce(frame.read_depth(), axis=None, initial=np.inf)) for frame in frames)
    if not np.isfinite(nearest):
        raise ValueError("gaussian: expected some depth, got holes alone")
    scale = 65536 / _STEPS / nearest
    masked, files = _have_holes(frames), list[Path]()
    for frame in frames:
        depth = frame.read_depth()
        inverse = np.rint(65536 / (scale * depth.astype(np.float64)))
        values = np.nan_to_num(inverse, nan=0, posinf=0).astype(np.uint16)
        files += _write_pictures(folder, ("images", "depths"), frame, values, ~np.isnan(depth) if masked else None)
    parameters = {frame.stem: {"scale": scale, "offset": 0.0} for frame in frames}
    (points, observed), sparse = sample_points(frames), folder / "sparse" / "0"
    contents = {
        sparse / "depth_params.json": (json.dumps(parameters, indent=2) + "\n").encode(),
        folder / "gaussians.ply": initial_gaussians(points),
    }
    if all(frame.pose is not None for frame in frames):
        contents |= {sparse / name: content for name, content in colmap_model(frames, points, observed).items()}
    for file, content in contents.items():
        with replacing(file) as temporary:
            temporary.write_bytes(content)
    return [*files, *contents]


def write_rerun(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write a recording ``.rrd``: for each frame the entities ``camera``, ``camera/rgb`` and ``camera/depth``.

    They are on the timeline ``frame``, by number, and on ``time`` if all frames have one. Cameras have the axes RDF;
    the world's are known as far as it is known which one points up. The library is the extra ``rerun``.
    """
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
