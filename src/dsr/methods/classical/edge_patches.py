"""Patches of edge maps, and labels of low energy for overlapping ones by loopy min-sum belief propagation.

Patches are (N, PATCH, PATCH) bool; :mod:`dsr.methods.classical.edge_map` uses them.

Pearl, *Probabilistic Reasoning in Intelligent Systems*, 1988; min-sum is max-product in negative logarithms, as used by
Freeman, Pasztor, Carmichael, *Learning Low-Level Vision*, IJCV 2000. The energy of labels x is

    E(x) = sum over nodes i of unary_i(x_i) + sum over pairs (i, j) of cost_ij(x_i, x_j),

the message from i to j is m_ij(x_j) = min over x_i of unary_i(x_i) + cost_ij(x_i, x_j) + the messages to i from nodes
other than j, less its minimum. A node's label minimises unary_i plus all messages to it. On trees this is the minimum;
on other graphs it is an approximation, and the best labels so far are kept. Messages are damped by one half, because
they may oscillate on loops.

Sums run in the order of the pairs, on any device: equal input gives equal labels. Memory: for each pair, 4 messages of
K values and K x K costs, with K labels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.utils.progress import Steps

PATCH = 11  # rows and columns of a patch, in high-resolution pixels
_ENTRIES = 2**24  # maximum number of distances between patches in memory
_BITS = 62  # pixels per 64-bit word, without its sign

_MOVE = 0.5  # damping factor of messages; 1 would be undamped
CHECK_EVERY = 5  # iterations between two evaluations of the labels


class Patches(NamedTuple):
    """Edges of an upsampled map, and the true edges at the same positions."""

    low: Tensor
    high: Tensor


def no_patches(device: torch.device) -> Patches:
    """Return an empty set of patches."""
    none = torch.zeros(0, PATCH, PATCH, dtype=torch.bool, device=device)
    return Patches(none, none)


def extract_patches(mask: Tensor, places: Tensor) -> Tensor:
    """Return the patches of a mask, (H, W), around positions (N, 2), rows and columns, whose patches lie inside."""
    offsets = torch.arange(PATCH, device=mask.device) - PATCH // 2
    return mask[places[:, 0, None, None] + offsets[:, None], places[:, 1, None, None] + offsets]


def orient(patches: Tensor) -> Tensor:
    """Return patches under the 8 dihedral transforms, (8 N, PATCH, PATCH)."""
    quarters = [patches.rot90(k, (1, 2)) for k in range(4)]
    return torch.cat(quarters + [each.mT for each in quarters])


def deduplicate(patches: Patches) -> Patches:
    """Return the pairs without repetitions, sorted."""
    pixels = 2 * PATCH**2
    bits = torch.cat((patches.low.flatten(1), patches.high.flatten(1)), dim=1).long()
    place = torch.arange(_BITS, device=bits.device)
    words = (functional.pad(bits, (0, -pixels % _BITS)).unflatten(1, (-1, _BITS)) << place).sum(dim=2)
    words = torch.unique(words, dim=0)
    bits = ((words[:, :, None] >> place) & 1).flatten(1)[:, :pixels]
    return Patches(*bits.bool().unflatten(1, (2, PATCH, PATCH)).unbind(1))


def edge_distances(patches: Tensor) -> Tensor:
    """Return each pixel's Euclidean distance from the edges of its patch, (N, PATCH, PATCH) float32.

    Infinite in a patch without an edge.
    """
    place = torch.arange(PATCH, device=patches.device)
    square = (place[:, None] - place).square().float()
    along = torch.where(patches[:, :, None], square, torch.inf).amin(dim=3)  # (N, row, column), within the row
    return (along[:, None] + square[:, :, None]).amin(dim=2).sqrt()


def find_nearest(query: Tensor, examples: Patches, count: int, weight: float) -> tuple[Tensor, Tensor]:
    """Return the examples most similar to patches: squared distances and indices, (N, count) each, the best first.

    |D(query) - D(low)|^2 + weight^2 |query - high|^2, D being :func:`edge_distances`.
    """
    features = _features(examples.low, examples.high, weight)
    length = features.square().sum(dim=1)
    distances, indices = [], []
    for chunk in query.split(max(_ENTRIES // len(features), 1)):
        query_features = _features(chunk, chunk, weight)
        square = query_features.square().sum(dim=1, keepdim=True) + length - 2 * query_features @ features.T
        least = square.clamp_(min=0).topk(min(count, len(features)), dim=1, largest=False)
        distances.append(least.values)
        indices.append(least.indices)
    return torch.cat(distances), torch.cat(indices)


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
                costs.append(_disagreement(images[first], images[second], down, across))
    return torch.cat(pairs), torch.cat(costs)


def average_patches(patches: Tensor, places: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return the mean of the patches, (N, PATCH^2), that cover each pixel, (H, W); 0 where there is none."""
    total, number = patches.new_zeros(shape), patches.new_zeros(shape)
    for k in range(PATCH**2):  # for one k, all patches touch different pixels
        rows, columns = places[:, 0] + k // PATCH - PATCH // 2, places[:, 1] + k % PATCH - PATCH // 2
        total[rows, columns] += patches[:, k]
        number[rows, columns] += 1
    return total / number.clamp(min=1)


