"""What all published networks of the field share: how they are fed, and how their authors' files are read."""

import pickle
from typing import ClassVar

import numpy as np
import pytest
import torch
from bombs import Trap
from PIL import Image
from torch import nn

from dsr.geometry.camera import Camera, from_range
from dsr.methods.base import Cost
from dsr.methods.images import inpaint, resize_bicubic
from dsr.methods.networks.peers.local_filters import SVLRM
from dsr.methods.networks.peers.peer import PEERS, Peer
from dsr.methods.networks.peers.peer_network import PeerNetwork, fold_batch_norm, load_peer
from dsr.methods.networks.weight_files import has_weights, nearest_scale
from dsr.methods.recipe import read_recipe
from dsr.sample import DepthSample
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
    generator = torch.Generator().manual_seed(3)
    height, width = (round(scale * n) for n in size_lr)
    camera = Camera(width, height, 600.0, 600.0, 3.0, 4.0, baseline=0.2, doffs=doffs)
    camera_lr = camera.rescale(size_lr[1], size_lr[0])
    disparity_lr = 20 + 5 * torch.rand((1, *size_lr), generator=generator, dtype=torch.float64)
    disparity = torch.linspace(10, 40, height * width, dtype=torch.float64).view(1, height, width)
    depth_lr = from_range(disparity_lr / (width / size_lr[1]), camera_lr, "disparity")
    rgb = torch.rand((3, height, width), generator=generator)
    return DepthSample(
        "test", "scene", rgb, depth_lr, camera, camera_lr, scale, from_range(disparity, camera, "disparity")
    )


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


def test_range_is_that_of_the_low_resolution_map():
    upsampler, sample = Peer(Enlarged()), _sample(scale=1)
    upsampler(sample)
    [values] = upsampler.net.seen
    assert (float(values.min()), float(values.max())) == pytest.approx((0, 1), abs=1e-6)
    assert upsampler.flag == ""


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
    unknown = DepthSample("test", "scene", sample.rgb, sample.depth_lr, sample.camera, sample.camera_lr, 1)
    measured = Peer(Enlarged())
    assert torch.equal(measured(sample), measured(unknown))  # does not read the truth
    with pytest.raises(ValueError, match="scene: range=truth expects a scene with a true depth map, there is none"):
        upsampler(unknown)


def test_holes_are_inpainted_before_the_range_is_taken():
    sample = _sample(scale=1)
    holes = sample.depth_lr.clone()
    holes[0, 2:4, 3:6] = torch.nan
    pierced = DepthSample("test", "scene", sample.rgb, holes, sample.camera, sample.camera_lr, 1)
    depth = Peer(Enlarged())(pierced)
    expected = from_range(inpaint(pierced.disparity_lr()[None])[0], sample.camera, "disparity")
    torch.testing.assert_close(depth, expected, rtol=1e-5, atol=0)


def test_constant_map_stays_constant():
    sample = _sample()
    flat = torch.full_like(sample.depth_lr, 2.5)
    depth = Peer(Enlarged())(DepthSample("t", "s", sample.rgb, flat, sample.camera, sample.camera_lr, 4))
    torch.testing.assert_close(depth, torch.full_like(depth, 2.5))


def test_tiles_change_rounding_errors_only():
    sample, steps = _sample((17, 23), 4), []
    whole = Peer(Smoothed())(sample)
    tiled = Peer(Smoothed(), tile=24)(sample, lambda *step: steps.append(step))
    torch.testing.assert_close(tiled, whole, rtol=1e-5, atol=0)
    assert steps == [(i + 1, 12) for i in range(12)]


def test_bfloat16_changes_the_result_a_little():
    exact, rounded = (Peer(Smoothed(), precision=each)(_sample()) for each in ("float32", "bfloat16"))
    assert 1e-7 < float((rounded / exact - 1).abs().max()) < 0.02


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"range_type": "depth"}, "range_type: expected one of orthogonal, perspective, disparity, got 'depth'"),
        ({"range": "full"}, "range: expected one of measured, truth, got 'full'"),
        ({"precision": "float16"}, "precision: expected one of float32, bfloat16, got 'float16'"),
    ],
)
def test_unsupported_value_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Peer(Enlarged(), **arguments)


def test_folded_batch_normalisation_gives_the_same_result():
    torch.manual_seed(1)
    conv, norm = nn.Conv2d(3, 5, 3), nn.BatchNorm2d(5)
    for part in (norm.weight, norm.bias, norm.running_mean, norm.running_var):
        part.data.uniform_(0.5, 2)
    tensors = {f"a.{name}": value for name, value in conv.state_dict().items()}
    tensors |= {f"b.{name}": value for name, value in norm.state_dict().items()}
    x = torch.rand(2, 3, 8, 8)
    expected = norm.eval()(conv(x))
    fold_batch_norm(tensors, "a", "b")
    assert set(tensors) == {"a.weight", "a.bias"}
    torch.testing.assert_close(nn.functional.conv2d(x, tensors["a.weight"], tensors["a.bias"]), expected)


def test_batch_normalisation_that_does_not_fit_is_left_in_place():
    tensors = {"a.weight": torch.ones(2, 1, 3, 3), "a.bias": torch.ones(2)}
    tensors |= {f"b.{name}": torch.ones(3) for name in ("weight", "bias", "running_mean", "running_var")}
    before = dict(tensors)
    fold_batch_norm(tensors, "a", "b")
    fold_batch_norm(tensors, "missing", "b")
    assert tensors == before


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
    with pytest.raises(ValueError, match=f"peer: expected one of {', '.join(PEERS)}, got 'svlr'"):
        Peer("svlr", tmp_path, 4, FILES)
    with pytest.raises(ValueError, match=r"^weights: expected a file of svlrm's weights, got none$"):
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
