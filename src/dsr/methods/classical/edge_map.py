"""The high-resolution edge map of a low-resolution map: recurring patches of edges and a Markov random field.

Xie, Feris, Sun, *Edge-Guided Single Depth Image Super Resolution*, IEEE TIP 25(1), 2016, the self-similar mode, which
needs no training data. The map itself, downsampled once more, gives pairs of patches: edges found after upsampling, and
the true ones. The candidates of each patch of edges in the upsampled map are the pairs most similar to it, and a Markov
random field selects one of them: its data term is the squared distance of the patches' distance
transforms plus ``sharp_weight``^2 times that of the sharp edges, by the number of pixels, and its smoothness term the
squared difference of the true patches where two patches overlap. Loopy belief propagation finds the labels
(:mod:`dsr.methods.classical.edge_patches`). The mean of the chosen patches, where it is above ``KEPT``, is the
edge map.

As in the original: patches of 11 x 11 pixels in the self-similar mode, 5 candidates, weight 3, 100 iterations, a mean
above 0.2, edges of less than 4 pixels dropped, pairs only if both have enough edge pixels and similar numbers of them.

What differs:

- Edges are Canny's edges of the bicubic map, whose inflection lines locate a step of block means within a
  low-resolution pixel. In the original, a map holds single samples, each repeated as a block, and a shock filter makes
  a second, sharper edge map for the data term. As that filter does not move inflection lines, one map serves for both
  here.
- The slope of the surface does not count as a step.
- Pairs are used in the 8 exact orientations of the grid, not rotated by multiples of 18 degrees.
- Each cell of 2 x 2 pixels has at most one patch; the original scans, and skips the neighbours of each patch.
- The edge map is thinned to lines one pixel wide. The map is extrapolated linearly, so that edges reach the border.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.base import NoSolutionError
from dsr.methods.classical.edge_patches import (
    PATCH,
    Labelling,
    Patches,
    average_patches,
    deduplicate,
    extract_patches,
    find_nearest,
    find_overlaps,
    label,
    no_patches,
    orient,
)
from dsr.methods.classical.finite_differences import box_mean, extend_linearly, upsample_linear_border
from dsr.methods.classical.photo_guided import estimate_slopes
from dsr.methods.inpainting import inpaint
from dsr.utils.progress import Steps

KEPT = 0.2  # fraction of the chosen patches from which a pixel is an edge
_WEAK = 0.4  # canny's lower threshold relative to the upper one
_CELL = 2  # side in pixels of the cells with at most one patch each
_SMALLEST = 4  # minimum number of edge pixels around an edge pixel, itself included
# rows and columns of the 8 neighbours in a 3 x 3 window, clockwise from the one above
_AROUND = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))


def predict_edge_map(
    lr: Tensor,
    scale: int,
    step: float,
    candidates: int = 5,
    sharp_weight: float = 3.0,
    smoothness: float = 1.0,
    iterations: int = 100,
    progress: Steps | None = None,
) -> tuple[Tensor, Labelling | None]:
    """Return the edge map of a map (h, w), NaN in holes, (h * scale, w * scale) bool, and its labelling.

    ``step`` is the minimum height of an edge in the map's unit; the others are as for
    :class:`dsr.methods.classical.edge_guided.EdgeGuided`. The labelling is None without an edge.
    """
    border = -(-(PATCH // 2 + 1) // scale)
    edges = detect_edges(extend_linearly(lr[None, None], border)[0, 0], scale, step)
    within = (slice(border * scale, -border * scale),) * 2
    if not bool(edges[within].any()):
        return torch.zeros_like(edges[within]), None
    examples = find_recurring(lr, scale, step)
    if len(examples.low) == 0:
        raise NoSolutionError(
            f"edge-guided upsampling: the edges of a map of {lr.shape[0]} x {lr.shape[1]} pixels do not recur "
            f"at 1/{scale} of its size, so nothing shows how high-resolution ones look"
        )
    places = _patch_centres(edges)
    distances, indices = find_nearest(extract_patches(edges, places), examples, candidates, sharp_weight)
    patches = examples.high.flatten(1)[indices].float()  # (N, K, PATCH^2)
    pairs, costs = find_overlaps(places, patches)
    answer = label(distances / PATCH**2, pairs, smoothness * costs, iterations, progress=progress)
    chosen = patches[torch.arange(len(patches), device=patches.device), answer.labels]
    mean = average_patches(chosen, places, (edges.shape[0], edges.shape[1]))
    return _drop_small(thin(mean > KEPT))[within], answer


def detect_edges(lr: Tensor, scale: int, step: float) -> Tensor:
    """Return the edges of a map, (h, w), upsampled by ``scale``, (h * scale, w * scale) bool, about one pixel wide.

    Canny, *A Computational Approach to Edge Detection*, PAMI 1986: pixels whose gradient is a maximum
    along its direction and above a threshold, or above a lower one and connected with such a pixel. A step of height s
    between low-resolution pixels has a gradient of at least s / 2. A gradient counts only by how much it exceeds the
    slope of the surface (see
    :func:`dsr.methods.classical.photo_guided.estimate_slopes`) there or at a neighbouring low-resolution pixel. So a
    plane has no edge, however steep it is, and neither has an inpainted hole.
    """
    hr = upsample_linear_border(inpaint(lr[None, None]), scale)[0, 0]
    down, across = (_central_difference(hr, axis) * scale for axis in (0, 1))
    strength = (down.square() + across.square()).sqrt()
    excess = [(_central_difference(lr, axis) - estimate_slopes(lr, axis)).square() for axis in (0, 1)]
    most = functional.max_pool2d((excess[0] + excess[1]).sqrt().nan_to_num(nan=0.0)[None, None], 3, stride=1, padding=1)
    most = most.repeat_interleave(scale, 2).repeat_interleave(scale, 3)[0, 0]
    ridge = torch.minimum(strength, most) * _is_ridge(strength, down, across)
    strong, weak = ridge > step / 2, ridge > _WEAK * step / 2
    return _drop_small(_grow(strong, weak))


def find_recurring(lr: Tensor, scale: int, step: float) -> Patches:
    """Return the pairs of patches of a map, (h, w), downsampled by ``scale``; none if it is too small."""
    height, width = (n - n % scale for n in lr.shape)
    if min(height, width) < max(PATCH, 2 * scale):
        return no_patches(lr.device)
    truth = lr[:height, :width]
    low, high = detect_edges(box_mean(truth[None, None], scale)[0, 0], scale, step), detect_edges(truth, 1, step)
    half = PATCH // 2
    places = low[half : height - half, half : width - half].nonzero() + half
    lows, highs = extract_patches(low, places), extract_patches(high, places)
    first, second = lows.sum(dim=(1, 2)), highs.sum(dim=(1, 2))
    enough = min(2 * scale, PATCH - 3)
    kept = (first > enough) & (second > enough) & ((first - second).abs() < 0.8 * PATCH)
    return deduplicate(Patches(orient(lows[kept]), orient(highs[kept])))


def thin(mask: Tensor) -> Tensor:
    """Thin a mask, (H, W), to lines about one pixel wide, preserving connectivity.

    Zhang, Suen, *A Fast Parallel Algorithm for Thinning Digital Patterns*, CACM 27(3), 1984.
    """
    while True:
        before = mask
        for first, second in (((0, 2, 4), (2, 4, 6)), ((0, 2, 6), (0, 4, 6))):
            around = _neighbours(mask)
            number = around.sum(dim=0)
            starts = (~around & around.roll(-1, 0)).sum(dim=0)
            free = ~(around[list(first)].all(dim=0) | around[list(second)].all(dim=0))
            mask = mask & ~((number >= 2) & (number <= 6) & (starts == 1) & free)
        if bool((mask == before).all()):
            return mask


def _neighbours(x: Tensor) -> Tensor:
    """Return the 8 neighbours of each pixel, clockwise from the one above, (8, H, W); 0 beyond the border."""
    height, width = x.shape
    padded = functional.pad(x, (1, 1, 1, 1))
    return torch.stack([padded[v : v + height, u : u + width] for v, u in _AROUND])


def _central_difference(x: Tensor, axis: int) -> Tensor:
    """Return the central difference along an axis, one-sided at the border, 0 along a single pixel."""
    return torch.gradient(x, dim=axis)[0] if x.shape[axis] > 1 else torch.zeros_like(x)


def _is_ridge(strength: Tensor, down: Tensor, across: Tensor) -> Tensor:
    """Return where the strength is the maximum of three pixels along the gradient, (H, W) bool; of equal ones one.

    The direction of the gradient is rounded to that of the nearest of the 8 neighbours.
    """
    ring = _neighbours(strength)
    turn = (torch.atan2(across, -down) / (torch.pi / 4)).round().long().remainder(4)[None]
    return (strength > ring.gather(0, turn)[0]) & (strength >= ring.gather(0, turn + 4)[0])


def _grow(strong: Tensor, weak: Tensor) -> Tensor:
    """Return the weak pixels that are connected with strong ones."""
    grown = strong & weak
    while True:
        new = weak & (functional.max_pool2d(grown[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0)
        if bool((new == grown).all()):
            return grown
        grown = new


def _drop_small(mask: Tensor) -> Tensor:
    """Return a mask without pixels that have less than ``_SMALLEST`` pixels in the window around them."""
    size = 2 * _SMALLEST - 1
    number = functional.avg_pool2d(mask[None, None].float(), size, 1, size // 2, divisor_override=1)[0, 0]
    return mask & (number > _SMALLEST - 0.5)


def _patch_centres(edges: Tensor) -> Tensor:
    """Return the first edge pixel of each cell whose patch lies inside the map, (N, 2)."""
    half = PATCH // 2
    places = edges[half:-half, half:-half].nonzero() + half
    number = places[:, 0] // _CELL * edges.shape[1] + places[:, 1] // _CELL
    order = number.argsort(stable=True)
    first = torch.ones_like(number, dtype=torch.bool)
    first[1:] = number[order].diff() != 0
    return places[order[first].sort().values]
