"""Unrolled networks, PDN and dynamic guidance: against plain loops, another optimiser, the energy's gradient."""

import math

import numpy as np
import pytest
import torch
from small_scenes import maps, photos, plane_map
from torch.nn import functional

from dsr.methods.images import box_mean, repeat_blocks, upsample_linear_border
from dsr.methods.networks.dynamic_guidance import (
    WIDTHS,
    DynamicGuidance,
    Stage,
    polynomial_filters,
)
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.networks.pdn import PrimalDualNetwork, UnrolledHuber, half_window, pair_differences


def _random(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _problem(size, window, count=1):
    """Return a map with steps, continued beyond the border, and weights whose pairs are partly across the steps."""
    r, n = window // 2, len(half_window(window))
    first = _random(count, 1, size + 2 * r, size + 4 * r, seed=1) * 0.02
    first[..., size // 2 :] += 0.5
    return first, (_random(count, n, size, size, seed=2) + 0.01) / n


def _net(scale=4, *, noise=0.05, window=3, **arguments):
    """Return a small network with weights far from those that it starts with."""
    torch.manual_seed(scale)
    sizes = {"width": 6, "layers": 3, "iterations": 3, **arguments}
    net = PrimalDualNetwork(scale, window=window, **sizes).requires_grad_(False)
    for parameter in net.parameters():
        parameter.add_(noise * torch.randn_like(parameter))
    return net


def _photo(height, width, count=1):
    return _random(count, 3, height, width, seed=3).float()


def _map(height, width, count=1):
    return 20 + 9 * _random(count, 1, height, width, seed=4)


def test_unrolled_stage_equals_a_plain_loop():
    window, size, data, huber = 5, 16, 7.0, 0.4
    first, weights = _problem(size, window)
    stage = UnrolledHuber(window, 4, data, huber).double().requires_grad_(False)
    stage.log_steps.add_(0.3 * torch.randn(4, 3, generator=torch.Generator().manual_seed(5)))
    result = stage(first, weights)
    steps = stage.log_steps.exp().tolist()
    expected = _loop(first[0, 0].numpy(), weights[0].numpy(), steps, data, huber, window)
    np.testing.assert_allclose(result[0, 0].numpy(), expected, rtol=0, atol=1e-7)  # the parameters are float32's


def _loop(f, w, steps, data, huber, window):
    """Return u - f, pair by pair and pixel by pixel, on a map with r rows and 2 r columns around the image."""
    r, (height, width) = window // 2, w.shape[1:]
    inside = [(y, x) for y in range(height) for x in range(width)]
    pairs = {}
    for k, (dy, dx) in enumerate(half_window(window)):
        for y in range(height + r):
            for x in range(-r, width + r):
                weight = w[k, min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
                pairs[k, y, x] = ((y + r, x + 2 * r), (y + dy + r, x + dx + 2 * r), weight)
    u, ahead = f.copy(), f.copy()
    p = {key: float(np.clip((f[j] - f[i]) / huber, -most, most)) for key, (i, j, most) in pairs.items()}
    for sigma, tau, theta in steps:
        for key, (i, j, most) in pairs.items():
            p[key] = float(np.clip((p[key] + sigma * (ahead[j] - ahead[i])) / (1 + sigma * huber), -most, most))
        sums = np.zeros_like(f)
        for key, (i, j, _) in pairs.items():
            sums[j] += p[key]
            sums[i] -= p[key]
        for y, x in inside:
            at = (y + r, x + 2 * r)
            new = (u[at] - tau * sums[at] + tau * data * f[at]) / (1 + tau * data)
            ahead[at] = new + theta * (new - u[at])
            u[at] = new
    return (u - f)[r : r + height, 2 * r : 2 * r + width]


def _energy(moved, first, weights, data, huber, window):
    """Return E by its definition: the Huber function of each pair, with the image's pixels alone free to move."""
    r = window // 2
    x = pair_differences(first + functional.pad(moved, (2 * r, 2 * r, r, r)), window)
    w = functional.pad(weights, (r, r, 0, r), mode="replicate")
    size = x.abs()
    pairs = torch.where(size <= huber * w, x.square() / (2 * huber), w * size - huber / 2 * w.square())
    return pairs.sum() + data / 2 * moved.square().sum()


def test_many_steps_reach_the_minimum_that_another_optimiser_finds():
    window, data, huber = 3, 2.0, 0.3
    first, weights = _problem(8, window)
    stage = UnrolledHuber(window, 200, data, huber).double().requires_grad_(False)
    for parameter, value in ((stage.log_data, data), (stage.log_huber, huber)):
        parameter.fill_(math.log(value))  # more exact than float32
    found = stage(first, weights)
    other = torch.zeros_like(found).requires_grad_()
    optimiser = torch.optim.LBFGS(
        [other], max_iter=500, tolerance_grad=1e-12, tolerance_change=0, line_search_fn="strong_wolfe"
    )

    def closure():
        optimiser.zero_grad()
        energy = _energy(other, first, weights, data, huber, window)
        energy.backward()
        return energy

    optimiser.step(closure)
    other = other.detach()
    least, start = (float(_energy(at, first, weights, data, huber, window)) for at in (other, torch.zeros_like(other)))
    assert start - least > 0.05 * start  # there is something to gain
    assert float(_energy(found, first, weights, data, huber, window)) == pytest.approx(least, rel=1e-9)
    torch.testing.assert_close(found, other, rtol=0, atol=1e-6)


def test_gradients_of_maps_weights_and_parameters_agree_with_finite_differences():
    window = 3
    first, weights = _problem(4, window)
    stage = UnrolledHuber(window, 2, 3.0, 0.5).double()
    names, parameters = zip(*stage.named_parameters(), strict=True)

    def answer(first, weights, *values):
        return torch.func.functional_call(stage, dict(zip(names, values, strict=True)), (first, weights))

    assert torch.autograd.gradcheck(answer, [first.requires_grad_(), weights.requires_grad_(), *parameters])


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
def test_untrained_pdn_reproduces_a_plane_up_to_the_border(scale):
    torch.manual_seed(0)
    net = PrimalDualNetwork(scale, width=6, layers=3).requires_grad_(False)
    fine = plane_map(6 * scale, 7 * scale, 0.1, -0.07)
    scene = torch.tensor([20.0, 60.0]).view(1, 2, 1, 1)  # the plane is part of it
    result = net.upsample(_photo(6 * scale, 7 * scale), functional.avg_pool2d(fine, scale), scene)
    torch.testing.assert_close(result, fine, rtol=0, atol=1e-6)


def test_convolutions_may_run_in_bfloat16():
    net, rgb, coarse = _net(), _photo(24, 28), _map(6, 7)
    exact = net.upsample(rgb, coarse)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = net.upsample(rgb, coarse)
    assert mixed.dtype == torch.float64
    assert 0 < float((mixed - exact).abs().max()) < 0.05 * 9
    halved = NetworkUpsampler(net, "bfloat16").upsample_disparity(rgb, coarse)
    assert float((halved - exact).abs().max()) < 0.05 * 9


def _guided(scale=4, *, stages=2, filters=5, size=5, noise=0.2):
    """Return a small network with weights far from those that it starts with."""
    torch.manual_seed(scale)
    net = DynamicGuidance(scale, stages, filters, size).requires_grad_(False)
    for parameter in net.parameters():
        parameter.add_(noise * torch.randn_like(parameter))
    return net


def _stage(*, filters=5, size=5):
    net = _guided(stages=1, filters=filters, size=size).double()
    stage = net.stages[0]
    if not isinstance(stage, Stage):
        raise TypeError
    return stage


@pytest.mark.parametrize("size", [3, 4, 7])
def test_filters_are_orthonormal_and_blind_to_what_the_first_ones_see(size):
    v, u = torch.meshgrid(torch.arange(size).double(), torch.arange(size).double(), indexing="ij")
    basis = polynomial_filters(size)
    flat = basis.flatten(1)
    torch.testing.assert_close(flat @ flat.T, torch.eye(size**2).double(), rtol=0, atol=1e-12)
    for each, blind in ((v - v + 1, basis[1:]), (u, basis[3:]), (v, basis[3:])):
        assert float((blind * each).sum(dim=(1, 2)).abs().max()) < 1e-11


def test_stage_equals_plain_loops():
    stage, rgb = _stage(filters=3), photos(16, 16).double()
    coarse = maps(4, 4) / 30
    x = repeat_blocks(coarse, 4) + 0.1 * maps(16, 16)
    with torch.no_grad():
        result = stage(x, coarse, rgb)[0, 0].numpy()
        misfit = upsample_linear_border(box_mean(x, 4) - coarse, 4)[0, 0].numpy()
    y = x[0, 0].numpy() - float(stage.fidelity) * misfit
    photo = rgb[0].numpy()
    combined = stage.analysis.numpy() / np.linalg.norm(stage.analysis.numpy(), axis=1, keepdims=True)
    filters = np.tensordot(combined, polynomial_filters(5)[3:].numpy(), 1)
    seeing = np.tensordot(stage.guidance.numpy(), polynomial_filters(5)[1:].numpy(), 1)  # (L, 3, 5, 5)
    expected = y.copy()
    for i in range(12):
        for j in range(12):
            squares = [float((b * photo[:, i : i + 5, j : j + 5]).sum()) ** 2 for b in seeing]
            for k, c, heights in zip(filters, np.abs(stage.mixing.numpy()), stage.heights.numpy() / 3, strict=True):
                z = float((k * y[i : i + 5, j : j + 5]).sum())
                slope = sum(a * z / (1 + z * z / t**2) for a, t in zip(heights, WIDTHS, strict=True))
                expected[i : i + 5, j : j + 5] -= np.exp(-float(c @ squares)) * slope * k
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-12)


def test_gradients_agree_with_finite_differences():
    net = _guided(2, filters=2, size=3).double().requires_grad_()
    rgb, coarse = photos(8, 6).double(), maps(4, 3) / 30
    names, parameters = zip(*net.named_parameters(), strict=True)

    def answer(*values):
        return torch.func.functional_call(net, dict(zip(names, values, strict=True)), (rgb, coarse))

    assert torch.autograd.gradcheck(answer, parameters, eps=1e-7, atol=1e-4, fast_mode=True)


def test_mixed_precision_training_computes_in_float32():
    net, rgb, coarse = _guided(), photos(24, 28), maps(6, 7)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = net.upsample(rgb, coarse)
    torch.testing.assert_close(mixed, net.upsample(rgb, coarse), rtol=0, atol=0)


def test_map_may_break_at_a_photo_edge_and_a_flat_photo_has_no_influence():
    stage = _stage()
    edge = torch.zeros(1, 3, 16, 16, dtype=torch.float64)
    edge[..., 8:] = 1.0
    weights = stage.weights(edge)[0]
    assert float(weights[..., 5:7].max()) < 0.5  # filters over the edge's middle
    torch.testing.assert_close(weights[..., 8:], torch.ones(5, 12, 4).double(), rtol=0, atol=1e-12)
    torch.testing.assert_close(weights[..., :4], torch.ones(5, 12, 4).double(), rtol=0, atol=1e-12)
