"""What is written beside an upsampled depth map: renderings, normals, a cloud and a mesh, and the input.

A PLY file has points in the camera frame: x right, y down, z forward. glTF has y up and +z towards the viewer (Khronos,
glTF 2.0 specification, section 3.4). The input, a copy of the depth map as it was read and of the photo, lets a result
be looked at anywhere: its unit, holes and registration are not in the user's file alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.mesh import (
    QUADRIC,
    project,
    select_points,
    simplify,
    thin,
    triangulate,
    vertex_normals,
)
from dsr.geometry.surface import depth_to_normals, render
from dsr.io.glb import write_glb
from dsr.io.photos import to_jpeg, write_png
from dsr.sample import expect_distances
from dsr.utils.arrays import read_arrays
from dsr.utils.decoding import decode_pixels
from dsr.utils.files import replacing
from dsr.utils.guards import MOST_FACES, MOST_POINTS
from dsr.utils.versions import how_to_install

FLAT = "large triangles where the surface is flat"  # which makes a mesh smaller without a limit
CAMERA_FRAME = "camera frame: x right, y down, z forward; metres"
INPUT = "input.npz"
LONGEST = 2048  # pixels of the longer side of the stored photo
_STRIP = 1 << 20  # pixels whose normals are held in memory at a time


def world_comment(up: str) -> str:
    """Return a PLY file's comment on its frame, the world with the axis ``up``, see :data:`dsr.io.frames.UPS`."""
    return f"world frame of the poses{f': {up} up' if up else ''}; metres"


def write_ply(
    path: Path,
    points: np.ndarray,
    colours: np.ndarray,
    normals: np.ndarray | None = None,
    faces: np.ndarray | None = None,
    *,
    filled: np.ndarray | None = None,
    frame: str = CAMERA_FRAME,
) -> None:
    """Write a binary PLY file of points (N, 3), their colours (N, 3) uint8 and normals (N, 3), and faces (M, 3).

    ``filled``, (N,) bool, whether points were not measured, is a property of that name; ``frame`` is a comment.
    """
    import trimesh  # noqa: PLC0415 - half a second that most results save
    from trimesh.exchange.ply import export_ply  # noqa: PLC0415

    corners = np.empty((0, 3), int) if faces is None else faces
    model = trimesh.Trimesh(
        points, corners, vertex_normals=normals, vertex_colors=colours, process=False,
        vertex_attributes=None if filled is None else {"filled": filled.astype(np.uint8)},
    )  # fmt: skip
    content = export_ply(model, vertex_normal=normals is not None)
    header, mark, content = content.partition(b"element vertex")
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.writelines((header, f"comment {frame}\n".encode(), mark, content))


class Written(NamedTuple):
    """How much of a surface was written.

    ``before`` and ``after``: triangles of the mesh, or points of the cloud, at full density and as written; ``how``:
    what made them fewer, empty if nothing did; see :data:`FLAT`.
    """

    before: int
    after: int
    how: str = ""

    def __str__(self) -> str:
        return f"{self.after} of {self.before}, by {self.how}"


