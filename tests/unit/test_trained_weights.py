"""Files of weights, ours and their authors': what they give back, what is refused, and what fetches them."""

import functools
import http.server
import json
import pickle
import shutil

import numpy as np
import pytest
import torch
from bombs import Trap
from safetensors.torch import save_file
from urllib3 import Retry

from dsr.cli import main
from dsr.data.download import fetching
from dsr.methods import weights
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.methods.networks.trained import NETWORKS, TrainedNetwork, load_msg_weights
from dsr.methods.networks.weight_files import is_dsr_weights, load_network, read_header, save_network
from dsr.methods.recipe import read_recipe
from dsr.methods.weights import packaged_names, packaged_weights
from dsr.utils.configuration import ConfigError

NETS = {
    "msg": lambda: MSGNet(2, "dsr"),
    "msg_v": lambda: MSGNet(8, "dsr"),
    "as published": lambda: MSGNet(4, "voynov"),
    "facets": lambda: Facets(4, width=8, blocks=1, facets=1),
    "with batch normalisation": lambda: SparseToDense(4, width=4).eval(),
}


@pytest.mark.parametrize("case", NETS)
def test_file_restores_the_saved_network(tmp_path, case):
    net = NETS[case]()
    net.to(memory_format=torch.channels_last)  # as training has it
    save_network(tmp_path / "w.safetensors", net, "mine")
    before = torch.get_rng_state()
    loaded = load_network(tmp_path / "w.safetensors", NETWORKS, net.scale, "mine").train(net.training)
    assert torch.equal(torch.get_rng_state(), before)
    assert (type(loaded), loaded.arguments()) == (type(net), net.arguments())
    assert list(loaded.state_dict()) == list(net.state_dict())
    torch.testing.assert_close(dict(loaded.state_dict()), dict(net.state_dict()), rtol=0, atol=0)
    rgb, disparity = torch.rand(1, 3, 8 * net.scale, 8 * net.scale), torch.rand(1, 1, 8, 8)
    with torch.no_grad():
        torch.testing.assert_close(loaded.upsample(rgb, disparity), net.upsample(rgb, disparity), rtol=1e-4, atol=1e-5)


def test_half_precision_halves_the_kernels_and_is_loaded_as_float32(tmp_path):
    net = SparseToDense(4, width=16).eval()
    save_network(tmp_path / "whole", net, "mine")
    save_network(tmp_path / "half", net, "mine", half=True)
    assert (tmp_path / "half").stat().st_size < 0.52 * (tmp_path / "whole").stat().st_size
    loaded = load_network(tmp_path / "half", NETWORKS).state_dict()
    for name, value in net.state_dict().items():
        assert loaded[name].dtype == torch.float32
        expected = value.half().float() if value.dim() > 1 else value
        assert torch.equal(loaded[name], expected), name


def test_equal_networks_give_equal_bytes_and_the_facts_are_restored(tmp_path):
    net, facts = MSGNet(4, "dsr"), {"steps": 12, "loss": "lap1", "nested": {"b": 1, "a": [2]}}
    for name in ("a", "b"):
        save_network(tmp_path / name, net, "msg_v", facts)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    head = read_header(tmp_path / "a")
    assert head["facts"] == facts
    assert (head["network"], head["model"], head["arguments"]) == ("MSGNet", "msg_v", {"scale": 4, "variant": "dsr"})


def test_file_is_distinguished_from_a_published_one_by_its_content(tmp_path):
    save_network(tmp_path / "w.pth", MSGNet(4, "dsr"), "msg_v")
    torch.save({"model_state_dict": {}}, tmp_path / "w.caffemodel")
    assert is_dsr_weights(tmp_path / "w.pth")
    assert not is_dsr_weights(tmp_path / "w.caffemodel")
    assert TrainedNetwork(tmp_path / "w.pth", 4, "msg_v", "voynov").net.scale == 4
    with pytest.raises(ValueError, match=r"w.caffemodel: expected MSG-Net for a scale"):
        TrainedNetwork(tmp_path / "w.caffemodel", 4, "msg_v", "voynov")


def test_trained_networks_default_to_averaging_over_quarter_turns_and_published_ones_to_none(tmp_path):
    save_network(tmp_path / "w", MSGNet(4, "dsr"), "msg_v")
    published(tmp_path / "net.pth")
    for path, default in ((tmp_path / "w", 4), (tmp_path / "net.pth", 1)):
        assert TrainedNetwork(path, 4, "msg_v", "voynov").ensemble == default
        assert TrainedNetwork(path, 4, "msg_v", "voynov", ensemble=8).ensemble == 8


def _file(path, tensors=None, **changes):
    """Write a file like ours with some facts other, and perhaps other tensors."""
    head = {"format": "dsr-network-1", "network": "MSGNet", "arguments": {"scale": 4, "variant": "dsr"}}
    head |= {"model": "msg_v", "facts": {}, **changes}
    state = MSGNet(4, "dsr").state_dict() if tensors is None else tensors
    save_file(dict(state), path, {"dsr": json.dumps(head)})
    return path


