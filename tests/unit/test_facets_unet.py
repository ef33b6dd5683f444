"""Facets, with and without context: what holds for any weights, kernels, sharing, and its parts against plain loops."""

import itertools

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from small_networks import with_any_weights
from small_scenes import maps, normal
from torch import nn
from torch.nn import functional

from dsr.degradation.downsampling import FACTS, KERNELS, Downsampling, encode_facts
from dsr.methods.networks import facets_planes, facets_unet
from dsr.methods.networks.facets import Facets, enlarge_and_join
from dsr.methods.networks.facets_planes import NEIGHBOURS, average_planes, mix_planes, stencil
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.trained import NETWORKS
from dsr.methods.networks.weight_files import load_network, save_network

SCALES = (1, 2, 4, 8, 16)


def test_differences_are_those_of_a_map_that_goes_on_linearly():
    values = maps(4, 5)
    found, padded = stencil(values), np.pad(values[0, 0].numpy(), 1, mode="reflect", reflect_type="odd")
    for axis, slopes in ((1, found.slopes[0, 0]), (0, found.slopes[0, 1])):
        rows = np.moveaxis(padded, axis, 0)[:, 1:-1]
        expected = rows[1:-1] - rows[:-2], (rows[2:] - rows[:-2]) / 2, rows[2:] - rows[1:-1]
        np.testing.assert_allclose(slopes, np.moveaxis(np.stack(expected), 1, 1 + axis), atol=1e-12)
    np.testing.assert_allclose(found.mean[0, 0], sliding_window_view(padded, (3, 3)).mean((2, 3)), rtol=1e-12)
    step = torch.where(torch.arange(12) >= 6, 2.0, 0.0).expand(1, 1, 9, 12)
    assert stencil(step).bend[0, 0, 4].tolist() == [0, 0, 0, 0, 2, 2, 2, 2, 0, 0, 0, 0]


def _net(scale=4):
    """Return a small network with random weights, also in the layers that begin small."""
    return with_any_weights(lambda: FacetsUNet(scale, 8, 12, 4).eval(), 0.05, 3).requires_grad_()


def _maps(answer):
    return answer.disparity, answer.spread, answer.angle


def _inputs(scale, height=12, width=10):
    """Return a photo and a rough map whose median is 1 or so."""
    generator = torch.Generator().manual_seed(scale)
    if scale == 1:
        height, width = 2 * height, 2 * width
    rgb = torch.rand((1, 3, scale * height, scale * width), generator=generator)
    return rgb, 1 + 0.1 * torch.rand((1, 1, height, width), generator=generator).double()


def _plane(height, width, scale):
    """Return a plane at the centres of the pixels of a map of a factor, (1, 1, height, width)."""
    v, u = ((scale * (torch.arange(n, dtype=torch.float64) + 0.5)) for n in (height, width))
    return (2 + 0.003 * u - 0.002 * v[:, None])[None, None]


