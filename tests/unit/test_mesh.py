"""Meshes of depth maps, and the mesh fused of several: planes stay whole, steps are cut, faces look at the camera."""

import math
import sys

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from small_scenes import grid, sphere_depth

from dsr.geometry.camera import Camera
from dsr.geometry.mesh import fuse_maps, project, select_points, simplify, thin, triangulate, vertex_normals
from dsr.geometry.poses import PosedMap
from dsr.io.exports import write_mesh

CAMERA = Camera(40, 30, 50, 50, 19.5, 14.5)


def wall(z=2.0, camera=CAMERA):
    return torch.full((1, camera.height, camera.width), float(z))


def sphere(camera, distance=3.0, radius=1.0):
    """Return the depth of a sphere on the optical axis, NaN around it."""
    depth = sphere_depth(camera.rays(), (0, 0, distance), radius)[None]
    return depth.masked_fill(depth.isinf(), torch.nan)


def face_normals(mesh):
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(axis=1)


def spans(mesh):
    """Return the largest relative range of depth within a face."""
    z = mesh.vertices[mesh.faces][..., 2]
    return (z.max(axis=1) / z.min(axis=1)).max() - 1


def test_wall_mesh_has_two_triangles_per_square_and_the_area_of_the_wall():
    mesh = triangulate(wall(), CAMERA)
    assert len(mesh.vertices) == 40 * 30
    assert len(mesh.faces) == 2 * 39 * 29
    assert mesh.faces.dtype == np.int32
    areas = np.linalg.norm(face_normals(mesh)[0], axis=1) / 2
    assert areas.sum() == pytest.approx(39 * 29 * (2 / 50) ** 2)


@pytest.mark.parametrize("seed", range(3))
def test_faces_and_vertex_normals_face_the_camera(seed):
    depth = 2 + 0.02 * torch.rand(1, 30, 40, generator=torch.Generator().manual_seed(seed))
    depth[0, 5:8, 5:8] = torch.nan
    mesh = triangulate(depth, CAMERA)
    normals, centres = face_normals(mesh)
    assert ((normals * centres).sum(axis=1) < 0).all()
    assert ((vertex_normals(mesh) * mesh.vertices).sum(axis=1) < 0).all()


def test_floor_stays_whole_up_to_the_row_below_the_horizon():
    camera = Camera(20, 120, 400, 400, 9.5, 14.5)
    rows = torch.arange(120, dtype=torch.float64) - camera.cy
    depth = (1.5 * camera.fy / torch.where(rows > 0, rows, torch.nan))[None, :, None].expand(1, -1, 20)
    assert float(depth[0, 15, 0] / depth[0, 16, 0]) == pytest.approx(3)  # the change that must not be cut
    mesh = triangulate(depth, camera)
    assert len(mesh.faces) == 2 * 19 * (120 - 15 - 1)


