"""Edge-guided upsampling of a depth map alone: a bilateral filter whose means do not cross predicted edges.

Xie, Feris, Sun, *Edge-Guided Single Depth Image Super Resolution*, IEEE TIP 25(1), 2016, in its self-similar mode. The
map itself, downsampled once more, gives pairs of patches: edges found after upsampling, and the true ones. A Markov
random field selects one of the most similar pairs for each patch of edges in the upsampled map; the mean of the true
ones, thinned to lines, is the edge map. The modified joint bilateral filter then is

    S_p = 1 / k_p * sum over low-resolution pixels q of S_q f(|p - q|) r(p, q),

with f a Gaussian of the distance in low-resolution pixels, r = 1 if a 4-connected path from p to q within the
neighbourhood touches no edge and 0 otherwise, and k_p the sum of the weights. What differs is in
docs/measurements/methods.md, and: a low-resolution pixel with an edge through it mixes both sides, so its weight is
multiplied by ``mixed``. Pixels on edges get the value that preserves the mean of their block; in the last stage, each
then takes the reachable pixels of its most similar neighbour off the edge.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import from_range
from dsr.methods.base import Abilities, Cost, Method, NoSolutionError, whole_scale
from dsr.methods.classical.guided_filter import BEYOND, estimate_slopes, expect_window
from dsr.methods.images import box_mean, extend_linearly, inpaint, repeat_blocks, upsample_linear_border
from dsr.sample import DepthSample
from dsr.utils.guards import expect_positive
from dsr.utils.progress import Steps, ignore, part_of

# rows and columns from a pixel to its neighbours, the nearest first
_BESIDE = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
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


def bilateral_filter(
    lr: Tensor,
    barrier: Tensor,
    scale: int,
    radius: int,
    sigma_space: float,
    mixed: float,
    *,
    doubtful: Tensor | None = None,
    sharp: bool = True,
) -> Tensor:
    """Upsample a map, (h, w), by the modified joint bilateral filter to (H, W); holes, NaN, stay holes.

    The barrier is the edge map, (H, W) bool. ``doubtful``, (h, w) bool, are further low-resolution pixels that mix two
    sides. If ``sharp``, pixels on edges take a side; otherwise they keep the value that preserves the block means.
    """
    valid = lr.isfinite()
    doubtful = torch.zeros_like(valid) if doubtful is None else doubtful
    lr_inpainted = inpaint(lr[None, None])
    cut = functional.max_pool2d(barrier[None, None].float(), scale)[0, 0] > 0
    lr_certain = lr.masked_fill(doubtful, torch.nan)
    trust = torch.where(cut | doubtful, mixed, 1.0).to(lr) * valid
    planes = torch.stack((lr_inpainted[0, 0], estimate_slopes(lr_certain, 0), estimate_slopes(lr_certain, 1), trust))
    smooth = upsample_linear_border(lr_inpainted, scale)[0, 0]
    reachable = find_reachable(barrier, scale, radius)
    hr = _fill_edges(_filter(planes, reachable, scale, sigma_space, smooth), barrier, lr_inpainted, smooth, scale)
    if sharp:
        _take_sides(reachable, barrier, hr, scale)
        hr = torch.where(barrier, _filter(planes, reachable, scale, sigma_space, smooth), hr)
    return hr.masked_fill(~repeat_blocks(valid[None, None], scale)[0, 0], torch.nan)


def find_reachable(barrier: Tensor, scale: int, radius: int) -> Tensor:
    """Return which low-resolution pixels each high-resolution pixel reaches, (2 radius + 1, 2 radius + 1, H, W) bool.

    [radius + a, radius + b] is for the one a rows below and b columns right of the pixel's own. Paths start in its
    middle, and are 4-connected, off the edges of the barrier, (H, W) bool, and within ``radius`` rows and columns.
    """
    height, width = barrier.shape[0] // scale, barrier.shape[1] // scale
    side, edge = 2 * radius + 1, radius * scale
    padded = functional.pad(barrier, (edge, edge, edge, edge), value=True)
    windows = padded.unfold(0, side * scale, scale).unfold(1, side * scale, scale).flatten(0, 1)
    ways = torch.ones_like(windows)
    cut = windows.flatten(1).any(dim=1)
    free = ~windows[cut]
    middle = slice((side * scale - 1) // 2, side * scale // 2 + 1)
    start = torch.zeros_like(free)
    start[:, middle, middle] = free[:, middle, middle]
    within = ndimage.generate_binary_structure(2, 1)[None]  # a window's neighbours are no other windows
    flooded = ndimage.binary_propagation(start.cpu().numpy(), within, free.cpu().numpy())
    ways[cut] = torch.from_numpy(flooded).to(free.device)
    ways = functional.pad(ways.view(height, width, -1), (0, 0, radius, radius, radius, radius))
    ways = ways.unflatten(2, (side, scale, side, scale))
    result = []
    for a in range(side):
        for b in range(side):
            there = ways[a : a + height, b : b + width, side - 1 - a, :, side - 1 - b]  # (h, w, scale, scale)
            result.append(there.transpose(1, 2).reshape(barrier.shape))
    return torch.stack(result).unflatten(0, (side, side))


def _filter(planes: Tensor, reachable: Tensor, scale: int, sigma_space: float, smooth: Tensor) -> Tensor:
    """Return means of planes, (4, h, w): value, slopes along rows and columns, weight; ``smooth`` where all weigh 0."""
    height, width = planes.shape[1:]
    rows, columns = (torch.arange(n, device=smooth.device) for n in smooth.shape)
    y, x = ((n.to(smooth) + 0.5) / scale - 0.5 for n in (rows, columns))
    total, weights = torch.zeros_like(smooth), torch.zeros_like(smooth)
    radius = reachable.shape[0] // 2
    for a in range(-radius, radius + 1):
        for b in range(-radius, radius + 1):
            i, j = rows // scale + a, columns // scale + b
            at = i.clamp(0, height - 1)[:, None], j.clamp(0, width - 1)  # nothing beyond the border is reachable
            down, across = (y - i)[:, None], x - j
            weight = torch.exp((down.square() + across.square()) / (-2 * sigma_space**2))
            value, slope_down, slope_across, trust = planes[:, *at]
            weight = weight * trust * reachable[radius + a, radius + b]
            total += weight * (value + slope_down * down + slope_across * across)
            weights += weight
    return torch.where(weights > 0, total / torch.where(weights > 0, weights, 1), smooth)


def _fill_edges(hr: Tensor, barrier: Tensor, lr: Tensor, smooth: Tensor, scale: int) -> Tensor:
    """Return the map with smooth values on edges, shifted to preserve block means, clamped to the neighbours' range."""
    start = torch.where(barrier, smooth, hr)[None, None]
    fraction = box_mean(barrier[None, None].to(hr), scale)
    missing = repeat_blocks((lr - box_mean(start, scale)) / torch.where(fraction > 0, fraction, 1), scale)
    beside = torch.cat((start, -start)).masked_fill(barrier, -torch.inf)
    most, least = functional.max_pool2d(beside, 3, stride=1, padding=1).unbind(0)
    value = (start + missing)[0].clamp(-least, most)
    return torch.where(barrier & most.isfinite(), value, start[0])[0]


