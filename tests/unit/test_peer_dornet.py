"""Deformable convolution and DORNet."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn import functional

from dsr.methods.networks.peers import dornet
from dsr.methods.networks.peers.dornet import DORNet, deformable_conv3x3


def random(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def make_inputs(batch=2, channels=3, outputs=4, height=5, width=6):
    return (
        random(batch, channels, height, width),
        2 * random(batch, 18, height, width, seed=1),
        random(batch, 9, height, width, seed=2).sigmoid(),
        random(batch, outputs, channels, 3, 3, seed=3),
    )


def interpolate(image, y, x):
    """The bilinear value of (H, W) at a position; 0 outside."""
    value = 0.0
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                value += (1 - abs(y - row)) * (1 - abs(x - column)) * image[row, column]
    return value


def convolve_in_loops(x, offsets, mask, weight):
    batch, channels, height, width = x.shape
    result = np.zeros((batch, weight.shape[1], height, width))
    for b, row, column, tap in np.ndindex(batch, height, width, 9):
        dy, dx = offsets[b, 2 * tap : 2 * tap + 2, row, column]
        y, x_position = row + tap // 3 - 1 + dy, column + tap % 3 - 1 + dx
        for channel in range(channels):
            value = mask[b, tap, row, column] * interpolate(x[b, channel], y, x_position)
            result[b, :, row, column] += weight[b, :, channel, tap // 3, tap % 3] * value
    return result


def test_deformable_conv3x3_equals_plain_loops() -> None:
    inputs = make_inputs()
    expected = convolve_in_loops(*(each.numpy() for each in inputs))
    np.testing.assert_allclose(deformable_conv3x3(*inputs).numpy(), expected, atol=1e-12)


def test_deformable_conv3x3_without_offsets_is_a_convolution() -> None:
    x, offsets, mask, weight = make_inputs(batch=1)
    result = deformable_conv3x3(x, 0 * offsets, torch.ones_like(mask), weight)
    torch.testing.assert_close(result, functional.conv2d(x, weight[0], padding=1))


def test_deformable_conv3x3_does_not_depend_on_the_chunks(monkeypatch) -> None:
    inputs = make_inputs()
    whole = deformable_conv3x3(*inputs)
    monkeypatch.setattr(dornet, "_CHUNK", 1)
    torch.testing.assert_close(deformable_conv3x3(*inputs), whole)


def test_deformable_conv3x3_has_the_right_gradients() -> None:
    inputs = [each.requires_grad_() for each in make_inputs(1, 2, 2, 3, 4)]
    assert torch.autograd.gradcheck(deformable_conv3x3, inputs, fast_mode=True)


def test_dornet_refines_each_image_of_a_batch_alone() -> None:
    torch.manual_seed(0)
    net = DORNet(4).eval()
    rgb, values = torch.rand(2, 3, 12, 17), torch.rand(2, 1, 12, 17)
    with torch.inference_mode():
        both = net(rgb, values)
        one = torch.cat([net(rgb[i : i + 1], values[i : i + 1]) for i in range(2)])
    torch.testing.assert_close(both, one, atol=1e-5, rtol=1e-5)


def test_dornet_trains() -> None:
    torch.manual_seed(0)
    net = DORNet(4)
    rgb, values = torch.rand(1, 3, 9, 12), torch.rand(1, 1, 9, 12)
    refined = net(rgb, values)
    assert refined.shape == values.shape
    refined.sub(values).square().mean().backward()
    missing = [name for name, each in net.named_parameters() if each.grad is None or not each.grad.isfinite().all()]
    assert not missing


def test_dornet_folds_batch_normalisation_into_convolutions_with_and_without_a_bias() -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(1, 24, 8, 8, generator=generator)
    for conv, norm, has_bias in (
        ("Enc.E.0", "Enc.E.1", True),
        ("Enc.E_pre.1.shortcut.0", "Enc.E_pre.1.shortcut.1", False),
    ):
        weight = torch.randn(48, 24, 3, 3, generator=generator)
        bias = torch.randn(48, generator=generator) if has_bias else None
        parts = {part: torch.rand(48, generator=generator) + 0.5 for part in ("weight", "bias")}
        statistics = {part: torch.rand(48, generator=generator) + 0.5 for part in ("running_mean", "running_var")}
        tensors = {f"{conv}.weight": weight, **{f"{norm}.{name}": each for name, each in (parts | statistics).items()}}
        tensors |= {f"{norm}.num_batches_tracked": torch.tensor(7), "Dab.fc1.weight": weight}
        tensors |= {} if bias is None else {f"{conv}.bias": bias}
        converted = DORNet.convert(tensors)
        assert set(converted) == {f"{conv}.weight", f"{conv}.bias"}
        expected = functional.batch_norm(functional.conv2d(x, weight, bias), **statistics, **parts)
        folded = functional.conv2d(x, converted[f"{conv}.weight"], converted[f"{conv}.bias"])
        torch.testing.assert_close(folded, expected, atol=1e-4, rtol=1e-4)


def test_dornet_has_a_range_of_depth_with_the_weights_for_a_phone_alone() -> None:
    assert DORNet(8 / 3).depth_range == (0, 5)
    assert DORNet(4).depth_range is None
