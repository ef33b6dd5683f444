"""Dynamic guidance: its stages against plain loops and the energy's gradient, and what holds whatever its weights."""

import numpy as np
import pytest
import torch
from small_scenes import maps, photos
from torch.nn import functional

from dsr.methods.images import box_mean, repeat_blocks, upsample_linear_border
from dsr.methods.networks.dynamic_guidance import (
    WIDTHS,
    DynamicGuidance,
    Stage,
    influence,
    polynomial_filters,
)


def _net(scale=4, *, stages=2, filters=5, size=5, noise=0.2):
    """Return a small network with weights far from those that it starts with."""
    torch.manual_seed(scale)
    net = DynamicGuidance(scale, stages, filters, size).requires_grad_(False)
    for parameter in net.parameters():
        parameter.add_(noise * torch.randn_like(parameter))
    return net


def _stage(*, filters=5, size=5):
    net = _net(stages=1, filters=filters, size=size).double()
    stage = net.stages[0]
    if not isinstance(stage, Stage):
        raise TypeError
    return stage


def _penalty(z, heights):
    """Return rho(z) of the responses of L filters, (B, L, H, W), for the heights of their penalties, (L, 6)."""
    total = torch.zeros_like(z)
    for height, width in zip(heights.T, WIDTHS, strict=True):
        total = total + height[:, None, None] * (0.5 * width**2) * torch.log1p((z / width) ** 2)
    return total


@pytest.mark.parametrize("size", [3, 4, 7])
def test_filters_are_orthonormal_and_blind_to_what_the_first_ones_see(size):
    v, u = torch.meshgrid(torch.arange(size).double(), torch.arange(size).double(), indexing="ij")
    basis = polynomial_filters(size)
    flat = basis.flatten(1)
    torch.testing.assert_close(flat @ flat.T, torch.eye(size**2).double(), rtol=0, atol=1e-12)
    for each, blind in ((v - v + 1, basis[1:]), (u, basis[3:]), (v, basis[3:])):
        assert float((blind * each).sum(dim=(1, 2)).abs().max()) < 1e-11


def test_influence_is_the_derivative_of_the_penalty():
    z = torch.tensor([-2.0, -0.3, -4e-3, 0.0, 1e-3, 0.02, 0.7], dtype=torch.float64).view(1, 1, 1, 7)
    heights = torch.tensor([[1.0, -0.5, 0.3, 2.0, -1.0, 0.1]], dtype=torch.float64)
    z.requires_grad_()
    (expected,) = torch.autograd.grad(_penalty(z, heights).sum(), z)
    torch.testing.assert_close(influence(z, heights), expected, rtol=1e-12, atol=1e-15)
    one = sum(float(a) / (1 + (0.02 / width) ** 2) for a, width in zip(heights[0], WIDTHS, strict=True))
    assert float(influence(z, heights)[0, 0, 0, 5].detach()) == pytest.approx(0.02 * one, rel=1e-12)


def test_stage_is_a_gradient_step_on_its_energy_and_one_towards_the_low_resolution_map():
    stage, rgb = _stage(), photos(16, 20, 2).double()
    coarse = maps(4, 5, 2) / 30
    x = repeat_blocks(coarse, 4) + 0.1 * maps(16, 20, 2)
    y = (x - stage.fidelity * upsample_linear_border(box_mean(x, 4) - coarse, 4)).requires_grad_()
    penalties = _penalty(functional.conv2d(y, stage.filters(y)), stage.heights / len(stage.heights))
    (gradient,) = torch.autograd.grad((stage.weights(rgb) * penalties).sum(), y)
    assert float(gradient.abs().max()) > 1e-2
    torch.testing.assert_close(stage(x, coarse, rgb), y.detach() - gradient, rtol=0, atol=1e-13)


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
    net = _net(2, filters=2, size=3).double().requires_grad_()
    rgb, coarse = photos(8, 6).double(), maps(4, 3) / 30
    names, parameters = zip(*net.named_parameters(), strict=True)

    def answer(*values):
        return torch.func.functional_call(net, dict(zip(names, values, strict=True)), (rgb, coarse))

    assert torch.autograd.gradcheck(answer, parameters, eps=1e-7, atol=1e-4, fast_mode=True)


def test_mixed_precision_training_computes_in_float32():
    net, rgb, coarse = _net(), photos(24, 28), maps(6, 7)
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
