"""The method that runs a network: tiles give what the whole image gives, and the average over augmentations."""

import pytest
import torch
from torch.nn import functional

from dsr.geometry.camera import Camera, from_range, to_range
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import (
    ENSEMBLES,
    DisparityNetwork,
    NetworkUpsampler,
    apply_dihedral,
    blend_tiles,
    split_axis,
    undo_dihedral,
)
from dsr.sample import DepthSample

NETS = {
    "facets": lambda: Facets(4, width=8, blocks=2),
    "dsr": lambda: MSGNet(4, "dsr"),
    "voynov": lambda: MSGNet(4, "voynov"),
    "hui": lambda: MSGNet(2, "hui"),
}


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
    net = NETS[name]()
    with torch.no_grad():
        for parameter in net.parameters():
            if parameter.dim() > 1:
                parameter.mul_(1.5)
    return NetworkUpsampler(net.double(), ensemble=ensemble)


def _pair(scale, height, width):
    generator = torch.Generator().manual_seed(3)
    rgb = torch.rand((1, 3, scale * height, scale * width), generator=generator)
    coarse = 20 + 5 * torch.rand((1, 1, height, width), generator=generator)
    return rgb, coarse


def _sample(scale, height, width):
    rgb, coarse = _pair(scale, height, width)
    camera = Camera(scale * width, scale * height, 600.0, 600.0, 3.0, 4.0, baseline=0.2)
    low = camera.rescale(width, height)
    depth = from_range(coarse[0].double() / scale, low, "disparity")
    return DepthSample("test", "scene", rgb[0], depth, camera, low, scale)


@pytest.mark.parametrize(("size", "tile", "overlap"), [(100, 30, 4), (31, 30, 4), (30, 30, 4), (7, 1, 2), (1, 5, 0)])
def test_tile_weights_add_up_to_one_everywhere(size, tile, overlap):
    total = torch.zeros(2 * size)
    for span in split_axis(size, tile, 3, overlap):
        assert span.read.start <= span.kept.start < span.kept.stop <= span.read.stop
        assert span.kept.stop - span.kept.start <= max(tile, overlap + 1) + overlap
        total[2 * span.kept.start : 2 * span.kept.stop] += span.weights(2)
    torch.testing.assert_close(total, torch.ones(2 * size))


def test_window_covers_the_receptive_field_within_the_image():
    first, second, last = split_axis(90, 30, 7, 4)
    assert (first.read, second.read, last.read) == (slice(0, 39), slice(21, 69), slice(51, 90))
    assert (first.ramps, second.ramps, last.ramps) == ((0, 4), (4, 4), (4, 0))


def test_results_that_differ_by_a_constant_are_joined_by_a_ramp():
    values = iter((1.0, 2.0))
    rows, columns = split_axis(4, 4, 0, 0), split_axis(20, 10, 0, 4)
    line = blend_tiles(lambda r, c: torch.full((1, 1, 4, c.stop - c.start), next(values)), rows, columns, 1)[0, 0, 0]
    expected = torch.cat((torch.ones(8), torch.tensor([1.125, 1.375, 1.625, 1.875]), torch.full((8,), 2.0)))
    torch.testing.assert_close(line, expected)


@pytest.mark.parametrize(("name", "ensemble"), [*((name, 1) for name in NETS), ("facets", 8)])
def test_tiled_result_equals_the_whole_image(name, ensemble):
    method, steps = _method(name, ensemble=ensemble), []
    scale = method.net.scale
    rgb, coarse = _pair(scale, 14, 48)
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


@pytest.mark.parametrize("name", NETS)
def test_pixels_beyond_the_receptive_field_do_not_matter(name):
    net = _method(name).net
    size, at = 2 * net.receptive_field_radius + 9, net.receptive_field_radius + 4
    rgb, coarse = _pair(net.scale, size, size)
    coarse[..., at, at], rgb[..., net.scale * at + 1, net.scale * at + 1] = 22.0, 0.5
    other, photo = coarse.clone(), rgb.clone()
    other[..., at, at], photo[..., net.scale * at + 1, net.scale * at + 1] = 23.0, 0.6
    with torch.inference_mode():
        context = net.context(rgb, coarse)
        change = (net.upsample(photo, other, *context) - net.upsample(rgb, coarse, *context)).abs()[0, 0]
    rows, columns = (change > 1e-6).nonzero().T
    for index in (rows, columns):
        distance = (index // net.scale - at).abs()
        assert 0 < int(distance.max()) <= net.receptive_field_radius


def test_large_photo_is_tiled_automatically(monkeypatch):
    method, sample, parts = _method("facets"), _sample(4, 12, 12), []
    whole = method(sample, lambda done, total: parts.append(total))
    monkeypatch.setattr("dsr.methods.networks.network.UNTILED", 1000)
    monkeypatch.setattr("dsr.methods.networks.network.TILE", 24)
    tiled = method(sample, lambda done, total: parts.append(total))
    assert parts == [1, *[4] * 4]
    torch.testing.assert_close(tiled, whole, rtol=1e-5, atol=0)


@pytest.mark.parametrize("index", range(8))
def test_dihedral_transforms_are_distinct_and_invertible(index):
    x = torch.rand(2, 3, 5, 5)
    turned = apply_dihedral(x, index)
    assert torch.equal(undo_dihedral(turned, index), x)
    assert not any(torch.equal(turned, apply_dihedral(x, other)) for other in range(8) if other != index)


def test_augmentation_averages_what_depends_on_the_orientation():
    sample = _sample(2, 6, 8)
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
    with pytest.raises(ValueError, match="ensemble: expected 1 for a network that leaves out pixels, got 4"):
        NetworkUpsampler(MSGNet(2, "hui"), ensemble=4)
