"""The method for maps of any ratio: sizes, units, the estimate of the noise, and its settings."""

import math
from dataclasses import replace

import pytest
import safetensors.torch
import torch
from torch import nn
from torch.nn import functional

from dsr.degradation.downsampling import FACTS
from dsr.geometry.camera import Camera
from dsr.methods.networks.facets_method import CAUTION, AnyMap
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.network import Answer
from dsr.methods.networks.weight_files import files_of_weights, save_network
from dsr.sample import DepthSample


class Recording(nn.Module):
    """A network that returns a plane, whatever it gets, and remembers its hints."""

    def __init__(self, scale=4, spread=0.01):
        super().__init__()
        self.scale, self.spread = scale, spread
        self.calls = []

    serves = FacetsUNet.serves

    def answer(self, rgb, disparity, noise, hints, progress):
        if progress is not None:
            progress(1, 2)
        self.calls.append((tuple(rgb.shape), tuple(disparity.shape), noise, hints))
        height, width = rgb.shape[-2:]
        plane = _plane(height, width)
        return Answer(plane, torch.full_like(plane, self.spread), torch.full_like(plane, math.radians(3)))


def _plane(height, width):
    """Return inverse depth from 0.5 to 0.6 across an image, (1, 1, height, width)."""
    across = (torch.arange(width, dtype=torch.float64) + 0.5) / width
    return (0.5 + 0.1 * across).expand(1, 1, height, width).contiguous()


def _sample(size_lr, ratio, error=0.0):
    """Return a plane with a relative error of its inverse depth."""
    height, width = (round(ratio * n) for n in size_lr)
    camera = Camera.from_fov(60, width, height)
    depth_lr = (_plane(*size_lr)[0] * (1 + error)).reciprocal()
    rgb = torch.rand((3, height, width), generator=torch.Generator().manual_seed(0))
    camera_lr = camera if ratio == 1 else camera.reduce(size_lr[1], size_lr[0])
    return DepthSample("test", "plane", rgb, depth_lr, camera, camera_lr, ratio)


@pytest.mark.parametrize(
    ("size_lr", "ratio", "factor"),
    [((12, 16), 1, 1), ((11, 15), 1, 1), ((12, 16), 2, 2), ((12, 18), 8 / 3, 4), ((12, 16), 4, 4), ((8, 12), 7.5, 8),
     ((6, 8), 16, 16)],
)  # fmt: skip
def test_photo_is_resized_to_the_next_factor_and_the_result_to_the_photo(size_lr, ratio, factor):
    net, sample = Recording(max(factor, 2)), _sample(size_lr, ratio)
    surface = AnyMap(net).surface(sample)
    [(rgb, disparity, noise, hints)] = net.calls
    even = tuple(n + n % 2 if factor == 1 else n for n in size_lr)
    assert disparity == (1, 1, *even)
    assert rgb == (1, 3, *(factor * n for n in even))
    assert noise is None
    assert not bool(hints.any())
    height, width = sample.rgb.shape[-2:]
    assert surface.depth.shape == surface.depth_error.shape == surface.angle_error.shape == (1, height, width)
    inside = (..., slice(2, -2), slice(2, -2))
    if even == size_lr:
        torch.testing.assert_close(
            surface.depth[inside], _plane(height, width)[0].reciprocal()[inside], rtol=1e-3, atol=0
        )
    else:  # cropped, not squeezed
        expected = _plane(even[0], even[1])[0].reciprocal()[..., : size_lr[0], : size_lr[1]]
        torch.testing.assert_close(surface.depth, expected, rtol=1e-6, atol=0)
    torch.testing.assert_close(surface.depth_error, CAUTION * 0.01 * surface.depth)
    torch.testing.assert_close(surface.angle_error, torch.full_like(surface.depth, CAUTION * 3.0))


