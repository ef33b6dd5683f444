"""The high-resolution edge map of a low-resolution map: recurring patches of edges and a Markov random field.

Xie, Feris, Sun, *Edge-Guided Single Depth Image Super Resolution*, IEEE TIP 25(1), 2016, the self-similar mode. The map
itself, downsampled once more, gives pairs of patches: edges found after upsampling, and the true ones. The candidates
of each patch of edges in the upsampled map are the pairs most similar to it, and a Markov random field selects one of
them: its data term is the squared distance of the patches' distance transforms plus ``sharp_weight``^2 times that of
the sharp edges, by the number of pixels, and its smoothness term the squared difference of the true patches where two
patches overlap. The mean of the chosen patches, where it is above ``_KEPT``, and thinned to lines, is the edge map.

What differs: edges are Canny's edges of the bicubic map, and the surface's slope does not count. Pairs are used in the
8 orientations of the grid, not rotated by multiples of 18 degrees. Each cell of 2 x 2 pixels has at most one patch. The
map is extrapolated, so edges reach the border.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.methods.base import NoSolutionError
from dsr.methods.classical.guided_filter import estimate_slopes
from dsr.methods.images import box_mean, extend_linearly, inpaint, upsample_linear_border
from dsr.utils.progress import Steps, ignore

PATCH = 11  # rows and columns of a patch, in high-resolution pixels
_ENTRIES = 2**24  # maximum number of distances between patches in memory
_BITS = 62  # pixels per 64-bit word, without its sign
_MOVE = 0.5  # damping factor of messages; 1 would be undamped
_CHECK_EVERY = 5  # iterations between two evaluations of the labels
_KEPT = 0.2  # fraction of the chosen patches from which a pixel is an edge
_WEAK = 0.4  # Canny's lower threshold relative to the upper one
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
) -> tuple[Tensor, list[dict[str, float]]]:
    """Return the edge map of a map (h, w), NaN in holes, (h * scale, w * scale) bool, and :func:`label`'s history.

    ``step`` is the minimum height of an edge in the map's unit; the others are as for
    :class:`dsr.methods.classical.edge_guided.EdgeGuided`. The history is empty without an edge.
    """
    border = -(-(PATCH // 2 + 1) // scale)
    edges = detect_edges(extend_linearly(lr[None, None], border)[0, 0], scale, step)
    within = (slice(border * scale, -border * scale),) * 2
    if not bool(edges[within].any()):
        return torch.zeros_like(edges[within]), []
    examples = find_recurring(lr, scale, step)
    if len(examples) == 0:
        raise NoSolutionError(
            f"edge-guided upsampling: the edges of a map of {lr.shape[0]} x {lr.shape[1]} pixels do not recur "
            f"at 1/{scale} of its size, so nothing shows how high-resolution ones look"
        )
    half = PATCH // 2  # the first edge pixel of each cell whose patch lies inside the map
    places = edges[half:-half, half:-half].nonzero() + half
    cells = places[:, 0] // _CELL * edges.shape[1] + places[:, 1] // _CELL
    first = np.sort(np.unique(cells.cpu().numpy(), return_index=True)[1])
    places = places[torch.from_numpy(first).to(places.device)]
    distances, indices = find_nearest(extract_patches(edges, places), examples, candidates, sharp_weight)
    patches = examples[:, 1].flatten(1)[indices].float()  # (N, K, PATCH^2)
    pairs, costs = find_overlaps(places, patches)
    labels, history = label(distances / PATCH**2, pairs, smoothness * costs, iterations, progress=progress)
    chosen = patches[torch.arange(len(patches), device=patches.device), labels]
    total, number = chosen.new_zeros(edges.shape), chosen.new_zeros(edges.shape)  # of the patches that cover a pixel
    for k in range(PATCH**2):  # for one k, all patches touch different pixels
        rows, columns = places[:, 0] + k // PATCH - PATCH // 2, places[:, 1] + k % PATCH - PATCH // 2
        total[rows, columns] += chosen[:, k]
        number[rows, columns] += 1
    return _drop_small(thin(total / number.clamp(min=1) > _KEPT))[within], history


def detect_edges(lr: Tensor, scale: int, step: float) -> Tensor:
    """Return the edges of a map, (h, w), upsampled by ``scale``, (h * scale, w * scale) bool, about one pixel wide.

    Canny, *A Computational Approach to Edge Detection*, PAMI 1986. A step of height s has a gradient of at least s / 2,
    which counts only by how much it exceeds the slope of the surface around: planes and inpainted holes have no edges.
    """
    hr = upsample_linear_border(inpaint(lr[None, None]), scale)[0, 0]
    down, across = (_central_difference(hr, axis) * scale for axis in (0, 1))
    strength = (down.square() + across.square()).sqrt()
    excess = [(_central_difference(lr, axis) - estimate_slopes(lr, axis)).square() for axis in (0, 1)]
    most = functional.max_pool2d((excess[0] + excess[1]).sqrt().nan_to_num(nan=0.0)[None, None], 3, stride=1, padding=1)
    most = most.repeat_interleave(scale, 2).repeat_interleave(scale, 3)[0, 0]
    ring = _neighbours(strength)  # the maximum of three pixels along the gradient, to the nearest of 8 neighbours
    turn = (torch.atan2(across, -down) / (torch.pi / 4)).round().long().remainder(4)[None]
    ridge = torch.minimum(strength, most) * (
        (strength > ring.gather(0, turn)[0]) & (strength >= ring.gather(0, turn + 4)[0])
    )
    weak, strong = ((ridge > share * step / 2).cpu().numpy() for share in (_WEAK, 1))
    connected = ndimage.binary_propagation(strong, np.ones((3, 3)), weak)
    return _drop_small(torch.from_numpy(connected).to(lr.device))


def find_recurring(lr: Tensor, scale: int, step: float) -> Tensor:
    """Return pairs of patches of a map, (h, w), downsampled by ``scale``, (N, 2, PATCH, PATCH) bool.

    The first of a pair has the edges of the upsampled map, the second the true ones. There is none in a map too small.
    """
    height, width = (n - n % scale for n in lr.shape)
    if min(height, width) < max(PATCH, 2 * scale):
        return torch.zeros(0, 2, PATCH, PATCH, dtype=torch.bool, device=lr.device)
    truth = lr[:height, :width]
    low, high = detect_edges(box_mean(truth[None, None], scale)[0, 0], scale, step), detect_edges(truth, 1, step)
    half = PATCH // 2
    places = low[half : height - half, half : width - half].nonzero() + half
    patches = torch.stack((extract_patches(low, places), extract_patches(high, places)), dim=1)
    first, second = patches.sum(dim=(2, 3)).unbind(1)
    enough = min(2 * scale, PATCH - 3)
    kept = (first > enough) & (second > enough) & ((first - second).abs() < 0.8 * PATCH)
    return deduplicate(orient(patches[kept]))


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


def _drop_small(mask: Tensor) -> Tensor:
    """Return a mask without pixels that have less than ``_SMALLEST`` pixels in the window around them."""
    size = 2 * _SMALLEST - 1
    number = functional.avg_pool2d(mask[None, None].float(), size, 1, size // 2, divisor_override=1)[0, 0]
    return mask & (number > _SMALLEST - 0.5)


def extract_patches(mask: Tensor, places: Tensor) -> Tensor:
    """Return the patches of a mask, (H, W), around positions (N, 2), rows and columns, whose patches lie inside."""
    offsets = torch.arange(PATCH, device=mask.device) - PATCH // 2
    return mask[places[:, 0, None, None] + offsets[:, None], places[:, 1, None, None] + offsets]


def orient(patches: Tensor) -> Tensor:
    """Return patches, (N, ..., PATCH, PATCH), under the 8 dihedral transforms, (8 N, ..., PATCH, PATCH)."""
    quarters = [patches.rot90(k, (-2, -1)) for k in range(4)]
    return torch.cat(quarters + [each.mT for each in quarters])


def deduplicate(patches: Tensor) -> Tensor:
    """Return the pairs of patches, (N, 2, PATCH, PATCH) bool, without repetitions, sorted."""
    bits = patches.flatten(1).long()
    place = torch.arange(_BITS, device=bits.device)
    words = (functional.pad(bits, (0, -bits.shape[1] % _BITS)).unflatten(1, (-1, _BITS)) << place).sum(dim=2)
    words = torch.unique(words, dim=0)
    bits = ((words[:, :, None] >> place) & 1).flatten(1)[:, : bits.shape[1]]
    return bits.bool().unflatten(1, patches.shape[1:])


def edge_distances(patches: Tensor) -> Tensor:
    """Return each pixel's Euclidean distance from the edges of its patch, (N, PATCH, PATCH) float32.

    Infinite in a patch without an edge.
    """
    place = torch.arange(PATCH, device=patches.device)
    square = (place[:, None] - place).square().float()
    along = torch.where(patches[:, :, None], square, torch.inf).amin(dim=3)  # (N, row, column), within the row
    return (along[:, None] + square[:, :, None]).amin(dim=2).sqrt()


def find_nearest(query: Tensor, examples: Tensor, count: int, weight: float) -> tuple[Tensor, Tensor]:
    """Return the examples most similar to patches: squared distances and indices, (N, count) each, the best first.

    |D(query) - D(low)|^2 + weight^2 |query - high|^2, D being :func:`edge_distances`.
    """

    def features(low: Tensor, high: Tensor) -> Tensor:
        return torch.cat((edge_distances(low).flatten(1), weight * high.flatten(1).float()), dim=1)

    known = features(examples[:, 0], examples[:, 1])
    length = known.square().sum(dim=1)
    found = []
    for chunk in query.split(max(_ENTRIES // len(known), 1)):
        asked = features(chunk, chunk)
        square = asked.square().sum(dim=1, keepdim=True) + length - 2 * asked @ known.T
        found.append(square.clamp_(min=0).topk(min(count, len(known)), dim=1, largest=False))
    return torch.cat([each.values for each in found]), torch.cat([each.indices for each in found])


def find_overlaps(places: Tensor, patches: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pairs of overlapping patches, (E, 2), and the disagreement of their candidates, (E, K, K).

    The disagreement is the sum of squared differences over the pixels that both patches cover. ``places`` are the rows
    and columns of the patches' centres, (N, 2), all different, and ``patches`` the candidates, (N, K, PATCH^2) float.
    """
    index = places.new_full(tuple((places.amax(dim=0) + PATCH).tolist()), -1)
    index[places[:, 0], places[:, 1]] = torch.arange(len(places), device=places.device)
    images = patches.unflatten(2, (PATCH, PATCH))
    pairs, costs = [places.new_zeros(0, 2)], [patches.new_zeros(0, patches.shape[1], patches.shape[1])]
    for down in range(PATCH):
        for across in range(-PATCH + 1 if down else 1, PATCH):
            first = (places[:, 1] + across >= 0).nonzero()[:, 0]
            second = index[places[first, 0] + down, places[first, 1] + across]
            first, second = first[second >= 0], second[second >= 0]
            if len(first):
                pairs.append(torch.stack((first, second), dim=1))
                left, right = max(across, 0), max(-across, 0)
                a = images[first][:, :, down:, left : PATCH - right].flatten(2)
                b = images[second][:, :, : PATCH - down, right : PATCH - left].flatten(2)
                costs.append(a.square().sum(dim=2)[:, :, None] + b.square().sum(dim=2)[:, None] - 2 * a @ b.mT)
    return torch.cat(pairs), torch.cat(costs)