@pytest.mark.parametrize("scale", SCALES)
def test_planes_are_reproduced_by_any_weights(scale):
    rgb, values = _inputs(scale)
    height, width = values.shape[-2:]
    found = _net(scale).upsample(rgb, _plane(height, width, scale))
    torch.testing.assert_close(found, _plane(*rgb.shape[-2:], 1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", SCALES)
def test_result_scales_with_the_map(scale):
    rgb, values = _inputs(scale)
    net = _net(scale)
    once, thrice = (net.answer(rgb, factor * values) for factor in (1, 3))
    torch.testing.assert_close(thrice.disparity, 3 * once.disparity, rtol=1e-5, atol=0)
    torch.testing.assert_close(thrice.spread, once.spread, rtol=1e-4, atol=0)
    assert not torch.allclose(once.disparity[..., ::scale, ::scale], values, atol=1e-3)


@pytest.mark.parametrize("scale", SCALES)
def test_bands_change_nothing(scale, monkeypatch):
    rgb, values = _inputs(scale, 40, 6)
    net, steps = _net(scale), []
    whole = net.answer(rgb, values)
    monkeypatch.setattr(facets_unet, "_BAND", rgb[0, 0].numel() // 5)
    banded = net.answer(rgb, values, progress=lambda *step: steps.append(step))
    torch.testing.assert_close(_maps(banded), _maps(whole), rtol=1e-4, atol=1e-7)
    assert steps == [(number, 5) for number in range(1, 6)]


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
def test_every_parameter_serves(scale):
    net = _net(scale).train()
    for factor in (1, 2) if scale == 2 else (scale,):
        rgb, values = _inputs(factor)
        answer = net.answer(rgb, values.float(), None, torch.ones(1, FACTS))
        sum(each.square().mean() for each in _maps(answer)).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.any()), name


def test_weights_of_factor_2_serve_maps_of_the_photos_size(tmp_path):
    net = _net(2)
    save_network(tmp_path / "weights", net, "facets")
    for scale in (1, 2):
        rgb, values = _inputs(scale)
        loaded = load_network(tmp_path / "weights", NETWORKS, scale, "facets").eval()
        assert loaded.scale == scale
        assert torch.equal(loaded.upsample(rgb, values), net.upsample(rgb, values))
    with pytest.raises(ValueError, match="weights are for scale 2, the run is at scale 4"):
        load_network(tmp_path / "weights", NETWORKS, 4, "facets")


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
@pytest.mark.parametrize("older", [True, False])
def test_it_starts_near_what_facets_or_that_of_another_factor_does(scale, older):
    torch.manual_seed(1)
    first = Facets(4, width=8, blocks=4)
    if not older:
        facets, first = first, FacetsUNet(4, 8, 12, 4)
        first.start_from(facets)
    net, fresh = (FacetsUNet(scale, 8, 12, 4).eval() for _ in range(2))
    net.start_from(first.eval())
    photo, values = _inputs(4)
    rgb = nn.functional.interpolate(photo, scale_factor=scale / 4, mode="bilinear", antialias=scale < 4)
    with torch.inference_mode():
        near, far, expected = net.upsample(rgb, values), fresh.upsample(rgb, values), first.upsample(photo, values)
    grown = nn.functional.interpolate(expected, near.shape[-2:], mode="bilinear", antialias=scale < 4)
    ratio = float((near - grown).abs().mean() / (far - grown).abs().mean())
    assert ratio < (0.5 if older and scale == 4 else 0.7), ratio
    if not older:
        kept = {name: value for name, value in first.state_dict().items() if "trunk" in name}
        assert all(torch.equal(value, net.state_dict()[name]) for name, value in kept.items())


@pytest.mark.parametrize("kernel", KERNELS)
def test_an_open_gate_reproduces_what_was_measured(kernel):
    rgb, values = _inputs(4)
    net, hints = _net(), torch.zeros(1, FACTS)
    hints[0, KERNELS.index(kernel)] = 1
    model = Downsampling(kernel)
    left = []
    for logit in (-50.0, 50.0):
        with torch.no_grad():
            net.gate.weight.zero_()
            net.gate.bias.fill_(logit)
        with torch.inference_mode():
            found = net.answer(rgb, values, None, hints).disparity
        left.append(float((model(found[0], 4) - values[0]).abs().mean()))
    assert left[1] < 0.4 * left[0]
    values[..., 4:6, 4:6] = torch.nan
    assert bool(net.answer(rgb, values, None, hints).disparity.isfinite().all())


@pytest.mark.parametrize("reach", [1, 2, 16])
def test_planes_are_averaged_with_those_around_extended_to_the_pixel(reach):
    planes, weights = normal(1, 1, 3, 5, 7), normal(1, 1, NEIGHBOURS, 5, 7, seed=reach)
    expected = torch.zeros_like(planes)
    for row, column in itertools.product(range(5), range(7)):
        for k in range(NEIGHBOURS):
            i = min(max(row + reach * (k // 3 - 1), 0), 4)
            j = min(max(column + reach * (k % 3 - 1), 0), 6)
            value, slope_u, slope_v = planes[0, 0, :, i, j]
            here = torch.stack((value + (column - j) * slope_u + (row - i) * slope_v, slope_u, slope_v))
            expected[0, 0, :, row, column] += weights[0, 0, k, row, column] * here
    torch.testing.assert_close(average_planes(planes, weights, reach), expected)


@pytest.mark.parametrize("reach", [1, 4])
def test_gradients_of_averaged_planes_are_those_of_differences(reach):
    given = normal(1, 1, 3, 3, 4).requires_grad_(), normal(1, 1, NEIGHBOURS, 3, 4, seed=reach).requires_grad_()
    assert torch.autograd.gradcheck(lambda *maps: average_planes(*maps, reach), given, fast_mode=True)


def test_gradients_of_mixed_planes_are_those_of_differences(monkeypatch):
    monkeypatch.setattr(facets_planes, "_CHUNK", 5 * 9 * 4)  # several parts, the last one smaller
    planes, found = normal(1, 1, 3, 3, 4).requires_grad_(), normal(1, NEIGHBOURS + 2, 6, 8, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda *given: mix_planes(*given, 2), (planes, found), fast_mode=True)
    torch.testing.assert_close(mix_planes(planes, found, 2)[1], found[:, NEIGHBOURS:])


def test_two_convolutions_and_the_shuffle_between_them_are_one():
    up, join = nn.Conv2d(3, 12, 1), nn.Conv2d(3 + 2, 4, 3, padding=1)
    up, join = (each.double().to(memory_format=torch.channels_last) for each in (up, join))
    x, features = normal(2, 3, 4, 5).requires_grad_(), normal(2, 2, 8, 10, seed=1).requires_grad_()
    expected = join(torch.cat((functional.pixel_shuffle(up(x), 2), features), dim=1))
    found = enlarge_and_join(up, join, x, features)
    torch.testing.assert_close(found, expected)
    factors = normal(*found.shape, seed=2)
    inputs = [x, features, *up.parameters(), *join.parameters()]
    expected_gradients = torch.autograd.grad((expected * factors).sum(), inputs)
    (found * factors).sum().backward()
    for each, gradient in zip(inputs, expected_gradients, strict=True):
        torch.testing.assert_close(each.grad, gradient)
        assert each.grad.stride() == each.stride()  # which several devices expect


def test_mixed_planes_are_planes_at_each_pixel_weighted_by_a_softmax():
    planes, choice = normal(1, 2, 3, 3, 4), normal(1, 2 * NEIGHBOURS, 6, 8, seed=1)
    found, _ = mix_planes(planes, choice, 2)
    offsets = torch.tensor([-0.25, 0.25], dtype=torch.float64)
    splines = torch.tensor([[9, 22, 1], [1, 22, 9]], dtype=torch.float64) / 32  # of the pixels of a row, by neighbour
    prior = torch.einsum("yi,xj->ijyx", splines, splines).flatten(0, 1).repeat(1, 3, 4) + 1e-4
    weights = choice.view(NEIGHBOURS, 2, 6, 8).exp() * prior[:, None]
    weights = weights / weights.sum(dim=(0, 1))
    for row, column in itertools.product(range(6), range(8)):
        y, x = row // 2, column // 2
        expected = 0.0
        for k, facet in itertools.product(range(NEIGHBOURS), range(2)):
            i, j = y + k // 3 - 1, x + k % 3 - 1
            i, j = (i if 0 <= i < 3 else y), (j if 0 <= j < 4 else x)
            value, slope_u, slope_v = planes[0, facet, :, i, j].tolist()
            u, v = x - j + float(offsets[column % 2]), y - i + float(offsets[row % 2])
            expected += float(weights[k, facet, row, column]) * (value + u * slope_u + v * slope_v)
        assert float(found[0, 0, row, column]) == pytest.approx(expected, abs=1e-12)


def test_prepared_patches_have_the_answer_of_the_maps_and_the_hints():
    net, generator = _net(), torch.Generator().manual_seed(5)
    rgb, values = torch.rand((2, 3, 48, 40), generator=generator), 1 + torch.rand((2, 1, 12, 10), generator=generator)
    values[1, :, 3:6, 2:5] = torch.nan
    hints = {"noise": torch.full_like(values, 0.01), "facts": torch.stack([encode_facts("bicubic"), encode_facts()])}
    batch = {"rgb": rgb, "disparity_lr": values, "doffs": torch.full((2, 1, 1, 1), 0.5), **hints}
    prepared = net.prepare(batch)
    assert prepared["kernels"] == ["bicubic", None]
    found, expected = net.answer_patches(prepared), net.answer(rgb, values + 0.5, *hints.values())
    torch.testing.assert_close(_maps(found), _maps(expected), rtol=0, atol=0)


def test_images_of_a_batch_do_not_see_each_other():
    """With kernels of their own, one of them unknown, and holes in one."""
    net = _net()
    rgb = torch.rand((3, 3, 48, 40), generator=torch.Generator().manual_seed(5))
    values = 1 + 0.1 * torch.rand((3, 1, 12, 10), generator=torch.Generator().manual_seed(6)).double()
    values[1, :, 3:6, 2:5] = torch.nan
    facts = torch.stack([encode_facts("box", noise=True), encode_facts("bicubic", soft=True), encode_facts()])
    noise = torch.full_like(values, 0.01)
    with torch.inference_mode():
        together = net.answer(rgb, values, noise, facts)
        for i in range(3):
            alone = net.answer(rgb[i : i + 1], values[i : i + 1], noise[i : i + 1], facts[i : i + 1])
            expected = tuple(each[i : i + 1] for each in _maps(together))
            torch.testing.assert_close(_maps(alone), expected, rtol=1e-4, atol=1e-6)


def test_photos_of_another_size_and_other_networks_are_refused():
    rgb, values = _inputs(4)
    with pytest.raises(ValueError, match="rgb: expected"):
        _net(8).answer(rgb, values)
    for first in (FacetsUNet(4, 12, 12, 4), Facets(4, width=8, blocks=5)):
        with pytest.raises(ValueError, match=r"expected weights of Facets or FacetsUNet with .*'width': 8"):
            _net().start_from(first)
    net = FacetsUNet(16, 8, 10, 4)  # of another width in its depth: neither a part of those weights nor a bias is taken
    fresh = {name: value.clone() for name, value in net.state_dict().items() if name.startswith("wide.")}
    net.start_from(_net(8))
    assert all(torch.equal(net.state_dict()[name], value) for name, value in fresh.items())


def test_layers_at_the_low_resolution_are_shared_and_not_trained(tmp_path):
    first, net = _net(4), _net(8)
    with torch.no_grad():
        for parameter in first.parameters():
            parameter.add_(0.01)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    net.share(first)
    low = {name for name, value in first.state_dict().items() if torch.equal(net.state_dict()[name], value)}
    assert {name.split(".")[0] for name in low} == set(facets_unet._SHARED)
    assert all(torch.equal(before[name], value) for name, value in net.state_dict().items() if name not in low)
    assert {name for name, value in net.named_parameters() if not value.requires_grad} == low
    with pytest.raises(ValueError, match=r"expected weights of FacetsUNet with .*'width': 8.*, got those of Facets"):
        net.share(Facets(4, width=8, blocks=4))
    # a file beside the other's has only what differs
    for name, each, shared in (("x4", first, None), ("x8", net, tmp_path / "x4"), ("whole", net, None)):
        save_network(tmp_path / name, each, "facets", half=True, links={} if shared is None else {"shared": shared})
    assert (tmp_path / "x8").stat().st_size < 0.7 * (tmp_path / "whole").stat().st_size
    whole, parts = (load_network(tmp_path / name, NETWORKS, 8, "facets").state_dict() for name in ("whole", "x8"))
    for name, value in whole.items():
        assert torch.equal(parts[name], value), name
    (tmp_path / "x4").unlink()
    with pytest.raises(FileNotFoundError, match="x8: expected"):
        load_network(tmp_path / "x8", NETWORKS)
