"""Facets: what holds whatever its weights are, and that it can learn."""

import copy

import pytest
import torch
from small_scenes import maps, photos, plane_map
from torch.nn import functional

from dsr.methods.networks.facets import Facets
from dsr.methods.networks.facets_planes import stencil


def _net(scale=4, *, noise=0.1, facets=2):
    """Return a small network with weights far from those that it starts with."""
    torch.manual_seed(scale)
    net = Facets(scale, width=12, blocks=1, facets=facets).requires_grad_(False)
    for parameter in net.parameters():
        parameter.add_(noise * torch.randn_like(parameter))
    return net


@pytest.mark.parametrize(
    ("scale", "precision"), [*((scale, torch.float32) for scale in (2, 4, 8, 16)), (4, torch.bfloat16)]
)
def test_facets_reproduce_a_plane_exactly_for_any_weights_and_photo(scale, precision):
    hr = plane_map(6 * scale, 7 * scale)
    coarse = functional.avg_pool2d(hr, scale)
    result = _net(scale).to(precision).upsample(photos(6 * scale, 7 * scale), coarse)
    torch.testing.assert_close(result, hr, rtol=0, atol=1e-11)


def test_untrained_mixture_is_the_spline_blend_of_central_difference_planes():
    """A plain loop over high-resolution pixels, with every output of the network's three heads at 0."""
    net, coarse = _net(noise=0), maps(4, 5)
    for head in (net.planes, net.choice):
        torch.nn.init.zeros_(head.weight)
        torch.nn.init.zeros_(head.bias)
    result = net.upsample(photos(16, 20), coarse)[0, 0]
    values = coarse[0, 0]
    first = torch.tensor([0.0, 2.0, 0.0]).softmax(0).double()

    def at(i, j):
        """Return the map, continued linearly by one pixel."""
        for axis, k, size in ((0, i, 4), (1, j, 5)):
            if k in (-1, size):
                inner, outer = (0, 1) if k == -1 else (size - 1, size - 2)
                near, far = ((inner, j), (outer, j)) if axis == 0 else ((i, inner), (i, outer))
                return 2 * at(*near) - at(*far)
        return float(values[i, j])

    def slope(before, here, after):
        return float(first @ torch.tensor([here - before, (after - before) / 2, after - here]).double())

    def spline(t, step):
        return {-1: 0.5 * (0.5 - t) ** 2, 0: 0.75 - t * t, 1: 0.5 * (0.5 + t) ** 2}[step]

    for y, x in ((0, 0), (5, 9), (9, 6), (15, 19), (7, 0)):
        i, j = y // 4, x // 4
        ty, tx = (y % 4 + 0.5) / 4 - 0.5, (x % 4 + 0.5) / 4 - 0.5
        total = weights = 0.0
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                weight = spline(ty, dy) * spline(tx, dx) + 1e-4
                inside = (i + dy in range(4), j + dx in range(5))
                k, m = i + dy * inside[0], j + dx * inside[1]  # a neighbour outside is the pixel itself
                along_u = slope(at(k, m - 1), at(k, m), at(k, m + 1))
                along_v = slope(at(k - 1, m), at(k, m), at(k + 1, m))
                total += weight * (at(k, m) + (tx + j - m) * along_u + (ty + i - k) * along_v)
                weights += weight
        assert float(result[y, x]) == pytest.approx(total / weights, rel=1e-6)


def test_facets_without_slopes_stay_within_the_surrounding_values():
    net = Facets(4, width=12, blocks=1, slopes=False)
    coarse = torch.zeros(1, 1, 6, 6, dtype=torch.float64)
    coarse[..., 3:] = 1.0
    with torch.no_grad():
        for parameter in (net.planes.weight, net.planes.bias):
            parameter.zero_()
        hr = net.upsample(photos(24, 24), coarse)
    assert 0 <= float(hr.min()) < 1e-12
    assert 1 - 1e-12 < float(hr.max()) <= 1 + 1e-12


def test_bend_is_zero_on_planes_and_the_step_beside_an_edge():
    assert float(stencil(plane_map(8, 9)).bend.max()) < 1e-12
    step = torch.zeros(1, 1, 9, 12)
    step[..., 6:] = 2.0
    bend = stencil(step).bend[0, 0, 4]
    assert bend.tolist() == [0, 0, 0, 0, 2, 2, 2, 2, 0, 0, 0, 0]


def test_gradients_reach_every_parameter_and_agree_with_finite_differences():
    net = _net(2, facets=1).double().requires_grad_()
    rgb, coarse = photos(8, 6).double(), maps(4, 3)
    net.upsample(rgb, coarse).square().mean().backward()
    assert all(parameter.grad is not None and bool((parameter.grad != 0).any()) for parameter in net.parameters())
    bias = net.choice.bias
    other = copy.deepcopy(net)

    def loss(value):
        return torch.func.functional_call(other, {"choice.bias": value}, (rgb, coarse / 30)).square().mean()

    assert torch.autograd.gradcheck(loss, bias.detach().clone().requires_grad_())


@pytest.mark.slow
def test_training_learns_an_edge_that_the_photo_shows():
    """A wall behind a wall: after a few steps on one patch the edge is several times sharper than a spline's."""
    torch.manual_seed(0)
    hr = torch.full((1, 1, 32, 32), 20.0)
    hr[..., 13:] = 26.0
    rgb = (hr / 40).expand(1, 3, 32, 32)
    coarse, net = functional.avg_pool2d(hr, 4), Facets(4, width=16, blocks=1)
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    errors = []
    for _ in range(80):
        loss = (net.upsample(rgb, coarse) - hr).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        errors.append(float(loss.detach()))
    assert errors[-1] < 0.2 * errors[0]
