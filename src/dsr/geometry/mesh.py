"""Triangle meshes of depth maps, cut at depth steps, with fewer triangles beyond a limit; and one mesh of many maps.

Neighbouring pixels lie on different sides of a step if inverse depth, which is linear on a plane, changes by more than
the slopes on both sides predict, over windows of up to five pairs of pixels. With a tolerance, flat parts get large
triangles of a hierarchy (Evans, Kirkpatrick and Townsend, *Right-Triangulated Irregular Networks*, Algorithmica 2001):
a triangle is halved as long as leaving out the middle of its longest side changes the inverse depth there by too much.
Meshes are simplified by quadric edge collapses (Garland and Heckbert, SIGGRAPH 1997) of the library
`fast-simplification` (the extra ``mesh``); without it, rows and columns are left out.
"""

import importlib
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.poses import PosedMap, in_picture, invert

LARGEST_STEP = 0.02  # relative change of a neighbour's depth, beyond what the slopes on both sides predict, that is cut
_HALF_WIDTHS = (1, 2, 3)  # half widths of the windows in pixels
_OWN_FRACTION = 0.25  # fraction of LARGEST_STEP by which a pair within a wider window must itself change to be cut
_LEVELS = 6  # the largest triangles have two sides of 2 to this power pixels
_STRIP = 1 << 21  # pixels whose steps are found, and triangles whose normals are summed, at a time

QUADRIC = "quadric decimation"
FLATNESS = 3e-4  # tolerance of a mesh that looks like the one of all pixels, as a fraction of the depth
ERROR_SHARE = 0.1  # the same as a fraction of the depth's expected error, if that is more

# largest change of the distance within a cell, in units of the truncation; at a surface it is at most 0.43
_STEEPEST = 0.9
_SIDE = 8  # voxels along a side of a block
_TRUNCATION = 4.0  # distance from the surface, in voxels, beyond which it does not count
MOST_BLOCKS = 120_000  # blocks that are stored, 8 KiB each
# largest extent of the surfaces in blocks of one layer, 2.3 KiB each, whether they are stored or not
_LARGEST_LAYER = 65_536
_AT_ONCE = 2048  # blocks that are updated at a time


class Mesh(NamedTuple):
    """Triangles in the camera frame: x right, y down, z forward."""

    vertices: np.ndarray  # (N, 3) float32 in metres
    faces: np.ndarray  # (M, 3) int32 indices of vertices, counterclockwise as the camera sees them
    pixels: np.ndarray  # (N,) int64 index of each vertex in the flattened depth map
    dense: int = 0  # number of triangles if there were two per square of four pixels


