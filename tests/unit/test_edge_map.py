"""The edge map and its Markov random field, against enumeration, dynamic programming and plain loops."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from dsr.methods.base import NoSolutionError
from dsr.methods.classical.edge_map import (
    PATCH,
    Patches,
    deduplicate,
    detect_edges,
    edge_distances,
    energy,
    find_nearest,
    find_overlaps,
    label,
    orient,
    predict_edge_map,
    thin,
)


def _field(nodes: int, pairs: list[tuple[int, int]], labels: int = 3, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    unary = torch.rand(nodes, labels, generator=random, dtype=torch.float64)
    costs = torch.rand(len(pairs), labels, labels, generator=random, dtype=torch.float64)
    return unary, torch.tensor(pairs, dtype=torch.long).view(-1, 2), costs


def _least(unary: Tensor, pairs: Tensor, costs: Tensor) -> float:
    nodes, labels = unary.shape
    every = itertools.product(range(labels), repeat=nodes)
    return min(energy(torch.tensor(each), unary, pairs, costs) for each in every)


def _patches(count: int, seed: int = 0) -> Tensor:
    random = np.random.default_rng(seed)
    return torch.from_numpy(random.random((count, PATCH, PATCH)) < 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_belief_propagation_finds_the_minimum_on_a_tree(seed: int) -> None:
    field = _field(6, [(0, 1), (1, 2), (3, 1), (3, 4), (5, 3)], seed=seed)
    found = label(*field)
    assert found.converged
    assert found.energy == pytest.approx(_least(*field), abs=1e-12)
    assert energy(found.labels, *field) == pytest.approx(found.energy)


def test_belief_propagation_equals_viterbi_on_a_chain() -> None:
    unary, pairs, costs = _field(40, [(i, i + 1) for i in range(39)], labels=5)
    best = unary[0]
    for i in range(39):
        best = (best[:, None] + costs[i]).amin(dim=0) + unary[i + 1]
    assert label(unary, pairs, costs, 300, 1e-9).energy == pytest.approx(float(best.min()), abs=1e-9)


def test_distances_equal_scipy_and_overlaps_equal_a_loop() -> None:
    masks = _patches(5)
    expected = [ndimage.distance_transform_edt(~each) for each in masks.numpy()]
    np.testing.assert_allclose(edge_distances(masks), np.stack(expected), rtol=1e-6)
    places = torch.tensor([[5, 7], [8, 5], [8, 17], [30, 30]])
    patches = _patches(8, seed=1).flatten(1).float().view(4, 2, -1)
    pairs, costs = find_overlaps(places, patches)
    assert sorted(sorted(pair) for pair in pairs.tolist()) == [[0, 1], [0, 2]]
    for (a, b), cost in zip(pairs.tolist(), costs, strict=True):
        for x, y in itertools.product(range(2), repeat=2):
            first, second = (np.full((50, 50), np.nan) for _ in range(2))
            for canvas, node, chosen in ((first, a, x), (second, b, y)):
                v, u = (places[node] - PATCH // 2).tolist()
                canvas[v : v + PATCH, u : u + PATCH] = patches[node, chosen].view(PATCH, PATCH)
            assert float(cost[x, y]) == pytest.approx(np.nansum((first - second) ** 2))


def test_distinct_pairs_are_kept_once_and_found_again() -> None:
    low, high = _patches(6), _patches(6, seed=1)
    known = deduplicate(Patches(torch.cat((low, low)), torch.cat((high, high))))
    assert len(known.low) == 6
    far, which = find_nearest(high, Patches(high, high), 3, 3.0)
    assert torch.equal(which[:, 0], torch.arange(6))
    assert float(far[:, 0].max()) < 1e-3
    assert len(deduplicate(Patches(orient(low), orient(high))).low) == 48


def test_thinning_reduces_a_bar_to_a_line_and_keeps_a_line() -> None:
    bar = torch.zeros(20, 30, dtype=torch.bool)
    bar[8:11, 5:25] = True
    line = thin(bar)
    assert int(line.sum(dim=0).max()) == 1
    assert int(line.any(dim=0).sum()) >= 16
    assert torch.equal(thin(line), line)


def test_edges_lie_at_steps_and_not_on_steep_planes() -> None:
    v, u = torch.meshgrid(torch.arange(16.0).double(), torch.arange(20.0).double(), indexing="ij")
    assert not bool(detect_edges(3 * u - 2 * v, 2, 0.1).any())
    assert predict_edge_map(3 * u - 2 * v, 2, 0.1)[1] is None
    found = detect_edges(torch.where(u < 10, 0.0, 1.0).double(), 2, 0.1)
    assert bool(found[:, 18:22].any(dim=1).all())
    assert not bool(found[:, :18].any() | found[:, 22:].any())


def test_map_with_edges_too_small_for_patches_has_no_solution() -> None:
    step = torch.where(torch.arange(8) < 4, 0.0, 1.0).double().expand(8, 8)
    with pytest.raises(NoSolutionError, match="the edges of a map of 8 x 8 pixels do not recur at 1/2 of its size"):
        predict_edge_map(step, 2, 0.1)
