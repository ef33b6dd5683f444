"""Holes of low-resolution depth maps: blobs, strips hidden from a second camera, and those of training, at random.

A kind of holes is a callable from a low-resolution map, its camera and a generator to a mask; see
:func:`dsr.degradation.downsampling.make_sample`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.random_fields import chance, field_of, integer, near_steps, uniform
from dsr.geometry.camera import Camera

# From (1, h, w) depth in metres, NaN where missing, to a (1, h, w) bool mask of the pixels to remove
Holes = Callable[[Tensor, Camera, torch.Generator], Tensor]


@dataclass(frozen=True)
class Blobs:
    """Blobs of random shape and position: the highest values of smoothed noise."""

    share: float = 0.1
    size: float = 12.0

    def __post_init__(self) -> None:
        if not 0 < self.share < 1:
            raise ValueError(f"share: expected a number above 0 and below 1, got {self.share}")
        if not self.size >= 1:
            raise ValueError(f"size: expected 1 or more low-resolution pixels, got {self.size}")

    def __call__(self, depth: Tensor, camera: Camera, generator: torch.Generator) -> Tensor:
        """Return the mask of the holes, (1, h, w) bool; their number is exact to the pixel."""
        draws = torch.randn(1, *depth.shape, generator=generator, dtype=torch.float64)
        sigma = self.size / 4
        radius = max(round(3 * sigma), 1)
        taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=draws.dtype) / sigma).square())
        for shape, padding in (((-1, 1), (0, 0, radius, radius)), ((1, -1), (radius, radius, 0, 0))):
            padded = functional.pad(draws, padding, mode="replicate")
            draws = functional.conv2d(padded, (taps / taps.sum()).view(1, 1, *shape))
        values = draws[0].flatten()
        holes = torch.zeros_like(values, dtype=torch.bool)
        holes[values.argsort(descending=True)[: round(self.share * values.numel())]] = True
        return holes.view_as(depth).to(depth.device)


@dataclass(frozen=True)
class Shadows:
    """Strips beside depth steps, hidden from a second camera or projector ``baseline`` metres right of the first."""

    baseline: float = 0.2

    def __post_init__(self) -> None:
        if not 0 < abs(self.baseline) < float("inf"):
            raise ValueError(f"baseline: expected metres other than 0, got {self.baseline}")

    def __call__(self, depth: Tensor, camera: Camera, generator: torch.Generator) -> Tensor:
        """Return the mask of the holes, (1, h, w) bool: points that a nearer one covers in the second image."""
        return occluded(self.baseline * camera.fx / depth.double())


def occluded(disparity: Tensor) -> Tensor:
    """Return the mask of the pixels, (..., h, w), that a nearer one covers in a second image, by their disparity."""
    if bool((disparity < 0).any()):  # the second camera is to the left
        return occluded(-disparity.flip(-1)).flip(-1)
    seen_at = torch.arange(disparity.shape[-1], device=disparity.device) - disparity  # the column in the second image
    nearest = seen_at.nan_to_num(torch.inf).flip(-1).cummin(dim=-1).values.flip(-1)
    return seen_at > nearest  # points to the right that are nearer cover it


def no_holes() -> None:
    """Return no holes, for ``holes=none``."""


HOLES = ("blobs", "shadows", "steps", "dark", "pixels")


def draw_holes(kind: str, values: Tensor, luma: Tensor, camera: Camera, generator: torch.Generator) -> Tensor:
    """Return a random mask of a kind of ``HOLES``, (1, h, w), for a map of inverse depth and its brightness."""
    if kind == "blobs":
        blobs = Blobs(uniform(0.02, 0.25, generator), uniform(2, 12, generator))
        return blobs(values.reciprocal(), camera, generator)
    if kind == "shadows":
        side = -1 if chance(0.5, generator) else 1
        return Shadows(side * uniform(0.03, 0.2, generator))(values.reciprocal(), camera, generator)
    if kind == "steps":
        reach = integer(1, 2, generator)
        return near_steps(values, reach) & (torch.rand(values.shape, generator=generator) < uniform(0.3, 1, generator))
    if kind == "dark":
        return dark(values, luma, generator)
    return torch.rand(values.shape, generator=generator) < uniform(0.01, 0.4, generator)


def dark(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """Return the mask of the darkest pixels, most of them, (1, h, w)."""
    limit = float(luma[:, ::3, ::3].flatten().quantile(uniform(0.02, 0.2, generator)))
    return (luma < limit) & (field_of(values, 1, generator) > -0.3)