def triangulate(
    depth: Tensor,
    camera: Camera,
    *,
    stride: int = 1,
    isolated: bool = False,
    tolerance: Tensor | None = None,
) -> Mesh:
    """Join neighbouring valid pixels by triangles, two per square of four pixels, except across steps in depth.

    The diagonal of a square is the one with the smaller change of depth. Depth is (1, H, W) in metres, NaN in holes.
    ``isolated`` keeps vertices without a triangle. ``tolerance``, (1, H, W), is the largest deviation of most pixels
    from the mesh in metres, so that flat parts get large triangles; None for a mesh of all pixels.
    """
    strided = depth[0, ::stride, ::stride].detach().cpu().double().numpy()
    allowed = None
    if tolerance is not None:
        allowed = tolerance[0, ::stride, ::stride].detach().cpu().double().numpy() / strided**2
    faces, dense = _faces(1 / strided, allowed)
    kept = np.isfinite(strided).ravel() if isolated else np.zeros(strided.size, bool)
    kept[faces.ravel()] = True
    vertex_of = np.cumsum(kept, dtype=np.int32) - 1
    rows, columns = np.divmod(np.flatnonzero(kept), strided.shape[1])
    rows, columns = rows * stride, columns * stride
    z = strided.ravel()[kept]
    vertices = np.stack(((columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z), axis=1)
    return Mesh(vertices.astype(np.float32), vertex_of[faces], rows * camera.width + columns, dense)


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return the unit normals of the vertices, (N, 3) float32: the mean of their triangles', weighted by area."""
    total = np.zeros((len(mesh.vertices), 3))
    for start in range(0, len(mesh.faces), _STRIP):
        faces = mesh.faces[start : start + _STRIP]
        corners = mesh.vertices[faces]  # (M, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        for axis in range(3):
            total[:, axis] += np.bincount(faces.ravel(), np.repeat(normals[:, axis], 3), len(total))
    lengths = np.linalg.norm(total, axis=1, keepdims=True)
    towards = -mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return np.where(lengths > 0, total / np.where(lengths > 0, lengths, 1), towards).astype(np.float32)


def _faces(inverse: np.ndarray, allowed: np.ndarray | None) -> tuple[np.ndarray, int]:
    """Return the triangles of a map of inverse depth, (H, W), as (M, 3) indices, and how many there are of all."""
    height, width = inverse.shape
    across, down = find_connections(inverse), find_connections(inverse.T).T
    top, bottom, left, right = across[:-1], across[1:], down[:, :-1], down[:, 1:]
    falling = np.abs(inverse[:-1, :-1] - inverse[1:, 1:])  # from the upper left pixel to the lower right one
    rising = np.abs(inverse[1:, :-1] - inverse[:-1, 1:])
    first = ~(np.nan_to_num(falling, nan=np.inf) > np.nan_to_num(rising, nan=np.inf))
    index = np.arange(height * width, dtype=np.int32).reshape(height, width)
    upper_left, upper_right = index[:-1, :-1], index[:-1, 1:]
    lower_left, lower_right = index[1:, :-1], index[1:, 1:]
    choices = (
        (first & left & bottom, (upper_left, lower_left, lower_right)),
        (first & top & right, (upper_left, lower_right, upper_right)),
        (~first & left & top, (upper_left, lower_left, upper_right)),
        (~first & bottom & right, (lower_left, lower_right, upper_right)),
    )
    kept, large = np.ones(first.shape, bool), np.empty((0, 3), np.int32)
    if allowed is not None:
        kept, large = _join(inverse, top & bottom & left & right, allowed)
    faces, dense = [], 0
    for where, corners in choices:
        dense += int(np.count_nonzero(where))
        small = where & kept
        faces.append(np.stack([corner[small] for corner in corners], axis=1))
    return np.concatenate((*faces, large)), dense


def _join(inverse: np.ndarray, whole: np.ndarray, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join pixels by triangles of up to 64 x 64 pixels; return the squares that are left for two each, and the others.

    ``whole``, (H - 1, W - 1), are the squares of four pixels that are one surface. Leaving out a pixel may change the
    inverse depth there by ``tolerance``, (H, W), at each halving, NaN for not at all.
    """
    height, width = whole.shape
    side = 1 << _LEVELS
    rows, columns = (-(-size // side) for size in whole.shape)  # of the largest squares
    values, allowed = np.full((2, rows * side + 1, columns * side + 1), np.nan, np.float32)
    values[: height + 1, : width + 1], allowed[: height + 1, : width + 1] = inverse, tolerance
    split = ~np.pad(whole, ((0, rows * side - height), (0, columns * side - width)))
    triangles, small = _leaves(_needed(values, allowed, split), rows, columns)
    pitch = values.shape[1]
    squares = np.minimum.reduce(small // pitch, axis=1) * pitch + np.minimum.reduce(small % pitch, axis=1)
    found = np.bincount(squares, minlength=values.size)
    dense = (found == 2).reshape(values.shape)[:height, :width]
    triangles = np.concatenate((triangles, small[found[squares] == 1]))
    place = triangles // pitch * (width + 1) + triangles % pitch
    return dense, place.astype(np.int32)


def _needed(values: np.ndarray, allowed: np.ndarray, split: np.ndarray) -> np.ndarray:
    """Return the largest change by leaving out a pixel, or one that only exists where it does, over what is allowed."""
    needed = np.zeros(values.shape, np.float32)
    for corner in (needed[:-1, :-1], needed[1:, :-1], needed[:-1, 1:], needed[1:, 1:]):
        corner[split] = np.inf
    for level in range(_LEVELS):
        half = 1 << level
        side = 2 * half
        _sides(values, allowed, needed, half)
        _sides(values.T, allowed.T, needed.T, half)
        lattice = values[::side, ::side]
        falling = np.add.outer(np.arange(len(lattice) - 1), np.arange(lattice.shape[1] - 1)) % 2 == 0
        ends = np.where(falling, lattice[:-1, :-1] + lattice[1:, 1:], lattice[:-1, 1:] + lattice[1:, :-1])
        at = np.s_[half::side, half::side]
        beside = (needed[:-1:side, half::side], needed[side::side, half::side],
                  needed[half::side, :-1:side], needed[half::side, side::side])  # fmt: skip
        needed[at] = np.maximum.reduce((needed[at], _change(values[at], ends, allowed[at]), *beside))
    return needed


def _sides(values: np.ndarray, allowed: np.ndarray, needed: np.ndarray, half: int) -> None:
    """Note what the pixels in the middles of the horizontal sides of squares are needed for."""
    side = 2 * half
    at = np.s_[::side, half::side]
    middles = needed[at]
    ends = values[::side, :-1:side] + values[::side, side::side]
    middles[:] = np.maximum(middles, _change(values[at], ends, allowed[at]))
    if half > 1:
        smaller = needed[half // 2 :: half, half // 2 :: half]  # of the squares around
        smaller = np.maximum(smaller[:, ::2], smaller[:, 1::2])
        middles[:-1] = np.maximum(middles[:-1], smaller[::2])
        middles[1:] = np.maximum(middles[1:], smaller[1::2])


def _change(values: np.ndarray, ends: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Return how far values are from the mean of two, given by its sum, over what is allowed; infinite if unknown."""
    return np.nan_to_num(np.abs(values - ends / 2) / allowed, nan=np.inf)


def _leaves(needed: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles, (M, 3), and those of half a square of four pixels, as indices with the right angle last."""
    pitch, side = needed.shape[1], 1 << _LEVELS
    row, column = np.divmod(np.arange(rows * columns), columns)
    first = (row * pitch + column) * side
    second, third, fourth = first + side, first + side * pitch, first + side * pitch + side
    falling = (row + column) % 2 == 0
    upper = np.where(falling, (first, fourth, second), (third, second, first))
    lower = np.where(falling, (fourth, first, third), (second, third, fourth))
    corners, done = np.concatenate((upper, lower), axis=1), []
    for _ in range(2 * _LEVELS):
        a, b, c = corners
        split = needed.ravel()[(a + b) // 2] > 1
        done.append(corners[:, ~split])
        a, b, c = corners[:, split]
        middle = (a + b) // 2
        corners = np.concatenate(((c, a, middle), (b, c, middle)), axis=1)
    return np.concatenate(done, axis=1).T, corners.T


def find_connections(inverse: np.ndarray) -> np.ndarray:
    """Return whether each pixel of inverse depth, (H, W), is on one surface with its right neighbour, (H, W - 1)."""
    width, widest = inverse.shape[1], 2 * max(_HALF_WIDTHS)
    rows, found = max(1, _STRIP // width), []
    for start in range(0, len(inverse), rows):
        strip = inverse[start : start + rows]
        padded = np.pad(strip, ((0, 0), (widest, widest)), constant_values=np.nan)
        change = np.diff(strip, axis=1)
        scale = LARGEST_STEP * np.minimum(strip[:, :-1], strip[:, 1:])
        step = np.zeros(change.shape, dtype=bool)
        for half_width in _HALF_WIDTHS:
            far, near, beyond, before = (
                padded[:, widest + by : widest + by + width - 1]
                for by in (half_width, 1 - half_width, 2 * half_width, 1 - 2 * half_width)
            )
            total, pairs = far - near, 2 * half_width - 1
            excess, own = np.abs(total), np.abs(change)
            for slope in ((beyond - far) / half_width, (near - before) / half_width):
                excess = np.fmin(excess, np.abs(total - pairs * slope))
                own = np.fmin(own, np.abs(change - slope))
            step |= (excess > scale) & (own > (1.0 if half_width == 1 else _OWN_FRACTION) * scale)
        found.append(np.isfinite(change) & ~step)
    return np.concatenate(found)


def simplify(mesh: Mesh, most: int, camera: Camera) -> Mesh:
    """Return a mesh of at most ``most`` triangles by quadric decimation, or a few more where edges cannot collapse."""
    if len(mesh.faces) <= most:
        return mesh
    library = importlib.import_module("fast_simplification")
    points, faces = library.simplify(mesh.vertices, mesh.faces, target_count=most)
    used = np.unique(faces)
    place_of = np.zeros(len(points), np.int32)
    place_of[used] = np.arange(len(used), dtype=np.int32)
    vertices = points[used].astype(np.float32)
    places = project(vertices, camera).round().astype(np.int64)
    return Mesh(vertices, place_of[faces], places[:, 1] * camera.width + places[:, 0])


def thin(depth: Tensor, camera: Camera, most: int) -> tuple[Mesh, int]:
    """Return a mesh of at most ``most`` triangles, of every second, third, ... row and column, and that stride."""
    stride = max(2, math.isqrt(2 * int(depth.isfinite().sum()) // most))
    while len((mesh := triangulate(depth, camera, stride=stride)).faces) > most:
        stride += 1
    return mesh, stride


def select_points(mesh: Mesh, most: int, camera: Camera) -> np.ndarray:
    """Return the indices of at most ``most`` vertices of an unsimplified mesh, (N,), evenly spread in the image."""
    count = len(mesh.pixels)
    if count <= most:
        return np.arange(count)
    rows, columns = np.divmod(mesh.pixels, camera.width)
    step = math.sqrt(count / most)
    while True:
        chosen_rows = np.arange(0, camera.height, step).astype(int)
        chosen_columns = np.arange(0, camera.width, step).astype(int)
        chosen = np.flatnonzero(np.isin(rows, chosen_rows) & np.isin(columns, chosen_columns))
        if len(chosen) <= most:
            return chosen
        step *= 1.02


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the columns and rows of points, (N, 3) in front of the camera, in pixels, (N, 2), clipped to the image."""
    x, y, z = points.astype(np.float64).T
    places = np.stack((x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy), axis=1)
    return places.clip(0, (camera.width - 1, camera.height - 1))


class FusedMesh(NamedTuple):
    """A mesh of many depth maps in the world's frame."""

    vertices: np.ndarray  # (N, 3) in metres
    normals: np.ndarray  # (N, 3), outward
    faces: np.ndarray  # (M, 3)


def fuse_maps(maps: Callable[[], Iterable[PosedMap]], voxel: float) -> FusedMesh:
    """Return the surface on which depth maps agree, in voxels of an edge length in metres.

    Curless and Levoy, *A Volumetric Method for Building Complex Models from Range Images*, SIGGRAPH 1996: the signed
    distances of a voxel to the surface of each map, along the map's rays, are averaged with weights, and the surface is
    where the average is 0, by marching cubes (Lewiner et al. 2003). Only blocks of 8 x 8 x 8 voxels near a surface are
    stored (Niessner et al. 2013). ``maps`` yields the maps; it is called twice, and one map is held at a time.
    """
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
    u, v, inside = in_picture(each.camera, x, y, z)
    places = np.flatnonzero(inside)
    columns, rows = np.rint(u[places]).astype(np.intp), np.rint(v[places]).astype(np.intp)
    gap = (each.depth[rows, columns] - z[places]) / (_TRUNCATION * voxel)
    certain = np.ones(len(places)) if each.deviation is None else (voxel / each.deviation[rows, columns]) ** 2
    seen = (gap >= -1) & (certain > 0) & np.isfinite(certain)
    places, gap, certain = places[seen], gap[seen].clip(max=1), certain[seen].clip(max=1e6)
    flat_distance, flat_weight = distance.reshape(-1), weight.reshape(-1)
    total = flat_weight[places] + certain
    flat_distance[places] += (certain / total * (gap - flat_distance[places])).astype(np.float32)
    flat_weight[places] = total


def _extract(blocks: NDArray[np.int64], distance: np.ndarray, weight: np.ndarray, voxel: float) -> FusedMesh:
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
    """Return vertices in voxels, normals and faces of a volume, without cells that have an unknown corner."""
    low, high = volume[1:, 1:, 1:].copy(), volume[1:, 1:, 1:].copy()
    for i, j, k in np.ndindex(2, 2, 2):
        corner = volume[i : i + low.shape[0], j : j + low.shape[1], k : k + low.shape[2]]
        np.minimum(low, corner, out=low)  # NaN if a corner is
        np.maximum(high, corner, out=high)
    cells = high - low < _STEEPEST  # behind the rim of a surface, where the distance jumps, there are no triangles
    known = np.isfinite(volume)
    values = np.where(known, volume, 1.0)
    values[values == 0] = -np.finfo(np.float32).eps  # a surface in a layer of voxels, where no sign would change
    if not cells.any() or not (values.min() < 0 < values.max()):
        return None
    from skimage.measure import marching_cubes  # noqa: PLC0415 - a mesh of a single map needs none

    places, faces, normals, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
    middle = np.floor(places[faces].mean(1)).astype(np.intp).clip(max=np.array(cells.shape) - 1)
    faces = faces[cells[tuple(middle.T)]]
    used = np.unique(faces)
    if not len(used):
        return None
    renumbered = np.full(len(places), -1)
    renumbered[used] = np.arange(len(used))
    return places[used].astype(np.float64), -normals[used].astype(np.float64), renumbered[faces[:, ::-1]]
