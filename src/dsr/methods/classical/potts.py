"""Piecewise constant albedo: the Potts problem, by region fusion.

Of all piecewise constant albedos, it finds one with a low

    E = 1/2 sum (rgb - albedo * shading)^2 + weight * (length of the regions' boundaries)

where the length is the number of pairs of neighbours, horizontal or vertical, in different regions: the Potts prior on
the albedo of Haefner et al. (CVPR 2018), who minimise it with the primal-dual iteration of Strekalovskiy and Cremers
(*Real-Time Minimization of the Piecewise Smooth Mumford-Shah Functional*, ECCV 2014) and count pixels whose gradient is
not 0. Here regions are fused, as in Nguyen and Brown (*Fast and Effective L0 Gradient Minimization by Region Fusion*,
ICCV 2015): it starts with one region per pixel, and fuses two neighbours if this costs less than the boundary between
them, whose weight grows to its value in a few levels. Many are fused at once, in disjoint groups, and only if this
lowers E at the current weight. Albedos are exactly constant, boundaries exact, and no fusion of two of the resulting
regions lowers E.

The best albedo of a region is sum (shading * rgb) / sum shading^2 in each channel, clamped to 0 .. BRIGHTEST, because a
shading near 0 does not determine it. Memory: about 60 maps of 8 bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

BRIGHTEST = 2.0  # maximum albedo; the minimum is 0
_LEVELS = 5  # number of times that the weight of boundaries grows to reach its value
_GROWTH = 4.0  # factor of its growth
_SHUFFLE = 2654435761  # multiplier of Knuth's hash
_RANGE = 2**32


class Regions(NamedTuple):
    """A partition: ``labels`` (B, H, W) int64, from 0 to ``number`` - 1, different in each image."""

    labels: Tensor
    number: int


class _Fits(NamedTuple):
    """Sums of squared shading and of shading times image over each region, (count, C)."""

    squares: Tensor
    products: Tensor

    def albedo(self) -> Tensor:
        """Return the best albedo within its limits; 0 where there is no shading."""
        best = self.products / torch.where(self.squares > 0, self.squares, 1)
        return torch.where(self.squares > 0, best, 0).clamp(0, BRIGHTEST)

    def worth(self) -> Tensor:
        """Return the decrease of the data term from albedo 0 to the best albedo, (count,)."""
        albedo = self.albedo()
        return ((self.products - 0.5 * self.squares * albedo) * albedo).sum(dim=1)


class _Borders(NamedTuple):
    """Pairs of neighbouring regions, (N,) each: both labels, and the length of the boundary between them."""

    one: Tensor
    other: Tensor
    length: Tensor


def fuse(rgb: Tensor, shading: Tensor, weight: float, inside: Tensor | None = None) -> Regions:
    """Return regions that are a local minimum of E, equal for equal input.

    Image and shading are (B, C, H, W) float64, ``weight`` is that of a unit of boundary length, and ``inside`` the mask
    (B, 1, H, W) of the problem; each pixel outside is a region of its own.
    """
    batch, channels, height, width = rgb.shape
    count = batch * height * width
    labels = torch.arange(count, device=rgb.device)
    fits = _Fits(*(each.movedim(1, -1).reshape(count, channels) for each in (shading.square(), shading * rgb)))
    borders = _borders(labels.reshape(batch, height, width), inside)
    turn = 0
    for level in range(_LEVELS, -1, -1):
        price = weight / _GROWTH**level
        while (parent := _choose_fusions(fits, borders, price, turn)) is not None:
            turn += 1
            roots = parent == torch.arange(len(parent), device=parent.device)
            renamed = (roots.cumsum(0) - 1)[parent]
            joined = ~roots
            fits = _Fits(*(each.index_add(0, parent[joined], each[joined])[roots] for each in fits))
            borders = _merge_borders(borders, renamed, len(fits.squares))
            labels = renamed[labels]
    return Regions(labels.reshape(batch, height, width), len(fits.squares))


def fit_albedo(rgb: Tensor, shading: Tensor, regions: Regions) -> Tensor:
    """Return the best albedo that is constant in each region, (B, C, H, W)."""
    channels = rgb.shape[1]
    flat = regions.labels.reshape(-1)
    sums = [
        each.new_zeros(regions.number, channels).index_add_(0, flat, each.movedim(1, -1).reshape(-1, channels))
        for each in (shading.square(), shading * rgb)
    ]
    return _Fits(*sums).albedo()[regions.labels].movedim(-1, 1)


def boundary_length(regions: Regions, inside: Tensor | None = None) -> int:
    """Return the number of pairs of neighbours in different regions, both inside the mask."""
    borders = _borders(regions.labels, inside)
    return int((borders.one != borders.other).sum())


def _borders(labels: Tensor, inside: Tensor | None) -> _Borders:
    """Return a border of length 1 for each pair of neighbouring pixels."""
    pairs = [(labels[..., :-1], labels[..., 1:]), (labels[..., :-1, :], labels[..., 1:, :])]
    if inside is None:
        ends = [(one.reshape(-1), other.reshape(-1)) for one, other in pairs]
    else:
        within = inside[:, 0]
        both = (within[..., :-1] & within[..., 1:], within[..., :-1, :] & within[..., 1:, :])
        ends = [(one[where], other[where]) for (one, other), where in zip(pairs, both, strict=True)]
    one, other = (torch.cat(each) for each in zip(*ends, strict=True))
    return _Borders(one, other, torch.ones_like(one))


def _choose_fusions(fits: _Fits, borders: _Borders, price: float, turn: int) -> Tensor | None:
    """Return the region that each region is fused into, (count,), or None if no fusion of two lowers E.

    The best neighbour of a region has the lowest cost of fusing per unit of boundary saved. A hash splits regions into
    centres and those that may join their best neighbour, if it is a centre. If all fusions of a centre together cost
    more than the boundaries between them, it only takes its best neighbour.
    """
    worth = fits.worth()
    one, other, length = borders
    pair = _Fits(*(each[one] + each[other] for each in fits))
    cost = (worth[one] + worth[other] - pair.worth()) / length
    cheap = cost < price
    if not bool(cheap.any()):
        return None
    ends = torch.cat((torch.stack((one, other)), torch.stack((other, one))), dim=1)[:, cheap.repeat(2)]
    length, cost = length[cheap].repeat(2), cost[cheap].repeat(2)
    count = len(worth)
    takes = (_hash(torch.arange(count, device=one.device) + turn * count) & 1).bool()
    kept = ~takes[ends[0]] & takes[ends[1]]
    leaf, centre, length, cost = ends[0][kept], ends[1][kept], length[kept], cost[kept]
    kept = _is_cheapest(leaf, cost, count)
    leaf, centre, length, cost = leaf[kept], centre[kept], length[kept], cost[kept]
    union = _Fits(*(each.index_add(0, centre, each[leaf]) for each in fits))
    lost = worth.index_add(0, centre, worth[leaf]) - union.worth()
    saved = torch.zeros_like(worth).index_add_(0, centre, price * length.to(worth))
    alone = _is_cheapest(centre, cost, count)
    parent = torch.arange(count, device=one.device)
    joins = (lost < saved)[centre] | alone
    parent[leaf[joins]] = centre[joins]
    return parent


def _is_cheapest(owner: Tensor, cost: Tensor, count: int) -> Tensor:
    """Return the mask of the cheapest entry of each owner; ties are broken by a hash."""
    least = cost.new_full((count,), torch.inf).scatter_reduce_(0, owner, cost, "amin")
    number = _hash(torch.arange(len(owner), device=owner.device))
    number = torch.where(cost == least[owner], number, _RANGE)
    return number == torch.full((count,), _RANGE, device=owner.device).scatter_reduce_(0, owner, number, "amin")[owner]


def _hash(number: Tensor) -> Tensor:
    """Return pseudo-random integers below 2^32; the map is one-to-one below 2^32."""
    for _ in range(2):
        number = (number * _SHUFFLE) % _RANGE
        number = number ^ (number >> 15)
    return number


def _merge_borders(borders: _Borders, renamed: Tensor, count: int) -> _Borders:
    """Return the borders after regions were renamed, each pair once."""
    one, other = renamed[borders.one], renamed[borders.other]
    apart = one != other
    low, high = torch.minimum(one, other)[apart], torch.maximum(one, other)[apart]
    keys, places = torch.unique(low * count + high, return_inverse=True)
    length = torch.zeros_like(keys).index_add_(0, places, borders.length[apart])
    return _Borders(keys // count, keys % count, length)
