"""The published networks of the field, part by part, against plain loops, OpenCV and torch's own layers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional

from dsr.methods.networks.peers import local_filters, pgsr
from dsr.methods.networks.peers.local_filters import FDKN, SVLRM
from dsr.methods.networks.peers.pgsr import PGSR

_FOLDED = {SVLRM: 0, FDKN: 4 * (32 + 64 + 128), PGSR: 2 * (7 * 8 + 4)}
"""Parameters of the batch normalisations, which are merged into the convolutions."""
_UNUSED = {SVLRM: 0, FDKN: 0, PGSR: 3 * (2 * (16 * 64 * 9 + 64) + 16 * 9 + 1) + 4 * (48 * 32 * 9 + 32)}
"""Parameters that serve the training, or nothing."""


@pytest.mark.parametrize(("network", "published"), [(SVLRM, 371_650), (FDKN, 693_856), (PGSR, 728_737)])
def test_network_has_the_published_number_of_parameters(network, published: int) -> None:
    parameters = sum(value.numel() for value in network(8).parameters())
    assert parameters + _FOLDED[network] + _UNUSED[network] == published


@pytest.mark.parametrize("network", [SVLRM, FDKN, PGSR])
def test_each_image_of_a_batch_is_computed_by_itself(network) -> None:
    torch.manual_seed(2)
    net, rgb, values = network(4).eval(), torch.rand(2, 3, 16, 24), torch.rand(2, 1, 16, 24)
    both = net(rgb, values)
    assert both.shape == (2, 1, 16, 24)
    torch.testing.assert_close(both[1:], net(rgb[1:], values[1:]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("scale", [4, 8])
def test_svlrm_is_fed_the_map_shifted_by_the_authors_sampling(scale: int) -> None:
    values = np.random.default_rng(0).random((5, 7), dtype=np.float32)
    shift = (scale - 1) / 2
    rows, columns = ((np.arange(scale * n) + 0.5 + shift) / scale - 0.5 for n in values.shape)
    grid = [each.astype(np.float32) for each in np.meshgrid(columns, rows)]
    expected = cv2.remap(values, *grid, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    found = SVLRM(scale).enlarge(torch.from_numpy(values)[None, None], (5 * scale, 7 * scale))
    np.testing.assert_allclose(found[0, 0].numpy(), expected, atol=2e-6)


def test_svlrm_is_linear_in_the_grey_photo() -> None:
    net = SVLRM(4)
    net.final_layer.weight.data.zero_()
    net.final_layer.bias.data = torch.tensor([2.0, 0.25])
    rgb = torch.rand(1, 3, 8, 8)
    grey = 0.299 * rgb[:, :1] + 0.587 * rgb[:, 1:2] + 0.114 * rgb[:, 2:]
    torch.testing.assert_close(net(rgb, torch.rand(1, 1, 8, 8)), 2 * grey + 0.25)


def test_fdkn_sums_the_map_at_deformed_positions_of_a_window() -> None:
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


def test_fdkn_changes_a_constant_map_by_a_constant_at_the_border_only() -> None:
    torch.manual_seed(0)
    net = FDKN(8).eval()
    found = net(torch.rand(1, 3, 40, 40), torch.full((1, 1, 40, 40), 0.5))
    torch.testing.assert_close(found[..., 12:-12, 12:-12], torch.full((1, 1, 16, 16), 0.5), rtol=0, atol=1e-5)


def test_pgsr_plane_with_a_fixed_normal_has_the_depth_of_its_distance() -> None:
    planes = torch.tensor([0.0, 0.0, 3.0, 4.0]).view(1, 4, 1, 1).expand(1, 4, 5, 6)
    normalised = pgsr._normalise(planes)
    torch.testing.assert_close(normalised[:, 2], torch.ones(1, 5, 6))
    torch.testing.assert_close(pgsr._evaluate(normalised), torch.full((1, 1, 5, 6), 1 / 4))
    behind = pgsr._evaluate(-normalised * torch.tensor([1.0, 1, 1, -1]).view(1, 4, 1, 1))
    torch.testing.assert_close(behind, torch.ones(1, 1, 5, 6))  # no farther than 1


def test_pgsr_planes_have_the_authors_coordinates() -> None:
    planes = torch.rand(1, 4, 5, 8) + 0.1
    p, q, r, s = planes[0].double().numpy()
    u, v = ((np.arange(n) - (n - 1) / 2) / 8 / (n - 1) for n in (8, 5))
    inverse = (p * (u - 0.5) * 2 + q * (v[:, None] - 0.5) * 2 + r) * s
    np.testing.assert_allclose(pgsr._evaluate(planes)[0, 0].numpy(), 1 / np.maximum(inverse, 1), rtol=1e-5)


def test_pgsr_strips_change_rounding_errors_only(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    net, rgb, values = PGSR(4).eval(), torch.rand(1, 3, 44, 16), torch.rand(1, 1, 44, 16)
    whole = net(rgb, values)
    monkeypatch.setattr(pgsr, "_STRIP", 3 * 16 * 4)
    torch.testing.assert_close(net(rgb, values), whole, rtol=1e-5, atol=1e-6)


def test_pgsr_has_the_authors_names_and_drops_those_of_its_training() -> None:
    mine = "feature_extraction_rgb.1.body.0.body.0.weight"
    assert mine in PGSR(4).state_dict()
    dropped = ("conv_depth_mapping2.weight", "PAI_2.upconv1.weight", "PAI_1.fusion2Depth.bias")
    tensors = {name: torch.zeros(1) for name in (mine.replace("0.weight", "0.0.weight"), "PGR.other.bias", *dropped)}
    assert list(PGSR.convert(tensors)) == [mine, "PGR.other.bias"]


def test_pgsr_runs_in_bfloat16() -> None:
    torch.manual_seed(0)
    net, rgb, values = PGSR(4).eval(), torch.rand(1, 3, 16, 24), torch.rand(1, 1, 16, 24)
    exact = net(rgb, values)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(net(rgb, values).float(), exact, rtol=0, atol=0.02)
