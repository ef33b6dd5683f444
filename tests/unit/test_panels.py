"""A picture comes out of every scene, whatever its shape and whatever is unknown of it."""

import struct

import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.pictures.panels import save_picture
from dsr.sample import DepthSample

pytestmark = pytest.mark.slow  # drawing takes a second

SCORES = {"RMSE_d": 0.07, "DSSIM_v": 0.3}
WIDTH = 2656  # Pixels: five panels of 3.2 inches and 0.6 inches of margin at 160 dpi


def toy_sample(height=32, width=32, *, truth=True, name="toy", scale=4):
    camera = Camera(width, height, 1.2 * width, 1.2 * width, (width - 1) / 2, (height - 1) / 2)
    depth = 2 + 0.01 * torch.arange(height * width, dtype=torch.float64).view(1, height, width)
    coarse = torch.nn.functional.avg_pool2d(depth[None], scale)[0]
    coarse_camera = camera.rescale(width // scale, height // scale)
    rgb = torch.full((3, height, width), 0.5)
    return DepthSample("set", name, rgb, coarse, camera, coarse_camera, scale, depth if truth else None)


def drawn(folder, sample, depth, scores=SCORES, label="Toy"):
    """Draw and return the picture's width and height from the PNG's header."""
    path = folder / "pictures" / "scene.png"
    save_picture(path, sample, depth, scores, label, KNOWN_FORMATS)
    assert [file.name for file in path.parent.iterdir()] == ["scene.png"]
    content = path.read_bytes()
    assert content.startswith(b"\x89PNG")
    assert content.endswith(b"IEND\xaeB`\x82")
    return struct.unpack(">II", content[16:24])


def inches(rows, panel):
    return 160 * (0.8 + rows * (panel + 0.95))


def test_scene_without_truth_has_two_rows(tmp_path):
    sample = toy_sample(truth=False)
    width, height = drawn(tmp_path, sample, torch.full((1, 32, 32), 2.0), {})
    assert width == WIDTH
    assert height == pytest.approx(inches(2, 3.2), abs=1)


def test_holes_are_drawn(tmp_path):
    sample = toy_sample()
    depth = sample.depth.clone()
    depth[0, :10] = torch.nan
    sample.depth[0, 5:20, :9] = torch.nan
    sample.depth_lr[0, 0] = torch.nan
    drawn(tmp_path, sample, depth)


@pytest.mark.parametrize("truth", [True, False])
def test_prediction_of_holes_alone_is_drawn(tmp_path, truth):
    sample = toy_sample(truth=truth)
    drawn(tmp_path, sample, torch.full((1, 32, 32), torch.nan), {"RMSE_d": float("nan")})
