"""Pictures of results beside the input and the truth."""

from __future__ import annotations

import torch

from dsr.geometry.camera import Camera
from dsr.geometry.shading import comparison, render
from dsr.geometry.surface import depth_to_normals

CAMERA = Camera(width=160, height=144, fx=200.0, fy=200.0, cx=79.5, cy=71.5)
RAYS = CAMERA.rays()[None]
RANDOM = torch.Generator().manual_seed(1)
DEPTH = 2 + torch.rand(1, 1, 144, 160, dtype=torch.float64, generator=RANDOM)
RGB = torch.rand(1, 3, 144, 160, generator=RANDOM)
LOW = DEPTH[..., ::4, ::4]


def _panel(picture: torch.Tensor, row: int, column: int) -> torch.Tensor:
    """Return a panel, (3, 144, 160), without the line of 16 pixels above it."""
    top = row * 160 + 16
    return picture[:, top : top + 144, column * 160 : (column + 1) * 160].int()


def test_comparison_shows_photo_input_result_and_truth_and_all_four_lights() -> None:
    other = 1.1 * DEPTH
    other = other + 0.05 * torch.rand(other.shape, generator=RANDOM)
    picture = comparison(other, DEPTH, RAYS, RGB, LOW)
    assert (picture.shape, picture.dtype) == ((3, 4 * 160, 4 * 160), torch.uint8)
    torch.testing.assert_close(_panel(picture, 0, 0), (255 * RGB[0]).round().int())
    coarse, truth = _panel(picture, 0, 1), _panel(picture, 0, 3)
    torch.testing.assert_close(coarse[:, 2::4, 2::4], truth[:, ::4, ::4])  # the truth's colours
    near = (truth[0].float() - (255 * (1 - 0.9 * (DEPTH[0, 0] - DEPTH.min()) / (DEPTH.max() - DEPTH.min())))).abs()
    assert float(near.max()) <= 1
    result, lit = (render(depth_to_normals(each, RAYS))[0].float() for each in (other, DEPTH))
    for light in range(4):
        assert (_panel(picture, 1, light)[0] - 255 * result[light]).abs().max() <= 1
        assert (_panel(picture, 2, light)[0] - 255 * lit[light]).abs().max() <= 1
        difference = (2 * (result[light] - lit[light]).abs()).clamp(max=1)
        assert (_panel(picture, 3, light)[0] - 255 * difference).abs().max() <= 1


def test_comparison_without_truth_shows_the_result_alone_and_holes_black() -> None:
    depth = DEPTH.clone()
    depth[..., 5:9, 5:9] = torch.nan
    picture = comparison(depth, None, RAYS, RGB, LOW)
    assert picture.shape == (3, 320, 640)
    assert int(_panel(picture, 0, 2)[:, 5:9, 5:9].max()) == 0
    assert int(_panel(picture, 0, 3).max()) == 0
    assert int(_panel(picture, 1, 3)[:, 5:8, 5:8].max()) == 0
