"""Sparse-to-Dense and DDRNet: their parts against plain computations, and the published sizes."""

import numpy as np
import pytest
import torch
from small_scenes import maps, photos
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.images import compute_min_max, upsample_linear_border
from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.sparse_to_dense import BatchNorm, SparseToDense, UpProjection, place_samples

RESNET18 = 11_689_512 - 513_000 + 64 * 49
"""Parameters of ResNet-18 (He et al. 2016) without its classifier, with a fourth input channel."""


def _net(scale=4, width=4):
    torch.manual_seed(scale)
    return SparseToDense(scale, width).eval()


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
def test_samples_lie_next_to_the_centres_of_their_blocks_and_zeros_elsewhere(scale):
    values = maps(3, 5, 2)
    expected = np.zeros((2, 1, 3 * scale, 5 * scale))
    for i in range(3):
        for j in range(5):
            expected[..., scale * i + scale // 2, scale * j + scale // 2] = values[..., i, j].numpy()
    assert np.array_equal(place_samples(values, scale).numpy(), expected)


def test_encoder_has_the_parameters_of_resnet18():
    net = SparseToDense(4, width=64)
    assert sum(each.numel() for part in (net.stem, net.encoder) for each in part.parameters()) == RESNET18
    x = net.encoder(functional.max_pool2d(net.stem(torch.zeros(1, 4, 64, 96)), 3, stride=2, padding=1))
    assert x.shape == (1, 512, 2, 3)
    assert net.decoder(net.middle(x)).shape == (1, 16, 32, 48)


def _unpool_and_convolve(x, layer):
    """Insert zeros to the right of and below each pixel, then apply the layer's kernel as a 5 x 5 convolution."""
    assert isinstance(layer, nn.ConvTranspose2d)
    batch, channels, height, width = x.shape
    spread = x.new_zeros(batch, channels, 2 * height, 2 * width)
    spread[..., ::2, ::2] = x
    kernel = layer.weight.flip(-2, -1).transpose(0, 1)
    return functional.conv2d(spread, kernel, padding=2)


def test_up_projection_equals_unpooling_and_convolutions():
    torch.manual_seed(1)
    block = UpProjection(6).double().eval()
    for layer in block.modules():
        if isinstance(layer, BatchNorm):
            layer.running_mean = torch.randn_like(layer.running_mean)
            layer.running_var = torch.rand_like(layer.running_var) + 0.5
    x = torch.randn(2, 6, 4, 5, dtype=torch.float64)

    def norm(x, layer):
        mean, var, weight, bias = (
            each.view(1, -1, 1, 1) for each in (layer.running_mean, layer.running_var, layer.weight, layer.bias)
        )
        return (x - mean) / (var + 1e-5).sqrt() * weight + bias

    upper, lower = block.upper, block.lower
    first = norm(_unpool_and_convolve(x, upper[0]), upper[1]).clamp(min=0)
    above = norm(functional.conv2d(first, upper[3].weight, padding=1), upper[4])
    expected = (above + norm(_unpool_and_convolve(x, lower[0]), lower[1])).clamp(min=0)
    torch.testing.assert_close(block(x), expected, rtol=0, atol=1e-12)


def test_normalisation_is_that_of_the_library():
    torch.manual_seed(2)
    layer, expected, x = BatchNorm(3).double(), nn.BatchNorm2d(3).double(), 2 * torch.randn(4, 3, 8, 9).double() + 1
    for training in (True, False):
        torch.testing.assert_close(layer.train(training)(x), expected.train(training)(x))
    assert set(layer.state_dict()) == set(expected.state_dict()) - {"num_batches_tracked"}


@pytest.mark.parametrize("scale", [2, 8])
def test_sizes_that_are_no_multiple_of_32_equal_those_that_repeat_the_border(scale):
    net = _net(scale).double()
    height, width = 40 // scale, 56 // scale
    rgb, values = photos(scale * height, scale * width).double(), maps(height, width)
    more = [-n % (32 // scale) for n in (height, width)]
    padded = functional.pad(values, (0, more[1], 0, more[0]), mode="replicate")
    padded_rgb = functional.pad(rgb, (0, scale * more[1], 0, scale * more[0]), mode="replicate")
    expected = net.upsample(padded_rgb, padded)[..., : scale * height, : scale * width]
    torch.testing.assert_close(net.upsample(rgb, values), expected, rtol=0, atol=1e-12)


def test_holes_are_inpainted_before_the_samples_are_placed():
    net, rgb, values = _net(), photos(32, 32), maps(8, 8)
    values[..., 4, 4] = torch.nan
    inpainted = values.clone()
    inpainted[..., 4, 4] = (values[..., 3:6, 3:6].nansum() / 8).item()
    torch.testing.assert_close(net.upsample(rgb, values), net.upsample(rgb, inpainted), rtol=1e-9, atol=0)


# (inputs, outputs, size) of the convolutions of the authors' convResnet and hypercolumn
DENOISING = [(1, 32, 3), (32, 64, 3), (64, 128, 3), *[(128, 128, 3)] * 4, (256, 64, 3), (128, 32, 3), (64, 1, 3)]
REFINEMENT = [(1, 8, 3), (1, 8, 3), (16, 16, 3), (32, 32, 3), (32, 32, 3), (64, 64, 3), (64, 64, 3), (64, 64, 3),
              (112, 16, 1), (16, 4, 1), (4, 1, 1)]  # fmt: skip


def _ddrnet(scale: int = 4) -> DDRNet:
    """Return a small network with weights far from those that it starts with."""
    torch.manual_seed(scale)
    net = DDRNet(scale, denoising=4, refinement=4)
    for parameter in net.parameters():
        parameter.data.add_(0.3 * torch.randn_like(parameter))
    return net


def _stages(net: DDRNet, rgb: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the denoised and the refined map."""
    min_max = compute_min_max(values)
    answer = net.answer_patches({"rgb": rgb, "disparity_lr": values, "min_max": min_max})
    return answer.stages[0], answer.disparity


def test_networks_have_the_parameters_of_the_published_code() -> None:
    net = DDRNet(4)
    for part, layers in ((net.denoise, DENOISING), (net.refine, REFINEMENT)):
        expected = sum(inputs * outputs * size**2 + outputs for inputs, outputs, size in layers)
        assert sum(each.numel() for each in part.parameters()) == expected


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_new_network_is_bicubic_upsampling(scale: int) -> None:
    torch.manual_seed(0)
    values, rgb = maps(5, 6), photos(5 * scale, 6 * scale)
    expected = upsample_linear_border(values, scale)
    for stage in _stages(DDRNet(scale, denoising=4, refinement=4), rgb, values):
        torch.testing.assert_close(stage, expected.float(), rtol=1e-6, atol=0)


def test_refined_map_is_the_result_and_the_denoised_one_knows_no_photo() -> None:
    net, values, rgb = _ddrnet(), maps(6, 7), photos(24, 28)
    denoised, refined = _stages(net, rgb, values)
    assert torch.equal(refined, net.upsample(rgb, values).float())
    others = _stages(net, 1 - rgb, values)
    assert torch.equal(others[0], denoised)
    assert not torch.allclose(others[1], refined, rtol=1e-4)


def test_photo_counts_by_its_luma() -> None:
    net, values, rgb = _ddrnet(), maps(6, 7), photos(24, 28)
    grey = (0.299 * rgb[:, :1] + 0.587 * rgb[:, 1:2] + 0.114 * rgb[:, 2:]).expand(-1, 3, -1, -1)
    torch.testing.assert_close(net.upsample(grey, values), net.upsample(rgb, values), rtol=1e-6, atol=0)
