"""What is written beside an upsampled depth map, read back by other programs' code."""

import json
import struct

import cv2
import numpy as np
import pytest
import torch
import trimesh

from dsr.geometry.camera import Camera
from dsr.geometry.mesh import triangulate, vertex_normals
from dsr.geometry.surface import depth_to_normals, render
from dsr.io.exports import (
    LONGEST,
    Written,
    read_input,
    write_cloud,
    write_glb,
    write_input,
    write_mesh,
    write_normals,
    write_renderings,
    write_rgbd_picture,
    write_stereo,
)

CAMERA = Camera(24, 18, 30, 30, 11.5, 8.5)


def wall(camera=CAMERA):
    return torch.full((1, camera.height, camera.width), 2.0)


def bumpy(camera=CAMERA, seed=0):
    noise = torch.rand(1, camera.height, camera.width, generator=torch.Generator().manual_seed(seed))
    return 2 + 0.02 * noise


def photo(camera=CAMERA):
    """Return a picture with red growing to the right, green downward."""
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack((columns / camera.width, rows / camera.height, torch.full(rows.shape, 0.5)))


def leaning(axis, camera=CAMERA):
    """Return a plane whose normal leans by 45 degrees along an axis, towards its positive end."""
    return (2 / (1 - camera.rays()[axis]))[None]


def read(path):
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return picture if picture.ndim == 2 else picture[..., [2, 1, 0, *range(3, picture.shape[2])]]


def test_renderings_are_those_of_the_protocol_in_eight_bits(tmp_path):
    paths = write_renderings(tmp_path / "new", bumpy(), CAMERA)
    assert [path.name for path in paths] == ["e1.png", "e2.png", "e3.png", "e4.png"]
    expected = render(depth_to_normals(bumpy().double()[None], CAMERA.rays()[None]))[0]
    for path, shades in zip(paths, expected, strict=True):
        assert read(path).shape == (18, 24)
        np.testing.assert_allclose(read(path), 255 * shades.numpy(), atol=0.51)


def test_holes_are_transparent(tmp_path):
    depth = bumpy()
    depth[0, 4:7, 5:9] = torch.nan
    write_renderings(tmp_path, depth, CAMERA)
    write_normals(tmp_path / "normals.png", depth, CAMERA)
    transparent = np.zeros((18, 24), bool)
    transparent[3:7, 4:9] = True
    transparent[3, 4] = False  # its normal needs the pixels to the right and below alone
    for name in ("e1.png", "e4.png", "normals.png"):
        picture = read(tmp_path / name)
        assert picture.shape == (18, 24, 4)
        np.testing.assert_array_equal(picture[..., 3] == 0, transparent)


@pytest.mark.parametrize(
    ("depth", "colour"),
    [(wall(), [128, 128, 255]), (leaning(0), [218, 128, 218]), (leaning(1), [128, 37, 218])],
)
def test_normal_map_has_red_right_and_no_green_downward(tmp_path, depth, colour):
    write_normals(tmp_path / "n.png", depth, CAMERA)
    np.testing.assert_allclose(read(tmp_path / "n.png").reshape(-1, 3), [colour] * (18 * 24), atol=1)


