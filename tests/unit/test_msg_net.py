"""MSG-Net and its pre- and post-processing, against SciPy, Pillow and its own slow ways."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from dsr.geometry.camera import Camera, from_range, to_range
from dsr.methods.images import mean3x3, normalise, upsample_bicubic
from dsr.methods.networks.msg_net import MSGNet, guidance_map
from dsr.methods.networks.network import NetworkUpsampler
from dsr.sample import DepthSample
from dsr.utils.ratios import SCALES


def _net(scale, variant="voynov"):
    torch.manual_seed(scale)
    return MSGNet(scale, variant).eval()


def _scene(scale, height, width, batch=1):
    """Return a photo and a low-resolution disparity map, random but smooth enough to resemble one."""
    generator = torch.Generator().manual_seed(height + width)
    rgb = torch.rand((batch, 3, scale * height, scale * width), generator=generator)
    disparity = 20 + 5 * torch.rand((batch, 1, height, width), generator=generator, dtype=torch.float64)
    return rgb, disparity


def _sample(scale, height, width, doffs=0.0):
    rgb, disparity = _scene(scale, height, width)
    camera = Camera(scale * width, scale * height, 600.0, 600.0, 3.0, 4.0, baseline=0.2, doffs=doffs)
    coarse = camera.rescale(width, height)
    depth = from_range(disparity[0] / scale, coarse, "disparity")
    return DepthSample("test", "scene", rgb[0], depth, camera, coarse, scale)


@pytest.mark.parametrize(("scale", "parameters"), [(4, 326_015), (8, 454_147)])
def test_voynov_network_has_the_published_number_of_parameters(scale, parameters):
    assert sum(value.numel() for value in MSGNet(scale).parameters()) == parameters


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("size", [(1, 3), (5, 4)])
def test_voynov_network_covers_every_pixel_and_the_hui_network_all_but_the_last(scale, size):
    rgb, disparity = _scene(scale, *size, batch=2)
    rows, columns = (scale * n for n in size)
    assert _net(scale).upsample(rgb, disparity).shape == (2, 1, rows, columns)
    assert _net(scale, "hui").upsample(rgb, disparity).shape == (2, 1, rows - 1, columns - 1)


@pytest.mark.parametrize("variant", ["hui", "voynov"])
def test_guidance_is_the_published_intensity_minus_its_mean(variant):
    rgb = torch.rand(1, 3, 6, 5, dtype=torch.float64)
    red, green, blue = 255 * rgb[0].numpy()
    luma = 16 + (65.481 * red + 128.553 * green + 24.966 * blue) / 255
    if variant == "voynov":  # the clipped red of the released code
        luma = np.clip(red - 0.34414 * (green - 128) - 0.71414 * (blue - 128), 0, 255)
    luma = (luma - luma.min()) / (luma.max() - luma.min())
    luma -= ndimage.uniform_filter(luma, 3, mode="reflect")
    expected = (luma - luma.min()) / (luma.max() - luma.min())
    torch.testing.assert_close(guidance_map(rgb, variant)[0, 0], torch.from_numpy(expected))


@pytest.mark.parametrize(
    ("scale", "height", "width"), [(2, 40, 90), (4, 64, 40), (4, 16, 33), (4, 32, 48), (8, 8, 8), (16, 20, 16)]
)
def test_drift_is_the_mean_of_the_output_for_a_probe_of_one_half(scale, height, width):
    net, (rgb, disparity) = _net(scale), _scene(scale, height, width, batch=2)
    guidance, probe = guidance_map(rgb, net.variant), normalise(disparity).values
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


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("rows", [1, 4, 7])
def test_receptive_field_bounds_the_input_rows_that_matter(scale, rows):
    net = _net(scale).double()
    seen = net.rows_seen(rows)
    height = seen + 6
    guidance = torch.rand(1, 1, scale * height, scale, dtype=torch.float64, requires_grad=True)
    depth = torch.rand(1, 1, height, 1, dtype=torch.float64, requires_grad=True)
    net(guidance, depth)[..., :rows, :].square().sum().backward()
    used = [int(grad.abs().sum((0, 1, 3)).nonzero().max()) + 1 for grad in (guidance.grad, depth.grad)]
    assert used[0] <= scale * seen
    assert used[1] == seen


@pytest.mark.parametrize("variant", ["hui", "voynov"])
def test_bfloat16_stays_within_a_thousandth_of_the_range(variant):
    sample, net = _sample(4, 32, 40), _net(4, variant)
    exact = to_range(NetworkUpsampler(net)(sample), sample.camera, "disparity")
    rounded = to_range(NetworkUpsampler(net, "bfloat16")(sample), sample.camera, "disparity")
    assert bool((exact.isnan() == rounded.isnan()).all())
    difference = (exact - rounded).nan_to_num().abs() / 5
    assert 0 < float(difference.max()) < 0.001  # 0.0002 measured


@pytest.mark.parametrize("doffs", [0.0, 30.0])
def test_plane_keeps_its_depth_with_and_without_a_disparity_offset(doffs):
    sample = _sample(4, 8, 8, doffs)
    flat = DepthSample("test", "flat", sample.rgb, torch.full((1, 8, 8), 2.5), sample.camera, sample.camera_lr, 4)
    depth = NetworkUpsampler(_net(4))(flat)
    assert depth.shape == (1, 32, 32)
    torch.testing.assert_close(depth, torch.full_like(depth, 2.5))


def test_hui_method_leaves_its_last_row_and_column_missing():
    depth = NetworkUpsampler(_net(4, "hui"))(_sample(4, 8, 9))
    assert depth.shape == (1, 32, 36)
    assert bool(depth[0, -1].isnan().all())
    assert bool(depth[0, :, -1].isnan().all())
    assert bool(depth[0, :-1, :-1].isfinite().all())


def test_disparity_that_is_not_positive_becomes_a_hole():
    net = _net(4, "hui")
    torch.nn.init.constant_(net.get_parameter("reconstruct.conv.bias"), -100.0)
    assert bool(NetworkUpsampler(net)(_sample(4, 8, 8)).isnan().all())


def test_weights_that_do_not_fit_are_refused_and_change_nothing():
    net = MSGNet(4)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    with pytest.raises(ValueError, match="weights are for scale 8, the run is at scale 4"):
        net.start_from(MSGNet(8))
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_other_scale_and_unknown_precision_are_refused():
    with pytest.raises(ValueError, match="scene: expected scale 4, the network's, got 2"):
        NetworkUpsampler(_net(4))(_sample(2, 8, 8))
    with pytest.raises(ValueError, match="precision: expected"):
        NetworkUpsampler(_net(4), "float16")


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
