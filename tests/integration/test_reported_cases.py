"""Situations that people reported of programs like this one, each with the values that must come out."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dsr.cli import main
from dsr.degradation.downsampling import Downsampling
from dsr.geometry.camera import Camera
from dsr.inference import plan_for
from dsr.inference.working_size import left_of, limit_to_noise
from dsr.methods.base import MapNoise
from dsr.methods.recipe import Run, read_recipe
from dsr.sample import DepthSample

WIDTH, HEIGHT, FOCAL = 320, 240, 288.0
CAMERA = ["--intrinsics", "288", "288", "159.5", "119.5"]


def scene(width=WIDTH, height=HEIGHT, focal=FOCAL, shift=0.0):
    """Return the exact depth (height, width) in metres and the photo (height, width, 3), uint8 RGB.

    A chequered slanted wall with a box and a ball in front of it, seen by a camera ``shift`` metres to the right.
    """
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal
    depth = (3.2 - 0.15 * shift) / (1 + 0.15 * x)
    squares = np.floor(4 * (shift + x * depth)) + np.floor(4 * y * depth)
    photo = np.stack([150 + 50 * (squares % 2)] * 3, -1) * (1.0, 0.9, 0.75)
    box = (np.abs(shift + 1.7 * x + 0.6) < 0.3) & (np.abs(1.7 * y - 0.2) < 0.4)
    depth, photo = np.where(box, 1.7, depth), np.where(box[..., None], (60, 90, 200), photo)
    centre, radius = np.array([0.45 - shift, 0.3, 2.0]), 0.45
    along = x * centre[0] + y * centre[1] + centre[2]
    norm = x * x + y * y + 1
    root = along**2 - norm * (centre @ centre - radius**2)
    near = (along - np.sqrt(np.maximum(root, 0))) / norm
    depth, photo = np.where(root > 0, near, depth), np.where((root > 0)[..., None], (220, 60, 50), photo)
    return depth, photo.astype(np.uint8)


def coarse(depth, by=4):
    """Return the means of squares of ``by`` pixels."""
    height, width = depth.shape
    return depth.reshape(height // by, by, width // by, by).mean((1, 3))


def millimetres(depth):
    return np.round(1000 * depth).astype(np.uint16)


def write(path: Path, picture):
    """Write a depth map, or a photo in RGB, in the format that the name has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, picture)
    else:
        cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture)
    return path


def upsample(out: Path, *options, method="bicubic", only="depth"):
    """Run ``dsr upsample`` and return its exit code."""
    return main(["upsample", *map(str, options), "-o", str(out), "--method", method, "--only", only])


def mean_error(out: Path, truth):
    """Return the mean absolute error in millimetres of the pixels that both know, and the known fraction."""
    depth = cv2.imread(str(next(out.rglob("depth_metres.tiff"))), cv2.IMREAD_UNCHANGED)
    assert depth.shape == truth.shape
    known = np.isfinite(depth) & np.isfinite(truth)
    return 1000 * np.abs(depth - truth)[known].mean(), np.isfinite(depth).mean()


def boards(number, by):
    """Return exact depth (240, 320) of a wall and boards at ``number`` depths, the map that has ``by`` times coarser
    pixels, and a photo of them."""
    depth = np.full((240, 320), 3.0)
    colour = np.full((240, 320, 3), 190.0) + 30 * np.random.default_rng(1).random((240, 320, 1))
    places = ((0, 240, 140, 180), (60, 120, 30, 90), (150, 200, 200, 300))
    for (top, bottom, left, right), z in zip(places[: number - 1], (1.5, 2.2, 1.125), strict=False):
        depth[top:bottom, left:right], colour[top:bottom, left:right] = z, (40, 200 * (z > 2), 100 * z)
    return depth, depth[by // 2 :: by, by // 2 :: by], colour.astype(np.uint8)


def expected_error(folder: Path, photo, depth, name, *options):
    """Return the median expected error in millimetres."""
    files = "--rgb", write(folder / "photo.png", photo), "--depth", write(folder / name, depth), *CAMERA, *options
    assert upsample(folder / "out", *files, method="facets", only="depth,confidence") == 0
    return 1000 * float(np.nanmedian(np.load(folder / "out/confidence.npz")["depth_error"]))


@pytest.mark.parametrize(
    ("number", "by", "name"), [(2, 4, "d.png"), (3, 8, "d.npy"), (4, 4, "d.npy"), (4, 2, "d.png"), (2, 1, "d.tiff")]
)
def test_exact_boards_are_not_rounded(tmp_path, number, by, name):
    _, depth, photo = boards(number, by)
    depth = millimetres(depth) if name == "d.png" else depth.astype(np.float32)
    assert expected_error(tmp_path, photo, depth, name, "--for", "robot") < 6
    kept = cv2.imread(str(tmp_path / "out/depth_metres.tiff"), cv2.IMREAD_UNCHANGED)
    assert np.isfinite(kept).mean() > 0.9


def test_exact_boards_beside_a_tilted_one_and_in_disparity_are_not_rounded(tmp_path):
    depth, _, photo = boards(2, 4)
    depth[40:200, 200:300] = 2 / (1 + 0.2 * (np.arange(200, 300) - 250) / FOCAL)
    photo[40:200, 200:300] = 30, 160, 60
    assert expected_error(tmp_path / "tilted", photo, millimetres(depth[2::4, 2::4]), "d.png") < 8
    disparity = (72 * 0.25 / boards(2, 4)[1]).astype(np.float32)
    options = "--range-type", "disparity", "--baseline", 0.25
    assert expected_error(tmp_path / "disparity", boards(2, 4)[2], disparity, "d.tiff", *options) < 6


@pytest.mark.parametrize("step", [0.02, 0.1, 0.2])
def test_rounded_slopes_keep_the_error_of_their_rounding(tmp_path, step):
    depth, photo = scene()
    rounded = (step * np.round(depth[2::4, 2::4] / step)).astype(np.float32)
    assert expected_error(tmp_path, photo, rounded, "d.npy") > 1000 * step / 6


@pytest.mark.parametrize(("method", "most"), [("nearest", 0), ("bilinear", 0), ("bicubic", 0), ("guided_filter", 100)])
def test_both_commands_agree_on_maps_of_the_photos_own_size(tmp_path, method, most):
    depth, photo = scene()
    files = "--rgb", write(tmp_path / "p.png", photo), "--depth", write(tmp_path / "d.png", millimetres(depth))
    assert upsample(tmp_path / "out", *files, *CAMERA, method=method) == 0
    result = torch.from_numpy(cv2.imread(str(tmp_path / "out/depth_metres.tiff"), cv2.IMREAD_UNCHANGED))
    given = torch.from_numpy(millimetres(depth) / 1000).float()
    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, 159.5, 119.5)
    rgb = torch.from_numpy(photo).permute(2, 0, 1) / 255
    run = Run(device=torch.device("cpu"), precision="float32", seed=0, downsampling=Downsampling("box"))
    direct = read_recipe(method).build(1, run)(DepthSample("a", "b", rgb, given[None], camera, camera, 1))[0]
    assert float((1000 * (result - direct)).abs().max()) < 0.01
    assert float((1000 * (result - given)).abs().max()) < most + 0.01


