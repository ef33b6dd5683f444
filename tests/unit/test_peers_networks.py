"""The published networks of the field, part by part, against plain loops, OpenCV, SciPy and torch's own layers."""

import math

import cv2
import numpy as np
import pytest
import scipy.fft
import scipy.ndimage
import torch
from torch.nn import functional

from dsr.methods.networks.dct import dct2, idct2
from dsr.methods.networks.peers import dctnet, dornet, local_filters, pgsr
from dsr.methods.networks.peers.dctnet import DCTNet, laplacian, transfer_edges
from dsr.methods.networks.peers.dornet import DORNet, deformable_conv3x3
from dsr.methods.networks.peers.local_filters import FDKN, SVLRM
from dsr.methods.networks.peers.pgsr import PGSR

_FOLDED = {SVLRM: 0, FDKN: 4 * (32 + 64 + 128), PGSR: 2 * (7 * 8 + 4), DCTNet: 0}
"""Parameters of the batch normalisations, which are merged into the convolutions."""
_UNUSED = {
    SVLRM: 0, FDKN: 0, PGSR: 3 * (2 * (16 * 64 * 9 + 64) + 16 * 9 + 1) + 4 * (48 * 32 * 9 + 32),
    DCTNet: 16 * 16 * 9 + 16,
}  # fmt: skip
"""Parameters that serve the training, or nothing."""
SIZES = [(4, 6), (5, 7), (5, 4), (6, 5), (1, 3), (4, 1), (1, 2), (1, 1)]


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize(
    ("network", "published"), [(SVLRM, 371_650), (FDKN, 693_856), (PGSR, 728_737), (DCTNet, 482_865)]
)
def test_network_has_the_published_number_of_parameters(network, published):
    parameters = sum(value.numel() for value in network(8).parameters())
    assert parameters + _FOLDED[network] + _UNUSED[network] == published


