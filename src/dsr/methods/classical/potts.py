"""Piecewise constant albedo: the Potts problem, by region fusion.

Of all piecewise constant albedos, it finds one with a low

    E = 1/2 sum (rgb - albedo * shading)^2 + weight * (number of pairs of neighbours in different regions),

the Potts prior of Haefner et al. (CVPR 2018). Regions are fused, as in Nguyen and Brown (*Fast and Effective L0
Gradient Minimization by Region Fusion*, ICCV 2015): from one region per pixel, two neighbours are fused if this costs
less than the boundary between them, whose weight grows to its value in a few levels. Many are fused at once, in
disjoint groups, and only if this lowers E at the current weight.
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


class _Borders(NamedTuple):
    """Pairs of neighbouring regions, (N,) each: both labels, and the length of the boundary between them."""

    one: Tensor
    other: Tensor
    length: Tensor


def fuse(rgb: Tensor, shading: Tensor, weight: float, inside: Tensor) -> Regions:
    """Return regions of which no fusion of two lowers E, equal for equal input.

    Image and shading are (B, C, H, W) float64, ``weight`` is that of a unit of boundary length, and ``inside`` the mask
    (B, 1, H, W) of the problem; each pixel outside is a region of its own.
    """
    batch, channels, height, width = rgb.shape
    labels = torch.arange(batch * height * width, device=rgb.device)
    squares, products = (each.movedim(1, -1).reshape(-1, channels) for each in (shading.square(), shading * rgb))
    borders = _find_borders(labels.reshape(batch, height, width), inside)
    turn = 0
    for level in range(_LEVELS, -1, -1):
        price = weight / _GROWTH**level
        while (parent := _choose_fusions(squares, products, borders, price, turn)) is not None:
            turn += 1
            roots = parent == torch.arange(len(parent), device=parent.device)
            joined = ~roots
            squares = squares.index_add(0, parent[joined], squares[joined])[roots]
            products = products.index_add(0, parent[joined], products[joined])[roots]
            renamed = (roots.cumsum(0) - 1)[parent]
            labels = renamed[labels]
            one, other = renamed[borders.one], renamed[borders.other]
            apart, count = one != other, len(squares)
            low, high = torch.minimum(one, other)[apart], torch.maximum(one, other)[apart]
            keys, places = torch.unique(low * count + high, return_inverse=True)  # each pair of regions once
            length = torch.zeros_like(keys).index_add_(0, places, borders.length[apart])
            borders = _Borders(keys // count, keys % count, length)
    return Regions(labels.reshape(batch, height, width), len(squares))


def fit_albedo(rgb: Tensor, shading: Tensor, regions: Regions) -> Tensor:
    """Return the best albedo that is constant in each region, (B, C, H, W)."""
    channels, flat = rgb.shape[1], regions.labels.reshape(-1)
    squares, products = (
        each.new_zeros(regions.number, channels).index_add_(0, flat, each.movedim(1, -1).reshape(-1, channels))
        for each in (shading.square(), shading * rgb)
    )
    return _best_albedo(squares, products)[regions.labels].movedim(-1, 1)


def boundary_length(regions: Regions, inside: Tensor) -> int:
    """Return the number of pairs of neighbours in different regions, both inside the mask (B, 1, H, W)."""
    borders = _find_borders(regions.labels, inside)
    return int((borders.one != borders.other).sum())


def _best_albedo(squares: Tensor, products: Tensor) -> Tensor:
    """Return the best albedo by the sums of shading^2 and shading * rgb, (count, C) each; 0 without shading."""
    best = products / torch.where(squares > 0, squares, 1)
    return torch.where(squares > 0, best, 0).clamp(0, BRIGHTEST)


def _worth(squares: Tensor, products: Tensor) -> Tensor:
    """Return the decrease of the data term from albedo 0 to the best albedo, (count,)."""
    albedo = _best_albedo(squares, products)
    return ((products - 0.5 * squares * albedo) * albedo).sum(dim=1)


def _find_borders(labels: Tensor, inside: Tensor) -> _Borders:
    """Return a border of length 1 for each pair of neighbouring pixels inside."""
    ends = []
    for dim in (-1, -2):
        size = labels.shape[dim] - 1
        both = inside[:, 0].narrow(dim, 0, size) & inside[:, 0].narrow(dim, 1, size)
        ends.append(torch.stack((labels.narrow(dim, 0, size)[both], labels.narrow(dim, 1, size)[both])))
    one, other = torch.cat(ends, dim=1)
    return _Borders(one, other, torch.ones_like(one))


def _choose_fusions(squares: Tensor, products: Tensor, borders: _Borders, price: float, turn: int) -> Tensor | None:
    """Return the region that each region is fused into, (count,), or None if no fusion of two lowers E."""
    one, other, length = borders
    worth, count = _worth(squares, products), len(squares)
    cost = (worth[one] + worth[other] - _worth(squares[one] + squares[other], products[one] + products[other])) / length
    cheap = cost < price
    if not bool(cheap.any()):
        return None
    leaf, centre = torch.cat((one, other))[cheap.repeat(2)], torch.cat((other, one))[cheap.repeat(2)]
    length, cost = length[cheap].repeat(2), cost[cheap].repeat(2)
    # a hash splits regions into centres and those that may join their best neighbour, if it is a centre
    joining = (_hash(torch.arange(count, device=one.device) + turn * count) & 1).bool()
    kept = ~joining[leaf] & joining[centre]
    leaf, centre, length, cost = leaf[kept], centre[kept], length[kept], cost[kept]
    kept = _is_cheapest(leaf, cost, count)
    leaf, centre, length, cost = leaf[kept], centre[kept], length[kept], cost[kept]
    union = squares.index_add(0, centre, squares[leaf]), products.index_add(0, centre, products[leaf])
    lost = worth.index_add(0, centre, worth[leaf]) - _worth(*union)
    saved = torch.zeros_like(worth).index_add_(0, centre, price * length.to(worth))
    # if all fusions of a centre together cost more than the boundaries, it only takes its best neighbour
    joins = (lost < saved)[centre] | _is_cheapest(centre, cost, count)
    parent = torch.arange(count, device=one.device)
    parent[leaf[joins]] = centre[joins]
    return parent


def _is_cheapest(owner: Tensor, cost: Tensor, count: int) -> Tensor:
    """Return the mask of the cheapest entry of each owner; ties are broken by a hash."""
    least = cost.new_full((count,), torch.inf).scatter_reduce_(0, owner, cost, "amin")
    number = torch.where(cost == least[owner], _hash(torch.arange(len(owner), device=owner.device)), _RANGE)
    return number == torch.full((count,), _RANGE, device=owner.device).scatter_reduce_(0, owner, number, "amin")[owner]


def _hash(number: Tensor) -> Tensor:
    """Return pseudo-random integers below 2^32; the map is one-to-one below 2^32."""
    for _ in range(2):
        number = (number * _SHUFFLE) % _RANGE
        number = number ^ (number >> 15)
    return number
