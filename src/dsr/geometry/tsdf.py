"""One mesh of many depth maps: a truncated signed distance function in blocks of voxels around the surfaces.

Curless and Levoy, *A Volumetric Method for Building Complex Models from Range Images*, SIGGRAPH 1996: the signed
distances of a voxel to the surface of each map, along the map's rays, are averaged with weights, and the surface is
where the average is 0. Only blocks of 8 x 8 x 8 voxels near a surface are stored (Niessner et al. 2013). The triangles
are those of scikit-image's marching cubes (Lewiner et al. 2003).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from dsr.geometry.poses import PosedMap, invert

# largest change of the distance within a cell, in units of the truncation; at a surface it is at most 0.43
_STEEPEST = 0.9
_SIDE = 8  # voxels along a side of a block
_TRUNCATION = 4.0  # distance from the surface, in voxels, beyond which it does not count
MOST_BLOCKS = 120_000  # blocks that are stored, 8 KiB each
# largest extent of the surfaces in blocks of one layer, 2.3 KiB each, whether they are stored or not
_LARGEST_LAYER = 65_536
_AT_ONCE = 2048  # blocks that are updated at a time


class FusedMesh(NamedTuple):
    """A mesh in the world's frame."""

    vertices: np.ndarray  # (N, 3) in metres
    normals: np.ndarray  # (N, 3), outward
    faces: np.ndarray  # (M, 3)


