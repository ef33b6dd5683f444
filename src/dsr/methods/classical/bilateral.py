"""Bilateral filters: of a sensor's own depth map without the photo, and joint bilateral upsampling with it.

Tomasi and Manduchi, *Bilateral Filtering for Gray and Color Images*, ICCV 1998, by OpenCV in float32: a pixel becomes
the mean of a round window, weighted by Gaussians of the distance and of the difference of depth. Holes have no weight.

Kopf, Cohen, Lischinski, Uyttendaele, *Joint Bilateral Upsampling*, SIGGRAPH 2007:

    S_p = 1 / k_p * sum over low-resolution pixels q of S_q f(|p - q|) g(|I_p - I_q|),

with Gaussians f of the distance in low-resolution pixels and g of the colour difference, and the sum k_p of the
weights. What differs: I_q is the mean colour over the low-resolution pixel, and the largest weight of a pixel is 1.
"""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.methods.base import Abilities, Cost
from dsr.methods.classical.guided_filter import Guided, GuidedMethod, expect_window
from dsr.methods.images import inpaint
from dsr.sample import DepthSample
from dsr.utils.guards import expect_positive
from dsr.utils.progress import Steps

_NO_WEIGHT = 10.0  # standard deviations of depth at which a pixel has no weight: exp(-50)


@dataclass(eq=False)
class MapFilter(GuidedMethod):
    """A filter of the low-resolution depth without the photo, and its interpolation where the scale is above 1."""

    abilities = Abilities(ratios="any", own_size=True, cost=Cost(150, 1))
    slopes: bool = field(default=True, init=False)

    @abstractmethod
    def filter_map(self, sample: DepthSample) -> Tensor:
        """Return the filtered low-resolution depth, (1, h, w) in metres."""

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres in the precision of the low-resolution depth."""
        filtered = self.filter_map(sample)
        if sample.scale > 1:
            return super().__call__(replace(sample, depth_lr=filtered), progress)
        return inpaint(filtered[None])[0] if self.fill_holes else filtered

    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the interpolated maps, (N, H, W); the photo is not used."""
        return guided.interpolate()[0]


@dataclass(eq=False)
class Bilateral(MapFilter):
    """The bilateral filter of the low-resolution depth, and its interpolation where the scale is above 1.

    The defaults suit depth cameras at 0.5 to 2 m; noise grows with distance.
    """

    range_type = "orthogonal"

    window: int = 19
    sigma_depth: float = 0.03
    sigma_space: float = 3.0

    def __post_init__(self) -> None:
        expect_window(window=self.window)
        expect_positive(sigma_depth=self.sigma_depth, sigma_space=self.sigma_space)

    def filter_map(self, sample: DepthSample) -> Tensor:
        """Return the filtered low-resolution depth, (1, h, w)."""
        return filter_bilateral(sample.depth_lr, self.window, self.sigma_depth, self.sigma_space)


def filter_bilateral(depth: Tensor, window: int, sigma_depth: float, sigma_space: float) -> Tensor:
    """Filter a depth map, (1, h, w) in metres, NaN in holes, which stay holes; the window is a diameter in pixels."""
    values = depth[0].cpu().numpy().astype(np.float32)
    valid = np.isfinite(values)
    outside = min(0.0, float(values[valid].min()) - _NO_WEIGHT * sigma_depth)
    filtered = cv2.bilateralFilter(np.where(valid, values, np.float32(outside)), window, sigma_depth, sigma_space)
    return torch.from_numpy(np.where(valid, filtered, np.nan))[None].to(depth)


@dataclass(eq=False)
class JointBilateral(GuidedMethod):
    """Joint bilateral upsampling of the low-resolution disparity; holes beyond its radius can only be inpainted."""

    abilities = replace(GuidedMethod.abilities, fast_on="cpu")

    radius: int = 2
    sigma_space: float = 0.5
    sigma_colour: float = 0.1

    def __post_init__(self) -> None:
        expect_window(radius=self.radius)
        expect_positive(sigma_space=self.sigma_space, sigma_colour=self.sigma_colour)

    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the weighted means of the low-resolution maps, (N, H, W)."""
        matrices = []  # of the means over the high-resolution pixels nearest to each low-resolution one
        for nearest, size in zip(guided.nearest(), guided.valid.shape, strict=True):
            belongs = (nearest == torch.arange(size, device=nearest.device)[:, None]).double()
            matrices.append(belongs / belongs.sum(dim=1, keepdim=True).clamp(min=1))
        rgb_lr = matrices[0] @ guided.rgb @ matrices[1].T
        largest = torch.full_like(guided.rgb[0], -torch.inf)
        for exponent, _ in self._iterate_neighbours(guided, rgb_lr):
            torch.maximum(largest, exponent, out=largest)
        found = largest.isfinite()
        largest = torch.where(found, largest, 0)
        weights = torch.zeros_like(largest)
        totals = largest.new_zeros((len(guided.maps), *largest.shape))
        for exponent, at in self._iterate_neighbours(guided, rgb_lr):
            weight = exponent.sub_(largest).exp_()
            weights += weight
            for total, values in zip(totals, guided.maps, strict=True):
                total.addcmul_(weight, values[at])
        rows, columns = guided.nearest()
        return torch.where(found, totals / torch.where(found, weights, 1), guided.maps[:, rows[:, None], columns])

    def _iterate_neighbours(self, guided: Guided, rgb_lr: Tensor) -> Iterator[tuple[Tensor, tuple[Tensor, Tensor]]]:
        """Yield each neighbour's exponents, (H, W), -inf in holes and outside, its rows, (H, 1), and columns, (W,)."""
        height, width = guided.valid.shape
        i, j = guided.nearest()
        for down in range(-self.radius, self.radius + 1):
            for across in range(-self.radius, self.radius + 1):
                rows, columns = i + down, j + across
                at = rows.clamp(0, height - 1)[:, None], columns.clamp(0, width - 1)
                squares = (guided.rows - rows).square()[:, None] + (guided.columns - columns).square()
                exponent = squares / (-2 * self.sigma_space**2)
                for channel, channel_lr in zip(guided.rgb, rgb_lr, strict=True):
                    exponent -= (channel - channel_lr[at]).square() / (2 * self.sigma_colour**2)
                inside = (rows[:, None] == at[0]) & (columns == at[1])
                yield exponent.masked_fill_(~inside | (guided.valid[at] == 0), -torch.inf), at