def test_cloud_has_every_valid_pixel_with_its_colour(tmp_path):
    depth = bumpy()
    depth[0, 3] = torch.nan
    assert write_cloud(tmp_path / "c.ply", photo(), depth, CAMERA) == Written(17 * 24, 17 * 24)
    cloud = trimesh.load(tmp_path / "c.ply")
    points = (CAMERA.rays() * depth).flatten(1).T
    kept = points.isfinite().all(dim=1)
    np.testing.assert_allclose(cloud.vertices, points[kept], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(cloud.colors[:, :3], 255 * photo().flatten(1).T[kept], atol=0.51)


def test_ply_header_describes_the_axes_and_normals_face_the_camera(tmp_path):
    write_cloud(tmp_path / "c.ply", photo(), wall(), CAMERA)
    header, _, content = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")
    assert b"comment camera frame: x right, y down, z forward; metres" in header
    assert len(content) == 24 * 18 * 28
    assert struct.unpack("<6f4B", content[:28]) == pytest.approx(
        (-2 * 11.5 / 30, -2 * 8.5 / 30, 2, 0, 0, -1, 0, 0, 128, 255), abs=1e-6
    )


def test_points_and_vertices_say_which_of_them_were_filled(tmp_path):
    depth, filled = bumpy(), torch.rand(1, 18, 24) < 0.3
    depth[0, 3] = torch.nan
    write_cloud(tmp_path / "c.ply", photo(), depth, CAMERA, filled=filled)
    header, _, content = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")
    assert b"property uchar filled" in header
    known = filled[depth.isfinite()].numpy()
    assert [content[29 * i + 28] for i in range(17 * 24)] == known.tolist()
    write_mesh([tmp_path / "m.ply", tmp_path / "m.glb"], photo(), bumpy(), CAMERA, filled=filled)
    assert b"property uchar filled" in (tmp_path / "m.ply").read_bytes().partition(b"end_header\n")[0]
    [mesh] = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    np.testing.assert_array_equal(mesh.vertex_attributes["_FILLED"].ravel(), filled.flatten().numpy())


def test_ply_mesh_is_read_back_with_its_faces(tmp_path):
    write_mesh(tmp_path / "m.ply", photo(), bumpy(), CAMERA)
    mesh = triangulate(bumpy(), CAMERA)
    again = trimesh.load(tmp_path / "m.ply", process=False)
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_allclose(again.visual.vertex_colors[:, :3], 255 * photo().flatten(1).T, atol=0.51)


def test_glb_mesh_is_y_up_looks_along_minus_z_and_has_the_photo_as_texture(tmp_path):
    write_mesh([tmp_path / "m.glb"], photo(), bumpy(), CAMERA)
    mesh = triangulate(bumpy(), CAMERA)
    again = trimesh.load(tmp_path / "m.glb", process=False, force="mesh")
    extent = np.ptp(mesh.vertices, axis=0).max()
    np.testing.assert_allclose(again.vertices, mesh.vertices * np.array([1, -1, -1]), atol=0.51 * extent / 65535)
    [raw] = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    stored = raw.vertex_normals / np.linalg.norm(raw.vertex_normals, axis=1, keepdims=True)
    cosines = (stored * vertex_normals(mesh) * [1, -1, -1]).sum(axis=1)
    assert cosines.min() > np.cos(np.radians(0.5))
    np.testing.assert_array_equal(again.faces, mesh.faces)
    assert (again.face_normals[:, 2] > 0).all()  # towards a viewer on the positive z axis
    assert (again.vertex_normals[:, 2] > 0).all()
    colours = again.visual.to_color().vertex_colors[:, :3]
    np.testing.assert_allclose(colours, 255 * photo().flatten(1).T, atol=0.51)
    material = again.visual.material
    assert (material.metallicFactor, material.roughnessFactor, material.doubleSided) == (0, 1, True)


def glb_parts(path):
    """Return the JSON and the binary part of a GLB file."""
    content = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", content[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def attribute(tree, content, name):
    """Return an attribute of a GLB file's mesh, as the specification of glTF lays it out."""
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"][name]]
    view = tree["bufferViews"][accessor["bufferView"]]
    dtype = {5120: "i1", 5121: "u1", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
    channels = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor["type"]]
    assert view["byteOffset"] % 4 == 0
    size = np.dtype(dtype).itemsize
    stride = view.get("byteStride", channels * size)
    assert stride % 4 == 0
    return np.ndarray((accessor["count"], channels), dtype, content, view["byteOffset"], (stride, size)), accessor


def test_glb_mesh_has_positions_of_16_bits(tmp_path):
    write_mesh(tmp_path / "m.glb", photo(), bumpy(), CAMERA)
    tree, content = glb_parts(tmp_path / "m.glb")
    assert tree["extensionsRequired"] == tree["extensionsUsed"] == ["KHR_mesh_quantization"]
    positions, accessor = attribute(tree, content, "POSITION")
    assert positions.dtype == np.uint16
    assert (accessor["min"], accessor["max"]) == (positions.min(0).tolist(), positions.max(0).tolist())
    assert attribute(tree, content, "NORMAL")[1]["normalized"] is True


def test_glb_mesh_from_near_to_far_has_positions_as_floats(tmp_path):
    points = np.array([[0, 0, 0.1], [0.01, 0, 0.1], [0, 50, 100.0]])
    normals, corners = np.tile([0.0, 0, -1], (3, 1)), np.array([[0, 2, 1]])
    write_glb(tmp_path / "m.glb", points, normals, corners, np.zeros((3, 2)), np.zeros((4, 4, 3), np.uint8))
    tree, content = glb_parts(tmp_path / "m.glb")
    np.testing.assert_allclose(attribute(tree, content, "POSITION")[0], points * [1, -1, -1], rtol=1e-6)
    assert set(tree["nodes"][0]) == {"mesh"}


@pytest.mark.parametrize(
    ("up", "turn"),
    [("", np.diag([1, -1, -1])), ("y", np.eye(3)), ("z", np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))],
)
def test_glb_mesh_with_colours_of_points_has_y_up(tmp_path, up, turn):
    points, corners = np.array([[0, 0, 2.0], [1, 0, 2], [0, 3, 4]]), np.array([[0, 2, 1]])
    normals, colours = np.tile([0.0, 0.6, 0.8], (3, 1)), np.array([[255, 0, 128], [1, 10, 11], [40, 80, 200]], np.uint8)
    write_glb(tmp_path / "m.glb", points, normals, corners, colours=colours, up=up)
    tree, content = glb_parts(tmp_path / "m.glb")
    assert "images" not in tree
    linear, _ = attribute(tree, content, "COLOR_0")  # glTF has linear light, photos are sRGB (IEC 61966-2-1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.rint(255 * encoded), colours)
    mesh = trimesh.load(tmp_path / "m.glb", process=False, force="mesh", skip_materials=True)
    np.testing.assert_allclose(mesh.vertices, points @ turn.T, atol=1e-4)
    np.testing.assert_allclose(attribute(tree, content, "NORMAL")[0] / 127, normals @ turn.T, atol=0.01)
    assert np.abs(np.asarray(mesh.visual.vertex_colors)[:, :3] - 255 * linear).max() <= 1


