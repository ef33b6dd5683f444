"""The fused mesh against the sphere that its depth maps show."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dsr.geometry.camera import Camera
from dsr.geometry.poses import PosedMap
from dsr.geometry.tsdf import fuse_maps

CAMERA = Camera.centred(96, 80, 110.0)
CENTRE, RADIUS = np.array([0.1, -0.2, 2.0]), 0.5


def seen(turn):
    """Return the sphere from a camera that is turned about it by some degrees."""
    turned = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned, CENTRE - turned @ np.array([0, 0, 2.0])
    rays = CAMERA.rays().numpy()
    half, square = 2.0 * rays[2], (rays**2).sum(0)
    root = half**2 - square * (4.0 - RADIUS**2)
    depth = np.where(root > 0, (half - np.sqrt(np.maximum(root, 0))) / square, np.nan)
    return PosedMap(depth, CAMERA, pose)


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
    wall = PosedMap(np.full((80, 96), 2.0), CAMERA, np.eye(4))
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


@pytest.mark.parametrize(
    ("voxel", "message"), [(0.0, "positive"), (1e-4, "at least about"), (float("nan"), "positive")]
)
def test_impossible_voxels_are_refused(voxel, message):
    with pytest.raises(ValueError, match=f"voxel: .*{message}"):
        fuse_maps(lambda: [seen(0)], voxel)
