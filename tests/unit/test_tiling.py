"""Tiles, and that networks answer in them as they answer the whole image."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dsr.geometry.camera import Camera, from_range
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import DisparityNetwork, NetworkUpsampler, blend_tiles, split_axis
from dsr.sample import DepthSample

NETS: dict[str, Callable[[], DisparityNetwork]] = {
    "facets": lambda: Facets(4, width=8, blocks=2),
    "dsr": lambda: MSGNet(4, "dsr"),
    "voynov": lambda: MSGNet(4, "voynov"),
    "hui": lambda: MSGNet(2, "hui"),
}


def _method(name: str, *, ensemble: int = 1, tile: int | None = None) -> NetworkUpsampler:
    """Return a network whose answer is far from smooth, so that whatever a window misses shows."""
    torch.manual_seed(0)
    net = NETS[name]()
    with torch.no_grad():
        for parameter in net.parameters():
            if parameter.dim() > 1:
                parameter.mul_(1.5)
    return NetworkUpsampler(net.double(), ensemble=ensemble, tile=tile)


def _pair(scale: int, height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    rgb = torch.rand((1, 3, scale * height, scale * width), generator=generator)
    coarse = 20 + 5 * torch.rand((1, 1, height, width), generator=generator)
    return rgb, coarse


@pytest.mark.parametrize(("size", "tile", "overlap"), [(100, 30, 4), (31, 30, 4), (30, 30, 4), (7, 1, 2), (1, 5, 0)])
def test_tile_weights_add_up_to_one_everywhere(size: int, tile: int, overlap: int) -> None:
    total = torch.zeros(2 * size)
    for span in split_axis(size, tile, 3, overlap):
        assert span.read.start <= span.kept.start < span.kept.stop <= span.read.stop
        assert span.kept.stop - span.kept.start <= max(tile, overlap + 1) + overlap
        total[2 * span.kept.start : 2 * span.kept.stop] += span.weights(2)
    torch.testing.assert_close(total, torch.ones(2 * size))


def test_window_covers_the_receptive_field_within_the_image() -> None:
    first, second, last = split_axis(90, 30, 7, 4)
    assert (first.read, second.read, last.read) == (slice(0, 39), slice(21, 69), slice(51, 90))
    assert (first.ramps, second.ramps, last.ramps) == ((0, 4), (4, 4), (4, 0))


def test_results_that_differ_by_a_constant_are_joined_by_a_ramp() -> None:
    values = iter((1.0, 2.0))
    rows, columns = split_axis(4, 4, 0, 0), split_axis(20, 10, 0, 4)
    line = blend_tiles(lambda r, c: torch.full((1, 1, 4, c.stop - c.start), next(values)), rows, columns, 1)[0, 0, 0]
    expected = torch.cat((torch.ones(8), torch.tensor([1.125, 1.375, 1.625, 1.875]), torch.full((8,), 2.0)))
    torch.testing.assert_close(line, expected)


@pytest.mark.parametrize("name", NETS)
def test_tiled_result_equals_the_whole_image(name: str) -> None:
    method = _method(name)
    scale = method.net.scale
    rgb, coarse = _pair(scale, 14, 48)
    coarse[..., 3:9, 4:20] = torch.nan  # a hole that is larger than a tile
    if method.net.arguments().get("variant") in ("voynov", "hui"):
        coarse = coarse.nan_to_num(nan=20.5)  # random networks turn the step at a hole into anything
    with torch.inference_mode():
        whole = method.upsample_disparity(rgb, coarse)
        method.tile = 12 * scale
        tiled = method.upsample_disparity(rgb, coarse)
    assert tiled.shape == whole.shape
    assert method.count_steps(*rgb.shape[-2:]) == 8
    assert float((tiled - whole).abs().max() / (whole.max() - whole.min())) < 1e-5


@pytest.mark.slow
def test_tiled_augmentation_equals_the_whole_image() -> None:
    method = _method("facets", ensemble=8)
    rgb, coarse = _pair(4, 12, 36)
    parts: list[tuple[int, int]] = []
    with torch.inference_mode():
        whole = method.upsample_disparity(rgb, coarse)
        method.tile = 24
        tiled = method.upsample_disparity(rgb, coarse, lambda done, total: parts.append((done, total)))
    assert float((tiled - whole).abs().max() / (whole.max() - whole.min())) < 1e-5
    assert parts == [(i + 1, method.count_steps(48, 144)) for i in range(8 * 2 * 6)]


@pytest.mark.parametrize("name", NETS)
def test_pixels_beyond_the_receptive_field_do_not_matter(name: str) -> None:
    net = _method(name).net
    assert net.receptive_field_radius is not None
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


def test_large_photo_is_tiled_automatically(monkeypatch: pytest.MonkeyPatch) -> None:
    method = _method("facets")
    rgb, coarse = _pair(4, 12, 12)
    camera = Camera(48, 48, 50.0, 50.0, 24.0, 24.0)
    low = camera.rescale(12, 12)
    sample = DepthSample("test", "scene", rgb[0], from_range(coarse[0] / 4, low, "disparity"), camera, low, 4)
    parts: list[int] = []
    whole = method(sample, lambda done, total: parts.append(total))
    monkeypatch.setattr("dsr.methods.networks.network.UNTILED", 1000)
    monkeypatch.setattr("dsr.methods.networks.network.TILE", 24)
    tiled = method(sample, lambda done, total: parts.append(total))
    assert parts == [1, *[4] * 4]
    torch.testing.assert_close(tiled, whole, rtol=1e-5, atol=0)
