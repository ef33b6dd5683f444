"""The networks of other papers, part by part: plain loops, SciPy, Pillow, finite differences, published sizes."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from small_networks import with_any_weights
from small_scenes import maps, photos, plane_map, problem, seeded
from torch import nn
from torch.nn import functional

from dsr.methods.images import (
    box_mean,
    compute_min_max,
    mean3x3,
    normalise,
    repeat_blocks,
    upsample_bicubic,
    upsample_linear_border,
)
from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.dynamic_guidance import WIDTHS, DynamicGuidance, polynomial_filters
from dsr.methods.networks.msg_net import MSGNet, guidance_map
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.networks.pdn import PrimalDualNetwork, UnrolledHuber, half_window
from dsr.methods.networks.sparse_to_dense import BatchNorm, SparseToDense, UpProjection, place_samples
from dsr.utils.ratios import SCALES

# PDN and dynamic guidance


def _problem(size, window):
    """Return a map with steps, continued beyond the border, and weights whose pairs are partly across the steps."""
    r, n = window // 2, len(half_window(window))
    first = torch.rand(1, 1, size + 2 * r, size + 4 * r, generator=seeded(1)).double() * 0.02
    first[..., size // 2 :] += 0.5
    return first, (torch.rand(1, n, size, size, generator=seeded(2)).double() + 0.01) / n


def test_unrolled_stage_equals_a_plain_loop():
    window, size, data, huber = 5, 16, 7.0, 0.4
    first, weights = _problem(size, window)
    stage = UnrolledHuber(window, 4, data, huber).double().requires_grad_(False)
    stage.log_steps.add_(0.3 * torch.randn(4, 3, generator=torch.Generator().manual_seed(5)))
    result = stage(first, weights)
    steps = stage.log_steps.exp().tolist()
    expected = _loop(first[0, 0].numpy(), weights[0].numpy(), steps, data, huber, window)
    np.testing.assert_allclose(result[0, 0].numpy(), expected, rtol=0, atol=1e-7)  # the parameters are float32's


def _loop(f, w, steps, data, huber, window):
    """Return u - f, pair by pair and pixel by pixel, on a map with r rows and 2 r columns around the image."""
    r, (height, width) = window // 2, w.shape[1:]
    inside = [(y, x) for y in range(height) for x in range(width)]
    pairs = {}
    for k, (dy, dx) in enumerate(half_window(window)):
        for y in range(height + r):
            for x in range(-r, width + r):
                weight = w[k, min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
                pairs[k, y, x] = ((y + r, x + 2 * r), (y + dy + r, x + dx + 2 * r), weight)
    u, ahead = f.copy(), f.copy()
    p = {key: float(np.clip((f[j] - f[i]) / huber, -most, most)) for key, (i, j, most) in pairs.items()}
    for sigma, tau, theta in steps:
        for key, (i, j, most) in pairs.items():
            p[key] = float(np.clip((p[key] + sigma * (ahead[j] - ahead[i])) / (1 + sigma * huber), -most, most))
        sums = np.zeros_like(f)
        for key, (i, j, _) in pairs.items():
            sums[j] += p[key]
            sums[i] -= p[key]
        for y, x in inside:
            at = (y + r, x + 2 * r)
            new = (u[at] - tau * sums[at] + tau * data * f[at]) / (1 + tau * data)
            ahead[at] = new + theta * (new - u[at])
            u[at] = new
    return (u - f)[r : r + height, 2 * r : 2 * r + width]


def _gradients_are_those_of_differences(net, *maps, **tolerance):
    """Check the gradients of a network's answer to maps in these, where they require some, and in its parameters."""
    names, parameters = zip(*net.named_parameters(), strict=True)

    def answer(*given):
        values = dict(zip(names, given[len(maps) :], strict=True))
        return torch.func.functional_call(net, values, given[: len(maps)])

    return torch.autograd.gradcheck(answer, [*maps, *parameters], **tolerance)