def _take_sides(reachable: Tensor, barrier: Tensor, hr: Tensor, scale: int) -> None:
    """Copy to each edge pixel, in place, what its most similar neighbour off the edge reaches, if there is one."""
    places = barrier.nonzero()
    beside = places[:, None] + places.new_tensor(_BESIDE)  # (N, 8, 2)
    inside = ((beside >= 0) & (beside < places.new_tensor(barrier.shape))).all(dim=2)
    beside = torch.where(inside[:, :, None], beside, places[:, None])
    off = ~barrier[beside[..., 0], beside[..., 1]]
    apart = (hr[beside[..., 0], beside[..., 1]] - hr[places[:, 0], places[:, 1]][:, None]).abs()
    best = apart.masked_fill(~off, torch.inf).argmin(dim=1)
    chosen = beside[torch.arange(len(places), device=places.device), best]  # an edge where there is no neighbour
    side = len(reachable)
    there = places // scale - chosen // scale + torch.arange(side, device=places.device)[:, None, None]  # (side, N, 2)
    within = (there >= 0) & (there < side)
    rows, columns = there.clamp(0, side - 1).unbind(2)
    seen = reachable[rows[:, None], columns[None], chosen[:, 0], chosen[:, 1]]  # (side, side, N)
    reachable[:, :, places[:, 0], places[:, 1]] = seen & within[:, None, :, 0] & within[None, :, :, 1]