def label(
    unary: Tensor,
    pairs: Tensor,
    costs: Tensor,
    iterations: int = 100,
    tolerance: float = 1e-3,
    progress: Steps | None = None,
) -> tuple[Tensor, list[dict[str, float]]]:
    """Return labels, (N,), that have a low :func:`energy`, and the history of min-sum belief propagation.

    Pearl, *Probabilistic Reasoning in Intelligent Systems*, 1988. The message from i to j is m_ij(x_j) = min over x_i
    of unary_i(x_i) + cost_ij(x_i, x_j) + the messages to i from nodes other than j, less its minimum, damped by one
    half. A node's label minimises unary_i plus all messages to it; the best labels so far are kept. ``unary`` is
    (N, K), ``costs`` (E, K, K) are those of the labels of the nodes of each pair (E, 2). It stops if ``moved``, the
    largest change of a message relative to the largest cost, is at most the tolerance; ``objective`` is the energy.
    """
    report = progress or ignore
    unit = (float(costs.abs().max()) if len(costs) else 0.0) or 1.0
    sources = torch.cat((pairs[:, 0], pairs[:, 1]))
    both = torch.cat((costs, costs.mT))  # (2E, K, K): the source's labels, the target's
    heard = _incoming(torch.cat((pairs[:, 1], pairs[:, 0])), len(unary))
    silence = torch.zeros_like(unary[:1])
    messages = unary.new_zeros(2 * len(pairs), unary.shape[1])
    beliefs, best, least, history = unary, unary.argmin(dim=1), torch.inf, []
    for done in range(1, iterations + 1):
        others = beliefs[sources] - messages.roll(len(pairs), 0)  # less the target's message
        new = (others[:, :, None] + both).amin(dim=1)
        step = (new - new.amin(dim=1, keepdim=True) - messages) * _MOVE
        messages = messages + step
        beliefs = unary + torch.cat((messages, silence))[heard].sum(dim=1)
        moved = float(step.abs().max()) / unit if len(step) else 0.0
        settled = moved <= tolerance
        if settled or done % _CHECK_EVERY == 0 or done == iterations:
            found = beliefs.argmin(dim=1)
            now = energy(found, unary, pairs, costs)
            history.append({"iteration": float(done), "objective": now, "moved": moved})
            if now < least:
                best, least = found, now
            report(iterations if settled else done, iterations)
        if settled:
            break
    return best, history


def energy(labels: Tensor, unary: Tensor, pairs: Tensor, costs: Tensor) -> float:
    """Return the energy of labels, (N,): the sum of their own costs and of those of the pairs."""
    alone = unary.gather(1, labels[:, None]).sum()
    first, second = labels[pairs[:, 0]], labels[pairs[:, 1]]
    return float(alone + costs[torch.arange(len(pairs), device=pairs.device), first, second].sum())


def _incoming(targets: Tensor, count: int) -> Tensor:
    """Return the indices of the messages to each node, (count, most), padded with the index past the last."""
    order = targets.argsort(stable=True)
    numbers = torch.bincount(targets, minlength=count)
    starts = numbers.cumsum(0) - numbers
    most = int(numbers.max()) if count else 0
    table = targets.new_full((count, most), len(targets))
    place = torch.arange(len(targets), device=targets.device) - starts[targets[order]]
    table[targets[order], place] = order
    return table
