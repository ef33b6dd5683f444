"""Holes between a nearer and a farther surface: each pixel is assigned to one of them by the colours of the photo.

Stereo and structured light lose what lies beside and between near objects, such as the loop between an arm and a head;
filling from the rim would span a sheet between the two surfaces. So each pixel of such a hole is compared with the
measured pixels around it, up to three times as far as the rim, as in a joint bilateral filter: the two of each surface
that are nearest and most alike in colour stand for it. The pixel gets the farther depth if that surface explains its
colour at least as well as the nearer one, and the nearer if that does clearly better. A pixel is left to the method,
which knows slopes and its own errors, if filling from the rim gives the same surface. The probability that a pixel is
of the other surface counts in its expected error. See ``docs/measurements/scripts/holes.py`` for the figures.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.hole_size import distance_to_known, is_scattered
from dsr.methods.images import inpaint

_STEP = 1.1  # ratio of the depths around a pixel from which they are of two surfaces
# samples from a pixel to the end of its window, beyond which every second one counts up to twice as far; and how wide
# they are apart in pixels, for each pixel to the rim and two more
_RADIUS, _PER_STRIDE = 6, 0.25
_CONTRAST = 0.03  # standard deviation of the difference of the colours of a surface, on the scale of [0, 1]
_LEAST = 1e-4  # affinity of pixels of different colours
# distances beyond the rim over which a pixel counts less: as a witness of a surface, and for its depth
_SPREAD, _CLOSE = 0.5, 0.2
_WITNESSES = 2
_CLEARLY = 1.0  # logarithm of the ratio of how well they explain a pixel from which on one surface is clearly better
_DIFFERENT = 0.1  # logarithm of the ratio of depths from which what would be filled in is of another surface
# quantiles of the depths around a pixel, from 5 to 95 %; these have a step if two that are so many apart, a quarter of
# the depths, have more than this part of the range between them
_LEVELS, _APART, _PART = 19, 5, 0.5
_MOST = 1 << 14  # pixels at a time


class Settled(NamedTuple):
    """A map whose holes between two surfaces are filled, and how wrong that may be, (1, h, w) each."""

    inverse: Tensor  # in 1/m, NaN in the other holes
    doubt: Tensor  # the relative error to expect because a pixel may be of the other surface, 0 elsewhere


def settle_holes(inverse: Tensor, rgb: Tensor, holes: Tensor) -> Settled:
    """Return a map, (1, h, w) inverse depth, whose holes between two surfaces have the depth of one of them.

    ``rgb`` is (3, H, W) of the same view; ``holes``, (1, h, w) bool, are those to fill, others stay as they are.
    """
    known = inverse.isfinite()
    settled, doubt, of_method = inverse.clone(), torch.zeros_like(inverse), torch.zeros_like(inverse)
    if not bool((holes & ~known).any()) or is_scattered(known):
        return Settled(settled, doubt)
    colours = functional.adaptive_avg_pool2d(rgb[None].to(inverse), (inverse.shape[-2], inverse.shape[-1]))[0]
    away = distance_to_known(known)[0]
    places = torch.nonzero((holes & ~known)[0])
    for part in places.split(_MOST):
        rows, columns = part[:, 0], part[:, 1]
        found = _settle(inverse[0], colours, rows, columns, away[rows, columns].to(inverse))
        for whole, values in zip((settled, doubt, of_method), found, strict=True):
            whole[0, rows, columns] = values
    decided = settled.isfinite() & ~known
    if bool(decided.any()):
        usual = inpaint(inverse[None], rgb[None])[0]
        same = decided & ((settled / usual).log().abs() < _DIFFERENT)
        settled = settled.masked_fill(same, math.nan)
    return Settled(settled, torch.where(settled.isfinite(), doubt, of_method))


def _settle(
    inverse: Tensor, colours: Tensor, rows: Tensor, columns: Tensor, away: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return inverse depth at pixels, NaN where it is not decided, its doubt and that of the method's, (n,) each.

    The map is (h, w), the photo (3, h, w); the pixels and their distance to the nearest known one are (n,) each.
    """
    steps = torch.arange(-_RADIUS, _RADIUS + 1, device=inverse.device)
    fine = torch.cartesian_prod(steps, steps)
    fine = fine[fine.square().sum(1) <= _RADIUS**2]
    offsets = torch.cat((fine, 2 * fine[4 * fine.square().sum(1) > _RADIUS**2]))
    stride = (_PER_STRIDE * (away + 2)).ceil().long()[:, None]
    height, width = inverse.shape
    at_row, at_column = rows[:, None] + stride * offsets[:, 0], columns[:, None] + stride * offsets[:, 1]
    inside = (at_row >= 0) & (at_row < height) & (at_column >= 0) & (at_column < width)
    index = at_row.clamp(0, height - 1) * width + at_column.clamp(0, width - 1)
    values = inverse.flatten()[index]
    known = inside & values.isfinite()
    distance = stride * offsets.square().sum(1).to(inverse).sqrt()
    rim = known & (distance <= 1.5 * away[:, None] + 3)
    high = values.masked_fill(~rim, -math.inf).amax(1)
    low = values.masked_fill(~known, math.inf).amin(1)
    found, doubt, of_method = torch.full_like(away, math.nan), torch.zeros_like(away), torch.zeros_like(away)
    two = high > _STEP * low
    if not bool(two.any()):
        return found, doubt, of_method
    values, known, index, distance, away = values[two], known[two], index[two], distance[two], away[two]
    nearer = values > (high * low).sqrt()[two, None]
    difference = colours.flatten(1)[:, index] - colours[:, rows[two], columns[two], None]
    affinity = (difference.square().sum(0) / (-2 * _CONTRAST**2)).exp() + _LEAST
    beyond = ((distance - away[:, None]) / (away[:, None] + 2)).clamp(min=0)
    witness, close = (-beyond / _SPREAD).exp() * affinity, (-beyond / _CLOSE).exp() * affinity
    says, depths = [], []
    for surface in (known & ~nearer, known & nearer):
        most = min(_WITNESSES, values.shape[1])
        says.append((witness * surface).topk(most, 1).values.mean(1).clamp(min=1e-12).log())
        weight = close * surface
        depths.append((weight * values.nan_to_num(0)).sum(1) / weight.sum(1))
    better = says[0] - says[1]
    farther, clearly = better >= 0, better < -_CLEARLY
    result = torch.where(farther, depths[0], depths[1])
    other = torch.where(farther, depths[1], depths[0])
    wrong = torch.sigmoid(-better.abs() / 2)  # the witnesses of a surface are not independent of each other
    decided = (farther | clearly) & result.isfinite()
    found[two] = torch.where(decided, result, math.nan)
    gap = (other / result - 1).abs().nan_to_num(0)
    doubt[two] = (wrong * gap).clamp(max=1)
    gap = gap.masked_fill(~_has_step(values, known), 0)
    of_method[two] = (torch.where(decided, wrong.square(), wrong) * gap).clamp(max=1)  # decided: two ways agree
    return found, doubt, of_method


def _has_step(values: Tensor, known: Tensor) -> Tensor:
    """Return where the known ones of inverse depths, (n, k), are of two surfaces, not of a slope, (n,)."""
    ordered = values.masked_fill(~known, math.inf).sort(1).values
    places = torch.linspace(0.05, 0.95, _LEVELS, device=values.device) * (known.sum(1, keepdim=True) - 1)
    quantiles = ordered.gather(1, places.long()).log()
    part = (quantiles[:, _APART:] - quantiles[:, :-_APART]).amax(1)
    whole = quantiles[:, -1] - quantiles[:, 0]
    return (whole > math.log(_STEP)) & (part > _PART * whole)
