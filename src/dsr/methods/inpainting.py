"""Inpainting of holes in low-resolution maps, for methods that need a value everywhere."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.exportable import exporting, fill_by_colour_in_graph, fill_in_graph, neighbours_of

_CONTRAST = 0.02  # standard deviation of the difference of the colours of a surface's neighbouring pixels in [0, 1]
_ALIKE = 0.3  # affinity from which two pixels count as of one surface
_LEAST = 1e-4  # affinity of pixels of different surfaces


def inpaint(x: Tensor, photo: Tensor | None = None) -> Tensor:
    """Replace the non-finite values of (B, 1, h, w) by means of the valid ones in 3 x 3 pixels, from outside in.

    With a photo, the means are weighted by how alike the colours are, and pixels of the colour of a valid neighbour are
    filled before others, so that values stop at the photo's edges. An image without a valid value stays unchanged. The
    photo is (B, 3, H, W) in [0, 1], of any size.

    Example:
        >>> import torch
        >>> from dsr.methods.inpainting import inpaint
        >>> values = torch.full((1, 1, 5, 5), 0.5)
        >>> values[..., 1:3, 1:3] = torch.nan
        >>> inpaint(values).unique()
        tensor([0.5000])

    """
    if not exporting() and bool(x.isfinite().all()):
        return x
    if photo is None:
        return _fill_evenly(x)
    if exporting():  # one factor for both axes
        colours = functional.avg_pool2d(photo.to(x.dtype), int(photo.shape[-1] // x.shape[-1]))
    else:
        colours = functional.adaptive_avg_pool2d(photo.to(x.dtype), (x.shape[-2], x.shape[-1]))
    colours = functional.avg_pool2d(functional.pad(colours, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    if exporting():
        difference = (neighbours_of(colours) - colours[:, None]).square().sum(dim=2)  # (B, 8, h, w)
        affinity = (difference / (-2 * _CONTRAST**2)).exp().clamp(min=_LEAST)
        return fill_by_colour_in_graph(x, affinity, _ALIKE)
    return torch.stack([_fill_by_colour(each[0], colour) for each, colour in zip(x, colours, strict=True)])[:, None]


def _fill_evenly(x: Tensor) -> Tensor:
    """Return the maps, (B, 1, h, w), filled with plain means."""
    valid = x.isfinite()
    values, weight = torch.where(valid, x, 0), valid.to(x.dtype)
    if exporting():
        values, weight = fill_in_graph(values, weight)
        return torch.where(weight > 0, values, torch.nan)
    for _ in range(max(x.shape[-2:])):
        total, fraction = (functional.avg_pool2d(each, 3, stride=1, padding=1) for each in (values, weight))
        new = (weight == 0) & (fraction > 0)
        if not bool(new.any()):
            break
        values = torch.where(new, total / torch.where(fraction > 0, fraction, 1), values)
        weight = torch.where(new, 1, weight)
    return torch.where(weight > 0, values, torch.nan)


def _fill_by_colour(x: Tensor, colours: Tensor) -> Tensor:
    """Return a map, (h, w), filled with means weighted by the colours, (3, h, w)."""
    height, width = x.shape
    values = functional.pad(x, (1, 1, 1, 1), value=torch.nan).flatten()
    colour = functional.pad(colours, (1, 1, 1, 1)).flatten(1)
    inside = functional.pad(torch.ones_like(x, dtype=torch.bool), (1, 1, 1, 1)).flatten()
    steps = [row * (width + 2) + column for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]
    around = torch.tensor(steps, device=x.device)
    unknown = values.isnan() & inside
    known = values.isfinite()
    places = unknown.nonzero()[:, 0]
    front = places[known[places[:, None] + around].any(dim=1)]  # beside what has just become known
    waiting, every = torch.zeros_like(known), False  # beside known pixels, none of which is alike
    while front.numel():
        beside = front[:, None] + around  # (n, 8)
        difference = (colour[:, beside] - colour[:, front, None]).square().sum(dim=0)
        affinity = (difference / (-2 * _CONTRAST**2)).exp().clamp(min=_LEAST) * known[beside]
        first = (affinity.amax(dim=1) >= _ALIKE) | every
        waiting[front] = ~first
        filled, affinity, beside = front[first], affinity[first], beside[first]
        values[filled] = (affinity * values[beside].nan_to_num(0)).sum(dim=1) / affinity.sum(dim=1)
        known[filled] = True
        unknown[filled] = False
        beside = beside.flatten()
        front = beside[unknown[beside]].unique()
        every = not front.numel()
        if every:
            front = waiting.nonzero()[:, 0]
    return values.view(height + 2, width + 2)[1:-1, 1:-1]
