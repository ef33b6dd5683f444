"""Sparse models of COLMAP: cameras, poses, lenses and points, binary and text."""

import json
import pickle
import struct

import captures
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dsr.cli import main
from dsr.geometry.camera import Camera, Lens
from dsr.io.captures.colmap import add_model, model_file
from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import Reading

WIDTH, HEIGHT, FRAMES = 64, 48, 3
F, CX, CY = 60.0, 33.0, 23.5
PRISM = (0.02, 3e-3, 1e-3, 2e-3, -1e-3, 2e-3, 3e-3, -2e-3)
MODELS = {
    "SIMPLE_PINHOLE": (0, (F, CX, CY), None),
    "PINHOLE": (1, (F, F + 1, CX, CY), None),
    "SIMPLE_RADIAL": (2, (F, CX, CY, 0.05), Lens("brown_conrady", (0.05, 0, 0, 0))),
    "RADIAL": (3, (F, CX, CY, 0.05, -0.01), Lens("brown_conrady", (0.05, -0.01, 0, 0))),
    "OPENCV": (4, (F, F + 1, CX, CY, 0.05, -0.01, 1e-3, 2e-3), Lens("brown_conrady", (0.05, -0.01, 1e-3, 2e-3))),
    "OPENCV_FISHEYE": (5, (F, F + 1, CX, CY, 0.02, 3e-3, 2e-3, 1e-3), Lens("kannala_brandt", (0.02, 3e-3, 2e-3, 1e-3))),
    "FULL_OPENCV": (6, (F, F + 1, CX, CY, *(1e-3 * k for k in range(1, 9))),
                    Lens("brown_conrady", tuple(1e-3 * k for k in range(1, 9)))),
    "SIMPLE_RADIAL_FISHEYE": (8, (F, CX, CY, 0.02), Lens("kannala_brandt", (0.02, 0, 0, 0))),
    "RADIAL_FISHEYE": (9, (F, CX, CY, 0.02, 3e-3), Lens("kannala_brandt", (0.02, 3e-3, 0, 0))),
    "THIN_PRISM_FISHEYE": (10, (F, F + 1, CX, CY, *PRISM), Lens("thin_prism_fisheye", PRISM)),
}  # fmt: skip


def pose(number):
    """Return the camera's place: camera to world, x right, y down, z forward."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec((0.02, 0.05 * number, -0.03)).as_matrix()
    matrix[:3, 3] = (0.1 * number, -0.02, 0.03)
    return matrix


def cloud():
    """Return points, (400, 3), in front of all cameras."""
    rng = np.random.default_rng(0)
    return np.column_stack((rng.uniform(-1.5, 1.5, 400), rng.uniform(-1, 1, 400), rng.uniform(2, 4, 400)))


def observations(number):
    """Return columns, rows and depths of the points that a pinhole camera shows, and their numbers."""
    own = np.linalg.inv(pose(number))
    x, y, z = (cloud() @ own[:3, :3].T + own[:3, 3]).T
    u, v = F * x / z + CX, F * y / z + CY
    seen = (u > 0) & (v > 0) & (u < WIDTH) & (v < HEIGHT)
    return u[seen], v[seen], z[seen], np.flatnonzero(seen)


def entries(number):
    own = np.linalg.inv(pose(number))
    x, y, z, w = Rotation.from_matrix(own[:3, :3]).as_quat()
    return (w, x, y, z), tuple(own[:3, 3])


def write_binary(folder, kind, names, points=True):
    """Write a model by the format's description, its images from last to first."""
    folder.mkdir(parents=True, exist_ok=True)
    number, numbers, _ = MODELS[kind]
    camera = struct.pack("<QiiQQ", 1, 7, number, WIDTH, HEIGHT) + struct.pack(f"<{len(numbers)}d", *numbers)
    (folder / "cameras.bin").write_bytes(camera)
    content = struct.pack("<Q", len(names))
    for place, name in reversed(list(enumerate(names))):
        quaternion, shift = entries(place)
        content += struct.pack("<I7dI", place + 1, *quaternion, *shift, 7) + name.encode() + b"\0"
        columns, rows, _, seen = observations(place)
        content += struct.pack("<Q", len(seen) + 1) + struct.pack("<ddQ", 1.0, 2.0, 2**64 - 1)
        content += b"".join(struct.pack("<ddQ", u, v, 10 + k) for u, v, k in zip(columns, rows, seen, strict=True))
    (folder / "images.bin").write_bytes(content)
    if points:
        content = struct.pack("<Q", 400)
        for k, point in enumerate(cloud()):
            track = struct.pack("<QII", 1, 1, k) if k % 2 else struct.pack("<Q", 0)
            content += struct.pack("<Q3d3Bd", 10 + k, *point, 1, 2, 3, 0.5) + track
        (folder / "points3D.bin").write_bytes(content)


