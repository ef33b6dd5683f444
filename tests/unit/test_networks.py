"""What holds of every network of ours that works on the disparity's range, whatever its weights are."""

from types import MappingProxyType

import pytest
import torch
from small_scenes import maps, photos

from dsr.methods.images import compute_min_max
from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.dynamic_guidance import DynamicGuidance
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.sparse_to_dense import SparseToDense

WINDOWED = MappingProxyType(
    {
        "facets": lambda scale: Facets(scale, width=8, blocks=1),
        "pdn": lambda scale: PrimalDualNetwork(scale, width=6, layers=2, window=3, iterations=1),
        "dg": lambda scale: DynamicGuidance(scale, stages=1, filters=4, size=3),
        "ddrnet": lambda scale: DDRNet(scale, denoising=4, refinement=4),
    }
)
BUILDERS = MappingProxyType({**WINDOWED, "sparse_to_dense": lambda scale: SparseToDense(scale, width=4)})


def _build(name, scale=4):
    """Return a small network whose weights are far from those that it starts with."""
    net = BUILDERS[name](scale)
    torch.manual_seed(scale)
    for parameter in net.eval().requires_grad_(False).parameters():
        parameter.add_(0.1 * torch.randn_like(parameter))
    return net


@pytest.fixture(params=BUILDERS)
def net(request):
    return _build(request.param)


def test_networks_are_equivariant_to_scale_and_offset_of_disparity(net):
    rgb, coarse = photos(24, 28), maps(6, 7)
    torch.testing.assert_close(net.upsample(rgb, 3 * coarse + 7), 3 * net.upsample(rgb, coarse) + 7, rtol=1e-6, atol=0)


def test_given_min_max_normalises_a_window_like_its_image(net):
    rgb, coarse = photos(24, 28), maps(6, 7)
    own = torch.tensor([coarse.min(), coarse.max()]).view(1, 2, 1, 1)
    torch.testing.assert_close(net.upsample(rgb, coarse, own), net.upsample(rgb, coarse), rtol=1e-6, atol=0)
    wide = torch.tensor([0.0, 100.0]).view(1, 2, 1, 1)
    assert not torch.allclose(net.upsample(rgb, coarse, wide), net.upsample(rgb, coarse), rtol=1e-5)


def test_constant_map_stays_constant(net):
    result = net.upsample(photos(24, 28), torch.full((1, 1, 6, 7), 5.0))
    torch.testing.assert_close(result, torch.full((1, 1, 24, 28), 5.0), rtol=1e-6, atol=0)


def test_photo_influences_the_result(net):
    coarse = maps(6, 7)
    one, other = (net.upsample(photo, coarse) for photo in (photos(24, 28), 1 - photos(24, 28).square()))
    assert not torch.allclose(one, other, rtol=1e-4)


def test_batch_equals_single_images_every_time(net):
    rgb, coarse = photos(24, 28, 3), maps(6, 7, 3)
    together = net.upsample(rgb, coarse)
    alone = torch.cat([net.upsample(rgb[i : i + 1], coarse[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-3)
    assert torch.equal(net.upsample(rgb, coarse), together)


def test_maps_of_any_size_keep_their_dtype(net):
    for height, width in ((1, 1), (1, 5), (2, 2), (3, 7)):
        for dtype in (torch.float32, torch.float64):
            result = net.upsample(photos(4 * height, 4 * width), maps(height, width).to(dtype))
            assert result.shape == (1, 1, 4 * height, 4 * width)
            assert result.dtype == dtype
            assert bool(result.isfinite().all())


@pytest.mark.parametrize("name", WINDOWED)
def test_hole_is_filled_locally_within_the_receptive_field(name):
    net = _build(name)
    columns = 2 * net.receptive_field_radius + 6
    rgb, coarse = photos(32, 4 * columns), maps(8, columns)
    coarse[..., 0, 0], coarse[..., 0, 1] = 20, 29  # the range, which normalises
    pierced = coarse.clone()
    pierced[..., 3, 2] = torch.nan
    result, whole = net.upsample(rgb, pierced), net.upsample(rgb, coarse)
    assert bool(result.isfinite().all())
    far = 4 * (2 + net.receptive_field_radius + 2)
    torch.testing.assert_close(result[..., far:], whole[..., far:], rtol=1e-6, atol=0)
    assert not torch.allclose(result[..., 12:16, 8:12], whole[..., 12:16, 8:12])


def test_image_without_a_valid_pixel_becomes_nan(net):
    assert bool(net.upsample(photos(24, 28), torch.full((1, 1, 6, 7), torch.nan)).isnan().all())


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("name", WINDOWED)
def test_tiles_equal_the_whole_image(name, scale):
    net = _build(name, scale)
    rows, columns = net.receptive_field_radius + 9, 2 * net.receptive_field_radius + 10
    rgb, coarse = photos(scale * rows, scale * columns).double(), maps(rows, columns).double()
    tiled, whole = NetworkUpsampler(net, tile=4 * scale), NetworkUpsampler(net)
    for method in (tiled, whole):
        method.net.double()  # in float32 the rounding depends on the processor
    atol = 2e-5 if isinstance(net, PrimalDualNetwork) else 1e-10  # PDN's inputs are always float32
    torch.testing.assert_close(
        tiled.upsample_disparity(rgb, coarse), whole.upsample_disparity(rgb, coarse), rtol=0, atol=atol
    )


def test_patches_get_the_answer_of_the_upsampling_prepared_or_not(net):
    rgb, coarse = photos(24, 28, 2), maps(6, 7, 2).float()
    coarse[0, :, 2:4, 3] = torch.nan
    batch = {"rgb": rgb, "disparity_lr": coarse, "min_max": compute_min_max(coarse)}
    for each in (batch, net.prepare(batch)):
        assert torch.equal(net.answer_patches(each).disparity, net.upsample(rgb, coarse))


def test_training_reaches_every_parameter(net):
    net.train().requires_grad_()
    coarse = maps(16, 16, 2).float()
    coarse[..., 8:] += 20  # a depth discontinuity, across which weights count
    answer = net.answer_patches({"rgb": photos(64, 64, 2), "disparity_lr": coarse, "min_max": compute_min_max(coarse)})
    torch.stack([each.square().mean() for each in (answer.disparity, *answer.stages)]).sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        assert bool(parameter.grad.any()), name


def test_photo_of_another_size_is_refused(net):
    with pytest.raises(ValueError, match=r"^rgb: expected \(24, 28\) pixels for a map of \(6, 7\) at scale 4"):
        net.upsample(photos(24, 24), maps(6, 7))


def test_network_is_rebuilt_from_its_arguments(net):
    again = type(net)(**net.arguments()).eval()
    again.load_state_dict(net.state_dict())
    rgb, coarse = photos(16, 12), maps(4, 3)
    assert torch.equal(again.upsample(rgb, coarse), net.upsample(rgb, coarse))
