"""Deep image priors: the method, its loss and its network."""

import re
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.dip.upsampler import DeepImagePrior, PriorOptimisation, SkipNet, levels_for, upsample_2x
from dsr.methods.images import mean3x3
from dsr.metrics.classes import visual_metrics
from dsr.metrics.functional import SurfacePair, dssim_v, mse_v, rmse_v
from dsr.metrics.losses import lap1
from dsr.sample import Scene
from dsr.utils.progress import Progress

BOX = Downsampling("box")
ENOUGH = {"steps": 120, "widths": (16, 32), "skips": (4, 4), "average": 0.9, "learning_rate": 0.02}
CAMERA = Camera(width=48, height=32, fx=60.0, fy=60.0, cx=23.5, cy=15.5)


def _sample(name="step", scale=2):
    """Two planes with an edge that the photo shows."""
    v, u = torch.meshgrid(torch.linspace(0, 1, 32), torch.linspace(0, 1, 48), indexing="ij")
    near = u + 0.3 * v > 0.6
    depth = torch.where(near, 1.5 + 0.4 * v, 3 - 0.5 * u).double()[None]
    rgb = torch.stack((near.float(), 0.5 * v, 1 - near.float())).clamp(0, 1)
    return make_sample(Scene("set", name, rgb, CAMERA, depth), scale, BOX, "orthogonal")


def _prior(**settings):
    quick = {"steps": 12, "widths": (4, 6), "skips": (2, 2), "validate_every": 0, "average": 0.5}
    return DeepImagePrior(**{"scale": 2, "downsampling": BOX, **quick, **settings})


def _module(sample, **settings):
    return PriorOptimisation(_prior(**settings), sample, visual=True)


def _depth():
    return 2 + torch.rand(1, 1, 32, 48, generator=torch.Generator().manual_seed(3))


def _error(depth, sample):
    return float((depth - sample.depth).square().mean().sqrt())


def test_result_is_a_function_of_seed_and_scene_alone():
    a, b = _sample("a"), _sample("b")
    alone, other = _prior()(b), _prior(seed=1)(b)
    torch.manual_seed(99)
    expected = torch.rand(3)
    torch.manual_seed(99)
    prior = _prior()
    both = {name: prior(sample) for name, sample in (("a", a), ("b", b))}
    assert torch.equal(torch.rand(3), expected)  # the global generator's state is unchanged
    assert torch.equal(both["b"], alone)
    assert not torch.equal(both["a"], both["b"])  # the same maps, but another scene
    assert not torch.equal(alone, other)
    assert alone.shape == (1, 32, 48)
    assert alone.dtype == b.depth_lr.dtype


def test_result_does_not_depend_on_the_truth():
    sample = _sample()
    settings = {"validate_every": 4, "metrics": visual_metrics}
    assert torch.equal(_prior(**settings)(sample), _prior(**settings)(replace(sample, depth=None)))


def test_oracle_is_the_best_validation_and_flagged():
    sample = _sample()
    prior = _prior(oracle=True, steps=5, validate_every=1, learning_rate=0.5)
    scores = [
        float(rmse_v(SurfacePair(depth[None], sample.depth[None], CAMERA.rays()[None])))
        for depth in (_prior(steps=n, learning_rate=0.5)(sample) for n in range(1, 6))
    ]
    best = prior(sample)
    assert torch.equal(best, _prior(steps=1 + scores.index(min(scores)), learning_rate=0.5)(sample))
    assert (prior.flag, _prior().flag) == ("oracle", "")


@pytest.mark.slow
def test_dip_approximates_two_planes_and_the_visual_loss_gives_better_normals():
    sample, errors = _sample(), []
    for settings in ({}, {"data_loss": "mse", "w": 0.0}):
        depth = _prior(**ENOUGH, **settings)(sample)
        flat = torch.full_like(depth, float(sample.depth_lr.mean()))
        assert _error(depth, sample) < 0.25 * _error(flat, sample)
        errors.append(float(rmse_v(SurfacePair(depth[None], sample.depth[None], CAMERA.rays()[None]))))
    assert errors[0] < 0.8 * errors[1]


