"""What ``dsr.Upsampler`` computes is what ``dsr upsample`` writes, to the bit; the lines of docs/python.md run."""

import json
import re
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
from PIL import Image
from small_frames import in_text, room, walk, write_recording

import dsr
from dsr.app.upsample.parts import METRES
from dsr.cli import main
from dsr.io.depth_files import read_depth_file

CAMERA = dsr.Camera.from_fov(60, width=96, height=72)
INTRINSICS = [str(each) for each in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)]


def stored(size, kind):
    """Return a map of the room in whole millimetres: with noise, a hole and an outlier; or in steps of disparity."""
    camera = CAMERA.rescale(*size)
    depth = room(camera, walk(1)[0]) * (1 + 0.004 * np.random.default_rng(0).standard_normal(size[::-1]))
    if kind == "stereo":
        constant = 0.05 * 645 * 32  # a RealSense D435's, in its steps
        depth = constant / np.round(constant / depth)
    values = np.round(1000 * depth).astype(np.uint16)
    values[8:11, 9:14] = 0
    values[20, 30] = 200
    return np.kron(values, np.ones((2, 2), np.uint16)) if kind == "repeated" else values


CASES = {
    "plain": ((48, 36), {}, []),
    "stereo": ((48, 36), {"sensor": "RealSense D435"}, ["--sensor", "RealSense D435"]),
    "repeated": ((48, 36), {}, []),
    "registered": ((96, 72), {"register": True, "fill": "all"}, ["--register", "--fill", "all"]),
    "halved": ((96, 72), {"working_size": 2, "noise": 0.01, "smooth": 2.0},
               ["--working-size", "2", "--noise", "0.01", "--smooth", "2"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", CASES)
def test_surface_is_that_of_the_command(tmp_path, kind):
    size, how, options = CASES[kind]
    photo = cv2.resize(room(CAMERA, walk(1)[0]).astype(np.float32), (96, 72))
    photo = np.stack([255 * photo / photo.max()] * 3, -1).astype(np.uint8)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    Image.fromarray(stored(size, kind)).save(tmp_path / "depth.png")
    files = ["--rgb", tmp_path / "photo.png", "--depth", tmp_path / "depth.png", "-o", tmp_path / "out"]
    main(["upsample", *map(str, files), "--only", "depth,confidence", "--intrinsics", *INTRINSICS, *options])
    expected = read_depth_file(tmp_path / "out" / "depth_metres.tiff")
    rgb, depth = dsr.read(tmp_path / "photo.png"), dsr.read_depth(tmp_path / "depth.png", "mm")
    surface = dsr.Upsampler(**how)(rgb, depth, CAMERA)
    np.testing.assert_array_equal(surface.depth, expected)
    written = np.load(tmp_path / "out" / "confidence.npz")
    np.testing.assert_allclose(written["angle_error"], surface.angle_error, rtol=0.017)  # stored with 64 steps
    if kind == "plain":
        np.testing.assert_array_equal(dsr.upsample(rgb, stored(size, kind), CAMERA, unit="mm"), expected)


@pytest.mark.parametrize("neighbours", [3, 9])
def test_stream_with_poses_is_the_command_with_neighbours(tmp_path, neighbours):
    poses = walk(7)
    folder = write_recording(tmp_path / "recording", CAMERA.rescale(48, 36), poses)
    (tmp_path / "poses.txt").write_text(in_text(poses))
    files = [folder, "-o", tmp_path / "out", "--poses", tmp_path / "poses.txt", "--neighbours", neighbours]
    main(["upsample", *map(str, files), "--method", "bicubic", "--only", "depth", "--depth-unit", "mm"])
    camera = dsr.Camera.from_json(folder / "camera.json")
    written = [np.array([float(f"{value:.9f}") for value in pose.ravel()]).reshape(4, 4) for pose in poses]
    frames = [
        (dsr.read(folder / "rgb" / f"{number:03}.png"), dsr.read_depth(folder / "depth" / f"{number:03}.png", "mm"),
         camera, pose) for number, pose in enumerate(written)
    ]  # fmt: skip
    upsampler = dsr.Upsampler("bicubic")
    surfaces = list(upsampler.stream(iter(frames), neighbours=neighbours))
    assert len(surfaces) == len(frames)
    for number, surface in enumerate(surfaces):
        np.testing.assert_array_equal(
            surface.depth, read_depth_file(tmp_path / "out" / f"{number:03}" / "depth_metres.tiff")
        )
    assert (surfaces[3].depth != upsampler(*frames[3][:3]).depth).any()


PAGE = Path(__file__).resolve().parents[2] / "docs" / "python.md"
ELSEWHERE = ("onnxruntime", "import lightning", "from hydra", "from dsr.metrics.classes import DSSIMv")
"""What is in blocks that other tests run: of the examples, and of trainings and metrics in a notebook."""


def blocks():
    found = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    return [block for block in found if not any(each in block for each in ELSEWHERE)]


@pytest.mark.slow
def test_lines_of_the_page_run_from_top_to_bottom(tmp_path, monkeypatch, capsys, dsr_cache):
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    camera = dsr.Camera.from_fov(60, width=64, height=48)
    pose, coarse = walk(1)[0], camera.rescale(32, 24)
    depth = room(camera, pose)
    picture = np.stack([255 * depth / depth.max()] * 3, -1).astype(np.uint8)
    Image.fromarray(picture).save("photo.jpg")
    noise = 1 + 0.003 * np.random.default_rng(0).standard_normal((24, 32))
    Image.fromarray(np.round(1000 * room(coarse, pose) * noise).astype(np.uint16)).save("depth.png")
    np.save("truth.npy", depth.astype(np.float32))
    names = ("width", "height", "fx", "fy", "cx", "cy")
    Path("camera.json").write_text(json.dumps({name: getattr(camera, name) for name in names}))
    known = {}
    for block in blocks():
        quick = block.replace("size=128", "size=64").replace("steps=600", "steps=2")
        exec(compile(quick, PAGE, "exec"), known)
    said = capsys.readouterr().out
    assert re.search(r"^\d+% of the pixels are expected", said, re.MULTILINE)
    assert len(re.findall(r"^\d\.\d{3} m$", said, re.MULTILINE)) == 3
    assert {METRES, "mesh.glb", "info.json", "input.npz"} <= {path.name for path in Path("out").iterdir()}
    assert Path("surface.stl").stat().st_size > 1000
    assert 0 < float(known["metrics"].compute()["RMSE_d"]) < 1000
    assert len(known["points"]) > 1000
