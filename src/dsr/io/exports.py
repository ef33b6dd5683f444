"""What is written beside an upsampled depth map: renderings, the normal map, a coloured cloud and mesh."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.mesh import LARGEST_STEP, Mesh, triangulate, vertex_normals
from dsr.geometry.shading import render
from dsr.geometry.simplification import QUADRIC, project, select_points, simplify, thin
from dsr.geometry.surface import depth_to_normals
from dsr.io.model_files import write_glb, write_ply
from dsr.io.photos import write_png
from dsr.utils.limits import MOST_FACES, MOST_POINTS

_STRIP = 1 << 20
"""Pixels whose normals are held in memory at a time."""


class Written(NamedTuple):
    """How much of a surface was written.

    ``before`` and ``after``: triangles of the mesh, or points of the cloud, at full density and as written; ``how``:
    what made them fewer, empty if nothing did.
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
        write_png(path, picture, known)
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
    write_png(path, picture, known)


def write_cloud(path: Path, rgb: Tensor, depth: Tensor, camera: Camera, *, most: int = MOST_POINTS) -> Written:
    """Write the known pixels as a coloured PLY cloud with normals, in metres; x right, y down, z forward.

    Args:
        path: a PLY.
        rgb: (3, H, W) in [0, 1].
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.
        most: points; of more, those in rows and columns at equal distances are taken.

    Returns:
        The numbers of points.

    """
    mesh = triangulate(depth, camera, isolated=True)
    chosen, normals = select_points(mesh, most, camera), vertex_normals(mesh)
    write_ply(path, mesh.vertices[chosen], normals[chosen], _colours(rgb, mesh.pixels[chosen]))
    fewer = len(chosen) < len(mesh.vertices)
    return Written(len(mesh.vertices), len(chosen), "leaving out rows and columns" if fewer else "")


def write_mesh(
    paths: Path | Sequence[Path],
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    *,
    largest_step: float = LARGEST_STEP,
    most: int = MOST_FACES,
) -> Written:
    """Write the surface as a mesh with the photo's colours, cut at depth steps.

    A PLY file is in the camera frame (x right, y down, z forward) and has a colour at each vertex, a GLB file in glTF's
    frame (x right, y up, z towards the viewer) with the photo as its texture, both in metres.

    Args:
        paths: one or several files, each ``.ply`` or ``.glb``.
        rgb: (3, H, W) in [0, 1].
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.
        largest_step: see :func:`dsr.geometry.mesh.triangulate`.
        most: triangles; a larger mesh is simplified, see :mod:`dsr.geometry.simplification`.

    Returns:
        The numbers of triangles.

    Raises:
        ValueError: a suffix is another, or no two neighbours are known, so that there is nothing to write.

    """
    paths = [paths] if isinstance(paths, Path) else list(paths)
    for path in paths:  # before anything is written
        if path.suffix.lower() not in (".ply", ".glb"):
            raise ValueError(f"{path}: expected a mesh file, .ply or .glb, got {path.suffix or 'no suffix'}")
    mesh = triangulate(depth, camera, largest_step=largest_step)
    if not len(mesh.faces):
        raise ValueError(f"{paths[0]}: expected neighbours of known depth to make a surface of, got none")
    before, how = len(mesh.faces), ""
    if before > most:
        mesh, how = _reduce(mesh, depth, camera, most, largest_step)
    normals = vertex_normals(mesh)
    for path in paths:
        if path.suffix.lower() == ".ply":
            write_ply(path, mesh.vertices, normals, _colours(rgb, mesh.pixels), mesh.faces)
        else:
            places = project(mesh.vertices, camera)
            write_glb(path, mesh.vertices, normals, mesh.faces, places, _bytes(rgb).transpose(1, 2, 0).copy())
    return Written(before, len(mesh.faces), how)


def _reduce(mesh: Mesh, depth: Tensor, camera: Camera, most: int, largest_step: float) -> tuple[Mesh, str]:
    """Return a mesh of fewer triangles, and what made them fewer."""
    try:
        return simplify(mesh, most, camera), QUADRIC
    except ImportError:
        thinned, stride = thin(depth, camera, most, largest_step)
        return thinned, f"a stride of {stride} pixels; `pip install dsr[mesh]` simplifies and keeps more detail"


def _colours(rgb: Tensor, pixels: np.ndarray) -> np.ndarray:
    """Return the photo's colours at some pixels, (N, 3) uint8; ``pixels`` are indices of the flattened map."""
    return _bytes(rgb.flatten(1)[:, torch.from_numpy(pixels)]).T


def _bytes(values: Tensor) -> np.ndarray:
    """Return values in [0, 1] as uint8; NaN becomes 0."""
    return (values.nan_to_num(0) * 255).round().clamp(0, 255).byte().cpu().numpy()