def _features(low: Tensor, high: Tensor, weight: float) -> Tensor:
    return torch.cat((edge_distances(low).flatten(1), weight * high.flatten(1).float()), dim=1)


def _disagreement(first: Tensor, second: Tensor, down: int, across: int) -> Tensor:
    """Return the squared differences of (E, K, PATCH, PATCH) patches, the second shifted by rows and columns."""
    left, right = max(across, 0), max(-across, 0)
    a = first[:, :, down:, left : PATCH - right].flatten(2)
    b = second[:, :, : PATCH - down, right : PATCH - left].flatten(2)
    return a.square().sum(dim=2)[:, :, None] + b.square().sum(dim=2)[:, None] - 2 * a @ b.mT


class Labelling(NamedTuple):
    """Labels (N,), their energy, whether the messages converged, and the history.

    Each entry of ``history`` has ``iteration``, ``objective`` (the energy) and ``moved`` (the largest change of a
    message, relative to the largest cost).
    """

    labels: Tensor
    energy: float
    converged: bool
    history: list[dict[str, float]]


def label(
    unary: Tensor,
    pairs: Tensor,
    costs: Tensor,
    iterations: int = 100,
    tolerance: float = 1e-3,
    progress: Steps | None = None,
) -> Labelling:
    """Return the labels that min-sum belief propagation finds.

    The costs of each node's labels are ``unary`` (N, K), and ``costs`` (E, K, K) those of the labels of the first and
    the second node of each pair (E, 2). It stops if no message changes by more than the tolerance, times the largest
    cost.
    """
    count, labels = unary.shape
    unit = float(costs.abs().max()) if len(costs) else 0.0
    unit = unit if unit > 0 else 1.0
    sources = torch.cat((pairs[:, 0], pairs[:, 1]))
    both = torch.cat((costs, costs.mT))  # (2E, K, K): the source's labels, the target's
    heard = _incoming(torch.cat((pairs[:, 1], pairs[:, 0])), count)
    silence = unary.new_zeros(1, labels)
    messages = unary.new_zeros(2 * len(pairs), labels)
    best, least, history = unary.argmin(dim=1), torch.inf, []
    moved = 0.0
    for done in range(1, iterations + 1):
        beliefs = unary + torch.cat((messages, silence))[heard].sum(dim=1)
        others = beliefs[sources] - messages.roll(len(pairs), 0)  # less the target's message
        new = (others[:, :, None] + both).amin(dim=1)
        step = (new - new.amin(dim=1, keepdim=True) - messages) * _MOVE
        messages = messages + step
        moved = float(step.abs().max()) / unit if len(step) else 0.0
        settled = moved <= tolerance
        if settled or done % CHECK_EVERY == 0 or done == iterations:
            found = (unary + torch.cat((messages, silence))[heard].sum(dim=1)).argmin(dim=1)
            now = energy(found, unary, pairs, costs)
            history.append({"iteration": float(done), "objective": now, "moved": moved})
            if now < least:
                best, least = found, now
            if progress is not None:
                progress(iterations if settled else done, iterations)
        if settled:
            break
    return Labelling(best, least, moved <= tolerance, history)


def energy(labels: Tensor, unary: Tensor, pairs: Tensor, costs: Tensor) -> float:
    """Return E of labels (N,)."""
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