def fuse_maps(maps: Callable[[], Iterable[PosedMap]], voxel: float) -> FusedMesh:
    """Return the surface on which depth maps agree, in voxels of an edge length in metres.

    ``maps`` yields the maps; it is called twice, and one map is held at a time.
    """
    if not 0 < voxel < np.inf:
        raise ValueError(f"voxel: expected a positive number of metres, got {voxel}")
    blocks = _touched_blocks(maps(), voxel)
    layer = math.prod(int(extent) + 1 for extent in np.ptp(blocks[:, :2], axis=0))  # of any size
    excess = max(len(blocks) / MOST_BLOCKS, layer / _LARGEST_LAYER)
    if excess > 1:
        least = f"{voxel * excess**0.5:.2g} m for surfaces as large as these"
        raise ValueError(f"voxel: expected one of at least about {least}, got {voxel:g}")
    distance = np.zeros((len(blocks), _SIDE**3), np.float32)
    weight = np.zeros_like(distance)
    for each in maps():
        for start in range(0, len(blocks), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            _integrate(each, blocks[part], voxel, distance[part], weight[part])
    return _extract(blocks, distance, weight, voxel)


def suggest_voxel(maps: Iterable[PosedMap]) -> float:
    """Return a voxel's edge length: the median width of a pixel on the surfaces, in metres."""
    widths = [float(np.nanmedian(each.depth)) / each.camera.fx for each in maps if np.isfinite(each.depth).any()]
    if not widths:
        raise ValueError("expected depth maps with at least one known pixel, all are holes")
    return float(np.median(widths))


def _touched_blocks(maps: Iterable[PosedMap], voxel: float) -> NDArray[np.int64]:
    """Return the blocks within the truncation distance of a surface, (N, 3) in units of a block, sorted by z."""
    reach, found = _TRUNCATION * voxel, np.empty((0, 3), np.int64)
    corners = np.stack(np.meshgrid((-1, 1), (-1, 1), (-1, 1)), axis=-1).reshape(-1, 3)
    for each in maps:
        points = (each.depth * each.camera.rays().numpy()).reshape(3, -1)
        points = points[:, np.isfinite(points[2])]
        points = (each.pose[:3, :3] @ points + each.pose[:3, 3:]).T  # in the world's frame
        own = [np.floor((points + reach * corner) / (voxel * _SIDE)).astype(np.int64) for corner in corners]
        found = np.unique(np.concatenate((found, *(np.unique(part, axis=0) for part in own))), axis=0)
        if len(found) > 8 * MOST_BLOCKS:
            break  # far too many already
    return found[np.argsort(found[:, 2], kind="stable")]


def _integrate(
    each: PosedMap, blocks: NDArray[np.int64], voxel: float, distance: np.ndarray, weight: np.ndarray
) -> None:
    """Average the distances of voxels to the surface of a map into ``distance``, in units of the truncation."""
    inner = np.stack(np.meshgrid(*(np.arange(_SIDE),) * 3, indexing="ij")).reshape(3, 1, -1)  # z changes fastest
    world = voxel * (_SIDE * blocks.T[:, :, None] + inner).reshape(3, -1).astype(np.float64)
    to_camera = invert(each.pose)
    x, y, z = to_camera[:3, :3] @ world + to_camera[:3, 3:]
    camera = each.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0) & (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    places = np.flatnonzero(inside)
    columns, rows = np.rint(u[places]).astype(np.intp), np.rint(v[places]).astype(np.intp)
    columns, rows = columns.clip(0, camera.width - 1), rows.clip(0, camera.height - 1)
    gap = (each.depth[rows, columns] - z[places]) / (_TRUNCATION * voxel)
    certain = np.ones(len(places)) if each.deviation is None else (voxel / each.deviation[rows, columns]) ** 2
    seen = (gap >= -1) & (certain > 0) & np.isfinite(certain)
    places, gap, certain = places[seen], gap[seen].clip(max=1), certain[seen].clip(max=1e6)
    flat_distance, flat_weight = distance.reshape(-1), weight.reshape(-1)
    total = flat_weight[places] + certain
    flat_distance[places] += (certain / total * (gap - flat_distance[places])).astype(np.float32)
    flat_weight[places] = total


def _extract(blocks: NDArray[np.int64], distance: np.ndarray, weight: np.ndarray, voxel: float) -> FusedMesh:
    """Return the triangles where the distance is 0, one layer of blocks after the other."""
    low = blocks.min(0)
    size = tuple(_SIDE * (blocks.max(0) - low + 1)[:2] + 1)
    vertices, normals, faces, count = [], [], [], 0
    for layer in np.unique(blocks[:, 2]):
        volume = np.full((*size, _SIDE + 1), np.nan, np.float32)  # a layer of voxels more, to join the next layer
        for number in np.flatnonzero((blocks[:, 2] == layer) | (blocks[:, 2] == layer + 1)):
            i, j = _SIDE * (blocks[number] - low)[:2]
            known = np.where(weight[number] > 0, distance[number], np.nan).reshape(_SIDE, _SIDE, _SIDE)
            if blocks[number, 2] == layer:
                volume[i : i + _SIDE, j : j + _SIDE, :_SIDE] = known
            else:
                volume[i : i + _SIDE, j : j + _SIDE, _SIDE:] = known[..., :1]
        found = _march(volume)
        if found is not None:
            places, outward, corners = found
            vertices.append(voxel * (places + _SIDE * np.array([low[0], low[1], layer])))
            normals.append(outward)
            faces.append(corners + count)
            count += len(places)
    if not vertices:
        raise ValueError("expected depth maps that show a surface, got none that voxels of this size can hold")
    every = np.concatenate(vertices)
    keys = np.rint(every / (1e-4 * voxel)).astype(np.int64)  # vertices at the same place are joined
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    joined = place.reshape(-1)[np.concatenate(faces)]
    a, b, c = joined.T
    return FusedMesh(every[first], np.concatenate(normals)[first], joined[(a != b) & (b != c) & (c != a)])


def _march(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return vertices in voxels, normals and faces of a volume, without cells that have an unknown corner.

    Behind the rim of a surface, free space borders on what the surface hides: there the distance jumps, and no triangle
    is made.
    """
    low, high = volume[1:, 1:, 1:].copy(), volume[1:, 1:, 1:].copy()
    for i, j, k in np.ndindex(2, 2, 2):
        corner = volume[i : i + low.shape[0], j : j + low.shape[1], k : k + low.shape[2]]
        np.minimum(low, corner, out=low)  # NaN if a corner is
        np.maximum(high, corner, out=high)
    cells = high - low < _STEEPEST
    known = np.isfinite(volume)
    values = np.where(known, volume, 1.0)
    values[values == 0] = -np.finfo(np.float32).eps  # a surface in a layer of voxels, where no sign would change
    if not cells.any() or not (values.min() < 0 < values.max()):
        return None
    places, faces, normals, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
    middle = np.floor(places[faces].mean(1)).astype(np.intp).clip(max=np.array(cells.shape) - 1)
    faces = faces[cells[tuple(middle.T)]]
    used = np.unique(faces)
    if not len(used):
        return None
    renumbered = np.full(len(places), -1)
    renumbered[used] = np.arange(len(used))
    return places[used].astype(np.float64), -normals[used].astype(np.float64), renumbered[faces[:, ::-1]]