def test_gradients_of_a_stage_agree_with_finite_differences():
    given = [each.requires_grad_() for each in _problem(4, 3)]
    assert _gradients_are_those_of_differences(UnrolledHuber(3, 2, 3.0, 0.5).double(), *given)


@pytest.mark.parametrize("scale", [2, 4, 8, 16])
def test_untrained_pdn_reproduces_a_plane_up_to_the_border(scale):
    torch.manual_seed(0)
    net = PrimalDualNetwork(scale, width=6, layers=3).requires_grad_(False)
    fine = plane_map(6 * scale, 7 * scale, 0.1, -0.07)
    scene = torch.tensor([20.0, 60.0]).view(1, 2, 1, 1)  # the plane is part of it
    result = net.upsample(photos(6 * scale, 7 * scale), functional.avg_pool2d(fine, scale), scene)
    torch.testing.assert_close(result, fine, rtol=0, atol=1e-6)


def test_convolutions_may_run_in_bfloat16():
    net = with_any_weights(lambda: PrimalDualNetwork(4, width=6, layers=3, window=3, iterations=3), 0.05, 4)
    rgb, coarse = photos(24, 28), maps(6, 7)
    exact = net.upsample(rgb, coarse)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = net.upsample(rgb, coarse)
    assert mixed.dtype == torch.float64
    assert 0 < float((mixed - exact).abs().max()) < 0.05 * 9
    halved = NetworkUpsampler(net, "bfloat16").upsample_disparity(rgb, coarse)
    assert float((halved - exact).abs().max()) < 0.05 * 9


def _guided(scale=4, *, stages=2, filters=5, size=5):
    return with_any_weights(lambda: DynamicGuidance(scale, stages, filters, size), 0.2, scale)


@pytest.mark.parametrize("size", [3, 4, 7])
def test_filters_are_orthonormal_and_blind_to_what_the_first_ones_see(size):
    v, u = torch.meshgrid(torch.arange(size).double(), torch.arange(size).double(), indexing="ij")
    basis = polynomial_filters(size)
    flat = basis.flatten(1)
    torch.testing.assert_close(flat @ flat.T, torch.eye(size**2).double(), rtol=0, atol=1e-12)
    for each, blind in ((v - v + 1, basis[1:]), (u, basis[3:]), (v, basis[3:])):
        assert float((blind * each).sum(dim=(1, 2)).abs().max()) < 1e-11


def test_stage_equals_plain_loops():
    stage, rgb = _guided(stages=1, filters=3).double().stages[0], photos(16, 16).double()
    coarse = maps(4, 4) / 30
    x = repeat_blocks(coarse, 4) + 0.1 * maps(16, 16)
    with torch.no_grad():
        result = stage(x, coarse, rgb)[0, 0].numpy()
        misfit = upsample_linear_border(box_mean(x, 4) - coarse, 4)[0, 0].numpy()
    y = x[0, 0].numpy() - float(stage.fidelity) * misfit
    photo = rgb[0].numpy()
    combined = stage.analysis.numpy() / np.linalg.norm(stage.analysis.numpy(), axis=1, keepdims=True)
    filters = np.tensordot(combined, polynomial_filters(5)[3:].numpy(), 1)
    seeing = np.tensordot(stage.guidance.numpy(), polynomial_filters(5)[1:].numpy(), 1)  # (L, 3, 5, 5)
    expected = y.copy()
    for i in range(12):
        for j in range(12):
            squares = [float((b * photo[:, i : i + 5, j : j + 5]).sum()) ** 2 for b in seeing]
            for k, c, heights in zip(filters, np.abs(stage.mixing.numpy()), stage.heights.numpy() / 3, strict=True):
                z = float((k * y[i : i + 5, j : j + 5]).sum())
                slope = sum(a * z / (1 + z * z / t**2) for a, t in zip(heights, WIDTHS, strict=True))
                expected[i : i + 5, j : j + 5] -= np.exp(-float(c @ squares)) * slope * k
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-12)


