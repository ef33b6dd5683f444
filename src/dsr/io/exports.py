"""What is written beside an upsampled depth map: renderings, the normal map, a coloured cloud and mesh."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.mesh import LARGEST_STEP, MOST_VERTICES, Mesh, triangulate, vertex_normals
from dsr.geometry.shading import LIGHT_NAMES, render
from dsr.geometry.surface import depth_to_normals
from dsr.io.model_files import write_glb, write_ply
from dsr.utils.files import replacing

_STRIP = 1 << 20
"""Pixels whose normals are held in memory at a time."""


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
    """Write the renderings under the four lights as ``e1.png`` to ``e4.png``, 8 bits of grey, holes transparent.

    Args:
        folder: is made if need be.
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.

    Returns:
        The files.

    Raises:
        ValueError: the map is less than 2 pixels high or wide.

    """
    shades = np.zeros((len(LIGHT_NAMES), camera.height, camera.width), np.uint8)
    known = np.zeros(shades.shape[1:], bool)
    for rows, normals in normal_strips(depth, camera):
        known[rows] = normals[0].isfinite().numpy()
        shades[:, rows] = _bytes(render(normals[None])[0])
    paths = [folder / f"{name}.png" for name in LIGHT_NAMES]
    for path, picture in zip(paths, shades, strict=True):
        _write_png(path, picture, known)
    return paths


def write_normals(path: Path, depth: Tensor, camera: Camera) -> None:
    """Write the normals as an 8-bit colour picture, holes transparent.

    Red is x to the right, green is y up, blue is towards the viewer, each from -1 at 0 to 1 at 255: a wall that faces
    the camera is (128, 128, 255), as in the normal maps of modelling programs.

    Args:
        path: a PNG.
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.

    Raises:
        ValueError: the map is less than 2 pixels high or wide.

    """
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    known = np.zeros(picture.shape[:2], bool)
    signs = torch.tensor([-1, -1, 1])[:, None, None]  # blue, green, red is -z, -y, x
    for rows, normals in normal_strips(depth, camera):
        known[rows] = normals[0].isfinite().numpy()
        picture[rows] = _bytes((1 + signs * normals.flip(0)) / 2).transpose(1, 2, 0)
    _write_png(path, picture, known)


def write_cloud(path: Path, rgb: Tensor, depth: Tensor, camera: Camera, *, most: int = MOST_VERTICES) -> int:
    """Write the known pixels as a coloured PLY cloud with normals, in metres; x right, y down, z forward.

    Args:
        path: a PLY.
        rgb: (3, H, W) in [0, 1].
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.
        most: points; of a larger map every second, third, ... row and column is taken.

    Returns:
        The number of points.

    """
    mesh = triangulate(depth, camera, most=most, isolated=True)
    write_ply(path, mesh.vertices, vertex_normals(mesh), _colours(rgb, mesh))
    return len(mesh.vertices)


def write_mesh(
    paths: Path | Sequence[Path],
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    *,
    largest_step: float = LARGEST_STEP,
    most: int = MOST_VERTICES,
) -> Mesh:
    """Write the surface as a mesh with the photo's colours, cut at depth steps.

    A PLY file is in the camera frame (x right, y down, z forward) and has a colour at each vertex, a GLB file in glTF's
    frame (x right, y up, z towards the viewer) with the photo as its texture, both in metres.

    Args:
        paths: one or several files, each ``.ply`` or ``.glb``.
        rgb: (3, H, W) in [0, 1].
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.
        largest_step: see :func:`dsr.geometry.mesh.triangulate`.
        most: vertices; of a larger map every second, third, ... row and column is taken.

    Returns:
        The mesh.

    Raises:
        ValueError: a suffix is another, or no two neighbours are known, so that there is nothing to write.

    """
    paths = [paths] if isinstance(paths, Path) else list(paths)
    for path in paths:  # before anything is written
        if path.suffix.lower() not in (".ply", ".glb"):
            raise ValueError(f"{path}: expected a mesh file, .ply or .glb, got {path.suffix or 'no suffix'}")
    mesh = triangulate(depth, camera, largest_step=largest_step, most=most)
    if not len(mesh.faces):
        raise ValueError(f"{paths[0]}: expected neighbours of known depth to make a surface of, got none")
    normals = vertex_normals(mesh)
    for path in paths:
        if path.suffix.lower() == ".ply":
            write_ply(path, mesh.vertices, normals, _colours(rgb, mesh), mesh.faces)
        else:
            places = np.stack((mesh.pixels % camera.width, mesh.pixels // camera.width), axis=1)
            write_glb(path, mesh.vertices, normals, mesh.faces, places, _bytes(rgb).transpose(1, 2, 0).copy())
    return mesh


def _colours(rgb: Tensor, mesh: Mesh) -> np.ndarray:
    """Return the photo's colours at the vertices, (N, 3) uint8."""
    return _bytes(rgb.flatten(1)[:, torch.from_numpy(mesh.pixels)]).T


def _bytes(values: Tensor) -> np.ndarray:
    """Return values in [0, 1] as uint8; NaN becomes 0."""
    return (values.nan_to_num(0) * 255).round().clamp(0, 255).byte().cpu().numpy()


def _write_png(path: Path, picture: np.ndarray, known: np.ndarray) -> None:
    """Write a grey (H, W) or blue-green-red (H, W, 3) picture atomically, transparent where not known."""
    if not known.all():
        colours = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
        picture = np.concatenate((colours, np.where(known, 255, 0).astype(np.uint8)[..., None]), axis=2)
    done, content = cv2.imencode(".png", picture)
    if not done:
        raise OSError(f"{path}: the picture of {picture.shape} could not be encoded")
    with replacing(path) as temporary:
        temporary.write_bytes(content.tobytes())
