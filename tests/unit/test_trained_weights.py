"""Files of our own networks' weights: what they give back, and what is refused."""

import json

import pytest
import torch
from safetensors.torch import save_file

from dsr.methods.networks.facets import Facets
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.methods.networks.trained import NETWORKS, TrainedNetwork
from dsr.methods.networks.weight_files import is_dsr_weights, load_network, read_header, save_network
from dsr.methods.weights import packaged_names, packaged_weights

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


def test_trained_networks_default_to_averaging_over_quarter_turns(tmp_path):
    save_network(tmp_path / "w", MSGNet(2, "dsr"), "msg_v")
    assert TrainedNetwork(tmp_path / "w", 2, "msg_v", "voynov").ensemble == 4
    assert TrainedNetwork(tmp_path / "w", 2, "msg_v", "voynov", ensemble=1).ensemble == 1


def _file(path, changes=None, tensors=None):
    """Write a file like ours with some facts other, and perhaps other tensors."""
    head = {"format": "dsr-network-1", "network": "MSGNet", "arguments": {"scale": 4, "variant": "dsr"}}
    head |= {"model": "msg_v", "facts": {}, **(changes or {})}
    state = MSGNet(4, "dsr").state_dict() if tensors is None else tensors
    save_file(dict(state), path, {"dsr": json.dumps(head)})
    return path


def _refusal(path, scale=4, model=None):
    """Return the message with which the file is refused: one line that names it."""
    with pytest.raises(ValueError, match=r"expected|weights are for") as caught:
        load_network(path, NETWORKS, scale, model)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_missing_file_and_weights_of_another_model_or_scale_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere: no such weights file"):
        load_network(tmp_path / "nowhere", NETWORKS)
    path = _file(tmp_path / "w")
    assert _refusal(path, model="msg") == "expected weights of model msg, got those of msg_v"
    assert _refusal(path, 8) == "weights are for scale 4, the run is at scale 8"
    with pytest.raises(ValueError, match=r"expected weights of model facets, got those of msg_v"):
        TrainedNetwork(path, 4, "facets")


def test_file_truncated_or_changed_anywhere_is_refused(tmp_path):
    path = _file(tmp_path / "w")
    whole = path.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    damaged = [whole[:length] for length in (9, 100, header - 1, header, header + 1000, len(whole) - 1)]
    damaged += [
        first + whole[8:] for first in (b"\xff" * 8, (2**40).to_bytes(8, "little"), (header - 20).to_bytes(8, "little"))
    ]
    for content in damaged:
        path.write_bytes(content)
        assert "expected a safetensors file, got a damaged one" in _refusal(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "expected weights that train.py wrote"),
        ({"format": None}, "expected weights that train.py wrote"),
        ({"network": "UNet"}, "expected one of the networks MSGNet, "),
        ({"arguments": {"scale": 3}}, "expected one of the networks MSGNet, "),
        ({"arguments": {"scale": 4, "depth": 9}}, "expected one of the networks MSGNet, "),
        ({"arguments": [4]}, "expected one of the networks MSGNet, "),
    ],
)
def test_foreign_header_is_refused(tmp_path, changes, message):
    assert _refusal(_file(tmp_path / "w", changes)).startswith(message)
    save_file({"a": torch.ones(2)}, tmp_path / "w")
    assert _refusal(tmp_path / "w").startswith("expected weights that train.py wrote")


def test_other_tensors_are_refused(tmp_path):
    state = {**MSGNet(4, "dsr").state_dict()}
    bias = state.pop("smooth.conv.bias")
    assert "but smooth.conv.bias is missing" in _refusal(_file(tmp_path / "w", tensors=state))
    extra = {**state, "smooth.conv.bias": bias, "extra": bias.clone()}
    assert "but 'extra' is unexpected" in _refusal(_file(tmp_path / "w", tensors=extra))
    state["smooth.conv.bias"] = torch.full_like(bias, torch.nan)
    assert "smooth.conv.bias holds values other than finite" in _refusal(_file(tmp_path / "w", tensors=state))


def test_packaged_files_load_as_the_model_and_scale_of_their_names():
    for name in packaged_names():
        path = packaged_weights(name)
        model, _, rest = name.partition("_x")
        net = load_network(path, NETWORKS, int(rest.split("_")[0]), model)
        assert net.covers
        assert read_header(path)["facts"]["steps"] > 0
    assert packaged_weights("msg_v_x3") is None