def normal_strips(depth: Tensor, camera: Camera) -> Iterator[tuple[slice, Tensor]]:
    """Yield the rows of one strip after another, and its normals, (3, rows, W) float32, NaN where unknown.

    The strips together are what :func:`dsr.geometry.surface.depth_to_normals` gives for the whole map, (1, H, W).
    """
    height, width = camera.height, camera.width
    rows = max(1, _STRIP // width)
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        first, last = max(0, min(start, height - 2)), min(stop + 1, height)
        part = depth[None, :, first:last].double()
        normals = depth_to_normals(part, camera.crop(first, 0, last - first, width).rays()[None], torch.float32)[0]
        yield slice(start, stop), normals[:, start - first : stop - first]


def write_renderings(folder: Path, depth: Tensor, camera: Camera) -> list[Path]:
    """Write the renderings of a map, (1, H, W), as ``e1.png`` to ``e4.png``, 8 bits of grey, holes transparent."""
    shades = np.zeros((len(LIGHT_NAMES), camera.height, camera.width), np.uint8)
    known = np.zeros(shades.shape[1:], bool)
    for rows, normals in normal_strips(depth, camera):
        known[rows] = normals[0].isfinite().numpy()
        shades[:, rows] = _bytes(render(normals[None])[0])
    paths = [folder / f"{name}.png" for name in LIGHT_NAMES]
    for path, picture in zip(paths, shades, strict=True):
        write_png(path, picture, known)
    return paths


def write_normals(path: Path, depth: Tensor, camera: Camera) -> None:
    """Write the normals as an 8-bit colour picture, holes transparent.

    Red is x to the right, green is y up, blue is towards the viewer, each from -1 at 0 to 1 at 255: a wall that faces
    the camera is (128, 128, 255), as in the normal maps of modelling programs.
    """
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    known = np.zeros(picture.shape[:2], bool)
    signs = torch.tensor([-1, -1, 1])[:, None, None]  # blue, green, red is -z, -y, x
    for rows, normals in normal_strips(depth, camera):
        known[rows] = normals[0].isfinite().numpy()
        picture[rows] = _bytes((1 + signs * normals.flip(0)) / 2).transpose(1, 2, 0)
    write_png(path, picture, known)


def write_mask(path: Path, mask: Tensor) -> None:
    """Write a mask, (1, H, W) bool, as an 8-bit picture: 255 where it holds, else 0."""
    write_png(path, 255 * mask[0].byte().cpu().numpy())


def write_cloud(
    path: Path, rgb: Tensor, depth: Tensor, camera: Camera, *, most: int = MOST_POINTS, filled: Tensor | None = None
) -> Written:
    """Write the known pixels as a coloured PLY cloud with normals, in metres; x right, y down, z forward.

    Of more than ``most`` points, those in rows and columns at equal distances are taken. ``filled``, (1, H, W) bool,
    depth that was not measured, is a property of the points.
    """
    mesh = triangulate(depth, camera, isolated=True)
    chosen, normals = select_points(mesh, most, camera), vertex_normals(mesh)
    pixels = mesh.pixels[chosen]
    write_ply(path, mesh.vertices[chosen], _colours(rgb, pixels), normals[chosen], filled=_at(filled, pixels))
    fewer = len(chosen) < len(mesh.vertices)
    return Written(len(mesh.vertices), len(chosen), "leaving out rows and columns" if fewer else "")


def write_mesh(
    paths: Path | Sequence[Path],
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    *,
    most: int = MOST_FACES,
    tolerance: Tensor | None = None,
    filled: Tensor | None = None,
) -> Written:
    """Write the surface as a mesh with the photo's colours, cut at depth steps.

    A PLY file is in the camera frame (x right, y down, z forward) and has a colour at each vertex, a GLB file in glTF's
    frame (x right, y up, z towards the viewer) with the photo as its texture, both in metres.

    Args:
        paths: one or several files, each ``.ply`` or ``.glb``.
        rgb: (3, H, W) in [0, 1].
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.
        most: triangles; a larger mesh is simplified, see :mod:`dsr.geometry.mesh`.
        tolerance: see :func:`dsr.geometry.mesh.triangulate`.
        filled: (1, H, W) bool, where depth was not measured; a GLB file has it as the attribute ``_FILLED``.

    """
    paths = [paths] if isinstance(paths, Path) else list(paths)
    for path in paths:  # before anything is written
        if path.suffix.lower() not in (".ply", ".glb"):
            raise ValueError(f"{path}: expected a mesh file, .ply or .glb, got {path.suffix or 'no suffix'}")
    mesh = triangulate(depth, camera, tolerance=tolerance)
    if not len(mesh.faces):
        raise ValueError(f"{paths[0]}: expected neighbours of known depth to make a surface of, got none")
    before, how = mesh.dense, FLAT if len(mesh.faces) < mesh.dense else ""
    if len(mesh.faces) > most:
        try:
            mesh, how = simplify(mesh, most, camera), QUADRIC
        except ImportError:
            mesh, stride = thin(depth, camera, most)
            how = f"a stride of {stride} pixels; {how_to_install('mesh')} simplifies and keeps more detail"
    normals, missing = vertex_normals(mesh), _at(filled, mesh.pixels)
    for path in paths:
        if path.suffix.lower() == ".ply":
            write_ply(path, mesh.vertices, _colours(rgb, mesh.pixels), normals, mesh.faces, filled=missing)
        else:
            places, photo = project(mesh.vertices, camera), _bytes(rgb).transpose(1, 2, 0).copy()
            write_glb(path, mesh.vertices, normals, mesh.faces, places, photo, missing)
    return Written(before, len(mesh.faces), how)


def _at(mask: Tensor | None, pixels: np.ndarray) -> np.ndarray | None:
    """Return a mask's values at some pixels, (N,) bool; ``pixels`` are indices of the flattened map."""
    return None if mask is None else mask.flatten().cpu().numpy()[pixels]


def _colours(rgb: Tensor, pixels: np.ndarray) -> np.ndarray:
    """Return the photo's colours at some pixels, (N, 3) uint8; ``pixels`` are indices of the flattened map."""
    return _bytes(rgb.flatten(1)[:, torch.from_numpy(pixels)]).T


def _bytes(values: Tensor) -> np.ndarray:
    """Return values in [0, 1] as uint8; NaN becomes 0."""
    return (values.nan_to_num(0) * 255).round().clamp(0, 255).byte().cpu().numpy()


def write_input(path: Path, rgb: Tensor, depth_lr: Tensor) -> None:
    """Write the input: ``depth_lr`` (h, w) float32 in metres, NaN in holes, and ``photo``, the bytes of a JPEG."""
    pixels = (255 * rgb).round().clamp(0, 255).byte().permute(1, 2, 0).cpu().numpy()
    photo = np.frombuffer(to_jpeg(pixels, LONGEST, 90), np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, depth_lr=depth_lr[0].float().cpu().numpy(), photo=photo)


def read_input(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the photo, (H, W, 3) uint8, and the depth map, (h, w) float32 in metres, NaN in holes."""
    arrays = read_arrays(path)
    kinds = {name: (str(array.dtype), array.ndim) for name, array in arrays.items()}
    if kinds != {"depth_lr": ("float32", 2), "photo": ("uint8", 1)}:
        raise ValueError(f"{path}: expected depth_lr (h, w) float32 and photo (n,) uint8, got {kinds}")
    depth = arrays["depth_lr"]
    if min(depth.shape) < 2:
        raise ValueError(f"{path}: expected a depth map of 2 x 2 pixels or more, got {depth.shape}")
    expect_distances(str(path), torch.from_numpy(depth[np.isfinite(depth)]))
    photo = decode_pixels(path, arrays["photo"].tobytes(), cv2.IMREAD_COLOR, LONGEST**2)
    if photo is None:
        raise ValueError(f"{path}: expected the bytes of a JPEG as photo, got something else")
    return photo[..., ::-1], np.where(np.isfinite(depth), depth, np.float32(np.nan))
