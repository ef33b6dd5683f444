"""Labels of low energy in a Markov random field by loopy min-sum belief propagation, batched over all pairs.

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

from dsr.utils.progress import Steps

_MOVE = 0.5
"""Damping factor of messages; 1 would be undamped."""
CHECK_EVERY = 5
"""Iterations between two evaluations of the labels."""


class Labelling(NamedTuple):
    """Labels (N,), their energy, whether the messages converged, and the history.

    Each entry of ``history`` has ``iteration``, ``objective`` (the energy of the labels) and ``moved`` (the largest
    change of a message, relative to the largest cost).
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

    Args:
        unary: (N, K) costs of each node's labels, finite.
        pairs: (E, 2) nodes, each pair once.
        costs: (E, K, K) of the labels of a pair's first node (rows) and second node (columns), finite.
        iterations: maximum number of iterations.
        tolerance: largest change of a message, relative to the largest cost, at which it stops.
        progress: is called with the iterations done and their maximum.

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
        told = beliefs[sources] - messages.roll(len(pairs), 0)  # less the target's message
        new = (told[:, :, None] + both).amin(dim=1)
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