def _author_state(state):
    """Return parameters under Voynov et al.'s names at x4, which the network's description lists."""
    parts = {"guidance": "feature_extraction_Y", "stem": "feature_extraction_X"}
    up = ("levels.0.up", "levels.0.fuse", "levels.0.refine", "levels.1.up", "levels.1.fuse", "levels.1.refine")
    parts |= {part: f"upsampling_X.{number}" for number, part in enumerate((*up, "smooth", "reconstruct"))}
    found = {}
    for name, value in state.items():
        part = next((part for part in parts if name.startswith(part)), None)
        found[name if part is None else parts[part] + name.removeprefix(part)] = value
    return found


def published(path, state=None):
    """Write a file like Voynov et al.'s."""
    torch.save({"model_state_dict": _author_state(MSGNet(4).state_dict() if state is None else state)}, path)
    return path


def _load(path, scale=4, model=None):
    return load_network(path, NETWORKS, scale, model)


def _refusal(path, load=_load, *arguments):
    """Return the message with which a file is refused, without its name: one line that begins with it."""
    with pytest.raises(ValueError, match=r"expected|weights are for") as caught:
        load(path, *arguments)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_weights_of_another_model_are_refused(tmp_path):
    path = _file(tmp_path / "w")
    assert _refusal(path, _load, 4, "msg") == "expected weights of model msg, got those of msg_v"
    with pytest.raises(ValueError, match=r"expected weights of model facets, got those of msg_v"):
        TrainedNetwork(path, 4, "facets")


@pytest.mark.parametrize(("write", "load", "variant"), [(_file, _load, "dsr"), (published, load_msg_weights, "voynov")])
def test_missing_files_other_scales_and_other_tensors_are_refused_by_name(tmp_path, write, load, variant):
    with pytest.raises(FileNotFoundError, match=r"nowhere: no such weights file"):
        load(tmp_path / "nowhere", 4)
    path, state = tmp_path / "w.pth", dict(MSGNet(4, variant).state_dict())
    assert _refusal(write(path, state), load, 8) == "weights are for scale 4, the run is at scale 8"
    name = "smooth.conv.bias"
    bias = state.pop(name)
    for change, message in (
        ({}, f"{name} is missing"),
        ({name: bias, "extra": bias.clone()}, "'extra' is unexpected"),
        ({name: bias[:3].clone()}, f"{name} has shape (3,) instead of (32,)"),
        ({name: torch.full_like(bias, torch.nan)}, f"{name} holds values other than finite"),
    ):
        assert message in _refusal(write(path, {**state, **change}), load, 4)


@pytest.mark.parametrize(
    "changes",
    [{"network": "UNet"}, {"arguments": {"scale": 3}}, {"arguments": {"scale": 4, "depth": 9}}, {"arguments": [4]}],
)
def test_foreign_header_is_refused(tmp_path, changes):
    assert _refusal(_file(tmp_path / "w", **changes)).startswith("expected one of the networks MSGNet, ")
    for kind in ("other", None):
        assert _refusal(_file(tmp_path / "w", format=kind)).startswith("expected weights that train.py wrote")
    save_file({"a": torch.ones(2)}, tmp_path / "w")
    assert _refusal(tmp_path / "w").startswith("expected weights that train.py wrote")


def test_packaged_files_load_as_the_model_and_scale_of_their_names():
    for name in packaged_names():
        path = packaged_weights(name)
        model, _, rest = name.partition("_x")
        net = load_network(path, NETWORKS, int(rest.split("_")[0]), model)
        assert net.covers
        assert read_header(path)["facts"]["steps"] > 0
    assert packaged_weights("msg_v_x3") is None


def _varint(value):
    head = b""
    while value > 0x7F:
        head += bytes([value & 0x7F | 0x80])
        value >>= 7
    return head + bytes([value])


def _field(number, content):
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _blob(values, *, packed):
    """Return a BlobProto; numbers one after the other, or each with its own key as proto2 writes them by default."""
    floats, sizes = values.numpy().astype("<f4").tobytes(), values.shape
    if packed:
        return _field(7, _field(1, b"".join(map(_varint, sizes)))) + _field(5, floats)
    singly = b"".join(_varint(5 << 3 | 5) + floats[i : i + 4] for i in range(0, len(floats), 4))
    return singly + _field(7, b"".join(_varint(1 << 3) + _varint(size) for size in sizes))


def caffe_layers(net):
    """Return the network's layers as Caffe keeps them: a convolution with two blobs, then a PReLU with one."""
    layers = []
    for name, value in net.state_dict().items():
        layer, part = name.rsplit(".", 1)
        kind = "PReLU" if "activation" in name else "Deconvolution" if ".up." in name else "Convolution"
        if part == "bias":
            layers[-1][2].append(value)
        else:
            layers.append((layer, kind, [value]))
    return layers


