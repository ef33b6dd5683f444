"""Pictures of results beside the truth."""

from __future__ import annotations

import torch

from dsr.geometry.camera import Camera
from dsr.geometry.comparison import comparison
from dsr.geometry.shading import render
from dsr.geometry.surface import depth_to_normals

CAMERA = Camera(width=40, height=36, fx=50.0, fy=50.0, cx=19.5, cy=17.5)
RAYS = CAMERA.rays()[None]
DEPTH = 2 + torch.rand(1, 1, 36, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_comparison_shows_result_truth_and_difference_under_two_lights() -> None:
    picture = comparison(DEPTH, DEPTH, RAYS)[0]
    assert picture.shape == (72, 120)
    torch.testing.assert_close(picture[:, :40], picture[:, 40:80])
    assert float(picture[:, 80:].abs().max()) == 0
    lit = render(depth_to_normals(DEPTH, RAYS))[0]
    torch.testing.assert_close(picture[:36, 40:80], lit[0].float())
    torch.testing.assert_close(picture[36:, 40:80], lit[3].float())
    other = comparison(1.1 * DEPTH + 0.05 * torch.rand(1, 1, 36, 40), DEPTH, RAYS)[0]
    torch.testing.assert_close(other[:, 80:], (2 * (other[:, :40] - other[:, 40:80]).abs()).clamp(max=1))


def test_comparison_without_truth_shows_the_result_alone_and_holes_black() -> None:
    depth = DEPTH.clone()
    depth[..., 5:9, 5:9] = torch.nan
    picture = comparison(depth, None, RAYS)[0]
    assert picture.shape == (72, 40)
    assert float(picture[5:8, 5:8].abs().max()) == 0
    lit = render(depth_to_normals(DEPTH, RAYS))[0, 3]
    torch.testing.assert_close(picture[50:, 12:], lit[14:, 12:].float())