@pytest.mark.parametrize("steps", [3, 150])
def test_diverging_optimisation_ends_with_advice(steps):
    with pytest.raises(ValueError, match=rf"step: diverged by step {min(steps, 100)}; a lower method.learning_rate"):
        _prior(steps=steps, learning_rate=1e30)(_sample())


def test_network_sees_a_mirrored_border_that_the_result_lacks():
    sample = _sample()
    module = _module(sample, border=5)
    assert module.start.shape == (1, 35, 42, 58)
    photo = module.start[0, 32:]
    torch.testing.assert_close(photo[:, 5:-5, 5:-5], sample.rgb)
    torch.testing.assert_close(photo[:, 4], photo[:, 6])
    depth, intensity = module()
    assert depth.shape == intensity.shape == (1, 1, 32, 48)
    wide = _module(sample, border=100)  # as far as there is something to mirror
    assert wide.start.shape == (1, 35, 32 + 62, 48 + 62)


def test_normals_of_noise_are_ignored():
    clean, lines = _sample(), list[str]()
    draws = torch.randn(clean.depth_lr.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = replace(clean, depth_lr=clean.depth_lr * (1 + 0.02 * draws))
    display = Progress()
    display.say = lines.append
    depth = _prior(steps=3, display=display)(noisy)
    assert torch.equal(depth, _prior(steps=3, w=0.0)(noisy))
    assert re.fullmatch(r"step: without MSE_v; noise of \d\.\d+% tilts the input's normals by \d+ degrees.*", lines[0])
    assert not torch.equal(_prior(steps=3)(clean), _prior(steps=3, w=0.0)(clean))


def test_map_too_small_for_the_visual_loss_is_refused():
    with pytest.raises(ValueError, match=r"^visual: dssim expects"):
        _module(_sample(scale=8), visual="dssim", scale=8)


def test_loss_is_the_sum_of_its_terms_on_low_resolution_maps():
    module = _module(_sample(), w=0.7, w_intensity=0.3)
    depth, intensity = _depth(), torch.rand(1, 1, 32, 48)
    blocks = depth.view(1, 1, 16, 2, 24, 2).mean(dim=(3, 5))
    depth_lr = module.depth_lr
    depth_range = float(depth_lr.max() - depth_lr.min())
    terms = module.loss_terms(depth, intensity)
    data = lap1(blocks / depth_range, depth_lr / depth_range)
    visual = rmse_v(SurfacePair(blocks, depth_lr, CAMERA.downscale(2).rays(dtype=torch.float32)[None])).square()
    photo = lap1(intensity, module.grey)
    torch.testing.assert_close(terms["data_lap1"], data[0])
    torch.testing.assert_close(terms["mse_v"], visual[0])
    torch.testing.assert_close(terms["loss"], data[0] + 0.7 * visual[0] + 0.3 * photo[0])
    plain = _module(_sample(), data_loss="mse", w=0.0, w_intensity=0.0).loss_terms(depth, intensity)
    torch.testing.assert_close(plain["loss"], 10 * ((blocks - depth_lr) / depth_range).square().mean())
    assert plain.keys() == {"loss", "data_mse"}


def test_automatic_weight_makes_a_loss_as_large_as_mse_v_for_a_smoothed_input():
    sample = _sample()
    depth_lr = sample.depth_lr[None].float()
    pair = SurfacePair(mean3x3(depth_lr), depth_lr, sample.camera_lr.rays(dtype=torch.float32)[None])
    w = _module(sample, visual="dssim").w
    assert w * dssim_v(pair).mean().item() == pytest.approx(mse_v(pair).item(), rel=1e-5)
    assert _module(sample).w == 1
    assert _module(sample, visual="dssim", w=0.25).w == 0.25


@pytest.mark.parametrize("loss", [{"data_loss": "mse", "w": 0.0}, {"data_loss": "lap1"}])
def test_depth_under_a_hole_does_not_matter(loss):
    sample = _sample()
    pierced, sparse = sample.depth_lr.clone(), torch.full_like(sample.depth_lr, torch.nan)
    pierced[:, 4:9, 6:14] = torch.nan
    sparse[:, ::3, ::3] = 2.5  # no two neighbours are valid
    for depth_lr in (pierced, sparse):
        depth = _depth().requires_grad_()
        module = _module(replace(sample, depth_lr=depth_lr), w_intensity=0.0, **loss)
        module.loss_terms(depth, torch.rand(1, 1, 32, 48))["loss"].backward()
        assert bool(depth.grad.isfinite().all())
        if depth_lr is pierced:
            assert float(depth.grad[..., 8:18, 12:28].abs().max()) == 0
            assert float(depth.grad[..., 20:, :].abs().min()) > 0


@pytest.mark.parametrize("shape", [(1, 3, 1, 1), (2, 3, 4, 5), (1, 1, 7, 1)])
@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_doubling_is_bilinear_interpolation(shape, layout):
    x = torch.rand(shape, dtype=torch.float64).to(memory_format=layout)
    expected = functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
    torch.testing.assert_close(upsample_2x(x), expected)


@pytest.mark.parametrize("size", [(3, 4), (1, 2)])
def test_gradient_of_doubling_agrees_with_finite_differences(size):
    x = torch.rand(1, 2, *size, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(upsample_2x, x)


def test_network_is_the_hourglass_of_ulyanov_et_al():
    """Against a plain construction from their supplementary material: two levels, written out."""
    torch.manual_seed(0)
    net = SkipNet(3, 2, (4, 6), (1, 2)).double()
    x = torch.rand(1, 3, 8, 12, dtype=torch.float64)

    def block(y, layer):
        convolution, norm, _ = layer
        weight, bias, stride = convolution.weight, convolution.bias, convolution.stride
        y = functional.conv2d(y, weight, bias, stride, convolution.kernel_size[0] // 2)
        return functional.leaky_relu(normal(y, norm), 0.2)

    def normal(y, norm):
        mean, variance = y.mean((0, 2, 3), keepdim=True), y.var((0, 2, 3), unbiased=False, keepdim=True)
        scaled = (y - mean) / (variance + 1e-5).sqrt()
        return scaled * norm.weight.view(1, -1, 1, 1) + norm.bias.view(1, -1, 1, 1)

    first = block(block(x, net.down[0][0]), net.down[0][1])
    y = block(block(first, net.down[1][0]), net.down[1][1])
    for level, source in ((1, first), (0, x)):
        y = functional.interpolate(y, scale_factor=2, mode="bilinear")
        y = normal(torch.cat((block(source, net.skip[level]), y), 1), net.norm[level])
        y = block(block(y, net.up[level][0]), net.up[level][1])
    torch.testing.assert_close(net(x), functional.conv2d(y, net.last.weight, net.last.bias))


def test_output_is_finer_than_bfloat16_even_if_the_convolutions_are_not():
    torch.manual_seed(0)
    net, x = SkipNet(4, 1, (8, 8), (2, 2)), torch.rand(1, 4, 64, 64)
    with torch.autocast("cpu", torch.bfloat16):
        y = net(x)
    assert y.dtype == torch.float32
    assert len(y.unique()) > 3000
    torch.testing.assert_close(y, net(x), rtol=0, atol=0.1 * float(y.detach().std()))


@pytest.mark.parametrize(
    ("height", "width", "most", "levels"), [(512, 512, 5, 5), (32, 512, 5, 4), (2, 2, 5, 1), (64, 64, 2, 2)]
)
def test_small_image_has_fewer_levels(height, width, most, levels):
    assert levels_for(height, width, most) == levels
    assert SkipNet(5, 2, (4, 6, 8), (2, 2, 2))(torch.rand(1, 5, 37, 50)).shape == (1, 2, 37, 50)
