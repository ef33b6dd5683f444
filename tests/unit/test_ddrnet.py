"""DDRNet: its sizes against the published ones, its two stages, and what it starts from."""

import pytest
import torch
from small_scenes import maps, photos
from torch import Tensor

from dsr.methods.images import compute_min_max, upsample_linear_border
from dsr.methods.networks.ddrnet import DDRNet

# (inputs, outputs, size) of the convolutions of the authors' convResnet and hypercolumn
DENOISING = [(1, 32, 3), (32, 64, 3), (64, 128, 3), *[(128, 128, 3)] * 4, (256, 64, 3), (128, 32, 3), (64, 1, 3)]
REFINEMENT = [(1, 8, 3), (1, 8, 3), (16, 16, 3), (32, 32, 3), (32, 32, 3), (64, 64, 3), (64, 64, 3), (64, 64, 3),
              (112, 16, 1), (16, 4, 1), (4, 1, 1)]  # fmt: skip


def _net(scale: int = 4) -> DDRNet:
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
    net, values, rgb = _net(), maps(6, 7), photos(24, 28)
    denoised, refined = _stages(net, rgb, values)
    assert torch.equal(refined, net.upsample(rgb, values).float())
    others = _stages(net, 1 - rgb, values)
    assert torch.equal(others[0], denoised)
    assert not torch.allclose(others[1], refined, rtol=1e-4)


def test_photo_counts_by_its_luma() -> None:
    net, values, rgb = _net(), maps(6, 7), photos(24, 28)
    grey = (0.299 * rgb[:, :1] + 0.587 * rgb[:, 1:2] + 0.114 * rgb[:, 2:]).expand(-1, 3, -1, -1)
    torch.testing.assert_close(net.upsample(grey, values), net.upsample(rgb, values), rtol=1e-6, atol=0)