def warnings_of(out: Path):
    """Return the messages of the warnings of a result, by code."""
    return {each["code"]: each["message"] for each in json.loads((out / "info.json").read_text())["warnings"]}


@pytest.mark.parametrize("by", [2, 4])
@pytest.mark.parametrize("ratio", [0.7, 0.85, 1.0, 1.3, 1.5])
def test_another_field_of_view_is_reported(tmp_path, ratio, by):
    depth, photo = scene()
    (height, width), cut = (round(each * min(ratio, 1 / ratio) / 4) * 4 for each in (HEIGHT, WIDTH)), max(ratio, 1)
    inner = slice((HEIGHT - height) // 2, (HEIGHT + height) // 2), slice((WIDTH - width) // 2, (WIDTH + width) // 2)
    depth, photo = (depth, photo[inner]) if cut > 1 else (depth[inner], photo)
    small = cv2.resize(millimetres(depth), (WIDTH // by, HEIGHT // by), interpolation=cv2.INTER_NEAREST)
    photo = cv2.resize(photo, (WIDTH, HEIGHT))
    files = "--rgb", write(tmp_path / "p.png", photo), "--depth", write(tmp_path / "d.png", small)
    assert upsample(tmp_path / "out", *files, *CAMERA) == 0
    found = warnings_of(tmp_path / "out")
    assert set(found) == ({"field-of-view"} if ratio != 1 else set())
    if ratio != 1:
        assert float(re.findall(r"looks ([\d.]+) times", found["field-of-view"])[0]) == pytest.approx(ratio, rel=0.1)
        assert upsample(tmp_path / "strict", *files, *CAMERA, "--strict") == 2


@pytest.mark.parametrize(("sign", "apart"), [(1, 0.1), (-1, 0.1), (1, -0.25), (-1, -0.25)])
def test_inverse_extrinsics_are_reported(tmp_path, sign, apart):
    depth, photo = scene(shift=apart)[0][2::4, 2::4], scene()[1]
    matrix = np.eye(4)
    matrix[0, 3] = sign * apart
    np.savetxt(tmp_path / "matrix.txt", matrix)
    np.savetxt(tmp_path / "depth.txt", [[72, 0, 39.5], [0, 72, 29.5], [0, 0, 1]])
    files = "--rgb", write(tmp_path / "p.png", photo), "--depth", write(tmp_path / "d.png", millimetres(depth))
    rig = "--depth-camera", tmp_path / "depth.txt", "--extrinsics", tmp_path / "matrix.txt"
    assert upsample(tmp_path / "out", *files, *CAMERA, *rig) == 0
    assert ("extrinsics-inverse" in warnings_of(tmp_path / "out")) == (sign < 0)


@pytest.mark.parametrize(
    ("photo", "depth", "gigabytes"),
    [((3000, 4000), (192, 256), 1.9), ((3000, 4000), (750, 1000), 2.5), ((6000, 8000), (192, 256), 3.0),
     ((6000, 8000), (750, 1000), 5.8), ((9000, 12000), (192, 256), 5.8)],
)  # fmt: skip
def test_estimated_memory_is_about_what_was_measured(photo, depth, gigabytes):
    text = plan_for(read_recipe("facets"), photo, depth).text
    assert float(re.findall(r"about ([\d.]+) GB", text)[0]) == pytest.approx(gigabytes, rel=0.25)


def test_expected_errors_of_stereo_grow_with_the_square_of_the_distance():
    inverse = 1 / torch.tensor([1.0, 2.0, 4.0]).double().repeat_interleave(64).expand(1, 64, 192)
    noise, spread = MapNoise(0.004, 8.0, 2.0), torch.full_like(inverse, 0.05)
    errors = (limit_to_noise(spread, noise, inverse, inverse) / inverse)[0, 0, 32::64]
    torch.testing.assert_close(errors, left_of(0.004) * torch.tensor([0.25, 1.0, 4.0]).double())
