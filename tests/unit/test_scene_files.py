"""Frames as other programs read them: axes, units, intrinsics and poses, read back by code of their own."""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from dsr.geometry.camera import Camera
from dsr.io.depth_files import write_depth_file
from dsr.io.scene_files import (
    Frame,
    to_millimetres,
    write_open3d,
    write_rerun,
    write_rgbd,
    write_splatting,
    write_transforms,
)

CAMERA = Camera(12, 8, 10.0, 11.0, 5.25, 3.5)
POSE = np.array([[0.0, 0.0, 1.0, 0.5], [1.0, 0.0, 0.0, -2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]])


def depth_map(number=0):
    rows, columns = np.mgrid[0:8, 0:12]
    depth = (1.5 + 0.01 * rows + 0.02 * columns + number).astype(np.float32)
    depth[2, 3:5] = np.nan
    return depth


@pytest.fixture
def make(tmp_path):
    """Return a function that writes a frame's folder, and returns the frame."""

    def frame(number, pose=POSE, camera=CAMERA):
        folder = tmp_path / "out" / f"room/{number:03}"
        rgb = torch.zeros(3, camera.height, camera.width)
        rgb[0], rgb[2, 0] = number / 10, 1
        depth = torch.from_numpy(depth_map(number))[None]
        assert write_rgbd(folder / "rgbd", rgb, depth, camera) == []
        write_depth_file(folder / "depth_metres.tiff", depth[0].numpy())
        name = f"room/{number:03}"
        return Frame(name, camera, pose, folder / "rgbd" / "color.png", folder / "depth_metres.tiff")

    return frame


def test_rgbd_has_millimetres_and_column_major_intrinsics(make):
    folder = make(1).colour.parent
    values = np.array(Image.open(folder / "depth.png"))
    assert values.dtype == np.uint16
    np.testing.assert_array_equal(values, np.nan_to_num(np.round(1000 * depth_map(1).astype(float)), nan=0))
    colours = np.array(Image.open(folder / "color.png"))
    assert colours.shape == (8, 12, 3)
    assert colours[0, 0].tolist() == [26, 0, 255]
    entries = json.loads((folder / "intrinsic.json").read_text())
    matrix = np.array(entries["intrinsic_matrix"]).reshape(3, 3).T
    assert (entries["width"], entries["height"]) == (12, 8)
    np.testing.assert_array_equal(matrix, [[10, 0, 5.25], [0, 11, 3.5], [0, 0, 1]])


def test_depth_beyond_sixteen_bits_is_a_hole_and_said(tmp_path):
    values, lost = to_millimetres(np.array([[65.535, 65.536, np.nan, 0.0004]]))
    assert (values.tolist(), lost) == ([[65535, 0, 0, 0]], 1)
    [fact] = write_rgbd(tmp_path / "rgbd", torch.zeros(3, 8, 12), torch.full((1, 8, 12), 70.0), CAMERA)
    assert str(fact) == "rgbd/depth.png: what is beyond 65.5 m is written as a hole (96 pixels)"


def read_as_nerfstudio(path, moved, scale):
    """Return frames and points as nerfstudio's parser has them after it has turned, moved and scaled the world.

    A frame: name of the photo, its pixels, depth, intrinsics fx fy cx cy, and camera to world, of OpenGL's axes.
    """
    entries, folder = json.loads(path.read_text()), path.parent
    assert entries["depth_unit_scale_factor"] == 0.001  # the parser's own default
    frames = []
    for entry in sorted(entries["frames"], key=lambda entry: entry["file_path"]):
        camera = entries if "fl_x" in entries else entry
        depth = cv2.imread(str(folder / entry["depth_file_path"]), cv2.IMREAD_ANYDEPTH).astype(np.float64) * 1e-3
        pose = moved @ np.array(entry["transform_matrix"])
        pose[:3, 3] *= scale
        photo = cv2.imread(str(folder / entry["file_path"]))
        mask = np.array(Image.open(folder / entry["mask_path"]))
        assert photo.shape[:2] == depth.shape == mask.shape == (camera["h"], camera["w"])
        np.testing.assert_array_equal(mask.astype(bool), depth > 0)
        numbers = [camera[name] for name in ("fl_x", "fl_y", "cx", "cy")]
        frames.append((Path(entry["file_path"]).name, photo[..., ::-1], depth * scale, numbers, pose))
    cloud = trimesh.load(folder / entries["ply_file_path"])
    ways = [moved @ np.vstack((entries["applied_transform"], [0, 0, 0, 1])), moved]  # of versions up to and since 1.1
    clouds = [scale * (np.asarray(cloud.vertices) @ way[:3, :3].T + way[:3, 3]) for way in ways]
    np.testing.assert_allclose(*clouds, atol=1e-6)
    return frames, clouds[0], np.asarray(cloud.colors)[:, :3]