def caffemodel(layers, *, packed=True):
    """Return a NetParameter: its name, an input layer without parameters, a number field, the layers."""
    content = _field(1, b"a test") + _varint(5 << 3) + b"\x01"
    content += _field(100, _field(1, b"data") + _field(2, b"HDF5Data"))
    for name, kind, blobs in layers:
        parts = b"".join(_field(7, _blob(blob, packed=packed)) for blob in blobs)
        content += _field(100, _field(1, name.encode()) + _field(2, kind.encode()) + parts)
    return content


def _write(path, content):
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("scale", "variant", "packed"),
    [(4, "voynov", None), *((scale, "hui", packed) for scale in (2, 8) for packed in (False, True))],
)
def test_published_file_restores_its_parameters(tmp_path, scale, variant, packed):
    net, path = MSGNet(scale, variant), tmp_path / "net"
    if variant == "voynov":
        published(path, net.state_dict())
    else:
        path.write_bytes(caffemodel(caffe_layers(net), packed=packed))
    before = torch.get_rng_state()
    loaded = load_msg_weights(path, scale, variant)
    assert torch.equal(torch.get_rng_state(), before)
    assert loaded.variant == variant
    torch.testing.assert_close(dict(loaded.state_dict()), dict(net.state_dict()), rtol=0, atol=0)
    other = {"voynov": "hui", "hui": "voynov"}[variant]
    with pytest.raises(ValueError, match=f"expected weights of variant {other}, got those of variant {variant}"):
        load_msg_weights(path, scale, other)


def test_code_in_a_file_is_not_run(tmp_path):
    path, mark = tmp_path / "net.pth", tmp_path / "trapped"
    for protocol in (0, 2, 4):
        _refusal(_write(path, pickle.dumps({"model_state_dict": Trap(mark)}, protocol)), load_msg_weights, 4)
    torch.save({"model_state_dict": _author_state(MSGNet(4).state_dict()), "x": Trap(mark)}, path)
    assert "which are never loaded" in _refusal(path, load_msg_weights, 4)
    assert not mark.exists()


def test_damaged_and_foreign_files_are_refused(tmp_path):
    path = tmp_path / "net.caffemodel"
    for content in (b"\xff" * 11, b"\xa2\x06\xff\xff\xff\xff\x0f\x00", b"\x0b", b"\xa0\x06\x01", _field(1, b"name")):
        assert "expected a torch or Caffe model" in _refusal(_write(path, content), load_msg_weights, 4)
    whole = caffemodel(caffe_layers(MSGNet(2, "hui")))
    for length in np.random.default_rng(0).integers(1, len(whole), 40).tolist():
        assert "expected" in _refusal(_write(path, whole[:length]), load_msg_weights, 2)
    assert "for scale 2, the run is at scale 4" in _refusal(_write(path, whole), load_msg_weights, 4)


# Weights that an installation does not come with

NAME = "dg_x4"


@pytest.fixture
def stripped(tmp_path, monkeypatch):
    """An installation without one file of weights, and a folder with what a server has, which has it."""
    source = weights.packaged_weights(NAME)
    weights.known()  # is read once
    (tmp_path / "package").mkdir()
    for name in weights.packaged_names():
        if name != NAME:
            (tmp_path / "package" / f"{name}.safetensors").symlink_to(weights.packaged_weights(name))
    (tmp_path / "server" / "weights").mkdir(parents=True)
    shutil.copy(source, tmp_path / "server" / "weights")
    monkeypatch.setattr(weights, "_HERE", tmp_path / "package")
    monkeypatch.setenv("DSR_DATA", str(tmp_path / "data"))
    monkeypatch.setattr(fetching, "RETRIES", Retry(0))
    return tmp_path


@pytest.fixture
def mirror(serve, stripped):
    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    return serve(functools.partial(Handler, directory=str(stripped / "server"))).url


@pytest.mark.usefixtures("stripped")
def test_a_method_without_its_weights_says_how_to_get_them():
    with pytest.raises(ConfigError, match=r"^weights: method=dg: dg_x4 does not come with .* `dsr data get weights`"):
        read_recipe("dg").weights(4)


def test_weights_are_fetched_and_used(mirror, stripped):
    assert main(["data", "get", "weights", "--mirror", mirror]) == 0
    assert read_recipe("dg").weights(4) == stripped / "data" / "weights" / f"{NAME}.safetensors"
    assert main(["data", "verify", "weights"]) == 0


def test_other_files_are_refused(mirror, stripped, capsys):
    (stripped / "server" / "weights" / f"{NAME}.safetensors").write_bytes(bytes(8) + b"{}")
    assert main(["data", "get", "weights", "--mirror", mirror]) == 2
    assert f"expected sha256 {weights.known()[NAME]}, which dsr knows" in capsys.readouterr().err
    place = stripped / "data" / "weights" / f"{NAME}.safetensors"
    place.parent.mkdir(exist_ok=True, parents=True)
    place.write_bytes(b"others")
    assert weights.packaged_weights(NAME) is None
