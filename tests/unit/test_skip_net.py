"""The network of image priors."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from dsr.methods.dip.skip_net import SkipNet, levels_for, upsample_2x


@pytest.mark.parametrize("shape", [(1, 3, 1, 1), (2, 3, 4, 5), (1, 1, 7, 1)])
@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_doubling_is_bilinear_interpolation(shape: tuple[int, ...], layout: torch.memory_format) -> None:
    x = torch.rand(shape, dtype=torch.float64).to(memory_format=layout)
    expected = functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
    torch.testing.assert_close(upsample_2x(x), expected)


def test_gradient_of_doubling_agrees_with_finite_differences() -> None:
    x = torch.rand(1, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(upsample_2x, x)


@pytest.mark.parametrize(("height", "width"), [(32, 48), (37, 50), (33, 32)])
def test_output_has_the_size_of_the_input(height: int, width: int) -> None:
    net = SkipNet(5, 2, (4, 6, 8), (2, 2, 2))
    assert net(torch.rand(1, 5, height, width)).shape == (1, 2, height, width)


def test_network_is_the_hourglass_of_ulyanov_et_al() -> None:
    """Against a plain construction from their supplementary material: two levels, written out."""
    torch.manual_seed(0)
    net = SkipNet(3, 2, (4, 6), (1, 2), padding="reflect").double()
    x = torch.rand(1, 3, 8, 12, dtype=torch.float64)

    def block(y: torch.Tensor, layer: torch.nn.Module) -> torch.Tensor:
        convolution, norm, _ = layer
        pad = convolution.kernel_size[0] // 2
        padded = functional.pad(y, (pad,) * 4, mode="reflect") if pad else y
        return functional.leaky_relu(normal(functional.conv2d(padded, convolution.weight, convolution.bias,
                                                              convolution.stride), norm), 0.2)  # fmt: skip

    def normal(y: torch.Tensor, norm: torch.nn.Module) -> torch.Tensor:
        mean, variance = y.mean((0, 2, 3), keepdim=True), y.var((0, 2, 3), unbiased=False, keepdim=True)
        scaled = (y - mean) / (variance + 1e-5).sqrt()
        return scaled * norm.weight.view(1, -1, 1, 1) + norm.bias.view(1, -1, 1, 1)

    first = block(block(x, net.down[0][0]), net.down[0][1])
    second = block(block(first, net.down[1][0]), net.down[1][1])
    y = second
    for level, source in ((1, first), (0, x)):
        y = functional.interpolate(y, scale_factor=2, mode="bilinear")
        y = normal(torch.cat((block(source, net.skip[level]), y), 1), net.norm[level])
        y = block(block(y, net.up[level][0]), net.up[level][1])
    torch.testing.assert_close(net(x), functional.conv2d(y, net.last.weight, net.last.bias))


def test_output_is_finer_than_bfloat16_even_if_the_convolutions_are_not() -> None:
    torch.manual_seed(0)
    net, x = SkipNet(4, 1, (8, 8), (2, 2)), torch.rand(1, 4, 64, 64)
    with torch.autocast("cpu", torch.bfloat16):
        y = net(x)
    assert y.dtype == torch.float32
    assert len(y.unique()) > 3000
    torch.testing.assert_close(y, net(x), rtol=0, atol=0.1 * float(y.detach().std()))


@pytest.mark.parametrize(
    ("height", "width", "most", "levels"),
    [(512, 512, 5, 5), (32, 512, 5, 4), (4, 4, 5, 1), (2, 2, 5, 1), (64, 64, 2, 2)],
)
def test_small_image_has_fewer_levels(height: int, width: int, most: int, levels: int) -> None:
    assert levels_for(height, width, most) == levels


def test_levels_must_match() -> None:
    with pytest.raises(ValueError, match="as many skips as widths"):
        SkipNet(3, 2, (4, 4), (2,))