def test_gradients_agree_with_finite_differences():
    net = _guided(2, filters=2, size=3).double().requires_grad_()
    given = photos(8, 6).double(), maps(4, 3) / 30
    assert _gradients_are_those_of_differences(net, *given, eps=1e-7, atol=1e-4, fast_mode=True)


def test_mixed_precision_training_computes_in_float32():
    net, rgb, coarse = _guided(), photos(24, 28), maps(6, 7)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = net.upsample(rgb, coarse)
    torch.testing.assert_close(mixed, net.upsample(rgb, coarse), rtol=0, atol=0)


# Sparse-to-Dense and DDRNet

RESNET18 = 11_689_512 - 513_000 + 64 * 49
"""Parameters of ResNet-18 (He et al. 2016) without its classifier, with a fourth input channel."""


def _sparse(scale=4):
    torch.manual_seed(scale)
    return SparseToDense(scale, 4).eval()


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


@pytest.mark.parametrize("scale", [2, 8])
def test_sizes_that_are_no_multiple_of_32_equal_those_that_repeat_the_border(scale):
    net = _sparse(scale).double()
    height, width = 40 // scale, 56 // scale
    rgb, values = photos(scale * height, scale * width).double(), maps(height, width)
    more = [-n % (32 // scale) for n in (height, width)]
    padded = functional.pad(values, (0, more[1], 0, more[0]), mode="replicate")
    padded_rgb = functional.pad(rgb, (0, scale * more[1], 0, scale * more[0]), mode="replicate")
    expected = net.upsample(padded_rgb, padded)[..., : scale * height, : scale * width]
    torch.testing.assert_close(net.upsample(rgb, values), expected, rtol=0, atol=1e-12)


def test_holes_are_inpainted_before_the_samples_are_placed():
    net, rgb, values = _sparse(), photos(32, 32), maps(8, 8)
    values[..., 4, 4] = torch.nan
    inpainted = values.clone()
    inpainted[..., 4, 4] = (values[..., 3:6, 3:6].nansum() / 8).item()
    torch.testing.assert_close(net.upsample(rgb, values), net.upsample(rgb, inpainted), rtol=1e-9, atol=0)


# (inputs, outputs, size) of the convolutions of the authors' convResnet and hypercolumn
DENOISING = [(1, 32, 3), (32, 64, 3), (64, 128, 3), *[(128, 128, 3)] * 4, (256, 64, 3), (128, 32, 3), (64, 1, 3)]
REFINEMENT = [(1, 8, 3), (1, 8, 3), (16, 16, 3), (32, 32, 3), (32, 32, 3), (64, 64, 3), (64, 64, 3), (64, 64, 3),
              (112, 16, 1), (16, 4, 1), (4, 1, 1)]  # fmt: skip


def _stages(net, rgb, values):
    """Return the denoised and the refined map."""
    min_max = compute_min_max(values)
    answer = net.answer_patches({"rgb": rgb, "disparity_lr": values, "min_max": min_max})
    return answer.stages[0], answer.disparity


def test_networks_have_the_parameters_of_the_published_code():
    net = DDRNet(4)
    for part, layers in ((net.denoise, DENOISING), (net.refine, REFINEMENT)):
        expected = sum(inputs * outputs * size**2 + outputs for inputs, outputs, size in layers)
        assert sum(each.numel() for each in part.parameters()) == expected


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_new_network_is_bicubic_upsampling(scale):
    torch.manual_seed(0)
    values, rgb = maps(5, 6), photos(5 * scale, 6 * scale)
    expected = upsample_linear_border(values, scale)
    for stage in _stages(DDRNet(scale, denoising=4, refinement=4), rgb, values):
        torch.testing.assert_close(stage, expected.float(), rtol=1e-6, atol=0)


# MSG-Net


def _msg(scale, variant="voynov"):
    torch.manual_seed(scale)
    return MSGNet(scale, variant).eval()


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("size", [(1, 3), (5, 4)])
def test_voynov_network_covers_every_pixel_and_the_hui_network_all_but_the_last(scale, size):
    rows, columns = (scale * n for n in size)
    rgb, disparity = photos(rows, columns, 2), maps(*size, 2)
    assert _msg(scale).upsample(rgb, disparity).shape == (2, 1, rows, columns)
    assert _msg(scale, "hui").upsample(rgb, disparity).shape == (2, 1, rows - 1, columns - 1)


@pytest.mark.parametrize(
    ("scale", "height", "width"), [(2, 40, 90), (4, 64, 40), (4, 16, 33), (4, 32, 48), (8, 8, 8), (16, 20, 16)]
)
def test_drift_is_the_mean_of_the_output_for_a_probe_of_one_half(scale, height, width):
    net = _msg(scale)
    guidance = guidance_map(photos(scale * height, scale * width, 2), net.variant)
    probe = normalise(maps(height, width, 2)).values
    with torch.inference_mode():
        drift = net.drift(guidance, probe)
        probe[..., : height // 4, : width // 4] = 0.5
        kernel = np.full((1, 1, 3, 3), 1 / 9)
        low_pass = torch.from_numpy(ndimage.convolve(probe.numpy(), kernel, mode="reflect"))
        output = net(guidance, (probe - low_pass).float())
    rows, columns = (slice(n // 16, n // 4 - n // 16) for n in (height, width))
    expected = output[..., rows, columns].mean((-2, -1), keepdim=True).double()
    torch.testing.assert_close(drift, expected, rtol=0, atol=1e-6)
    assert net.drift(guidance[..., : 2 * scale, :], probe[..., :2, :]).count_nonzero() == 0  # of no rows


def test_disparity_that_is_not_positive_becomes_a_hole():
    net = _msg(4, "hui")
    torch.nn.init.constant_(net.get_parameter("reconstruct.conv.bias"), -100.0)
    assert bool(NetworkUpsampler(net)(problem(4, 8, 8)).isnan().all())


def test_weights_that_do_not_fit_are_refused_and_change_nothing():
    net = MSGNet(4)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    with pytest.raises(ValueError, match="weights are for scale 8, the run is at scale 4"):
        net.start_from(MSGNet(8))
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_other_scale_and_unknown_precision_are_refused():
    with pytest.raises(ValueError, match="scene: expected scale 4, the network's, got 2"):
        NetworkUpsampler(_msg(4))(problem(2, 8, 8))
    with pytest.raises(ValueError, match="precision: expected"):
        NetworkUpsampler(_msg(4), "float16")


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_prelu_gradients_equal_those_of_torch(dtype):
    net = MSGNet(4, "dsr")
    layer = net.smooth.to(dtype)
    x = torch.randn(2, 32, 9, 8, generator=torch.Generator().manual_seed(0)).to(dtype).requires_grad_()
    plain = x.detach().clone().requires_grad_()
    slope = layer.activation.weight.detach().clone().requires_grad_()
    weights = torch.randn(2, 32, 9, 8, generator=torch.Generator().manual_seed(1)).to(dtype)
    (layer(x) * weights).sum().backward()
    (torch.nn.functional.prelu(layer.conv(plain), slope) * weights).sum().backward()
    tolerance = {"rtol": 1e-5, "atol": 1e-5} if dtype == torch.float32 else {"rtol": 2e-2, "atol": 2e-2}
    torch.testing.assert_close(x.grad, plain.grad, **tolerance)
    torch.testing.assert_close(layer.activation.weight.grad, slope.grad, rtol=max(tolerance["rtol"], 1e-4), atol=0)


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_untrained_variant_of_ours_is_nearly_the_interpolation_without_a_checkerboard(scale):
    torch.manual_seed(0)
    rgb, disparity = torch.rand(1, 3, 8 * scale, 9 * scale), torch.rand(1, 1, 8, 9, dtype=torch.float64)
    with torch.no_grad():
        fine = MSGNet(scale, "dsr").upsample(rgb, disparity)
    base = upsample_bicubic(mean3x3(disparity), scale)
    assert float((fine - base).abs().max()) < 0.02