def test_noise_is_described_in_metres_and_low_resolution_pixels():
    draws = torch.randn((1, 60, 80), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    white = AnyMap(Recording()).surface(_sample((60, 80), 4, 0.004 * draws)).noise
    assert white.deviation == pytest.approx(0.004 / 0.55, rel=0.06)
    assert white.extent == pytest.approx(1, abs=0.2)
    wide = 5 * functional.avg_pool2d(draws[None], 5, stride=1, padding=2)[0]
    alike = AnyMap(Recording()).surface(_sample((60, 80), 4, 0.004 * wide)).noise
    assert alike.extent == pytest.approx(5, abs=1)


def test_settings_are_given_to_the_network():
    net = Recording()
    AnyMap(net, noise=0.01, smooth=2, edges="soft", kernel="bicubic").surface(_sample((12, 16), 4))
    [(_, _, noise, hints)] = net.calls
    expected = torch.zeros(1, FACTS)
    expected[0, [3, 6, 7]] = 1
    assert torch.equal(hints, expected)
    torch.testing.assert_close(noise, (0.02 * _plane(12, 16)).float())  # relative to depth


@pytest.mark.parametrize("smooth", [0.0, 2.0])
def test_smooth_gives_more_or_less_noise_than_estimated_in_a_second_pass(smooth):
    draws = torch.randn((1, 24, 32), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    sample, net, seen = _sample((24, 32), 4, 0.004 * draws), Recording(), []
    AnyMap(net, smooth=smooth).surface(sample, lambda *now: seen.append(now))
    [(_, _, first, _), (_, _, second, hints)] = net.calls
    assert first is None
    assert float(second.mean()) == pytest.approx(0.004 * smooth, rel=0.1)
    assert float(hints[0, -1]) == 1
    assert seen == [(1, 4), (3, 4)]


def test_what_lies_behind_infinity_is_a_hole():
    net, sample = Recording(), _sample((12, 16), 4)
    negative = net.answer(torch.zeros(1, 3, 48, 64), torch.zeros(1, 1, 12, 16), None, torch.zeros(1, FACTS), None)
    negative.disparity[..., 3, 5] = -0.1
    net.answer = lambda *_: negative
    surface = AnyMap(net).surface(sample)
    for each in (surface.depth, surface.depth_error):
        assert torch.equal(each.isnan().nonzero(), torch.tensor([[0, 3, 5]]))
        assert bool((each[each.isfinite()] > 0).all())


def test_method_is_built_from_a_file_and_values_are_checked(tmp_path):
    save_network(tmp_path / "weights", FacetsUNet(4, 8, 8), "facets")
    depth = AnyMap(tmp_path / "weights")(_sample((12, 18), 8 / 3))
    assert depth.shape == (1, 32, 48)
    for key, value in (("smooth", 3), ("noise", -1), ("kernel", "sinc"), ("edges", "round"), ("max_error", 0)):
        with pytest.raises(ValueError, match=f"^{key}: expected .*, got '?{value}'?$"):
            AnyMap(tmp_path / "weights", **{key: value})


def test_some_maps_without_noise_have_weights_of_their_own(tmp_path):
    """Only where all hints are given that they were trained for; those for soft steps share the common ones' layers."""
    nets = {}
    for number, name in enumerate(("facets_x2", "facets_x2_clean", "facets_x2_soft")):
        torch.manual_seed(number)
        nets[name] = FacetsUNet(2, 8, 8, 4).eval()
    files = {name: tmp_path / f"{name}.safetensors" for name in nets}
    common, clean, soft = files.values()
    nets["facets_x2_soft"].share(nets["facets_x2"])
    save_network(clean, nets["facets_x2_clean"], "facets")
    save_network(common, nets["facets_x2"], "facets", links={"clean": clean, "soft": soft})
    save_network(soft, nets["facets_x2_soft"], "facets", links={"shared": common})
    assert "coarse.weight" not in safetensors.torch.load(soft.read_bytes())
    reported = {"kernel": "box", "edges": "sharp", "clean": True}

    def used(**settings):
        found = AnyMap(common, **settings)._net.state_dict()
        return next(
            name for name, net in nets.items() if torch.equal(net.state_dict()["photo.weight"], found["photo.weight"])
        )

    assert used(**reported) == "facets_x2_clean"
    assert used(kernel="bicubic", edges="soft", clean=True) == "facets_x2_soft"
    common_trunk, soft_trunk = (
        AnyMap(common, kernel="bicubic", edges=edges, clean=True)._net.coarse.weight for edges in ("sharp", "soft")
    )
    assert torch.equal(common_trunk, soft_trunk)
    others = [("kernel", "bicubic"), ("edges", "soft"), ("edges", "auto"), ("clean", False)]
    for key, value in [*others, ("noise", 0.001), ("smooth", 2.0)]:
        assert used(**reported | {key: value}) == "facets_x2", key
    assert {used(kernel="bicubic", edges="soft", **other) for other in ({"noise": 0.001}, {})} == {"facets_x2"}
    assert files_of_weights(common) == [common, clean, soft]
    assert files_of_weights(soft) == [soft, common]
    clean.unlink()
    with pytest.raises(FileNotFoundError, match=r"expected facets_x2_clean\.safetensors beside it, for box means"):
        AnyMap(common, **reported)
    soft.unlink()
    with pytest.raises(FileNotFoundError, match=r"facets_x2_soft\.safetensors beside it, for bicubic maps"):
        AnyMap(common, kernel="bicubic", edges="soft", clean=True)


def test_flat_parts_of_rounded_maps_are_at_best_as_sure_as_the_rounding():
    rows, columns = 24, 32
    steps = torch.tensor([0.50, 0.52, 0.545, 0.57]).double()
    inverse = steps.repeat_interleave(columns // 4).expand(1, rows, columns)
    sample = _sample((rows, columns), 4)
    sample = replace(sample, depth_lr=inverse.reciprocal())
    net = Recording(4, spread=1e-5)
    surface = AnyMap(net).surface(sample)
    share = (surface.depth_error / surface.depth)[0, rows * 2]
    nearest = torch.tensor([0.02, 0.02, 0.025, 0.025]).double()
    middles = share[torch.tensor([16, 48, 80, 112])]
    torch.testing.assert_close(middles, nearest / steps / 4)  # half a step at most, so a quarter on average
    angle = surface.angle_error[0, rows * 2]
    slope = (nearest[2] / steps[2] / 4) * sample.camera_lr.fx / 4  # gained over the 4 pixels to the next value
    assert float(angle[80]) == pytest.approx(math.degrees(math.atan(slope)), rel=0.05)
    assert float(angle[32]) == pytest.approx(3 * CAUTION)
    assert float(share[32]) < 1e-3  # where values change, the network says it
    exact = AnyMap(net).surface(_sample((rows, columns), 4))
    assert float((exact.depth_error / exact.depth).max()) < 1e-3
    constant = replace(sample, depth_lr=torch.full_like(inverse, 2.0))
    alone = AnyMap(net).surface(constant)  # no other value tells the step
    assert float(alone.depth_error.max()) < 1e-3