@pytest.mark.parametrize("network", [SVLRM, FDKN, PGSR, DCTNet, DORNet])
def test_each_image_of_a_batch_is_computed_by_itself(network):
    torch.manual_seed(2)
    net, rgb, values = network(4).eval(), torch.rand(2, 3, 16, 24), torch.rand(2, 1, 16, 24)
    with torch.inference_mode():
        both = net(rgb, values)
        assert both.shape == (2, 1, 16, 24)
        torch.testing.assert_close(both[1:], net(rgb[1:], values[1:]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("scale", [4, 8])
def test_svlrm_is_fed_the_map_shifted_by_the_authors_sampling(scale):
    values = np.random.default_rng(0).random((5, 7), dtype=np.float32)
    shift = (scale - 1) / 2
    rows, columns = ((np.arange(scale * n) + 0.5 + shift) / scale - 0.5 for n in values.shape)
    grid = [each.astype(np.float32) for each in np.meshgrid(columns, rows)]
    expected = cv2.remap(values, *grid, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    found = SVLRM(scale).enlarge(torch.from_numpy(values)[None, None], (5 * scale, 7 * scale))
    np.testing.assert_allclose(found[0, 0].numpy(), expected, atol=2e-6)


def test_svlrm_is_linear_in_the_grey_photo():
    net = SVLRM(4)
    net.final_layer.weight.data.zero_()
    net.final_layer.bias.data = torch.tensor([2.0, 0.25])
    rgb = torch.rand(1, 3, 8, 8)
    grey = 0.299 * rgb[:, :1] + 0.587 * rgb[:, 1:2] + 0.114 * rgb[:, 2:]
    torch.testing.assert_close(net(rgb, torch.rand(1, 1, 8, 8)), 2 * grey + 0.25)


def test_fdkn_sums_the_map_at_deformed_positions_of_a_window():
    torch.manual_seed(0)
    height, width, side = 9, 11, 15
    values, weights = torch.rand(1, 1, height, width), torch.rand(1, 9, height, width)
    offsets = 4 * torch.randn(1, 18, height, width)  # many reach beyond the window
    window = functional.unfold(values, side, padding=side // 2).view(side, side, height, width)
    expected = torch.zeros(height, width)
    for row in range(height):
        for column in range(width):
            for tap in range(9):
                start = torch.tensor([tap // 3, tap % 3]) + side // 2  # across, down: the authors' order
                place = (start + offsets[0, 2 * tap : 2 * tap + 2, row, column]) / side * 2 - 1
                value = functional.grid_sample(
                    window[None, None, ..., row, column], place.view(1, 1, 1, 2), align_corners=False
                )
                expected[row, column] += value.item() * weights[0, tap, row, column]
    torch.testing.assert_close(local_filters._sample(values, weights, offsets)[0, 0], expected, rtol=1e-4, atol=1e-4)


def test_fdkn_changes_a_constant_map_by_a_constant_at_the_border_only():
    torch.manual_seed(0)
    net = FDKN(8).eval()
    found = net(torch.rand(1, 3, 40, 40), torch.full((1, 1, 40, 40), 0.5))
    torch.testing.assert_close(found[..., 12:-12, 12:-12], torch.full((1, 1, 16, 16), 0.5), rtol=0, atol=1e-5)


def test_pgsr_plane_with_a_fixed_normal_has_the_depth_of_its_distance():
    planes = torch.tensor([0.0, 0.0, 3.0, 4.0]).view(1, 4, 1, 1).expand(1, 4, 5, 6)
    normalised = pgsr._normalise(planes)
    torch.testing.assert_close(normalised[:, 2], torch.ones(1, 5, 6))
    torch.testing.assert_close(pgsr._evaluate(normalised), torch.full((1, 1, 5, 6), 1 / 4))
    behind = pgsr._evaluate(-normalised * torch.tensor([1.0, 1, 1, -1]).view(1, 4, 1, 1))
    torch.testing.assert_close(behind, torch.ones(1, 1, 5, 6))  # no farther than 1


def test_pgsr_planes_have_the_authors_coordinates():
    planes = torch.rand(1, 4, 5, 8) + 0.1
    p, q, r, s = planes[0].double().numpy()
    u, v = ((np.arange(n) - (n - 1) / 2) / 8 / (n - 1) for n in (8, 5))
    inverse = (p * (u - 0.5) * 2 + q * (v[:, None] - 0.5) * 2 + r) * s
    np.testing.assert_allclose(pgsr._evaluate(planes)[0, 0].numpy(), 1 / np.maximum(inverse, 1), rtol=1e-5)


def test_pgsr_strips_change_rounding_errors_only(monkeypatch):
    torch.manual_seed(0)
    net, rgb, values = PGSR(4).eval(), torch.rand(1, 3, 44, 16), torch.rand(1, 1, 44, 16)
    whole = net(rgb, values)
    monkeypatch.setattr(pgsr, "_STRIP", 3 * 16 * 4)
    torch.testing.assert_close(net(rgb, values), whole, rtol=1e-5, atol=1e-6)


def test_pgsr_has_the_authors_names_and_drops_those_of_its_training():
    mine = "feature_extraction_rgb.1.body.0.body.0.weight"
    assert mine in PGSR(4).state_dict()
    dropped = ("conv_depth_mapping2.weight", "PAI_2.upconv1.weight", "PAI_1.fusion2Depth.bias")
    tensors = {name: torch.zeros(1) for name in (mine.replace("0.weight", "0.0.weight"), "PGR.other.bias", *dropped)}
    assert list(PGSR.convert(tensors)) == [mine, "PGR.other.bias"]


def test_pgsr_runs_in_bfloat16():
    torch.manual_seed(0)
    net, rgb, values = PGSR(4).eval(), torch.rand(1, 3, 16, 24), torch.rand(1, 1, 16, 24)
    exact = net(rgb, values)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(net(rgb, values).float(), exact, rtol=0, atol=0.02)


@pytest.mark.parametrize("size", SIZES)
def test_dct2_and_idct2_are_scipys_transforms(size):
    x = random(2, 3, *size)
    np.testing.assert_allclose(dct2(x).numpy(), scipy.fft.dctn(x.numpy(), axes=(-2, -1)), atol=1e-13)
    np.testing.assert_allclose(idct2(x).numpy(), scipy.fft.idctn(x.numpy(), axes=(-2, -1)), atol=1e-13)


def test_dct2_of_float32_is_float32_and_accurate():
    x = random(2, 48, 50, dtype=torch.float32)
    coefficients = dct2(x)
    assert coefficients.dtype == torch.float32
    expected = scipy.fft.dctn(x.double().numpy(), axes=(-2, -1))
    np.testing.assert_allclose(coefficients.numpy(), expected, atol=1e-6 * np.abs(expected).max())
    torch.testing.assert_close(idct2(coefficients), x, atol=2e-6, rtol=0)


@pytest.mark.parametrize("size", [(3, 4), (4, 3)])
def test_dct2_and_idct2_have_the_right_gradients(size):
    x = random(*size).requires_grad_()
    assert torch.autograd.gradcheck(dct2, (x,), fast_mode=True)
    assert torch.autograd.gradcheck(idct2, (x,), fast_mode=True)


def test_laplacian_is_scipys_convolution_with_a_mirrored_border():
    x = random(2, 3, 5, 4)
    kernel = np.ones((3, 3))
    kernel[1, 1] = -8
    expected = scipy.ndimage.convolve(x.numpy(), kernel[None, None] / 16, mode="mirror")
    np.testing.assert_allclose(laplacian(x).numpy(), expected, atol=1e-14)


def test_transfer_edges_solves_the_linear_system():
    height, width = 5, 6
    depth, guide, weight = (random(2, 3, height, width, seed=seed) for seed in range(3))
    strength = torch.tensor([0.1, 1.0, 30.0], dtype=torch.float64).view(1, 3, 1, 1)
    # the Laplacian of four neighbours, without those outside
    second = [np.diag(np.r_[-1, -2 * np.ones(n - 2), -1]) + np.eye(n, k=1) + np.eye(n, k=-1) for n in (height, width)]
    four = np.kron(second[0], np.eye(width)) + np.kron(np.eye(height), second[1])
    right = depth + strength * laplacian(weight * laplacian(guide))
    solved = transfer_edges(depth, guide, weight, strength)
    for channel, factor in enumerate(strength.flatten()):
        matrix = np.eye(height * width) + float(factor) * four @ four
        expected = np.linalg.solve(matrix, right[:, channel].reshape(2, -1).numpy().T).T
        np.testing.assert_allclose(solved[:, channel].reshape(2, -1).numpy(), expected, atol=1e-12)


def test_transfer_edges_does_not_depend_on_the_chunks(monkeypatch):
    inputs = [random(2, 5, 4, 6, seed=seed) for seed in range(3)]
    strength = random(1, 5, 1, 1, seed=3).exp()
    whole = transfer_edges(*inputs, strength)
    monkeypatch.setattr(dctnet, "_CHUNK", 2 * 4 * 6)
    torch.testing.assert_close(transfer_edges(*inputs, strength), whole)


def make_inputs(batch=2, channels=3, outputs=4, height=5, width=6):
    return (
        random(batch, channels, height, width),
        2 * random(batch, 18, height, width, seed=1),
        random(batch, 9, height, width, seed=2).sigmoid(),
        random(batch, outputs, channels, 3, 3, seed=3),
    )


def interpolate(image, y, x):
    """The bilinear value of (H, W) at a position; 0 outside."""
    value = 0.0
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                value += (1 - abs(y - row)) * (1 - abs(x - column)) * image[row, column]
    return value


def convolve_in_loops(x, offsets, mask, weight):
    batch, channels, height, width = x.shape
    result = np.zeros((batch, weight.shape[1], height, width))
    for b, row, column, tap in np.ndindex(batch, height, width, 9):
        dy, dx = offsets[b, 2 * tap : 2 * tap + 2, row, column]
        y, x_position = row + tap // 3 - 1 + dy, column + tap % 3 - 1 + dx
        for channel in range(channels):
            value = mask[b, tap, row, column] * interpolate(x[b, channel], y, x_position)
            result[b, :, row, column] += weight[b, :, channel, tap // 3, tap % 3] * value
    return result


def test_deformable_conv3x3_equals_plain_loops():
    inputs = make_inputs()
    expected = convolve_in_loops(*(each.numpy() for each in inputs))
    np.testing.assert_allclose(deformable_conv3x3(*inputs).numpy(), expected, atol=1e-12)


def test_deformable_conv3x3_without_offsets_is_a_convolution():
    x, offsets, mask, weight = make_inputs(batch=1)
    result = deformable_conv3x3(x, 0 * offsets, torch.ones_like(mask), weight)
    torch.testing.assert_close(result, functional.conv2d(x, weight[0], padding=1))


def test_deformable_conv3x3_does_not_depend_on_the_chunks(monkeypatch):
    inputs = make_inputs()
    whole = deformable_conv3x3(*inputs)
    monkeypatch.setattr(dornet, "_CHUNK", 1)
    torch.testing.assert_close(deformable_conv3x3(*inputs), whole)


def test_dornet_folds_batch_normalisation_into_convolutions_with_and_without_a_bias():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(1, 24, 8, 8, generator=generator)
    for conv, norm, has_bias in (
        ("Enc.E.0", "Enc.E.1", True),
        ("Enc.E_pre.1.shortcut.0", "Enc.E_pre.1.shortcut.1", False),
    ):
        weight = torch.randn(48, 24, 3, 3, generator=generator)
        bias = torch.randn(48, generator=generator) if has_bias else None
        parts = {part: torch.rand(48, generator=generator) + 0.5 for part in ("weight", "bias")}
        statistics = {part: torch.rand(48, generator=generator) + 0.5 for part in ("running_mean", "running_var")}
        tensors = {f"{conv}.weight": weight, **{f"{norm}.{name}": each for name, each in (parts | statistics).items()}}
        tensors |= {f"{norm}.num_batches_tracked": torch.tensor(7), "Dab.fc1.weight": weight}
        tensors |= {} if bias is None else {f"{conv}.bias": bias}
        converted = DORNet.convert(tensors)
        assert set(converted) == {f"{conv}.weight", f"{conv}.bias"}
        expected = functional.batch_norm(functional.conv2d(x, weight, bias), **statistics, **parts)
        folded = functional.conv2d(x, converted[f"{conv}.weight"], converted[f"{conv}.bias"])
        torch.testing.assert_close(folded, expected, atol=1e-4, rtol=1e-4)


def test_dornet_has_a_range_of_depth_with_the_weights_for_a_phone_alone():
    assert DORNet(8 / 3).depth_range == (0, 5)
    assert DORNet(4).depth_range is None
