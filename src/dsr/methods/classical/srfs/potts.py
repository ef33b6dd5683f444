"""Piecewise constant albedo: the Potts problem, by region fusion.

Of all albedos that are constant in regions, the one with the least

    E = 1/2 sum (photo - albedo * shading)^2 + weight * (length of the regions' boundaries)

where the length counts the pairs of neighbours, left and right or above and below, that belong to different regions:
the Potts prior on the albedo of Haefner et al. (CVPR 2018), who minimise it with the primal-dual iteration of
Strekalovskiy and Cremers (*Real-Time Minimization of the Piecewise Smooth Mumford-Shah Functional*, ECCV 2014) and
count pixels whose gradient is not 0. Here regions are fused, as by Nguyen and Brown (*Fast and Effective L0 Gradient
Minimization by Region Fusion*, ICCV 2015): it starts with a region a pixel; two neighbours become one where that costs
less than the boundary between them, the weight of which grows from little to its value. Many are fused at once, in
groups that do not touch each other and only where that lowers E as weighed at the time. Albedos are constant to the
last digit, boundaries exact, and no fusion of two of the regions that result lowers E.

A region's best albedo is sum (shading * photo) / sum shading^2 in each channel, cut to 0 .. BRIGHTEST: a shading near 0
asks for any albedo. Memory: about 60 maps of 8 bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

BRIGHTEST = 2.0
"""The most that an albedo may be; the least is 0."""
_LEVELS = 5
"""How often the weight of a boundary grows to its value."""
_GROWTH = 4.0
"""By what it grows each time."""
_SHUFFLE = 2654435761
"""Multiplier of Knuth's hash."""
_RANGE = 2**32


class Regions(NamedTuple):
    """A partition: ``labels`` (B, H, W) int64 from 0 on, none in two images; ``number`` of them."""

    labels: Tensor
    number: int


class _Fits(NamedTuple):
    """Of each region, (count, C): the sums of squared shading and of shading times photo."""

    squares: Tensor
    products: Tensor

    def albedo(self) -> Tensor:
        """Return the best albedo within its bounds; 0 where there is no shading."""
        best = self.products / torch.where(self.squares > 0, self.squares, 1)
        return torch.where(self.squares > 0, best, 0).clamp(0, BRIGHTEST)

    def worth(self) -> Tensor:
        """Return by how much the best albedo lowers the data term below that of albedo 0, (count,)."""
        albedo = self.albedo()
        return ((self.products - 0.5 * self.squares * albedo) * albedo).sum(dim=1)


class _Borders(NamedTuple):
    """Of each pair of neighbouring regions, (N,): the one, the other, and the length between them."""

    one: Tensor
    other: Tensor
    length: Tensor


def fuse(rgb: Tensor, shading: Tensor, weight: float, inside: Tensor | None = None) -> Regions:
    """Return regions that are a local minimum of E.

    Args:
        rgb: (B, C, H, W) float64.
        shading: likewise.
        weight: of a unit of boundary.
        inside: (B, 1, H, W) bool, the pixels that belong to the problem, None for all; others stay alone.

    Returns:
        the regions, the same for the same input.

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
    """Return the best albedo that is constant in regions, (B, C, H, W)."""
    channels = rgb.shape[1]
    flat = regions.labels.reshape(-1)
    sums = [
        each.new_zeros(regions.number, channels).index_add_(0, flat, each.movedim(1, -1).reshape(-1, channels))
        for each in (shading.square(), shading * rgb)
    ]
    return _Fits(*sums).albedo()[regions.labels].movedim(-1, 1)


def boundary_length(regions: Regions, inside: Tensor | None = None) -> int:
    """Return how many pairs of neighbours belong to different regions; both ``inside``."""
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
    """Return what each region becomes part of, (count,), None where no fusion of two lowers E.

    Each region's best neighbour is the one with the least cost of fusing for a unit of the boundary that this saves.
    A hash says which regions may take others in, and which may join their best neighbour, if that takes in. Where that
    costs more than the boundaries between them, the region takes in its best one alone.
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
    leaf, centre, length, cost = _select(~takes[ends[0]] & takes[ends[1]], ends[0], ends[1], length, cost)
    leaf, centre, length, cost = _select(_is_cheapest(leaf, cost, count), leaf, centre, length, cost)
    union = _Fits(*(each.index_add(0, centre, each[leaf]) for each in fits))
    lost = worth.index_add(0, centre, worth[leaf]) - union.worth()
    saved = torch.zeros_like(worth).index_add_(0, centre, price * length.to(worth))
    alone = _is_cheapest(centre, cost, count)
    parent = torch.arange(count, device=one.device)
    joins = (lost < saved)[centre] | alone
    parent[leaf[joins]] = centre[joins]
    return parent


def _is_cheapest(owner: Tensor, cost: Tensor, count: int) -> Tensor:
    """Return which entry is the cheapest of its owner, one each; ties are broken by a hash."""
    least = cost.new_full((count,), torch.inf).scatter_reduce_(0, owner, cost, "amin")
    number = _hash(torch.arange(len(owner), device=owner.device))
    number = torch.where(cost == least[owner], number, _RANGE)
    return number == torch.full((count,), _RANGE, device=owner.device).scatter_reduce_(0, owner, number, "amin")[owner]


def _select(which: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    return tuple(each[which] for each in values)


def _hash(number: Tensor) -> Tensor:
    """Return whole numbers below 2^32 that look random; none twice for numbers below it."""
    for _ in range(2):
        number = (number * _SHUFFLE) % _RANGE
        number = number ^ (number >> 15)
    return number


def _merge_borders(borders: _Borders, renamed: Tensor, count: int) -> _Borders:
    """Return the borders between regions that have new names, each once."""
    one, other = renamed[borders.one], renamed[borders.other]
    apart = one != other
    low, high = torch.minimum(one, other)[apart], torch.maximum(one, other)[apart]
    keys, places = torch.unique(low * count + high, return_inverse=True)
    length = torch.zeros_like(keys).index_add_(0, places, borders.length[apart])
    return _Borders(keys // count, keys % count, length)
