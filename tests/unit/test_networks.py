"""What holds of every network on the disparity's range, whatever its weights; its tiles and augmentations."""

import pytest
import torch
from small_networks import with_any_weights
from small_scenes import maps, photos, plane_map, problem
from torch.nn import functional

from dsr.geometry.camera import to_range
from dsr.methods.images import compute_min_max
from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.dynamic_guidance import DynamicGuidance
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import (
    ENSEMBLES,
    DisparityNetwork,
    NetworkUpsampler,
    blend_tiles,
    split_axis,
)
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.sparse_to_dense import SparseToDense

BUILDERS = {
    "facets": lambda scale: Facets(scale, width=8, blocks=1),
    "pdn": lambda scale: PrimalDualNetwork(scale, width=6, layers=2, window=3, iterations=1),
    "dg": lambda scale: DynamicGuidance(scale, stages=1, filters=4, size=3),
    "ddrnet": lambda scale: DDRNet(scale, denoising=4, refinement=4),
    "sparse_to_dense": lambda scale: SparseToDense(scale, width=4),
    "msg": lambda scale: MSGNet(scale, "dsr"),
}
WINDOWED = {
    **{name: lambda name=name: BUILDERS[name](4) for name in ("facets", "pdn", "dg", "ddrnet", "msg")},
    "voynov": lambda: MSGNet(4, "voynov"),
    "hui": lambda: MSGNet(2, "hui"),
}


def _build(name, scale=4):
    published = name not in BUILDERS  # whose weights stay as they start
    build = (lambda: MSGNet(scale, name)) if published else (lambda: BUILDERS[name](scale))
    return with_any_weights(build, 0.0 if published else 0.1, scale).eval()


@pytest.fixture(params=BUILDERS)
def net(request):
    return _build(request.param)


@pytest.fixture(params=[*BUILDERS, "voynov", "hui"])
def any_net(request):
    """A network, those among them that are trained as published alone."""
    return _build(request.param)


def test_networks_are_equivariant_to_scale_and_offset_of_disparity(net):
    rgb, coarse = photos(24, 28), maps(6, 7)
    torch.testing.assert_close(net.upsample(rgb, 3 * coarse + 7), 3 * net.upsample(rgb, coarse) + 7, rtol=1e-6, atol=0)


def test_constant_map_stays_constant_and_one_without_a_valid_pixel_becomes_nan(any_net):
    result = any_net.upsample(photos(24, 28), torch.full((1, 1, 6, 7), 5.0))
    torch.testing.assert_close(result, torch.full_like(result, 5.0), rtol=1e-6, atol=0)
    assert bool(any_net.upsample(photos(24, 28), torch.full((1, 1, 6, 7), torch.nan)).isnan().all())


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
@pytest.mark.parametrize("name", ["facets", "dg"])
def test_plane_is_reproduced_for_any_weights_and_photo(name, scale):
    fine = plane_map(6 * scale, 7 * scale)
    rgb, coarse = photos(6 * scale, 7 * scale), functional.avg_pool2d(fine, scale)
    for dtype, share in ((torch.float64, 1e-12), (torch.float32, 1e-5), (torch.bfloat16, 1e-4)):
        result = _build(name, scale).to(dtype).upsample(rgb, coarse)
        torch.testing.assert_close(result, fine, rtol=0, atol=share * 30 * scale if name == "dg" else 1e-11)