def test_sphere_loses_only_the_last_two_pixels_of_its_rim():
    camera = Camera(200, 200, 250, 250, 99.5, 99.5)
    depth = sphere(camera)
    mesh = triangulate(depth, camera)
    rim = 250 / 8**0.5  # pixels from the centre: the tangent has the sine 1 / 3
    radius = np.hypot(mesh.pixels % 200 - 99.5, mesh.pixels // 200 - 99.5)
    within = (radius[mesh.faces] < rim - 2).all(axis=1).sum()
    rows, columns = np.mgrid[:200, :200] - 99.5
    square = np.hypot(rows, columns) < rim - 2
    corners = [square[:-1, :-1], square[:-1, 1:], square[1:, :-1], square[1:, 1:]]
    assert within >= 2 * np.logical_and.reduce(corners).sum()
    normals = mesh.vertices - np.array([0, 0, 3])  # of a unit sphere
    inside = np.linalg.norm(mesh.vertices[:, :2], axis=1) < 0.8
    assert ((vertex_normals(mesh) * normals).sum(axis=1)[inside] > 0.999).all()


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize(("step", "cut"), [(1.03, True), (1.01, False)])
def test_step_of_three_percent_is_cut_and_one_of_one_percent_is_not(step, cut, transposed):
    camera = Camera(30, 30, 50, 50, 14.5, 14.5)
    depth = wall(camera=camera)
    depth[0, :, 15:] *= step
    mesh = triangulate(depth.mT if transposed else depth, camera)
    assert len(mesh.faces) == 2 * 29 * (28 if cut else 29)
    assert (spans(mesh) < 1e-6) == cut


def test_step_smeared_over_three_pixels_and_a_pole_of_one_leave_no_connecting_faces():
    smeared, pole = wall(), wall()
    smeared[0, :, 18:20] = torch.tensor([2.35, 2.7])
    smeared[0, :, 20:], pole[0, :, 20] = 3, 1.5
    mesh = triangulate(smeared, CAMERA)
    assert spans(mesh) < 1e-6
    assert set(np.unique(mesh.vertices[:, 2])) == {2.0, 3.0}
    mesh = triangulate(pole, CAMERA)
    assert (mesh.vertices[:, 2] == 2).all()
    assert len(mesh.faces) == 2 * 29 * 37


def test_isolated_pixels_are_dropped_unless_requested():
    depth = torch.full((1, 30, 40), torch.nan)
    depth[0, 3, 4] = 2
    depth[0, 10:12, 10:12] = 2
    assert len(triangulate(depth, CAMERA).vertices) == 4
    mesh = triangulate(depth, CAMERA, isolated=True)
    assert mesh.pixels.tolist() == [3 * 40 + 4, 410, 411, 450, 451]
    towards = -mesh.vertices[0] / np.linalg.norm(mesh.vertices[0])
    np.testing.assert_allclose(vertex_normals(mesh)[0], towards, rtol=1e-6)


def test_three_valid_pixels_of_a_square_make_a_triangle():
    for hole in ((0, 0), (0, 1), (1, 0), (1, 1)):
        depth = torch.full((1, 2, 2), 2.0)
        depth[0, *hole] = torch.nan
        mesh = triangulate(depth, Camera(2, 2, 5, 5, 0.5, 0.5))
        assert mesh.faces.tolist() in ([[0, 1, 2]], [[1, 2, 0]], [[2, 0, 1]], [[0, 2, 1]], [[1, 0, 2]], [[2, 1, 0]])
        assert face_normals(mesh)[0][0, 2] < 0


def test_diagonal_follows_the_smaller_change_of_depth():
    depth = torch.tensor([[[2.0, 2.03], [2.01, 2.0]]])
    for values, ends in ((depth, {0, 3}), (depth.flip(-1), {1, 2})):
        assert all(ends <= set(face) for face in triangulate(values, Camera(2, 2, 5, 5, 0.5, 0.5)).faces.tolist())


def test_strips_of_rows_and_triangles_of_large_maps_leave_no_seam(monkeypatch):
    depth = wall() + 0.1 * torch.rand(1, 30, 40, generator=torch.Generator().manual_seed(0))
    whole = triangulate(depth, CAMERA)
    normals = vertex_normals(whole)
    monkeypatch.setattr("dsr.geometry.mesh._STRIP", 70)
    strips = triangulate(depth, CAMERA)
    np.testing.assert_array_equal(strips.faces, whole.faces)
    np.testing.assert_allclose(vertex_normals(strips), normals, atol=1e-6)


@pytest.mark.parametrize("stride", [1, 2, 7])
def test_vertices_are_the_back_projected_pixels_of_every_which_row_and_column(stride):
    depth = wall() + 2e-4 * torch.arange(1200).view(1, 30, 40)
    mesh = triangulate(depth, CAMERA, stride=stride, isolated=True)
    assert len(mesh.vertices) == len(range(0, 30, stride)) * len(range(0, 40, stride))
    points = (CAMERA.rays() * depth).flatten(1).T.numpy()
    np.testing.assert_allclose(mesh.vertices, points[mesh.pixels], rtol=1e-6, atol=1e-7)
    assert triangulate(wall(torch.nan), CAMERA, stride=stride).faces.shape == (0, 3)


HEIGHT, WIDTH = 150, 210
OTHER = Camera(WIDTH, HEIGHT, 200.0, 200.0, 104.5, 74.5)


def plane():
    """A wall that recedes to the right."""
    _, x = grid(HEIGHT, WIDTH)
    return (1 / (0.5 - 0.001 * (x - 104.5)))[None]


def ball():
    """A ball before the wall, with holes beside it."""
    y, x = grid(HEIGHT, WIDTH)
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
    mesh = triangulate(plane(), OTHER, tolerance=1e-4 * plane())
    assert mesh.dense == 2 * (HEIGHT - 1) * (WIDTH - 1)
    assert len(mesh.faces) < 0.08 * mesh.dense  # most of them at the lower and right border of the picture
    assert (areas(mesh) > 0).all()
    assert areas(mesh).sum() == (HEIGHT - 1) * (WIDTH - 1)


def test_surface_keeps_its_steps_and_holes_without_cracks():
    full, mesh = (triangulate(ball(), OTHER, tolerance=each) for each in (None, 1e-3 * ball()))
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
    depth, full = ball(), ball().nan_to_num(9)
    mesh = triangulate(depth, OTHER, tolerance=tolerance * depth)
    y, x = (each[depth[0].isfinite()].numpy() for each in grid(HEIGHT, WIDTH))
    rays = np.stack(((x - OTHER.cx) / OTHER.fx, (y - OTHER.cy) / OTHER.fy, np.ones(len(x))), axis=1)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    places, ray, _ = shape.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    assert len(ray) > 0.95 * len(rays)
    true = depth[0].numpy()[y.astype(int), x.astype(int)][ray]
    # at an outline a ray may pass beside a side of a triangle
    far, near = (torch.nn.functional.max_pool2d(each[None], 5, 1, 2)[0, 0] for each in (full, -full))
    inside = ((far + near) < 0.1)[y.astype(int), x.astype(int)].numpy()
    off = np.abs(places[:, 2] / true - 1)[inside[ray]]
    assert np.quantile(off, 0.99) < 1.2 * tolerance
    assert off.max() < 3 * tolerance


def test_pixels_without_tolerance_are_all_kept():
    allowed = 1e-3 * ball()
    allowed[0, :, :60] = math.nan
    kept, whole = (
        np.bincount(triangulate(ball(), OTHER, tolerance=each).pixels, minlength=HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
        for each in (allowed, None)
    )
    np.testing.assert_array_equal(kept[:, :60], whole[:, :60])
    assert kept[:, 60:].mean() < 0.6


SMALL = Camera(40, 30, 45, 45, 19.5, 14.5)
TRIANGLES = 2 * 29 * 39


def wavy():
    rows, columns = grid(30, 40)
    return (2 + 0.05 * torch.sin(rows / 5) * torch.cos(columns / 6))[None]


def test_simplify_keeps_the_surface_and_its_outline():
    pytest.importorskip("fast_simplification")
    mesh = triangulate(wavy(), SMALL)
    less = simplify(mesh, 400, SMALL)
    assert 300 < len(less.faces) <= 400
    assert less.faces.max() == len(less.vertices) - 1
    columns, rows = project(less.vertices, SMALL).T
    np.testing.assert_allclose(less.vertices[:, 2], 2 + 0.05 * np.sin(rows / 5) * np.cos(columns / 6), atol=0.004)
    np.testing.assert_allclose(less.vertices.min(axis=0)[:2], mesh.vertices.min(axis=0)[:2], atol=0.02)
    np.testing.assert_allclose(less.vertices.max(axis=0)[:2], mesh.vertices.max(axis=0)[:2], atol=0.02)
    places = np.stack((less.pixels % 40, less.pixels // 40), axis=1)
    assert np.abs(places - project(less.vertices, SMALL)).max() <= 0.5 + 1e-4


@pytest.mark.parametrize(("most", "stride"), [(1200, 2), (TRIANGLES - 1, 2), (300, 3), (100, 5)])
def test_thin_takes_the_smallest_stride(most, stride):
    mesh, found = thin(1.6 + wavy() / 5, SMALL, most)  # without steps
    assert found == stride
    rows, columns = len(range(0, 30, stride)), len(range(0, 40, stride))
    assert len(mesh.faces) == 2 * (rows - 1) * (columns - 1) <= most


@pytest.mark.parametrize("most", [1200, 1199, 1000, 601, 100])
def test_select_points_are_close_to_the_limit_and_spread_evenly(most):
    mesh = triangulate(wavy(), SMALL, isolated=True)
    chosen = select_points(mesh, most, SMALL)
    assert 0.85 * most <= len(chosen) <= most
    rows, columns = (np.unique(each) for each in np.divmod(mesh.pixels[chosen], 40))
    assert len(rows) * len(columns) == len(chosen)
    for places in (rows, columns):
        assert np.diff(places).max() - np.diff(places).min() <= 1


def test_simplified_mesh_is_read_back_with_the_photo_at_its_place(tmp_path):
    pytest.importorskip("fast_simplification")
    columns = torch.arange(40.0).expand(30, 40) / 39
    photo = torch.stack((columns, columns, columns))
    written = write_mesh([tmp_path / "m.ply", tmp_path / "m.glb"], photo, wavy(), SMALL, most=500)
    assert written.before == TRIANGLES
    assert written.after <= 500
    assert written.how == "quadric decimation"
    ply = trimesh.load(tmp_path / "m.ply", process=False)
    assert len(ply.faces) == written.after
    red = project(np.asarray(ply.vertices), SMALL)[:, 0] / 39 * 255
    assert np.abs(ply.visual.vertex_colors[:, 0] - red).max() < 255 / 39
    [glb] = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    np.testing.assert_allclose(glb.visual.uv[:, 0] * 40 - 0.5, red / 255 * 39, atol=0.01)


def test_mesh_without_the_library_says_its_stride(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    written = write_mesh(tmp_path / "m.ply", torch.rand(3, 30, 40), wavy(), SMALL, most=600)
    assert (written.before, 0 < written.after <= 600) == (TRIANGLES, True)
    assert written.how.startswith("a stride of 2 pixels; pip install")


TURNING = Camera.centred(96, 80, 110.0)
CENTRE, RADIUS = np.array([0.1, -0.2, 2.0]), 0.5


def seen(turn):
    """Return the sphere from a camera that is turned about it by some degrees."""
    turned = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned, CENTRE - turned @ np.array([0, 0, 2.0])
    return PosedMap(sphere(TURNING, 2.0, RADIUS)[0].numpy(), TURNING, pose)


def test_fused_mesh_lies_on_the_sphere_and_faces_outward():
    views = [seen(turn) for turn in (0, 40, -40, 80)]
    mesh = fuse_maps(lambda: views, 0.02)
    off = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS
    assert np.abs(off).mean() < 0.003
    assert np.abs(off).max() < 0.03  # less than two voxels, at the rims
    outward = (mesh.vertices - CENTRE) / np.linalg.norm(mesh.vertices - CENTRE, axis=1, keepdims=True)
    assert ((mesh.normals * outward).sum(1) > 0).mean() > 0.98
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((across * (corners.mean(1) - CENTRE)).sum(1) > 0).mean() > 0.98
    assert len(mesh.faces) > 3000


def test_surface_in_a_layer_of_voxels_is_found():
    """At 2 m, where voxels of 5 cm and blocks of eight begin, distances are exactly 0."""
    wall = PosedMap(np.full((80, 96), 2.0), TURNING, np.eye(4))
    mesh = fuse_maps(lambda: [wall], 0.05)
    assert np.abs(mesh.vertices[:, 2] - 2).max() < 1e-3
    assert len(mesh.faces) > 500


def test_layers_of_blocks_are_joined():
    mesh = fuse_maps(lambda: [seen(0)], 0.02)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    inner = np.linalg.norm(mesh.vertices[:, :2] - CENTRE[:2], axis=1) < 0.6 * RADIUS
    border = np.unique(np.unique(edges, axis=0)[count == 1])
    assert not inner[border].any()  # no seam in the middle


def test_maps_are_weighted_by_their_expected_errors():
    near = seen(0)
    far = near._replace(depth=near.depth + 0.02)
    sure, unsure = np.full(near.depth.shape, 0.001), np.full(near.depth.shape, 0.1)
    middle = {}
    for name, deviations in (("near", (sure, unsure)), ("far", (unsure, sure)), ("both", (sure, sure))):
        views = [near._replace(deviation=deviations[0]), far._replace(deviation=deviations[1])]
        vertices = fuse_maps(lambda views=views: views, 0.02).vertices
        axis = np.linalg.norm(vertices[:, :2] - CENTRE[:2], axis=1) < 0.05
        middle[name] = vertices[axis, 2].mean()
    assert middle["far"] - middle["near"] == pytest.approx(0.02, abs=0.003)
    assert middle["both"] == pytest.approx((middle["near"] + middle["far"]) / 2, abs=0.002)


def test_voxels_that_are_too_small_are_refused():
    with pytest.raises(ValueError, match=r"voxel: .*at least about"):
        fuse_maps(lambda: [seen(0)], 1e-4)
