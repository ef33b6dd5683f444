"""Meshes of large triangles where a surface is flat: closed, facing the camera, and no further from it than allowed."""

import math

import numpy as np
import pytest
import torch
import trimesh

from dsr.geometry.camera import Camera
from dsr.geometry.mesh import triangulate

HEIGHT, WIDTH = 150, 210
CAMERA = Camera(WIDTH, HEIGHT, 200.0, 200.0, 104.5, 74.5)


def grid():
    return torch.meshgrid(torch.arange(HEIGHT).double(), torch.arange(WIDTH).double(), indexing="ij")


def plane():
    """A wall that recedes to the right."""
    _, x = grid()
    return (1 / (0.5 - 0.001 * (x - 104.5)))[None]


def ball():
    """A ball before the wall, with holes beside it."""
    y, x = grid()
    bump = (40**2 - (y - 70) ** 2 - (x - 90) ** 2).clamp(min=0).sqrt() / 100
    depth = torch.where(bump > 0, 1.5 - bump, plane()[0])
    depth[20:30, 150:155] = math.nan
    return depth[None]


def areas(mesh):
    """Return the signed areas of triangles in the picture, in pixels; positive if the camera sees their front."""
    rows, columns = np.divmod(mesh.pixels, WIDTH)
    corners = np.stack((columns, -rows), axis=1)[mesh.faces]
    (x1, y1), (x2, y2) = ((corners[:, k] - corners[:, 0]).T for k in (1, 2))
    return (x1 * y2 - x2 * y1) / 2


def test_plane_becomes_few_triangles_that_cover_it():
    mesh = triangulate(plane(), CAMERA, tolerance=1e-4 * plane())
    assert mesh.dense == 2 * (HEIGHT - 1) * (WIDTH - 1)
    assert len(mesh.faces) < 0.08 * mesh.dense  # most of them at the lower and right border of the picture
    assert (areas(mesh) > 0).all()
    assert areas(mesh).sum() == (HEIGHT - 1) * (WIDTH - 1)


def test_surface_keeps_its_steps_and_holes_without_cracks():
    full, mesh = (triangulate(ball(), CAMERA, tolerance=each) for each in (None, 1e-3 * ball()))
    assert len(mesh.faces) < 0.3 * len(full.faces) == 0.3 * mesh.dense
    assert (areas(mesh) > 0).all()
    assert areas(mesh).sum() == areas(full).sum()
    sides = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs, count = np.unique(sides, axis=0, return_counts=True)
    assert count.max() == 2
    rows, columns = np.divmod(mesh.pixels[pairs[count == 1]], WIDTH)  # sides of one triangle lie at a border
    framed = ((rows == 0) | (rows == HEIGHT - 1)).all(1) | ((columns == 0) | (columns == WIDTH - 1)).all(1)
    assert (np.abs(np.diff(rows)) <= 1).ravel()[~framed].all()
    assert (np.abs(np.diff(columns)) <= 1).ravel()[~framed].all()


@pytest.mark.parametrize("tolerance", [1e-4, 1e-3])
def test_pixels_lie_beside_the_mesh_by_little_more_than_allowed(tolerance):
    depth = ball()
    mesh = triangulate(depth, CAMERA, tolerance=tolerance * depth)
    y, x = (each[depth[0].isfinite()].numpy() for each in grid())
    rays = np.stack(((x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(len(x))), axis=1)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    places, ray, _ = shape.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    assert len(ray) > 0.95 * len(rays)
    true = depth[0].numpy()[y.astype(int), x.astype(int)][ray]
    off = np.abs(places[:, 2] / true - 1)[rays_inside(depth, y, x)[ray]]
    assert np.quantile(off, 0.99) < 1.2 * tolerance
    assert off.max() < 3 * tolerance


def rays_inside(depth, y, x):
    """Return which pixels are not at an outline, where a ray may pass beside a side of a triangle."""
    near = torch.nn.functional.max_pool2d(depth.nan_to_num(9)[None], 5, 1, 2)[0, 0]
    far = -torch.nn.functional.max_pool2d(-depth.nan_to_num(9)[None], 5, 1, 2)[0, 0]
    return ((near - far) < 0.1)[y.astype(int), x.astype(int)].numpy()


def test_pixels_without_tolerance_are_all_kept():
    allowed = 1e-3 * ball()
    allowed[0, :, :60] = math.nan
    kept, whole = (
        np.bincount(triangulate(ball(), CAMERA, tolerance=each).pixels, minlength=HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
        for each in (allowed, None)
    )
    np.testing.assert_array_equal(kept[:, :60], whole[:, :60])
    assert kept[:, 60:].mean() < 0.6