def write_text(folder, kind, names, points=True):
    folder.mkdir(parents=True, exist_ok=True)
    _, numbers, _ = MODELS[kind]
    text = " ".join(map(repr, map(float, numbers)))
    (folder / "cameras.txt").write_text(f"# cameras\n7 {kind} {WIDTH} {HEIGHT} {text}\n")
    lines = ["# images"]
    for place, name in enumerate(names):
        quaternion, shift = entries(place)
        head = " ".join(f"{float(value):.17g}" for value in (*quaternion, *shift))
        columns, rows, _, seen = observations(place)
        reported = [f"{u:.17g} {v:.17g} {10 + k}" for u, v, k in zip(columns, rows, seen, strict=True)]
        lines += [f"{place + 1} {head} 7 {name}", " ".join([*reported, "1 2 -1"]) if points else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    if points:
        text = "".join(f"{10 + k} {x:.17g} {y:.17g} {z:.17g} 1 2 3 0.5 1 2\n" for k, (x, y, z) in enumerate(cloud()))
        (folder / "points3D.txt").write_text("# points\n" + text)


WRITERS = {"binary": write_binary, "text": write_text}


@pytest.fixture
def folder(tmp_path):
    """Photos and depth maps in millimetres of a quarter of the size."""
    for number in range(FRAMES):
        captures.save(tmp_path / "scan/images" / f"{number:03}.png", captures.photo(number))
        depth = np.full((HEIGHT // 4, WIDTH // 4), 2000 + number, np.uint16)
        captures.save(tmp_path / "scan/depth" / f"{number:03}.png", depth)
    return tmp_path / "scan"


NAMES = [f"{number:03}.png" for number in range(FRAMES)]


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("kind", MODELS)
def test_cameras_poses_and_lenses_are_those_of_the_model(folder, writer, kind):
    WRITERS[writer](folder / "sparse" / "0", kind, NAMES)
    found = find_pairs_of_folder(folder)
    assert any(str(fact).startswith("cameras and poses of COLMAP: 0/images.") for fact in found.assumptions)
    assert len(found.pairs) == FRAMES
    _, numbers, lens = MODELS[kind]
    fy = F + 1 if numbers[1] == F + 1 else F
    for number, pair in enumerate(pickle.loads(pickle.dumps(found.pairs))):
        geometry = pair.capture.geometry_of((HEIGHT, WIDTH))
        assert geometry.camera == Camera(WIDTH, HEIGHT, F, fy, CX - 0.5, CY - 0.5)
        np.testing.assert_allclose(geometry.pose, pose(number), atol=1e-12)
        assert geometry.lens == lens
    picture = read_picture(found.pairs[1], Reading())
    assert any("distortion of the photo is undone" in str(fact) for fact in picture.assumptions) == (lens is not None)
    np.testing.assert_allclose(picture.depth_lr[picture.depth_lr.isfinite()], 2.001)


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("place", [".", "sparse", "colmap/sparse/0"])
def test_points_are_the_depth_of_photos_without_maps(folder, writer, place):
    for path in (folder / "depth").iterdir():
        path.unlink()
    WRITERS[writer](folder / place, "SIMPLE_PINHOLE", NAMES)
    found = find_pairs_of_folder(folder)
    assert [pair.name for pair in found.pairs] == ["000", "001", "002"]
    for number, pair in enumerate(found.pairs):
        picture = read_picture(pair, Reading())
        columns, rows, z, seen = observations(number)
        height, width = picture.depth_lr.shape[-2:]
        assert len(seen) / 2 < height * width < 2 * len(seen)
        expected = np.full((height, width), np.inf)
        cells = (rows * height / HEIGHT).astype(int), (columns * width / WIDTH).astype(int)
        np.minimum.at(expected, cells, z)
        known = np.isfinite(expected)
        np.testing.assert_array_equal(picture.depth_lr[0].isfinite().numpy(), known)
        np.testing.assert_allclose(picture.depth_lr[0].numpy()[known], expected[known], rtol=1e-5)
        np.testing.assert_allclose(picture.pose, pose(number), atol=1e-9)


def test_model_of_a_recording_leaves_it_its_depth_camera_and_its_times(tmp_path):
    photos = [captures.photo(number).repeat(10, 0).repeat(10, 1) for number in range(FRAMES)]
    depths = [np.full((288, 320), 1000, np.uint16)] * FRAMES
    found = find_pairs_of_folder(captures.kinect(tmp_path / "scan.mkv", photos, depths))
    write_binary(tmp_path / "model", "OPENCV", [f"{pair.rgb.name}.jpg" for pair in found.pairs])
    joined = add_model(found, model_file(tmp_path / "model"))
    size = photos[0].shape[:2]
    for number, (before, after) in enumerate(zip(found.pairs, pickle.loads(pickle.dumps(joined.pairs)), strict=True)):
        own, geometry = before.capture.geometry_of(size), after.capture.geometry_of(size)
        assert geometry.rig is not None
        np.testing.assert_array_equal(geometry.rig.transform, own.rig.transform)
        assert (geometry.rig.camera, geometry.rig.lens) == (own.rig.camera, own.rig.lens)
        assert after.time == before.time is not None
        np.testing.assert_allclose(geometry.pose, pose(number), atol=1e-12)
        assert geometry.lens == MODELS["OPENCV"][2]
        assert after.capture.record() != before.capture.record()


def test_points_that_the_model_lacks_are_none_of_a_photo(folder):
    """A model of the points with even numbers, and one of none."""
    for path in (folder / "depth").iterdir():
        path.unlink()
    write_text(folder, "SIMPLE_PINHOLE", NAMES)
    points = folder / "points3D.txt"
    pair = find_pairs_of_folder(folder).pairs[0]
    points.write_text("".join(line + "\n" for line in points.read_text().splitlines()[1::2]))
    _, _, z, seen = observations(0)
    found = pair.capture.depth.read()
    np.testing.assert_allclose(np.nanmin(found), z[seen % 2 == 0].min(), rtol=1e-6)
    assert 0 < np.isfinite(found).sum() <= (seen % 2 == 0).sum()
    points.write_text("# none\n")
    assert np.isnan(pair.capture.depth.read()).all()


@pytest.mark.parametrize("outside", ["{}/000.png", "../{}/000.png"])
def test_photos_that_a_model_names_outside_of_its_folder_are_not_read(folder, tmp_path, outside):
    other = (folder / "images").rename(tmp_path / "other")
    name = outside.format(other if outside.startswith("{") else "other")
    write_binary(folder / "sparse/0", "PINHOLE", [name, name, name])
    with pytest.raises(ValueError, match="found no pair"):
        find_pairs_of_folder(folder)


@pytest.mark.parametrize("given", ["model", "model/sparse/0", "model/sparse/0/images.bin"])
def test_model_elsewhere_is_given_by_poses(folder, tmp_path, given, capsys):
    write_binary(tmp_path / "model/sparse/0", "OPENCV", ["shots/000.jpg", "shots/001.jpg", "shots/002.jpg"])
    command = ("upsample", folder, "--poses", tmp_path / given, "--method", "bicubic", "--only", "nerfstudio")
    assert main([*map(str, command), "-o", str(tmp_path / "out")]) == 0
    assert "cameras and poses of COLMAP" in capsys.readouterr().out
    reported = json.loads((tmp_path / "out/001/info.json").read_text())
    np.testing.assert_allclose(reported["pose"], pose(1), atol=1e-9)
    assert [reported["camera"][name] for name in ("fx", "fy", "cx", "cy")] == [F, F + 1, CX - 0.5, CY - 0.5]
    assert reported["inputs"]["poses"]["file"] == "images.bin"
    assert len(json.loads((tmp_path / "out/transforms.json").read_text())["frames"]) == FRAMES


def test_photo_without_an_image_has_no_pose_and_a_model_of_other_photos_is_none(folder, tmp_path, capsys):
    write_text(folder / "sparse/0", "PINHOLE", NAMES[:1], points=False)
    pairs = find_pairs_of_folder(folder).pairs
    assert [pair.capture is None for pair in pairs] == [False, True, True]
    write_text(folder / "sparse/0", "PINHOLE", ["else.png"])
    found = find_pairs_of_folder(folder)
    assert any("none of these names" in str(fact) for fact in found.assumptions)
    command = ("upsample", folder, "--poses", folder / "sparse/0", "-o", tmp_path / "out")
    assert main([*map(str, command)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "images.txt: expected images named as the photos, such as 000.png" in line
    assert not (tmp_path / "out").exists()


def cut(path):
    path.write_bytes(path.read_bytes()[:-5])


def patch(path, place, layout, value):
    content = bytearray(path.read_bytes())
    struct.pack_into(layout, content, place, value)
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("cameras.bin", cut),
        ("images.bin", cut),
        ("cameras.bin", lambda path: patch(path, 0, "<Q", 2**60)),
        ("images.bin", lambda path: patch(path, 0, "<Q", 2**60)),
        ("cameras.bin", lambda path: patch(path, 12, "<i", 99)),
        ("cameras.bin", lambda path: patch(path, 16, "<Q", 0)),
        ("images.bin", lambda path: path.write_bytes(path.read_bytes()[:80])),
        ("images.bin", lambda path: patch(path, 68, "<I", 3)),
        ("cameras.txt", lambda path: path.write_text("1 PINHOLE 64 48 60 60 32\n")),
        ("cameras.txt", lambda path: path.write_text("1 FOV 64 48 60 60 32 24 1\n")),
        ("cameras.txt", lambda path: path.write_text("PINHOLE\n")),
        ("images.txt", lambda path: path.write_text("1 1 0 0 0 0 0 0 7\n")),
        ("images.txt", lambda path: path.write_text("1 1 0 0 0 0 0 0 7 000.png\n1 2\n")),
        ("images.txt", lambda path: path.write_text("1 1 0 0 0 0 0 0 7 000.png\nno numbers here\n")),
        ("images.txt", lambda path: path.write_text("1 1 0 0 0 0 0 0 7 000.png\n1 2 inf\n")),
    ],
)
def test_damaged_model_is_one_line_that_names_the_file(folder, tmp_path, capsys, name, damage):
    (write_text if name.endswith("txt") else write_binary)(folder / "sparse/0", "PINHOLE", NAMES)
    damage(folder / "sparse/0" / name)
    assert main(["upsample", str(folder), "--method", "bicubic", "-o", str(tmp_path / "out")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert name in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("place", "value"), [(12, 5.0), (12, np.nan), (44, np.inf)])
def test_pose_that_is_none_and_points_that_are_damaged_concern_a_frame(folder, tmp_path, capsys, place, value):
    write_binary(folder / "sparse/0", "PINHOLE", NAMES)
    patch(folder / "sparse/0/images.bin", place, "<d", value)  # of the first one that is stored, the last photo
    command = ["upsample", str(folder), "--method", "bicubic", "--only", "depth", "-o", str(tmp_path / "out")]
    assert main(command) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "images.bin: image '002.png'" in line
    assert (tmp_path / "out/000/info.json").is_file()
    write_binary(folder / "sparse/0", "PINHOLE", NAMES)
    for path in (folder / "depth").iterdir():
        path.unlink()
    cut(folder / "sparse/0/points3D.bin")
    assert main([*command[:-1], str(tmp_path / "more")]) == 2
    assert all("points3D.bin" in line for line in capsys.readouterr().err.splitlines())