def test_batch_equals_single_images_every_time(any_net):
    rgb, coarse = photos(80, 68, 3), maps(20, 17, 3)
    coarse[1, 0, 2, 3] = torch.nan
    any_net.double()  # processors round sums of a batch differently, which random layers amplify
    together = any_net.upsample(rgb, coarse)
    alone = torch.cat([any_net.upsample(rgb[i : i + 1], coarse[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(together, alone, rtol=1e-6, atol=1e-6)
    assert torch.equal(any_net.upsample(rgb, coarse), together)


def test_maps_of_any_size_keep_their_dtype(net):
    for height, width in ((1, 1), (1, 5), (2, 2), (3, 7)):
        for dtype in (torch.float32, torch.float64):
            result = net.upsample(photos(4 * height, 4 * width), maps(height, width).to(dtype))
            assert result.shape == (1, 1, 4 * height, 4 * width)
            assert result.dtype == dtype
            assert bool(result.isfinite().all())


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
    with pytest.raises(ValueError, match=r"^rgb: expected"):
        net.upsample(photos(24, 24), maps(6, 7))


class _Leaning(DisparityNetwork):
    """Repeats the low-resolution pixels and adds a ramp to the right and an arc from top to bottom."""

    scale = 2

    def arguments(self):
        return {}

    def upsample(self, rgb, disparity, min_max=None):
        ramp = torch.linspace(-1, 1, rgb.shape[-1], dtype=disparity.dtype)
        arc = torch.linspace(-1, 1, rgb.shape[-2], dtype=disparity.dtype)[:, None] ** 2
        return functional.interpolate(disparity, scale_factor=2, mode="nearest") + ramp + arc


def _method(name, *, ensemble=1):
    """Return a network whose answer is far from smooth, so that whatever a window misses shows."""
    torch.manual_seed(0)
    net = WINDOWED[name]()
    with torch.no_grad():
        for parameter in net.parameters():
            if parameter.dim() > 1:
                parameter.mul_(1.5)
    return NetworkUpsampler(net.double(), ensemble=ensemble)


def test_results_that_differ_by_a_constant_are_joined_by_a_ramp():
    values = iter((1.0, 2.0))
    rows, columns = split_axis(4, 4, 0, 0), split_axis(20, 10, 0, 4)
    line = blend_tiles(lambda r, c: torch.full((1, 1, 4, c.stop - c.start), next(values)), rows, columns, 1)[0, 0, 0]
    expected = torch.cat((torch.ones(8), torch.tensor([1.125, 1.375, 1.625, 1.875]), torch.full((8,), 2.0)))
    torch.testing.assert_close(line, expected)


@pytest.mark.parametrize(("name", "ensemble"), [*((name, 1) for name in WINDOWED), ("facets", 8)])
def test_tiled_result_equals_the_whole_image(name, ensemble):
    method, steps = _method(name, ensemble=ensemble), []
    scale = method.net.scale
    rgb, coarse = photos(14 * scale, 48 * scale), maps(14, 48)
    coarse[..., 3:9, 4:20] = torch.nan  # a hole that is larger than a tile
    if method.net.arguments().get("variant") in ("voynov", "hui"):
        coarse = coarse.nan_to_num(nan=20.5)  # random networks turn the step at a hole into anything
    with torch.inference_mode():
        whole = method.upsample_disparity(rgb, coarse)
        method.tile = 12 * scale
        tiled = method.upsample_disparity(rgb, coarse, lambda done, total: steps.append((done, total)))
    assert tiled.shape == whole.shape
    count = 8 * ensemble
    assert method.count_steps(*rgb.shape[-2:]) == count
    assert steps == [(i + 1, count) for i in range(count)]
    assert float((tiled - whole).abs().max() / (whole.max() - whole.min())) < 1e-5


def test_large_photo_is_tiled_automatically(monkeypatch):
    method, sample, parts = _method("facets"), problem(4, 12, 12), []
    whole = method(sample, lambda done, total: parts.append(total))
    monkeypatch.setattr("dsr.methods.networks.network.UNTILED", 1000)
    monkeypatch.setattr("dsr.methods.networks.network.TILE", 24)
    tiled = method(sample, lambda done, total: parts.append(total))
    assert parts == [1, *[4] * 4]
    torch.testing.assert_close(tiled, whole, rtol=1e-5, atol=0)


def test_augmentation_averages_what_depends_on_the_orientation():
    sample = problem(2, 6, 8)
    plain = functional.interpolate(sample.disparity_lr()[None], scale_factor=2, mode="nearest")[0]
    down, right = (torch.linspace(-1, 1, n, dtype=torch.float64) for n in plain.shape[-2:])
    leaning = plain + right + down[:, None] ** 2
    even = plain + (right**2 + down[:, None] ** 2) / 2  # the ramps cancel out, the arcs turn
    for ensemble, expected in zip(ENSEMBLES, (leaning, even, even), strict=True):
        depth = NetworkUpsampler(_Leaning(), ensemble=ensemble)(sample)
        torch.testing.assert_close(to_range(depth, sample.camera, "disparity"), expected)


def test_invalid_augmentation_is_refused():
    with pytest.raises(ValueError, match="ensemble: expected one of 1, 4, 8, got 2"):
        NetworkUpsampler(MSGNet(2, "dsr"), ensemble=2)
    with pytest.raises(ValueError, match="ensemble: expected"):
        NetworkUpsampler(MSGNet(2, "hui"), ensemble=4)
