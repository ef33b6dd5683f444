"""``dsr upsample`` on rigs and sequences, and ``dsr fuse``: what a user gets, and every refusal."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from small_frames import in_text, walk, write_recording
from upsampling import info, refused_line, upsample

import dsr
from dsr.cli import main
from dsr.geometry.camera import Camera
from dsr.inference import Steady
from dsr.io.depth_files import read_depth_file
from dsr.metrics.temporal import flicker, opw, rsd

CAMERA = Camera.centred(96, 72, 90.0)
DEPTH_ONLY = ("--method", "bicubic", "--only", "depth")
COLOURS = np.array([[200, 60, 60], [60, 120, 200]], np.uint8)


def world(camera, right=0.0):
    """Return photo and depth of a box before a wall, from a camera that is moved to the right; metres."""
    rays = camera.rays().numpy()
    x, y = 1.2 * rays[0] + right, 1.2 * rays[1]
    inside = (np.abs(x) < 0.3) & (np.abs(y) < 0.2)
    return COLOURS[inside.astype(int)], np.where(inside, 1.2, 2.0)


def pose(right):
    matrix = np.eye(4)
    matrix[0, 3] = right
    return matrix


def text(matrix):
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in matrix) + "\n"


def camera_json(camera):
    return json.dumps({name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")})


def write_capture(folder, apart):
    """Write five frames with noise, from cameras that far apart."""
    rng = np.random.default_rng(0)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for number in range(5):
        photo, depth = world(CAMERA, apart * number)
        low = depth.reshape(36, 2, 48, 2).mean((1, 3)) * (1 + 0.01 * rng.standard_normal((36, 48)))
        Image.fromarray(photo).save(folder / "rgb" / f"{number:03}.png")
        cv2.imwrite(str(folder / "depth" / f"{number:03}.png"), np.round(1000 * low).astype(np.uint16))
    (folder / "camera.json").write_text(camera_json(CAMERA))
    return folder


@pytest.fixture
def capture(tmp_path):
    """Frames from cameras 4 cm apart, and their poses."""
    (tmp_path / "poses.txt").write_text("".join(text(pose(0.04 * number)) for number in range(5)))
    return write_capture(tmp_path / "capture", 0.04)


# a depth camera elsewhere


@pytest.fixture
def rig(tmp_path):
    """A photo, and the depth map of a camera 10 cm to its left with another focal length."""
    sensor = Camera(80, 64, 70.0, 70.0, 40.0, 31.0)
    Image.fromarray(world(CAMERA)[0]).save(tmp_path / "photo.png")
    np.save(tmp_path / "depth.npy", world(sensor, -0.1)[1])
    (tmp_path / "ir.json").write_text(camera_json(sensor))
    (tmp_path / "photo.json").write_text(camera_json(CAMERA))
    (tmp_path / "move.txt").write_text(text(pose(-0.1)))
    return tmp_path


def with_rig(folder, *more):
    files = ("--rgb", folder / "photo.png", "--depth", folder / "depth.npy", "--camera", folder / "photo.json")
    rig = ("--depth-camera", folder / "ir.json", "--extrinsics", folder / "move.txt")
    return upsample(*files, *rig, *DEPTH_ONLY, "-o", folder / "out", *more)


def test_rig_gives_depth_in_the_photos_view(rig, capsys):
    assert with_rig(rig, "--fill", "none") == 0
    assert "the depth map is warped into the photo's view (75 x 56, " in capsys.readouterr().out
    depth, truth = np.load(rig / "out" / "depth.npy"), world(CAMERA)[1]
    known = np.isfinite(depth)
    assert 0.75 < known.mean() < 0.99  # the sensor does not see all
    assert (np.abs(depth - truth)[known] < 0.02).mean() > 0.88  # all but the steps, which bicubic blurs
    assert {"depth_camera", "extrinsics"} <= info(rig / "out")["inputs"].keys()


def test_extrinsics_of_a_camera_that_sees_something_else_are_refused(rig, capsys):
    (rig / "move.txt").write_text(text(pose(-9.0)))
    assert "--extrinsics: " in refused_line(capsys, with_rig(rig))
    assert not (rig / "out").exists()


# registration


@pytest.fixture
def apart(tmp_path):
    """A photo of many boxes, and a depth map that lies 6 pixels beside it."""
    rng = np.random.default_rng(1)
    depth, photo = np.full((240, 320), 3.0), np.full((240, 320, 3), 110.0)
    for near in np.linspace(2.5, 1, 16):
        top, left, height, width = rng.integers((0, 0, 20, 20), (200, 280, 60, 60))
        depth[top : top + height, left : left + width] = near
        photo[top : top + height, left : left + width] = rng.integers(30, 220, 3)
    photo = (photo + 3 * rng.standard_normal(photo.shape)).clip(0, 255).astype(np.uint8)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    np.save(tmp_path / "depth.npy", np.roll(depth, (4, -6), (0, 1)))
    return tmp_path, depth


def test_displaced_pair_is_warned_of_and_register_cures_it(apart, capsys):
    folder, depth = apart
    files = ("--rgb", folder / "photo.png", "--depth", folder / "depth.npy", "--fov", "60", *DEPTH_ONLY)
    files = (*files, "--fill", "none", "--method", "bilateral")
    assert upsample(*files, "-o", folder / "out") == 0
    [warning] = info(folder / "out")["warnings"]
    assert warning["code"] == "edges-beside"
    assert upsample(*files, "--register", "-o", folder / "cured") == 0
    assert "(by 6.0 px to the right, 4.0 px up)" in capsys.readouterr().out
    result = np.load(folder / "cured" / "depth.npy")
    inner = (slice(8, -8), slice(8, -8))
    assert (np.abs(result - depth)[inner] < 0.05).mean() > 0.97
    assert info(folder / "cured")["settings"]["register"] is True


# sequences


def test_neighbours_lower_the_noise_and_keep_the_pose(capture):
    poses = ("--poses", capture.parent / "poses.txt")
    assert upsample(capture, *poses, *DEPTH_ONLY, "-o", capture.parent / "one") == 0
    assert upsample(capture, *poses, "--neighbours", "4", *DEPTH_ONLY, "-o", capture.parent / "five") == 0
    truth = world(CAMERA, 0.08)[1]
    noise = {
        name: np.std((read_depth_file(capture.parent / name / "002" / "depth_metres.tiff") - truth)[5:15, 20:-20])
        for name in ("one", "five")
    }
    assert noise["five"] < 0.55 * noise["one"]
    about = info(capture.parent / "five" / "002")
    assert about["pose"] == pose(0.08).tolist()
    assert about["settings"]["neighbours"] == 4
    assert {"poses", "neighbour_1_depth", "neighbour_4_depth"} <= about["inputs"].keys()


def test_broken_neighbour_does_not_stop_the_others_and_a_changed_one_is_noticed(capture, capsys):
    broken, whole = capture.parent / "broken", capture.parent / "whole"
    command = (capture, "--poses", capture.parent / "poses.txt", "--neighbours", "2", *DEPTH_ONLY, "-o")
    content = (capture / "depth" / "003.png").read_bytes()
    (capture / "depth" / "003.png").write_bytes(b"\x89PNG broken")
    assert "003" in refused_line(capsys, upsample(*command, broken))
    assert sorted(path.parent.name for path in broken.glob("*/depth.png")) == ["000", "001", "002", "004"]
    (capture / "depth" / "003.png").write_bytes(content)
    assert upsample(*command, whole) == 0
    capsys.readouterr()
    assert upsample(*command, whole) == 0
    assert "5 complete already" in capsys.readouterr().out
    depth = cv2.imread(str(capture / "depth" / "000.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(capture / "depth" / "000.png"), depth + 1)
    assert upsample(*command, whole) == 2
    outcome = capsys.readouterr()
    assert all(f"{name}: holds a result of other inputs" in outcome.err for name in ("000", "001"))
    assert "3 complete already" in outcome.out  # the others do not depend on frame 000


def test_neighbours_without_poses_are_refused(capture, capsys):
    code = upsample(capture, "--neighbours", "2", *DEPTH_ONLY, "-o", capture.parent / "out")
    assert "expected a pose for each frame" in refused_line(capsys, code)


# a camera that stands still


@pytest.fixture
def still(tmp_path):
    return write_capture(tmp_path / "still", 0)


STEADY = ("--method", "bicubic", "--fill", "none", "--only", "depth,confidence")


def depths(folder):
    """Return the depth of all frames, (T, 1, H, W)."""
    maps = [read_depth_file(path) for path in sorted(folder.rglob("depth_metres.tiff"))]
    return torch.from_numpy(np.stack(maps))[:, None]


def test_steady_frames_flicker_less_and_go_on_after_an_interruption_as_if_there_were_none(still, capsys):
    single, steady, cut = (still.parent / name for name in ("single", "steady", "cut"))
    assert upsample(still, *STEADY, "-o", single) == 0
    assert upsample(still, *STEADY, "--steady", "-o", steady) == 0
    before, after = depths(single), depths(steady)
    assert float(flicker(after)) < 0.4 * float(flicker(before))
    assert info(steady / "003")["settings"]["steady"] is True
    capsys.readouterr()
    assert upsample(still, *STEADY, "-o", steady) == 2
    assert "other settings: steady" in capsys.readouterr().err
    shutil.copytree(steady, cut)
    for name in ("003", "004"):
        shutil.rmtree(cut / name)
    assert upsample(still, *STEADY, "--steady", "--with", "rgbd", "-o", cut) == 0
    for path in (*steady.rglob("depth_metres.tiff"), *steady.rglob("confidence.npz")):
        assert path.read_bytes() == (cut / path.relative_to(steady)).read_bytes(), path

    def read():
        for number in range(5):
            photo = np.array(Image.open(still / "rgb" / f"{number:03}.png"))
            yield photo, cv2.imread(str(still / "depth" / f"{number:03}.png"), cv2.IMREAD_UNCHANGED), CAMERA

    stream = dsr.Upsampler("bicubic", fill="none").stream(read(), unit="mm", steady=Steady())
    for surface, stored in zip(stream, depths(steady)[:, 0].numpy(), strict=True):
        np.testing.assert_array_equal(surface.depth, stored)


def test_steady_frames_of_two_cameras_in_turn_are_not_mixed_after_an_interruption_either(still):
    out, rgb, maps = still.parent / "out", [], []
    for number in range(2):
        for camera in ("left", "right"):
            folder = still.parent / camera
            folder.mkdir(exist_ok=True)
            for name, paths in (("rgb", rgb), ("depth", maps)):
                paths.append(folder / f"{camera}_{number}.{name}.png")
                shutil.copy(still / name / f"00{number}.png", paths[-1])
    command = ("--rgb", *rgb, "--depth", *maps, "--camera", still / "camera.json", *STEADY, "--steady", "-o", out)
    assert upsample(*command) == 0
    before = depths(out)
    [lost] = {each.parent for each in out.rglob("info.json") if "left_1" in each.parent.name}
    shutil.rmtree(lost)
    assert upsample(*command) == 0
    assert torch.equal(depths(out), before)


@pytest.mark.parametrize("options", [("--workers", "2"), ("--shard", "1/2"), ("--only", "depth")])
def test_steady_frames_are_refused_without_all_results_before(still, capsys, options):
    code = upsample(still, *STEADY, "--steady", *options, "-o", still.parent / "out")
    assert refused_line(capsys, code).startswith("--steady: ")
    assert not (still.parent / "out").exists()


# fuse


def test_results_with_poses_become_one_mesh(capture, capsys):
    out = capture.parent / "out"
    assert upsample(capture, "--poses", capture.parent / "poses.txt", *DEPTH_ONLY, "-o", out) == 0
    assert main(["fuse", str(out), "-o", str(capture.parent / "mesh.ply"), "--voxel", "0.03", "--score"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "5 results -> " in said
    folders = sorted(path.parent for path in out.rglob("info.json"))
    info = [json.loads((each / "info.json").read_text()) for each in folders]
    views = depths(out).double(), Camera(**info[0]["camera"]), [np.array(each["pose"]) for each in info]
    expected = opw(*views)
    found = re.search(r"successive results differ by ([\d.e-]+) mm, 4 pairs of a view in common \(OPW\)", said)
    assert float(found[1]) == pytest.approx(1e3 * float(expected), rel=0.01)
    assert f"distances of points spread by {100 * float(rsd(*views)):.2f} % of their mean (RSD)" in said
    mesh = trimesh.load(capture.parent / "mesh.ply", process=False)
    box = mesh.vertices[mesh.vertices[:, 2] < 1.25]
    assert abs(np.median(box[:, 2]) - 1.2) < 0.02
    assert abs(np.ptp(box[:, 0]) - 0.6) < 0.12  # the frames' boxes coincide


@pytest.mark.parametrize(("part", "up"), [("input", "y"), ("depth", "")])
def test_fused_mesh_says_its_frame_and_has_the_photos_colours(capture, part, up):
    out, path = capture.parent / "out", capture.parent / "mesh.ply"
    options = ("--method", "bicubic", "--only", f"depth,{part}")
    assert upsample(capture, "--poses", capture.parent / "poses.txt", *options, "-o", out) == 0
    for each in out.rglob("info.json"):
        each.write_text(json.dumps({**json.loads(each.read_text()), "up": up}))
    assert main(["fuse", str(out), "-o", str(path), "--voxel", "0.03"]) == 0
    header = path.read_bytes().partition(b"end_header")[0].decode().splitlines()
    assert f"comment world frame of the poses{': y up' if up else ''}; metres" in header
    names = [line.split()[2] for line in header if line.startswith(("property float", "property uchar"))]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    mesh = trimesh.load(path, process=False)
    vertices, colours = np.asarray(mesh.vertices), np.asarray(mesh.visual.vertex_colors)[:, :3].astype(int)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1, atol=1e-3)
    wall = (vertices[:, 2] > 1.9) & (np.abs(vertices[:, 0]) > 0.7)
    box = (vertices[:, 2] < 1.25) & (np.abs(vertices[:, 0]) < 0.2) & (np.abs(vertices[:, 1]) < 0.15)
    for places, colour in ((wall, COLOURS[0]), (box, COLOURS[1])):
        expected = colour if part != "depth" else 190
        assert np.abs(np.median(colours[places], axis=0) - expected).max() <= 6
    assert main(["fuse", str(out), "-o", str(path.with_suffix(".glb")), "--voxel", "0.03"]) == 0
    same = trimesh.load(path.with_suffix(".glb"), process=False, force="mesh")
    np.testing.assert_array_equal(same.faces, mesh.faces)
    np.testing.assert_allclose(same.vertices, vertices if up else vertices * [1, -1, -1], atol=1e-4)


def test_results_without_poses_and_damaged_ones_are_refused(capture, capsys):
    out, mesh = capture.parent / "out", capture.parent / "mesh.ply"
    assert upsample(capture, *DEPTH_ONLY, "-o", out) == 0
    capsys.readouterr()
    assert "expected a pose; run" in refused_line(capsys, main(["fuse", str(out), "-o", str(mesh)]))
    for number, change in enumerate(({"pose": np.ones((4, 4)).tolist()}, {"camera": 3}, {"complete": False}, {}, {})):
        path = out / f"{number:03}" / "info.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "pose": pose(0.0).tolist(), **change}))
    (out / "003" / "depth_metres.tiff").write_bytes(b"broken")
    assert main(["fuse", str(out), "-o", str(mesh)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 4
    assert mesh.is_file()
    assert ".ply" in refused_line(capsys, main(["fuse", str(out), "-o", str(capture.parent / "mesh.obj")]))
    assert "got one without info.json" in refused_line(capsys, main(["fuse", str(capture), "-o", str(mesh)]))


# poses that cannot be right


MAP = Camera.centred(64, 48, 52.0)


@pytest.fixture
def walked(tmp_path):
    """Six frames of a room, from a camera that walks and turns."""
    return write_recording(tmp_path / "walked", MAP, walk(6))


def poses_of(folder, change, count=6):
    """Write the poses of a walk, changed, and return the option that names them."""
    path = folder.parent / "poses.txt"
    path.write_text(in_text([change(each) for each in walk(count)]))
    return ("--poses", path)


def test_poses_that_are_read_wrongly_are_reported_once_and_in_every_info(walked, capsys):
    out = walked.parent / "out"
    assert upsample(walked, *poses_of(walked, np.linalg.inv), *DEPTH_ONLY, "-o", out) == 0
    assert capsys.readouterr().out.count("warning: ") == 1
    for number in range(6):
        (warning,) = info(out / f"{number:03}")["warnings"]
        assert warning["code"] == "poses"
        assert warning["value"] > warning["threshold"]


def test_frames_without_a_pose_are_reported_and_strict_refuses_them(walked, capsys):
    def write(*numbers):
        rows = [(*each[:3, 3], *Rotation.from_matrix(each[:3, :3]).as_quat()) for each in walk(6)]
        lines = [f"{number} " + " ".join(map(str, rows[number % 6])) for number in numbers]
        (walked.parent / "poses.txt").write_text("\n".join(lines) + "\n")

    command = (walked, "--poses", walked.parent / "poses.txt", *DEPTH_ONLY)
    write(0, 1, 2, 3)
    assert upsample(*command, "-o", walked.parent / "fewer") == 0
    assert capsys.readouterr().out.count("warning: poses.txt has no pose of this frame (2 of 6 ") == 1
    found = [info(walked.parent / "fewer" / f"{number:03}")["warnings"] for number in range(6)]
    assert [[each["code"] for each in warnings] for warnings in found] == [[]] * 4 + [["poses-missing"]] * 2
    assert upsample(*command, "--strict", "-o", walked.parent / "strict") == 2
    assert "4 done, 2 failed" in capsys.readouterr().out
    write(*range(8))
    assert upsample(*command, "--dry-run", "-o", walked.parent / "more") == 0
    assert "warning" not in capsys.readouterr().out
    write(100, 101)
    assert "poses.txt: " in refused_line(capsys, upsample(*command, "-o", walked.parent / "none"))


def test_fuse_reports_wrong_poses_and_strict_refuses_them(walked, capsys):
    out, mesh = walked.parent / "out", walked.parent / "mesh.ply"
    fuse = ["fuse", str(out), "-o", str(mesh), "--voxel", "0.05"]
    assert upsample(walked, *poses_of(walked, np.array), *DEPTH_ONLY, "-o", out) == 0
    capsys.readouterr()
    assert main([*fuse, "--strict"]) == 0
    assert "warning" not in capsys.readouterr().out
    mesh.unlink()
    for path in out.rglob("info.json"):
        content = json.loads(path.read_text())
        path.write_text(json.dumps({**content, "pose": np.linalg.inv(content["pose"]).tolist()}))
    assert "poses" in refused_line(capsys, main([*fuse, "--strict"]))
    assert not mesh.exists()
    assert main(fuse) == 0
    assert capsys.readouterr().out.count("warning: the poses ") == 1