def test_map_without_two_neighbours_is_refused_and_an_older_file_is_kept(tmp_path):
    depth = torch.full_like(wall(), torch.nan)
    depth[0, 3, 3] = 2
    (tmp_path / "m.glb").write_text("old")
    with pytest.raises(ValueError, match=r"m.glb: expected neighbours of known depth"):
        write_mesh(tmp_path / "m.glb", photo(), depth, CAMERA)
    assert (tmp_path / "m.glb").read_text() == "old"
    triangulate(depth, CAMERA, isolated=True)
    assert write_cloud(tmp_path / "c.ply", photo(), depth, CAMERA) == Written(1, 1)


@pytest.fixture
def stored(tmp_path):
    v, u = np.mgrid[:48, :64]
    rgb = torch.from_numpy(np.stack([u / 64, v / 48, 0 * u + 0.5])).float()
    depth = torch.linspace(1, 4, 12 * 16).reshape(1, 12, 16)
    depth[0, 3, 4] = torch.nan
    write_input(tmp_path / "input.npz", rgb, depth)
    return tmp_path / "input.npz", rgb, depth


def test_input_is_read_back(stored):
    path, rgb, depth = stored
    photo, read = read_input(path)
    np.testing.assert_array_equal(read, depth[0].numpy())
    assert photo.shape == (48, 64, 3)
    assert np.abs(photo - 255 * rgb.permute(1, 2, 0).numpy()).mean() < 2  # a JPEG, red first


def test_large_photos_are_stored_smaller(tmp_path):
    write_input(tmp_path / "input.npz", torch.rand(3, 30, 2 * LONGEST), torch.ones(1, 2, 2))
    assert read_input(tmp_path / "input.npz")[0].shape == (15, LONGEST, 3)


def views(path, rgb, depth):
    notes = write_stereo(path, rgb, depth, Camera(450, 40, 300, 300, 224.5, 19.5))
    return *np.split(read(path).astype(float), 2, axis=1), notes[0].detail


@pytest.mark.parametrize(("metres", "apart"), [(2.0, 0.063), (0.5, 0.025)])
def test_right_view_of_a_wall_is_shifted_by_focal_length_times_distance_over_depth(tmp_path, metres, apart):
    """Of the near wall 1/30 of the width, 15 pixels."""
    waves = [0.5 + 0.4 * np.sin((np.arange(450) + shift) / 5) for shift in (0, 300 * apart / metres)]
    rgb = torch.from_numpy(waves[0]).expand(3, 40, 450)
    left, right, detail = views(tmp_path / "a.jpg", rgb, torch.full((1, 40, 450), metres))
    assert detail == f"{1000 * apart:g} mm"
    np.testing.assert_allclose(left, np.broadcast_to(255 * waves[0][:, None], left.shape), atol=3)
    np.testing.assert_allclose(right[:, :432], np.broadcast_to(255 * waves[1][:432, None], (40, 432, 3)), atol=4)


def test_near_things_hide_others_and_what_they_uncover_is_background(tmp_path):
    depth, rgb = torch.full((1, 40, 450), 1e6), torch.zeros(3, 40, 450)
    rgb[1], depth[..., 200:280], rgb[:, :, 200:280] = 1, 300 * 0.063 / 15, torch.tensor([1.0, 0, 0])[:, None, None]
    depth[:, 5:9, 100:230] = torch.nan  # behind what is beside it: the background
    right = views(tmp_path / "a.jpg", rgb, depth)[1]
    red = (right[..., 0] > right[..., 1])[20:30]
    assert np.argwhere(red.all(0)).ravel().tolist() == [*range(185, 265)]
    assert red.any(0).sum() == 80
    assert (right[20:30, 268:, 1] > 220).all()


def test_rgbd_picture_has_inverse_depth_from_black_to_white_and_holes_are_as_far_as_what_is_behind_them(tmp_path):
    depth = torch.tensor([1.0, 1.0, torch.nan, torch.nan, 2.0, 4.0]).repeat_interleave(4).expand(1, 18, 24)
    write_rgbd_picture(tmp_path / "a.png", photo(), depth, CAMERA)
    picture = read(tmp_path / "a.png")
    np.testing.assert_allclose(picture[:, :24], 255 * photo().permute(1, 2, 0), atol=0.51)
    grey = np.repeat([255, 255, 85, 85, 85, 0], 4)
    np.testing.assert_array_equal(picture[:, 24:], np.broadcast_to(grey[:, None], (18, 24, 3)))
