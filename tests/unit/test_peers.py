"""The published networks of the field: how they are fed and read, and each part against an independent computation."""

import math
import pickle
from dataclasses import replace
from typing import ClassVar

import cv2
import numpy as np
import pytest
import scipy.fft
import scipy.ndimage
import torch
from bombs import Trap
from PIL import Image
from small_scenes import normal, problem
from torch import nn
from torch.nn import functional

from dsr.geometry.camera import from_range
from dsr.methods.base import Cost
from dsr.methods.images import dct2, idct2, inpaint, resize_bicubic
from dsr.methods.networks.peers import PeerNetwork, dctnet, dornet, fold_batch_norm, load_peer, local_filters, pgsr
from dsr.methods.networks.peers.dctnet import DCTNet, laplacian, transfer_edges
from dsr.methods.networks.peers.dornet import DORNet, deformable_conv3x3
from dsr.methods.networks.peers.local_filters import FDKN, SVLRM
from dsr.methods.networks.peers.peer import Peer
from dsr.methods.networks.peers.pgsr import PGSR
from dsr.methods.networks.weight_files import has_weights, nearest_scale
from dsr.methods.recipe import read_recipe
from dsr.utils.configuration import ConfigError
from dsr.utils.versions import file_hash

FILES = {"SVLRM_X4.pth": 4, "SVLRM_X8.pth": 8, "X8/model.pth": 8}


class Enlarged(PeerNetwork):
    """Returns its enlarged map."""

    title = "Enlarged"
    multiple: ClassVar[int] = 4
    cost: ClassVar[Cost] = Cost(1, 1)

    def __init__(self, scale=4):
        super().__init__(scale)
        self.seen = []

    def enlarge(self, values_lr, size):
        return resize_bicubic(values_lr, size)

    def forward(self, rgb, values):
        assert not any(n % self.multiple for n in values.shape[-2:])
        assert rgb.shape[-2:] == values.shape[-2:]
        self.seen.append(values)
        return values


class Smoothed(Enlarged):
    """Two convolutions, which need a neighbourhood of four pixels."""

    receptive_field_radius: ClassVar[int | None] = 4

    def __init__(self, scale=4):
        super().__init__(scale)
        torch.manual_seed(0)
        self.layers = nn.Sequential(nn.Conv2d(4, 8, 5, padding=2), nn.ReLU(), nn.Conv2d(8, 1, 5, padding=2))

    def forward(self, rgb, values):
        return values + self.layers(torch.cat((rgb, values), dim=1))


def _sample(size_lr=(6, 9), scale=4, doffs=0.0):
    """Return a sample whose true disparity goes beyond the low-resolution one."""
    sample = problem(scale, *size_lr, doffs)
    shape = (1, *sample.rgb.shape[1:])
    disparity = torch.linspace(10, 40, math.prod(shape), dtype=torch.float64).view(shape)
    return replace(sample, depth=from_range(disparity, sample.camera, "disparity"))


def _pillow(values, size):
    image = Image.fromarray(values.numpy().astype(np.float32))
    return torch.from_numpy(np.array(image.resize((size[1], size[0]), Image.Resampling.BICUBIC))).double()


@pytest.mark.parametrize(("size_lr", "scale"), [((6, 9), 4), ((9, 12), 8 / 3), ((5, 7), 3), ((10, 11), 1)])
@pytest.mark.parametrize("range_type", ["disparity", "orthogonal"])
def test_map_of_any_ratio_is_fed_in_its_range_type(size_lr, scale, range_type):
    sample = _sample(size_lr, scale, doffs=3.0)
    depth = Peer(Enlarged(), range_type=range_type)(sample)
    size = (sample.camera.height, sample.camera.width)
    values_lr = sample.disparity_lr() if range_type == "disparity" else sample.depth_lr
    expected = from_range(_pillow(values_lr[0], size)[None], sample.camera, range_type)
    assert depth.dtype == torch.float64
    torch.testing.assert_close(depth, expected, rtol=1e-5, atol=0)


def test_weights_trained_on_a_range_of_depth_get_depth_normalised_by_it():
    class Metric(Enlarged):
        depth_range = (1.0, 9.0)

    upsampler, sample = Peer(Metric(), range_type="disparity"), _sample(scale=1)
    depth = upsampler(sample)
    assert upsampler.range_type == "orthogonal"
    torch.testing.assert_close(upsampler.net.seen[0][0, :, :6, :9].double(), (sample.depth_lr - 1) / 8)
    torch.testing.assert_close(depth, sample.depth_lr, rtol=1e-5, atol=0)
    message = "range: expected measured for weights trained on depth of 1 to 9 m, got truth"
    with pytest.raises(ValueError, match=message):
        Peer(Metric(), range="truth")


