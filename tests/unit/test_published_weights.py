"""The readers of the authors' weight files: what they take, and what they refuse without running it."""

import pickle

import numpy as np
import pytest
import torch
from bombs import Trap
from torch import Tensor

from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.trained import TrainedNetwork, load_msg_weights

Layer = tuple[str, str, list[Tensor]]


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


def _caffe_layers(net):
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


def _caffemodel(layers, *, packed=True):
    """Return a NetParameter: its name, an input layer without parameters, a number field, the layers."""
    content = _field(1, b"a test") + _varint(5 << 3) + b"\x01"
    content += _field(100, _field(1, b"data") + _field(2, b"HDF5Data"))
    for name, kind, blobs in layers:
        parts = b"".join(_field(7, _blob(blob, packed=packed)) for blob in blobs)
        content += _field(100, _field(1, name.encode()) + _field(2, kind.encode()) + parts)
    return content


def _author_state(net):
    """Return the parameters under Voynov et al.'s names at x4, which the network's description lists."""
    names = {
        "guidance.0": "feature_extraction_Y.0",
        "guidance.1": "feature_extraction_Y.1",
        "guidance.2": "feature_extraction_Y.2",
        "stem": "feature_extraction_X",
        "levels.0.up": "upsampling_X.0",
        "levels.0.fuse": "upsampling_X.1",
        "levels.0.refine": "upsampling_X.2",
        "levels.1.up": "upsampling_X.3",
        "levels.1.fuse": "upsampling_X.4",
        "levels.1.refine": "upsampling_X.5",
        "smooth": "upsampling_X.6",
        "reconstruct": "upsampling_X.7",
    }
    state = {}
    for name, value in net.state_dict().items():
        layer, conv, part = name.rsplit(".", 2)
        state[f"{names[layer]}.{conv}.{part}"] = value
    return state


def _write(path, content):
    path.write_bytes(content)
    return path


def _save(path, content):
    torch.save(content, path)
    return path


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("scale", [2, 8])
def test_caffe_model_round_trips_its_parameters(tmp_path, scale, packed):
    net = MSGNet(scale, "hui")
    path = _write(tmp_path / "net.caffemodel", _caffemodel(_caffe_layers(net), packed=packed))
    loaded = load_msg_weights(path, scale)
    assert loaded.variant == "hui"
    torch.testing.assert_close(dict(loaded.state_dict()), dict(net.state_dict()), rtol=0, atol=0)


def test_torch_file_round_trips_its_parameters(tmp_path):
    net = MSGNet(4)
    path, before = _save(tmp_path / "net.pth", {"model_state_dict": _author_state(net)}), torch.get_rng_state()
    loaded = load_msg_weights(path, 4, "voynov")
    assert torch.equal(torch.get_rng_state(), before)
    assert loaded.variant == "voynov"
    torch.testing.assert_close(dict(loaded.state_dict()), dict(net.state_dict()), rtol=0, atol=0)


def test_published_networks_default_to_their_published_settings(tmp_path):
    path = _save(tmp_path / "net.pth", {"model_state_dict": _author_state(MSGNet(4))})
    assert TrainedNetwork(path, 4, "msg_v", "voynov").ensemble == 1
    assert TrainedNetwork(path, 4, "msg_v", "voynov", ensemble=8).ensemble == 8


def _refusal(path, scale=4, variant=None):
    """Return the message with which the file is refused: one line that names it."""
    with pytest.raises(ValueError, match=r"expected|weights are for") as caught:
        load_msg_weights(path, scale, variant)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_missing_file_and_weights_of_another_scale_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.pth: no such weights file"):
        load_msg_weights(tmp_path / "nowhere.pth", 4)
    caffe = _write(tmp_path / "net.caffemodel", _caffemodel(_caffe_layers(MSGNet(8, "hui"))))
    assert "weights are for scale 8, the run is at scale 4" in _refusal(caffe, 4)
    path = _save(tmp_path / "net.pth", {"model_state_dict": _author_state(MSGNet(4))})
    assert "weights are for scale 4, the run is at scale 2" in _refusal(path, 2)


def test_code_in_a_file_is_not_run(tmp_path):
    mark = tmp_path / "trapped"
    for protocol in (0, 2, 4):
        _refusal(_write(tmp_path / "net.pth", pickle.dumps({"model_state_dict": Trap(mark)}, protocol)))
    message = _refusal(_save(tmp_path / "net.pth", {"model_state_dict": _author_state(MSGNet(4)), "x": Trap(mark)}))
    assert "which are never loaded" in message
    assert not mark.exists()


def test_damaged_and_foreign_files_are_refused(tmp_path):
    whole = _save(tmp_path / "whole.pth", {"model_state_dict": _author_state(MSGNet(4))}).read_bytes()
    noise = np.random.default_rng(0).bytes(10_000)
    foreign = (b"", noise, b"\x80" + noise, b"PK\x03\x04" + noise, b"\x89PNG\r\n\x1a\n")
    for content in (whole[:5000], whole[:-30], *foreign):
        assert "expected a torch" in _refusal(_write(tmp_path / "net.pth", content))
    whole = _caffemodel(_caffe_layers(MSGNet(2, "hui")))
    for length in np.random.default_rng(0).integers(1, len(whole), 40).tolist():
        assert "expected" in _refusal(_write(tmp_path / "net.caffemodel", whole[:length]), 2)


@pytest.mark.parametrize(
    "content",
    [b"\xff" * 11, b"\xa2\x06\xff\xff\xff\xff\x0f\x00", b"\x0b", b"\xa0\x06\x01", _field(1, b"name")],
)
def test_what_is_no_protobuf_or_no_network_is_refused(tmp_path, content):
    assert "expected a torch or Caffe model" in _refusal(_write(tmp_path / "net.caffemodel", content))


def test_missing_unexpected_and_misshapen_tensors_are_named(tmp_path):
    path, state = tmp_path / "net.pth", _author_state(MSGNet(4))
    bias = state.pop("upsampling_X.5.conv.bias")
    assert "levels.1.refine.conv.bias is missing" in _refusal(_save(path, {"model_state_dict": state}))
    state |= {"upsampling_X.5.conv.bias": bias, "extra": bias}
    assert "'extra' is unexpected" in _refusal(_save(path, {"model_state_dict": state}))
    del state["extra"]
    state["feature_extraction_X.conv.bias"] = bias
    assert "stem.conv.bias has shape (32,) instead of (64,)" in _refusal(_save(path, {"model_state_dict": state}))
    state["feature_extraction_X.conv.bias"] = torch.full((64,), torch.nan)
    assert "stem.conv.bias holds values other than finite" in _refusal(_save(path, {"model_state_dict": state}))
