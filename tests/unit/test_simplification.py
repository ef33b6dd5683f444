"""Meshes and clouds beyond a limit: how many triangles and points are left, and where."""

import sys

import numpy as np
import pytest
import torch
import trimesh

from dsr.geometry.camera import Camera
from dsr.geometry.mesh import project, select_points, simplify, thin, triangulate
from dsr.io.exports import Written, write_cloud, write_mesh

CAMERA = Camera(40, 30, 45, 45, 19.5, 14.5)
TRIANGLES = 2 * 29 * 39


def wavy():
    rows, columns = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    return (2 + 0.05 * torch.sin(rows / 5) * torch.cos(columns / 6))[None]


def test_project_undoes_the_rays():
    mesh = triangulate(wavy(), CAMERA)
    places = project(mesh.vertices, CAMERA)
    np.testing.assert_allclose(places, np.stack((mesh.pixels % 40, mesh.pixels // 40), axis=1), atol=1e-4)


def test_project_stays_in_the_image():
    assert project(np.array([[9.0, -9.0, 1.0]]), CAMERA).tolist() == [[39, 0]]


def test_simplify_keeps_a_mesh_within_the_limit():
    mesh = triangulate(wavy(), CAMERA)
    assert simplify(mesh, TRIANGLES, CAMERA) is mesh


def test_simplify_keeps_the_surface_and_its_outline():
    pytest.importorskip("fast_simplification")
    mesh = triangulate(wavy(), CAMERA)
    less = simplify(mesh, 400, CAMERA)
    assert 300 < len(less.faces) <= 400
    assert less.faces.max() == len(less.vertices) - 1
    columns, rows = project(less.vertices, CAMERA).T
    np.testing.assert_allclose(less.vertices[:, 2], 2 + 0.05 * np.sin(rows / 5) * np.cos(columns / 6), atol=0.004)
    np.testing.assert_allclose(less.vertices.min(axis=0)[:2], mesh.vertices.min(axis=0)[:2], atol=0.02)
    np.testing.assert_allclose(less.vertices.max(axis=0)[:2], mesh.vertices.max(axis=0)[:2], atol=0.02)
    places = np.stack((less.pixels % 40, less.pixels // 40), axis=1)
    assert np.abs(places - project(less.vertices, CAMERA)).max() <= 0.5 + 1e-4


def test_simplify_makes_a_plane_of_few_triangles_without_moving_it():
    pytest.importorskip("fast_simplification")
    mesh = triangulate(torch.full((1, 30, 40), 2.0), CAMERA)
    less = simplify(mesh, 100, CAMERA)
    assert len(less.faces) <= 100
    np.testing.assert_allclose(less.vertices[:, 2], 2, atol=1e-5)
    area = trimesh.Trimesh(less.vertices, less.faces, process=False).area
    assert area == pytest.approx(29 * 39 * (2 / 45) ** 2, rel=0.03)  # corners are cut


@pytest.mark.parametrize(("most", "stride"), [(1200, 2), (TRIANGLES - 1, 2), (300, 3), (100, 5)])
def test_thin_takes_the_smallest_stride(most, stride):
    mesh, found = thin(wavy(), CAMERA, most, 0.5)
    assert found == stride
    rows, columns = len(range(0, 30, stride)), len(range(0, 40, stride))
    assert len(mesh.faces) == 2 * (rows - 1) * (columns - 1) <= most


@pytest.mark.parametrize("most", [1200, 1199, 1000, 601, 100])
def test_select_points_are_close_to_the_limit_and_spread_evenly(most):
    mesh = triangulate(wavy(), CAMERA, isolated=True)
    chosen = select_points(mesh, most, CAMERA)
    assert 0.85 * most <= len(chosen) <= most
    rows, columns = (np.unique(each) for each in np.divmod(mesh.pixels[chosen], 40))
    assert len(rows) * len(columns) == len(chosen)
    for places in (rows, columns):
        assert np.diff(places).max() - np.diff(places).min() <= 1


def test_full_density_is_written_by_default(tmp_path):
    photo = torch.rand(3, 30, 40)
    assert write_mesh(tmp_path / "m.ply", photo, wavy(), CAMERA) == Written(TRIANGLES, TRIANGLES)
    assert write_cloud(tmp_path / "c.ply", photo, wavy(), CAMERA) == Written(1200, 1200)
    assert len(trimesh.load(tmp_path / "m.ply", process=False).faces) == TRIANGLES
    assert len(trimesh.load(tmp_path / "c.ply").vertices) == 1200


def test_simplified_mesh_is_read_back_with_the_photo_at_its_place(tmp_path):
    pytest.importorskip("fast_simplification")
    columns = torch.arange(40.0).expand(30, 40) / 39
    photo = torch.stack((columns, columns, columns))
    written = write_mesh([tmp_path / "m.ply", tmp_path / "m.glb"], photo, wavy(), CAMERA, most=500)
    assert written.before == TRIANGLES
    assert written.after <= 500
    assert written.how == "quadric decimation"
    ply = trimesh.load(tmp_path / "m.ply", process=False)
    assert len(ply.faces) == written.after
    red = project(np.asarray(ply.vertices), CAMERA)[:, 0] / 39 * 255
    assert np.abs(ply.visual.vertex_colors[:, 0] - red).max() < 255 / 39
    [glb] = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    np.testing.assert_allclose(glb.visual.uv[:, 0] * 40 - 0.5, red / 255 * 39, atol=0.01)


def test_mesh_without_the_library_says_its_stride(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    written = write_mesh(tmp_path / "m.ply", torch.rand(3, 30, 40), wavy(), CAMERA, most=600)
    assert written.before == TRIANGLES
    assert 0 < written.after <= 600
    assert written.how.startswith("a stride of 2 pixels; pip install -e '.[mesh]' in a checkout simplifies")