@pytest.mark.parametrize("second", [CAMERA, Camera(12, 8, 20.0, 21.0, 5.25, 3.5)])
def test_transforms_are_read_as_nerfstudio_reads_them(make, tmp_path, second):
    frames = [make(1, camera=second), make(0)]
    path = tmp_path / "out" / "transforms.json"
    files = write_transforms(path, frames)
    assert {file.relative_to(path.parent).as_posix() for file in files} == {
        "transforms.json", "nerfstudio/points.ply", *(
            f"{kind}/room_00{number}.png" for number in (0, 1)
            for kind in ("nerfstudio/images", "nerfstudio/depths", "nerfstudio/masks", "normals_from_pretrain"))
    }  # fmt: skip
    moved = np.block([[Rotation.from_rotvec((0.3, -1.2, 0.4)).as_matrix(), np.array([[4.0], [-1], [2]])], [0, 0, 0, 1]])
    read, points, colours = read_as_nerfstudio(path, moved, 0.25)
    assert [name for name, *_ in read] == ["room_000.png", "room_001.png"]
    known = sum(int(np.isfinite(depth_map(number)).sum()) for number in (0, 1))
    assert len(points) == known
    found = 0
    for _, photo, depth, (fx, fy, cx, cy), pose in read:
        seen = (points - pose[:3, 3]) @ pose[:3, :3]  # OpenGL: x right, y up, z backwards
        z = -seen[:, 2]
        column, row = cx + fx * seen[:, 0] / z - 0.5, cy - fy * seen[:, 1] / z - 0.5
        inside = (np.abs(column - np.rint(column)) < 1e-3) & (np.abs(row - np.rint(row)) < 1e-3) & (z > 0)
        inside &= (column > -0.5) & (column < 11.5) & (row > -0.5) & (row < 7.5)
        u, v = np.rint(column[inside]).astype(int), np.rint(row[inside]).astype(int)
        own = np.abs(depth[v, u] - z[inside]) < 0.25 * 1e-3
        found += int(own.sum())
        np.testing.assert_array_equal(photo[v, u][own], colours[inside][own])
    assert found == known
    first = json.loads(path.read_text())
    np.testing.assert_allclose(np.array(first["frames"][0]["transform_matrix"]) @ np.diag([1, -1, -1, 1]), POSE)
    assert ("fl_x" in first) == (second == CAMERA)