@dataclass(eq=False)
class EdgeGuided(Method):
    """Edge-guided upsampling of the low-resolution disparity; ``history`` is that of the labels of all stages."""

    abilities = Abilities(cost=Cost(1500, 12))

    step: float = 0.05
    candidates: int = 5
    sharp_weight: float = 3.0
    smoothness: float = 1.0
    iterations: int = 100
    radius: int = 1
    sigma_space: float = 0.5
    mixed: float = 0.01
    fill_holes: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        expect_positive(step=self.step, candidates=self.candidates, sharp_weight=self.sharp_weight)
        expect_positive(smoothness=self.smoothness, iterations=self.iterations)
        expect_positive(sigma_space=self.sigma_space, mixed=self.mixed)
        expect_window(radius=self.radius)

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres in the precision of the low-resolution depth."""
        disparity = disparity_lr = sample.disparity_lr(torch.float64)[0]
        lowest, highest = (float(bound) for bound in disparity_lr[disparity_lr.isfinite()].aminmax())
        step = self.step * (highest - lowest)
        self.history = []
        stages, rest = [], whole_scale(sample)  # the prime factors, the smallest first
        while rest > 1:
            stages.append(next(n for n in range(2, rest + 1) if rest % n == 0))
            rest //= stages[-1]
        barrier: Tensor | None = None
        for number, scale in enumerate(stages):
            report = part_of(progress, number * self.iterations, len(stages) * self.iterations) or ignore
            doubtful, last = barrier, number == len(stages) - 1
            barrier, history = predict_edge_map(
                disparity, scale, step, self.candidates, self.sharp_weight, self.smoothness, self.iterations, report
            )
            report(self.iterations, self.iterations)
            done = self.history[-1]["iteration"] if self.history else 0.0
            self.history += [{**entry, "iteration": entry["iteration"] + done} for entry in history]
            disparity = bilateral_filter(
                disparity, barrier, scale, self.radius, self.sigma_space, self.mixed, doubtful=doubtful, sharp=last
            )
        doffs = sample.camera.doffs  # disparity + doffs is inverse depth
        disparity = disparity.clamp((lowest + doffs) / BEYOND - doffs, (highest + doffs) * BEYOND - doffs)
        if self.fill_holes:
            disparity = inpaint(disparity[None, None])[0, 0]
        return from_range(disparity[None], sample.camera, "disparity").to(sample.depth_lr)


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

    The data term of the field is the squared distance of the patches' distance transforms plus ``sharp_weight``^2 times
    that of the sharp edges, by the number of pixels, its smoothness term the squared difference of the true patches
    where two patches overlap. ``step`` is the minimum height of an edge in the map's unit.
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
    """Return pairs of patches of a map, (h, w), downsampled by ``scale``, found and true, (N, 2, PATCH, PATCH) bool."""
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
    return _distinct(patches[kept])


def thin(mask: Tensor) -> Tensor:
    """Thin a mask, (H, W), to lines of about one pixel, preserving connectivity (Zhang, Suen, CACM 27(3), 1984)."""
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


def _distinct(patches: Tensor) -> Tensor:
    """Return pairs of patches, (N, 2, PATCH, PATCH) bool, under the 8 dihedral transforms, sorted, each once."""
    quarters = [patches.rot90(k, (-2, -1)) for k in range(4)]
    bits = torch.cat(quarters + [each.mT for each in quarters]).flatten(1).long()
    place = torch.arange(_BITS, device=bits.device)
    words = (functional.pad(bits, (0, -bits.shape[1] % _BITS)).unflatten(1, (-1, _BITS)) << place).sum(dim=2)
    words = torch.unique(words, dim=0)
    bits = ((words[:, :, None] >> place) & 1).flatten(1)[:, : bits.shape[1]]
    return bits.bool().unflatten(1, patches.shape[1:])


def edge_distances(patches: Tensor) -> Tensor:
    """Return each pixel's distance from the edges of its patch, (N, PATCH, PATCH) float32, infinite without an edge."""
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
