"""Edge-guided upsampling: straight steps, and its parts against plain loops and exhaustive search."""

import itertools
import math
from collections import deque

import numpy as np
import pytest
import torch
from scipy import ndimage
from small_scenes import disparity_of, grid, sample_of, seeded

from dsr.methods.base import NoSolutionError
from dsr.methods.classical.edge_guided import (
    PATCH,
    EdgeGuided,
    bilateral_filter,
    edge_distances,
    energy,
    find_overlaps,
    find_reachable,
    label,
)
from dsr.methods.classical.guided_filter import estimate_slopes
from dsr.methods.classical.interpolation import Interpolation


def _step(size, degrees):
    """Return a map that is 5 left of a line and 9 right of it, and how many columns are left of it in each row."""
    v, u = grid(size, size)
    slant = math.tan(math.radians(degrees))
    where = size / 2 + 0.37 - (v[:, 0] - size / 2) * slant
    return torch.where(u < where[:, None], 5.0, 9.0).double(), where + 0.5


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("degrees", [0.0, 30.0])
@pytest.mark.parametrize("turned", [False, True])
def test_eg_keeps_a_straight_step_straight_and_sharp(scale, degrees, turned):
    """Each row's edge is nearer than half a low-resolution pixel to the line; bicubic smears it over more pixels."""
    truth, line = _step(96, degrees)
    sample = sample_of(truth.T.contiguous() if turned else truth, scale=scale)
    ours, bicubic = (disparity_of(method(sample), sample) for method in (EdgeGuided(), Interpolation("bicubic")))
    ours, bicubic = (each.T if turned else each for each in (ours, bicubic))
    apart = (((9 - ours) / 4).sum(dim=1) - line)[8:-8]
    assert float(apart.abs().max()) < scale / 2
    assert float(apart.std()) < 0.65
    smeared = [((each > 5.4) & (each < 8.6)).sum() for each in (ours, bicubic)]
    assert smeared[0] < 0.25 * smeared[1]


def _by_loops(coarse, barrier, radius, sigma, mixed):
    """The filter at scale 4, NaN on edges and where nothing is to be seen; ways are found by breadth-first search."""
    h, w = coarse.shape
    down, across = (estimate_slopes(torch.from_numpy(coarse), axis).numpy() for axis in (0, 1))
    total, weights = (np.zeros(barrier.shape) for _ in range(2))
    for i in range(h):
        for j in range(w):
            top, bottom = 4 * max(i - radius, 0), 4 * min(i + radius + 1, h)
            left, right = 4 * max(j - radius, 0), 4 * min(j + radius + 1, w)
            starts = [(v, u) for v in (4 * i + 1, 4 * i + 2) for u in (4 * j + 1, 4 * j + 2) if not barrier[v, u]]
            seen, queue = set(starts), deque(starts)
            while queue:
                v, u = queue.popleft()
                for to in ((v - 1, u), (v + 1, u), (v, u - 1), (v, u + 1)):
                    inside = top <= to[0] < bottom and left <= to[1] < right
                    if inside and to not in seen and not barrier[to]:
                        seen.add(to)
                        queue.append(to)
            trust = mixed if barrier[4 * i : 4 * i + 4, 4 * j : 4 * j + 4].any() else 1.0
            for v, u in seen:
                y, x = (v - 1.5) / 4 - i, (u - 1.5) / 4 - j
                weight = trust * math.exp(-0.5 * (math.hypot(y, x) / sigma) ** 2)
                total[v, u] += weight * (coarse[i, j] + y * down[i, j] + x * across[i, j])
                weights[v, u] += weight
    return np.where(barrier | (weights == 0), np.nan, total / np.where(weights > 0, weights, 1))


@pytest.mark.parametrize("radius", [1, 2])
def test_filter_is_a_mean_over_the_pixels_connected_by_a_path(radius):
    random = np.random.default_rng(0)
    coarse = random.uniform(5, 9, (4, 4))
    barrier = random.random((16, 16)) < 0.2
    barrier[:12, 7] = True
    expected = _by_loops(coarse, barrier, radius, 0.6, 0.1)
    answer = bilateral_filter(torch.from_numpy(coarse), torch.from_numpy(barrier), 4, radius, 0.6, 0.1).numpy()
    seen = np.isfinite(expected)
    assert seen.sum() > 150
    np.testing.assert_allclose(answer[seen], expected[seen], rtol=1e-10)
    reach = find_reachable(torch.from_numpy(barrier), 4, radius).any(dim=0).any(dim=0).numpy()
    np.testing.assert_array_equal(seen, reach & ~barrier)


def test_map_too_small_for_patches_has_no_solution():
    with pytest.raises(NoSolutionError, match="map of 8 x 8 pixels"):
        EdgeGuided()(sample_of(_step(32, 0.0)[0]))


def _patches(count, seed=0):
    random = np.random.default_rng(seed)
    return torch.from_numpy(random.random((count, PATCH, PATCH)) < 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_belief_propagation_finds_the_minimum_on_a_tree(seed):
    unary, costs = (torch.rand(shape, generator=seeded(seed)).double() for shape in ((6, 3), (5, 3, 3)))
    field = unary, torch.tensor([(0, 1), (1, 2), (3, 1), (3, 4), (5, 3)]), costs
    labels, history = label(*field)
    assert history[-1]["moved"] <= 1e-3
    least = min(energy(torch.tensor(each), *field) for each in itertools.product(range(3), repeat=6))
    assert energy(labels, *field) == pytest.approx(least, abs=1e-12)


def test_distances_equal_scipy_and_overlaps_equal_a_loop():
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