def test_open3d_folder_has_colour_depth_intrinsics_and_trajectory(make, tmp_path):
    frames = [make(0), make(1)]
    files = write_open3d(tmp_path / "o", frames)
    assert {file.relative_to(tmp_path / "o").as_posix() for file in files} == {
        "color/room_000.png", "color/room_001.png", "depth/room_000.png", "depth/room_001.png",
        "intrinsic.json", "trajectory.log",
    }  # fmt: skip
    assert all(file.is_file() for file in files)
    for frame in frames:
        for kind, original in (("color", "color.png"), ("depth", "depth.png")):
            ours = cv2.imread(str(tmp_path / "o" / kind / f"{frame.stem}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(ours, cv2.imread(str(frame.colour.with_name(original)), cv2.IMREAD_UNCHANGED))
    lines = (tmp_path / "o" / "trajectory.log").read_text().splitlines()
    assert lines[0::5] == ["0 0 1", "1 1 2"]
    np.testing.assert_array_equal(np.loadtxt(lines[6:10]), POSE)


def test_splatting_depth_is_inverse_depth_after_scale_and_offset(make, tmp_path):
    frames = [make(0), make(4)]
    write_splatting(tmp_path / "g", frames)
    parameters = json.loads((tmp_path / "g/sparse/0/depth_params.json").read_text())
    assert len({entry["scale"] for entry in parameters.values()}) == 1
    for frame in frames:
        values = cv2.imread(str(tmp_path / "g/depths" / f"{frame.stem}.png"), cv2.IMREAD_UNCHANGED)
        assert values.dtype == np.uint16
        inverse = values / 65536 * parameters[frame.stem]["scale"] + parameters[frame.stem]["offset"]
        expected = np.nan_to_num(1 / frame.read_depth(), nan=0)
        np.testing.assert_allclose(inverse, expected, atol=1e-5)
    assert cv2.imread(str(tmp_path / "g/depths/room_000.png"), cv2.IMREAD_UNCHANGED).max() == 65535


def test_normals_are_read_as_dn_splatter_reads_them(make, tmp_path):
    write_transforms(tmp_path / "out" / "transforms.json", [make(0)])
    entry = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"][0]
    assert entry["normal_file_path"].startswith("normals_from_pretrain/")
    read = np.array(Image.open(tmp_path / "out" / entry["normal_file_path"]))[..., :3] / 255.0
    normals = (2 * read - 1) * [1, -1, -1]  # from OpenGL's axes to OpenCV's
    points = CAMERA.rays().numpy() * depth_map()
    across, down = points[:, 5, 6] - points[:, 5, 5], points[:, 6, 5] - points[:, 5, 5]
    expected = np.cross(down, across)  # towards the camera
    np.testing.assert_allclose(normals[5, 5], expected / np.linalg.norm(expected), atol=0.01)


def test_frames_have_masks_of_their_holes_if_there_are_any(make, tmp_path):
    frames = [make(0), make(1)]
    write_depth_file(frames[1].depth, np.nan_to_num(depth_map(1), nan=2.0))
    write_splatting(tmp_path / "some", frames)
    for frame in frames:
        mask = np.array(Image.open(tmp_path / "some" / "masks" / f"{frame.stem}.png"))
        np.testing.assert_array_equal(mask, np.where(np.isnan(frame.read_depth()), 0, 255))
    files = [*write_splatting(tmp_path / "g", frames[1:]), *write_transforms(tmp_path / "t.json", frames[1:])]
    assert not [path for path in files if "masks" in path.parts]
    assert "mask_path" not in (tmp_path / "t.json").read_text()


def read_colmap(folder):
    """Return cameras, images and points as ``scene/colmap_loader.py`` of graphdeco's program unpacks them."""

    def take(form):
        return struct.unpack(f"<{form}", file.read(struct.calcsize(f"<{form}")))

    def several(form):
        return [take(form) for _ in range(*take("Q"))]

    readers = {
        "cameras": lambda: take("iiQQ4d"),
        "images": lambda: (take("i7di"), b"".join(iter(lambda: file.read(1), b"\0")).decode(), several("ddq")),
        "points3D": lambda: (take("Q3d3Bd"), several("ii")),
    }
    found = []
    for name, read in readers.items():
        with (folder / f"{name}.bin").open("rb") as file:
            found.append([read() for _ in range(*take("Q"))])
            assert not file.read()
    return found


def test_splatting_scene_is_a_colmap_model_of_the_same_points(make, tmp_path):
    write_splatting(tmp_path, [make(0)])
    [camera], [(numbers, name, observed)], points = read_colmap(tmp_path / "sparse" / "0")
    assert camera == (1, 1, 12, 8, 10, 11, 5.75, 4)  # PINHOLE
    assert (numbers[0], numbers[8], name) == (1, 1, "room_000.png")
    w, x, y, z, *shift = numbers[1:8]
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    assert len(points) == 8 * 12 - 2
    seen = np.array([point[1:4] for point, _ in points]) @ turn.T + shift
    pixels = seen[:, :2] / seen[:, 2:] * (10, 11) + (5.75, 4)
    rows, columns = np.nonzero(np.isfinite(depth_map()))
    expected = np.stack((columns, rows), axis=1) + 0.5
    np.testing.assert_allclose(pixels, expected, atol=1e-5)
    assert points[0][0][4:7] == (0, 0, 255)
    np.testing.assert_allclose([each[:2] for each in observed], expected, atol=1e-5)
    assert [each[2] for each in observed] == [point[0] for point, _ in points]
    assert [track for _, track in points] == [[(1, place)] for place in range(len(points))]


@pytest.fixture
def walls(make, tmp_path):
    """Three frames of a wall at 2 m, by cameras beside each other; the first has a floating pixel in the middle."""
    frames, depth, error = [], np.full((3, 8, 12), 2, np.float32), np.full((3, 8, 12), 0.01)
    depth[0, 4, 8], error[2, 0] = 1, 0.1
    for number in range(3):
        pose = np.eye(4)
        pose[0, 3] = 0.2 * number
        frames.append(replace(make(number, pose), errors=tmp_path / f"{number}.npz"))
        write_depth_file(frames[-1].depth, depth[number])
        np.savez(frames[-1].errors, depth_error=error[number], angle_error=error[number])
    return frames


def test_points_are_those_that_frames_agree_on_and_are_certain_of(walls, tmp_path):
    write_splatting(tmp_path / "g", walls)
    _, images, points = read_colmap(tmp_path / "g/sparse/0")
    places = np.array([point[1:4] for point, _ in points])
    assert len(places) == 3 * 8 * 12 - 1 - 12  # without the floating pixel, and an uncertain row
    np.testing.assert_allclose(places[:, 2], 2)
    for (number, *_), track in points:
        for image, place in track:
            assert images[image - 1][2][place][2] == number
    assert {tuple(image for image, _ in track) for _, track in points} >= {(1,), (1, 2), (1, 2, 3)}
    write_splatting(tmp_path / "two", walls[:2])  # where one stands against one
    assert len(read_colmap(tmp_path / "two/sparse/0")[2]) == 2 * 8 * 12


def test_initial_gaussians_are_discs_on_the_surface(make, tmp_path):
    frame, depth = make(0), (2 / (1 + CAMERA.rays()[0].numpy())).astype(np.float32)  # the plane x + z = 2
    write_depth_file(frame.depth, depth)
    errors = np.where(np.arange(12) < 6, 0.25, 5e-4) * np.ones((8, 1))
    np.savez(tmp_path / "e.npz", depth_error=errors, angle_error=errors)
    write_splatting(tmp_path, [replace(frame, errors=tmp_path / "e.npz", max_error=1.0)])
    raw = trimesh.load(tmp_path / "gaussians.ply").metadata["_ply_raw"]["vertex"]
    several = {"f_dc": 3, "f_rest": 45, "opacity": 0, "scale": 3, "rot": 4}
    names = [f"{name}_{n}" if count else name for name, count in several.items() for n in range(count or 1)]
    assert list(raw["properties"]) == ["x", "y", "z", "nx", "ny", "nz", *names]
    values = np.stack([raw["data"][name].ravel() for name in raw["properties"]], axis=1).astype(float)
    assert values.shape == (96, 62)
    inward = POSE[:3, :3] @ [1, 0, 1] / np.sqrt(2)
    np.testing.assert_allclose(values[:, 3:6], np.tile(-inward, (96, 1)), atol=1e-5)
    colours = 0.5 + 0.28209479177387814 * values[:, 6:9]
    np.testing.assert_allclose(colours, frame.read_colour().reshape(-1, 3) / 255, atol=1e-6)
    assert not values[:, 9:54].any()
    scales, turns = np.exp(values[:, 55:58]), Rotation.from_quat(values[:, [59, 60, 61, 58]]).as_matrix()
    np.testing.assert_allclose(turns[:, :, 2], values[:, 3:6], atol=1e-5)
    # on a small plane through the middle, a pixel's square is as wide as z / f and longer by 1 / cosine
    middle = 3 * 12 + 5
    np.testing.assert_allclose(sorted(scales[middle]), [0.1 * 2 / 11, 2 / 11, 2 / 10 * np.sqrt(2)], rtol=0.06)
    opacity = 1 / (1 + np.exp(-values[:, 54])).reshape(8, 12)
    np.testing.assert_allclose(opacity[:, 6:], 0.99, atol=1e-6)
    width = np.sort(scales, axis=1)[:, 1].reshape(8, 12)[3, 2]
    assert opacity[3, 2] == pytest.approx(math.erf(width / 0.25 / math.sqrt(math.pi)), rel=1e-4)


def test_rerun_recording_is_read_back(make, tmp_path):
    """As rerun reads it: columns by entity and name."""
    chunk = pytest.importorskip("rerun.chunk", reason="pip install -e '.[rerun]'")
    path, columns = tmp_path / "scene.rrd", {}
    assert write_rerun(path, [make(0), make(1, pose=None)]) == [path]
    for part in chunk.RrdReader(str(path)).stream():
        batch = part.to_record_batch()
        for name in batch.schema.names:
            columns.setdefault((part.entity_path, name), []).extend(batch.column(name).to_pylist())
    matrices = np.array(columns["/camera", "Pinhole:image_from_camera"]).reshape(2, 3, 3)
    np.testing.assert_allclose(matrices[0].T, [[10, 0, 5.75], [0, 11, 4], [0, 0, 1]])
    shifts = np.array(columns["/camera", "Transform3D:translation"]).reshape(2, 3)
    np.testing.assert_allclose(shifts, [POSE[:3, 3], [0, 0, 0]])
    turns = np.array(columns["/camera", "Transform3D:mat3x3"]).reshape(2, 3, 3)
    np.testing.assert_allclose(turns[0].T, POSE[:3, :3])
    meters = np.array(columns["/camera/depth", "EncodedDepthImage:meter"]).ravel()
    for number, [blob] in enumerate(columns["/camera/depth", "EncodedDepthImage:blob"]):
        values = cv2.imdecode(np.frombuffer(bytes(blob), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(values / meters[number], np.nan_to_num(depth_map(number)), atol=5.1e-4)
    for number, [blob] in enumerate(columns["/camera/rgb", "EncodedImage:blob"]):
        photo = cv2.imdecode(np.frombuffer(bytes(blob), np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_allclose(photo[4:, :, 2], 255 * number / 10, atol=4)
    assert columns["/camera/depth", "frame"] == [0, 1]


def test_damaged_depth_of_a_frame_is_refused(make):
    frame = make(0)
    write_depth_file(frame.depth, np.zeros((2, 2), np.float32))
    with pytest.raises(ValueError, match=r"expected depth of 12 x 8 pixels \(width x height\), got 2 x 2"):
        frame.read_depth()
