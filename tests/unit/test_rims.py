"""Holes between two surfaces."""

import pytest
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.inference import upsample_surface
from dsr.inference.rims import settle_holes
from dsr.methods.images import inpaint

NEAR, FAR = 1.0, 2.5
CAMERA = Camera(width=160, height=128, fx=150.0, fy=150.0, cx=79.5, cy=63.5)
RED, BLUE = (0.8, 0.2, 0.1), (0.2, 0.3, 0.7)


def _ring(inside: tuple[float, float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the photo of a red ring before a blue wall, its map, and what is inside of it, which the map lacks."""
    rows, columns = torch.meshgrid(torch.arange(32.0), torch.arange(40.0), indexing="ij")
    radius = ((rows - 15.5).square() + (columns - 19.5).square()).sqrt()
    ring, hole, lost = radius < 8, radius < 3, radius < 4
    red, blue, other = (torch.tensor(each)[:, None, None] for each in (RED, BLUE, inside))
    photo = torch.where(hole, other, torch.where(ring, red, blue)).repeat_interleave(4, 1).repeat_interleave(4, 2)
    photo = (photo + 0.02 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    hole = hole[None].repeat_interleave(4, 1).repeat_interleave(4, 2)
    return photo, torch.where(ring, NEAR, FAR).masked_fill(lost, torch.nan)[None], hole


@pytest.mark.parametrize("method", ["facets", "bicubic", "guided_filter"])
def test_loop_is_seen_through_where_the_photo_shows_what_is_behind(method: str) -> None:
    for colour, depth in ((BLUE, FAR), (RED, NEAR)):
        photo, given, hole = _ring(colour)
        surface = upsample_surface(photo, given, CAMERA, method=method, max_hole=20)
        assert surface.filled is not None
        assert bool(surface.filled[hole].all())
        middle = torch.zeros_like(hole)
        middle[:, 58:70, 74:86] = True
        torch.testing.assert_close(surface.depth[middle], torch.full((144,), depth), rtol=0.06, atol=0)


def test_hole_that_shows_neither_surface_is_doubtful() -> None:
    errors = []
    for colour in (BLUE, (0.5, 0.25, 0.4)):
        photo, given, _ = _ring(colour)
        surface = upsample_surface(photo, given, CAMERA, max_hole=20)
        assert surface.depth_error is not None
        errors.append(float((surface.depth_error / surface.depth)[:, 60:68, 76:84].mean()))
    assert errors[0] < 0.1 < errors[1]


@pytest.mark.parametrize("shape", ["ring", "floor", "hill", "outliers"])
def test_undecided_hole_is_doubtful_at_a_step_and_not_on_a_slope(shape: str) -> None:
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    squared = (rows % 20 - 10).square() + (columns % 20 - 10).square()
    few = torch.rand(rows.shape, generator=torch.Generator().manual_seed(0)) < 0.01
    depth = {
        "ring": torch.where(squared < 50, NEAR, FAR),
        "floor": 1 / (0.25 + rows / 80),
        "hill": 1 / (0.5 + (rows / 60).square() + (columns / 80).square()),
        "outliers": torch.where(few, NEAR, 1.5 * NEAR),
    }[shape]
    holes = (squared < 12)[None]
    found = settle_holes(depth[None].masked_fill(holes, torch.nan).reciprocal(), torch.full((3, 60, 80), 0.5), holes)
    doubtful = (found.doubt[holes] > 0.02).float().mean()
    assert doubtful > 0.95 if shape == "ring" else doubtful < 0.02


def test_strip_beside_a_near_object_is_of_what_is_behind_it() -> None:
    depth = torch.full((1, 40, 60), FAR)
    depth[:, 10:30, 20:40] = NEAR
    photo = torch.tensor(BLUE)[:, None, None].expand(3, 40, 60).clone()
    photo[:, 10:30, 20:40] = torch.tensor(RED)[:, None, None]
    holes = torch.zeros_like(depth, dtype=torch.bool)
    holes[:, 10:30, 17:20], holes[:, 10:30, 40:43] = True, True
    found = settle_holes(depth.masked_fill(holes, torch.nan).reciprocal(), photo, holes)
    torch.testing.assert_close(inpaint(found.inverse[None], photo[None])[0].reciprocal(), depth, rtol=1e-3, atol=0)


def test_other_holes_are_left_to_the_method() -> None:
    generator = torch.Generator().manual_seed(0)
    photo = torch.rand((3, 40, 60), generator=generator)
    slope = torch.linspace(2, 2.2, 60).expand(1, 40, 60).clone()
    holes = torch.zeros_like(slope, dtype=torch.bool)
    holes[:, 10:20, 20:30] = True
    step = torch.where(torch.arange(60) < 30, NEAR, FAR).expand(1, 40, 60)
    points = torch.rand(step.shape, generator=generator) < 0.2
    for depth, missing, fill in ((slope, holes, holes), (step, holes, ~holes), (step, ~points, ~points)):
        given = depth.masked_fill(missing, torch.nan).reciprocal()
        found = settle_holes(given, photo, fill)
        torch.testing.assert_close(found.inverse, given, equal_nan=True)
        assert not bool(found.doubt.any())


def test_maps_on_other_sizes_and_without_holes_pass() -> None:
    for size in ((1, 1), (2, 3), (5, 4)):
        full = torch.ones(1, *size)
        assert torch.equal(settle_holes(full, torch.rand(3, 10, 12), full > 2).inverse, full)
        pierced = full.clone()
        pierced[0, 0, 0] = torch.nan
        assert settle_holes(pierced, torch.rand(3, 10, 12), pierced.isnan()).inverse.shape == full.shape