def test_other_factor_than_that_of_the_weights_is_noted():
    upsampler = Peer(Enlarged(8))
    assert upsampler.describe(_sample(scale=8)) == ""
    assert upsampler.describe(_sample(scale=4)) == "weights trained for x8"
    assert Peer(Enlarged(8 / 3)).describe(_sample(scale=4)) == "weights trained for x2.67"


def test_true_range_is_flagged_and_needs_the_truth():
    upsampler, sample = Peer(Enlarged(), range="truth"), _sample(scale=1)
    depth = upsampler(sample)
    assert upsampler.flag == "true-range"
    expected = (sample.disparity_lr() - 10) / 30
    torch.testing.assert_close(upsampler.net.seen[0][0, :, :6, :9].double(), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(depth, sample.depth_lr, rtol=1e-5, atol=0)
    unknown = replace(sample, depth=None)
    measured = Peer(Enlarged())
    assert torch.equal(measured(sample), measured(unknown))  # does not read the truth
    with pytest.raises(ValueError, match="scene: range=truth expects"):
        upsampler(unknown)


def test_holes_are_inpainted_before_the_range_is_taken():
    sample = _sample(scale=1)
    holes = sample.depth_lr.clone()
    holes[0, 2:4, 3:6] = torch.nan
    pierced = replace(sample, depth_lr=holes, depth=None)
    depth = Peer(Enlarged())(pierced)
    expected = from_range(inpaint(pierced.disparity_lr()[None])[0], sample.camera, "disparity")
    torch.testing.assert_close(depth, expected, rtol=1e-5, atol=0)


def test_tiles_change_rounding_errors_only_and_bfloat16_a_little():
    sample, steps = _sample((17, 23), 4), []
    whole = Peer(Smoothed())(sample)
    tiled = Peer(Smoothed(), tile=24)(sample, lambda *step: steps.append(step))
    torch.testing.assert_close(tiled, whole, rtol=1e-5, atol=0)
    assert steps == [(i + 1, 12) for i in range(12)]
    assert 1e-7 < float((Peer(Smoothed(), precision="bfloat16")(sample) / whole - 1).abs().max()) < 0.02


def test_folded_batch_normalisation_gives_the_same_result_and_one_that_does_not_fit_stays():
    torch.manual_seed(1)
    conv, norm = nn.Conv2d(3, 5, 3), nn.BatchNorm2d(5)
    for part in (norm.weight, norm.bias, norm.running_mean, norm.running_var):
        part.data.uniform_(0.5, 2)
    tensors = {f"a.{name}": value for name, value in conv.state_dict().items()}
    tensors |= {f"b.{name}": value for name, value in norm.state_dict().items()}
    narrow = {**tensors, **{f"b.{name}": torch.ones(3) for name in ("weight", "bias", "running_mean", "running_var")}}
    x = torch.rand(2, 3, 8, 8)
    expected = norm.eval()(conv(x))
    fold_batch_norm(tensors, "a", "b")
    assert set(tensors) == {"a.weight", "a.bias"}
    torch.testing.assert_close(nn.functional.conv2d(x, tensors["a.weight"], tensors["a.bias"]), expected)
    for first in ("a", "missing"):
        before = dict(narrow)
        fold_batch_norm(narrow, first, "b")
        assert narrow == before


def test_weights_are_those_of_the_next_larger_factor_and_a_sensors_of_its_own_alone():
    for scale, trained in ((1, 4), (8 / 3, 4), (4, 4), (4.5, 8), (8, 8), (32, 8)):
        assert nearest_scale(FILES.values(), scale) == trained
    for scale, trained in ((1, 4), (2, 4), (8 / 3, 8 / 3), (3, 4)):
        assert nearest_scale([8 / 3, *FILES.values()], scale) == trained


def _state(prefix=""):
    torch.manual_seed(0)
    return {prefix + name: value for name, value in SVLRM(4).state_dict().items()}


def _build(path, scale=4):
    return Peer("svlrm", path, scale, FILES)


def _save(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(content, path)
    return path


@pytest.mark.parametrize("prefix", ["", "module."])
def test_authors_file_gives_its_network(tmp_path, prefix):
    net = load_peer(_save(tmp_path / "net.pth", _state(prefix)), SVLRM, 8)
    assert net.scale == 8
    assert all(torch.equal(value, _state()[name]) for name, value in net.state_dict().items())


def test_scale_is_read_from_the_name_where_the_content_is_unknown(tmp_path):
    for name in ("SVLRM_X8.pth", "X8/model.pth"):
        path = _save(tmp_path / name, _state())
        assert _build(path, 8).net.scale == 8
        assert _build(path, 8 / 3).net.scale == 8  # any file, where the network has no weights for the ratio
        with pytest.raises(ValueError, match=rf"{name}: weights are for scale 8, the run is at scale 4"):
            _build(path)
    assert _build(_save(tmp_path / "renamed.pth", _state()), 8).net.scale == 8
    assert _build(tmp_path / "renamed.pth", 2).net.scale == 4


def test_scale_is_recognised_by_the_content_before_the_name(tmp_path, monkeypatch):
    path = _save(tmp_path / "SVLRM_X4.pth", _state())
    monkeypatch.setattr(SVLRM, "checksums", {file_hash(path)[:16]: 8})
    assert _build(path, 8).net.scale == 8
    with pytest.raises(ValueError, match="weights are for scale 8, the run is at scale 4"):
        _build(path)


def test_bad_file_is_refused_in_one_line_and_runs_nothing(tmp_path, recwarn):
    whole = _save(tmp_path / "whole.pth", _state()).read_bytes()
    damaged = "expected a torch file of plain tensors, got one that is damaged or holds other Python objects"
    expected, tensor = "expected the tensors of SVLRM, but ", "final_layer.bias"
    infinite = _state()
    infinite[tensor][0] = torch.nan
    cases = [
        (whole[: len(whole) // 2], damaged),
        (b"no weights", damaged),
        (pickle.dumps(Trap(tmp_path / "sprung")), damaged),
        ({**_state(), "x": Trap(tmp_path / "sprung")}, damaged),
        ([1, 2], "expected a network's tensors by name, got list"),
        ({"step": 3}, "expected a network's tensors by name, got step"),
        ({name: value for name, value in _state().items() if name != tensor}, f"{expected}{tensor} is missing"),
        (_state() | {tensor: torch.ones(3)}, f"{expected}{tensor} has shape "),
        (infinite, f"{expected}{tensor} holds values other than"),
        ({"first_layer.weight": torch.ones(2), "extra": torch.ones(2)}, f"{expected}first_layer.bias is missing, and "),
    ]
    path = tmp_path / "bad.pth"
    for content, message in cases:
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            _save(path, content)
        with pytest.raises(ValueError, match=f"^{path}: {message}") as error:
            _build(path)
        assert "\n" not in str(error.value)
    assert not (tmp_path / "sprung").exists()
    assert not recwarn.list


def test_missing_file_and_unknown_network_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such weights file"):
        _build(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="peer: expected"):
        Peer("svlr", tmp_path, 4, FILES)
    with pytest.raises(ValueError, match=r"^weights: expected"):
        Peer("svlrm")
    with pytest.raises(ValueError, match=r"^weights: expected no file beside a network, got "):
        Peer(Enlarged(), tmp_path)


def test_directory_is_searched_for_the_authors_names(tmp_path, monkeypatch):
    monkeypatch.delenv("DSR_WEIGHTS", raising=False)
    recipe = read_recipe("svlrm")
    assert not has_weights(recipe.at(8)["weights"], 8)
    message = (
        r"weights: method=svlrm: scale 8 needs weights=FILE, or a directory with SVLRM_X8.pth "
        r"\(from github.com/sunny2109/SVLRM, weights/\); its authors publish them, dsr does not come with them"
    )
    with pytest.raises(ConfigError, match=message):
        recipe.weights(8)
    monkeypatch.setenv("DSR_WEIGHTS", str(tmp_path))
    recipe = read_recipe("svlrm")
    with pytest.raises(ConfigError, match=r"SVLRM_X8.pth \(no such file\)"):
        recipe.weights(8)
    path = _save(tmp_path / "X8" / "model_177200_iter.pth", _state())
    assert [recipe.weights(scale) for scale in (8, 7.5)] == [path, path]
    assert recipe.factors == (8,)
    renamed = _save(tmp_path / "SVLRM_X8.pth", _state())
    assert recipe.with_weights(tmp_path).weights(8) == renamed


@pytest.mark.parametrize(
    ("method", "scale"),
    [*((name, scale) for name in ("pgsr", "dctnet", "svlrm") for scale in (4, 8, 16)),
     *(("dornet", scale) for scale in (8 / 3, 4, 8)), ("fdkn", 8),
     *(("msg", scale) for scale in (2, 4, 8, 16)), ("msg_v", 4), ("msg_v", 8), ("msg_v_noisy", 4)],
)  # fmt: skip
def test_files_of_the_authors_have_the_names_and_shapes_of_the_networks(shared, method, scale):
    read_recipe(method).with_weights(shared / "weights" / ("" if "msg" in method else "peers")).build(scale)


SIZES = [(4, 6), (5, 7), (5, 4), (6, 5), (1, 3), (4, 1), (1, 2), (1, 1)]


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


def test_pgsr_planes_have_the_authors_coordinates():
    planes = torch.rand(1, 4, 5, 8) + 0.1
    p, q, r, s = planes[0].double().numpy()
    u, v = ((np.arange(n) - (n - 1) / 2) / 8 / (n - 1) for n in (8, 5))
    inverse = (p * (u - 0.5) * 2 + q * (v[:, None] - 0.5) * 2 + r) * s
    np.testing.assert_allclose(pgsr._evaluate(planes)[0, 0].numpy(), 1 / np.maximum(inverse, 1), rtol=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_dct2_and_idct2_are_scipys_transforms(size):
    x = normal(2, 3, *size)
    np.testing.assert_allclose(dct2(x).numpy(), scipy.fft.dctn(x.numpy(), axes=(-2, -1)), atol=1e-13)
    np.testing.assert_allclose(idct2(x).numpy(), scipy.fft.idctn(x.numpy(), axes=(-2, -1)), atol=1e-13)


def test_laplacian_is_scipys_convolution_with_a_mirrored_border():
    x = normal(2, 3, 5, 4)
    kernel = np.ones((3, 3))
    kernel[1, 1] = -8
    expected = scipy.ndimage.convolve(x.numpy(), kernel[None, None] / 16, mode="mirror")
    np.testing.assert_allclose(laplacian(x).numpy(), expected, atol=1e-14)


def test_transfer_edges_solves_the_linear_system():
    height, width = 5, 6
    depth, guide, weight = (normal(2, 3, height, width, seed=seed) for seed in range(3))
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


OFFSETS, MASK = 2 * normal(2, 18, 5, 6, seed=1), normal(2, 9, 5, 6, seed=2).sigmoid()
DEFORMED = normal(2, 3, 5, 6), OFFSETS, MASK, normal(2, 4, 3, 3, 3, seed=3)


def convolve_in_loops(x, offsets, mask, weight):
    batch, _, height, width = x.shape
    rows, columns = np.mgrid[:height, :width]
    result = np.zeros((batch, weight.shape[1], height, width))
    for b, tap in np.ndindex(batch, 9):
        places = rows + tap // 3 - 1 + offsets[b, 2 * tap], columns + tap % 3 - 1 + offsets[b, 2 * tap + 1]
        values = [scipy.ndimage.map_coordinates(each, places, order=1, mode="grid-constant") for each in x[b]]
        result[b] += np.tensordot(weight[b, :, :, tap // 3, tap % 3], mask[b, tap] * values, 1)
    return result


def test_deformable_conv3x3_equals_plain_loops():
    expected = convolve_in_loops(*(each.numpy() for each in DEFORMED))
    np.testing.assert_allclose(deformable_conv3x3(*DEFORMED).numpy(), expected, atol=1e-12)


def test_chunks_and_strips_change_rounding_errors_only(monkeypatch):
    torch.manual_seed(0)
    net, rgb, values = PGSR(4).eval(), torch.rand(1, 3, 44, 16), torch.rand(1, 1, 44, 16)
    edges, strength = [normal(2, 5, 4, 6, seed=seed) for seed in range(3)], normal(1, 5, 1, 1, seed=3).exp()
    cases = (
        (pgsr, "_STRIP", 3 * 16 * 4, lambda: net(rgb, values)),
        (dctnet, "_CHUNK", 2 * 4 * 6, lambda: transfer_edges(*edges, strength)),
        (dornet, "_CHUNK", 1, lambda: deformable_conv3x3(*DEFORMED)),
    )
    for module, name, size, run in cases:
        whole = run()
        monkeypatch.setattr(module, name, size)
        torch.testing.assert_close(run(), whole, rtol=1e-5, atol=1e-6)
