"""Sparse-to-Dense: the parts against plain computations and the published sizes, and images of any size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_scenes import maps, photos
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.networks.sparse_to_dense import BatchRenorm, SparseToDense, UpProjection, place_samples

RESNET18 = 11_689_512 - 513_000 + 64 * 49
"""Parameters of ResNet-18 (He et al. 2016) without its classifier, with a fourth input channel."""


def _net(scale: int = 4, width: int = 4) -> SparseToDense:
    torch.manual_seed(scale)
    return SparseToDense(scale, width).eval()


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
def test_samples_lie_next_to_the_centres_of_their_blocks_and_zeros_elsewhere(scale: int) -> None:
    values = maps(3, 5, 2)
    expected = np.zeros((2, 1, 3 * scale, 5 * scale))
    for i in range(3):
        for j in range(5):
            expected[..., scale * i + scale // 2, scale * j + scale // 2] = values[..., i, j].numpy()
    assert np.array_equal(place_samples(values, scale).numpy(), expected)


def test_encoder_has_the_parameters_of_resnet18() -> None:
    net = SparseToDense(4, width=64)
    assert sum(each.numel() for part in (net.stem, net.encoder) for each in part.parameters()) == RESNET18
    x = net.encoder(functional.max_pool2d(net.stem(torch.zeros(1, 4, 64, 96)), 3, stride=2, padding=1))
    assert x.shape == (1, 512, 2, 3)
    assert net.decoder(net.middle(x)).shape == (1, 16, 32, 48)


def _unpool_and_convolve(x: Tensor, layer: nn.Module) -> Tensor:
    """Insert zeros to the right of and below each pixel, then apply the layer's kernel as a 5 x 5 convolution."""
    assert isinstance(layer, nn.ConvTranspose2d)
    batch, channels, height, width = x.shape
    spread = x.new_zeros(batch, channels, 2 * height, 2 * width)
    spread[..., ::2, ::2] = x
    kernel = layer.weight.flip(-2, -1).transpose(0, 1)
    return functional.conv2d(spread, kernel, padding=2)


def test_up_projection_equals_unpooling_and_convolutions() -> None:
    torch.manual_seed(1)
    block = UpProjection(6).double().eval()
    for layer in block.modules():
        if isinstance(layer, BatchRenorm):
            layer.running_mean = torch.randn_like(layer.running_mean)
            layer.running_var = torch.rand_like(layer.running_var) + 0.5
    x = torch.randn(2, 6, 4, 5, dtype=torch.float64)

    def norm(x: Tensor, layer: BatchRenorm) -> Tensor:
        mean, var, weight, bias = (
            each.view(1, -1, 1, 1) for each in (layer.running_mean, layer.running_var, layer.weight, layer.bias)
        )
        return (x - mean) / (var + 1e-5).sqrt() * weight + bias

    upper, lower = block.upper, block.lower
    first = norm(_unpool_and_convolve(x, upper[0]), upper[1]).clamp(min=0)
    above = norm(functional.conv2d(first, upper[3].weight, padding=1), upper[4])
    expected = (above + norm(_unpool_and_convolve(x, lower[0]), lower[1])).clamp(min=0)
    torch.testing.assert_close(block(x), expected, rtol=0, atol=1e-12)


def _renorm() -> BatchRenorm:
    """Return a layer with random parameters and statistics."""
    torch.manual_seed(2)
    layer = BatchRenorm(3).double()
    for parameter in layer.parameters():
        parameter.data.normal_()
    layer.running_mean.normal_()
    layer.running_var.uniform_(0.5, 2)
    return layer


def test_renormalisation_gives_in_a_training_what_it_gives_in_use() -> None:
    layer, x = _renorm(), 2 * torch.randn(40, 3, 8, 9, dtype=torch.float64) + 1
    expected = layer.eval()(x)
    mean, var = layer.running_mean.clone(), layer.running_var.clone()
    torch.testing.assert_close(layer.train()(x), expected, rtol=0, atol=1e-3)
    torch.testing.assert_close(layer.running_mean, 0.9 * mean + 0.1 * x.mean(dim=(0, 2, 3)))
    torch.testing.assert_close(layer.running_var, 0.9 * var + 0.1 * x.transpose(0, 1).flatten(1).var(dim=1))


def test_renormalisation_has_the_gradient_of_batch_normalisation_with_its_corrections_fixed() -> None:
    layer, x = _renorm(), torch.randn(6, 3, 4, 5, dtype=torch.float64).requires_grad_()
    mean, var = x.detach().mean(dim=(0, 2, 3)), x.detach().transpose(0, 1).flatten(1).var(dim=1)
    factor = ((var + 1e-5) / (layer.running_var + 1e-5)).sqrt()
    shift = (mean - layer.running_mean) / (layer.running_var + 1e-5).sqrt()
    weight, bias = layer.weight * factor, layer.weight * shift + layer.bias
    expected = functional.batch_norm(x, None, None, weight, bias, training=True)
    upstream = torch.randn_like(expected)
    (wanted,) = torch.autograd.grad(expected, x, upstream)
    (found,) = torch.autograd.grad(layer.train()(x), x, upstream)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)


def test_renormalisation_limits_its_corrections() -> None:
    layer = BatchRenorm(1).double().train()
    x = 1e3 + 1e2 * torch.randn(9, 1, 5, 5, dtype=torch.float64)
    result = layer(x).detach()
    assert float(result.mean()) == pytest.approx(5, abs=1e-9)
    assert float(result.std()) == pytest.approx(3, rel=0.01)


@pytest.mark.parametrize("scale", [2, 8])
def test_sizes_that_are_no_multiple_of_32_equal_those_that_repeat_the_border(scale: int) -> None:
    net = _net(scale).double()
    height, width = 40 // scale, 56 // scale
    rgb, values = photos(scale * height, scale * width).double(), maps(height, width)
    more = [-n % (32 // scale) for n in (height, width)]
    padded = functional.pad(values, (0, more[1], 0, more[0]), mode="replicate")
    padded_rgb = functional.pad(rgb, (0, scale * more[1], 0, scale * more[0]), mode="replicate")
    expected = net.upsample(padded_rgb, padded)[..., : scale * height, : scale * width]
    torch.testing.assert_close(net.upsample(rgb, values), expected, rtol=0, atol=1e-12)


def test_gradients_reach_every_parameter() -> None:
    net = _net().train()
    net.upsample(photos(64, 64, 2), maps(16, 16, 2).float()).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        assert bool(parameter.grad.any()), name


def test_holes_are_inpainted_before_the_samples_are_placed() -> None:
    net, rgb, values = _net(), photos(32, 32), maps(8, 8)
    values[..., 4, 4] = torch.nan
    inpainted = values.clone()
    inpainted[..., 4, 4] = (values[..., 3:6, 3:6].nansum() / 8).item()
    torch.testing.assert_close(net.upsample(rgb, values), net.upsample(rgb, inpainted), rtol=1e-9, atol=0)


def test_width_that_the_decoder_cannot_halve_is_refused() -> None:
    for width in (0, 6):
        with pytest.raises(ValueError, match=rf"^width: expected a positive multiple of 4, got {width}"):
            SparseToDense(4, width)
