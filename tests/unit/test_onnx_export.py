"""Networks as ONNX files: onnxruntime computes what PyTorch does, for any size, with holes."""

import functools
import sys

import numpy as np
import pytest
import torch

from dsr.app.requests import ExportRequest
from dsr.cli import main
from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.dynamic_guidance import DynamicGuidance
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network_file import INPUTS, OnnxGraph, example_inputs, write_onnx
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.methods.networks.trained import NETWORKS

onnx = pytest.importorskip("onnx", reason="pip install -e '.[onnx]'")
onnxruntime = pytest.importorskip("onnxruntime", reason="pip install -e '.[onnx]'")

SMALL = {
    "facets": (lambda: FacetsUNet(4, 8, 8, 3), 4),
    "facets of the photo's size": (lambda: FacetsUNet(2, 8, 8, 3), 1),
    "facets_box": (lambda: Facets(4, 8, 2), 4),
    "msg": (lambda: MSGNet(4, "dsr"), 4),
    "msg as published": (lambda: MSGNet(2, "hui"), 2),
    "msg_v as published": (lambda: MSGNet(2, "voynov"), 2),
    "pdn": (lambda: PrimalDualNetwork(4, 8, 3, iterations=3), 4),
    "dg": (lambda: DynamicGuidance(4, 2, 8, 5), 4),
    "sparse_to_dense": (lambda: SparseToDense(4, 4), 4),
    "ddrnet": (lambda: DDRNet(4, 4, 4), 4),
}
SIZES = [(17, 13), (8, 29), (32, 32)]


def run(path, inputs):
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(None, {name: each.numpy() for name, each in zip(INPUTS, inputs, strict=True)})


def random_network(name):
    torch.manual_seed(0)
    build, scale = SMALL[name]
    net = build()
    with torch.no_grad():  # layers that are silent at first have to count, too
        for parameter in net.parameters():
            if not parameter.any():
                parameter.normal_(std=0.02)
    return net, scale


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return a function that gives the graph of a random network and its file, which is written once."""

    @functools.cache
    def export(name):
        path = tmp_path_factory.mktemp("onnx") / "net.onnx"
        graph = OnnxGraph(*random_network(name))
        assert write_onnx(path, graph, {"method": name, "scale": graph.scale}) <= 1e-4
        return graph, path

    return export


def test_every_network_is_tested():
    assert {type(build()).__name__ for build, _ in SMALL.values()} == set(NETWORKS)


@pytest.mark.parametrize("name", SMALL)
def test_graph_computes_what_the_network_does_at_any_size(name, exported):
    graph, path = exported(name)
    for size in SIZES:
        inputs = example_inputs(size, graph.scale)
        found = run(path, inputs)
        with torch.no_grad():
            expected = graph(*inputs)
        assert len(found) == len(expected) == len(graph.outputs)
        for mine, theirs in zip(found, expected, strict=True):
            assert mine.shape == tuple(theirs.shape)
            assert np.abs(mine - theirs.numpy()).max() <= 1e-4 * float(theirs.max() - theirs.min())


def test_graph_does_not_depend_on_values_in_holes_or_on_the_unit(exported):
    graph, path = exported("facets")
    photo, inverse, valid = example_inputs((16, 20), graph.scale)
    first = run(path, (photo, inverse, valid))
    again = run(path, (photo, torch.where(valid, 1000 * inverse, -7), valid))
    np.testing.assert_allclose(again[0], 1000 * first[0], rtol=1e-4)
    np.testing.assert_allclose(again[1], first[1], rtol=1e-3)


def test_file_says_what_it_is(exported):
    model = onnx.load(exported("dg")[1])
    onnx.checker.check_model(model, full_check=True)
    assert {each.key: each.value for each in model.metadata_props} == {"method": "dg", "scale": "4"}
    shapes = {
        each.name: [axis.dim_param or axis.dim_value for axis in each.type.tensor_type.shape.dim]
        for each in model.graph.input
    }
    low = [1, 1, "h", "w"]
    assert shapes == {"photo": [1, 3, "H", "W"], "inverse_depth": low, "valid": low}


@pytest.mark.slow
def test_command_writes_a_packaged_network(tmp_path, capsys):
    path = tmp_path / "new" / "net.onnx"
    assert main(["export", "--onnx", str(path), "--method", "msg_v", "--scale", "4"]) == 0
    assert "msg_v x4 -> " in capsys.readouterr().out
    found = run(path, example_inputs((12, 14), 4))
    assert found[0].shape == (1, 1, 48, 56)
    assert np.isfinite(found[0]).all()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--method", "nosuch"), "method: expected one of "),
        (("--method", "bicubic"), "method: expected one with a network "),
        (("--scale", "3"), "weights are for scale 4"),
        (("--scale", "0"), "--scale: "),
        (("--method", "pdn", "--scale", "16"), "scale 16 needs weights=FILE"),
        (("--weights", "nowhere.safetensors"), "nowhere.safetensors (no such file)"),
    ],
)
def test_command_refuses_in_one_line_and_writes_nothing(arguments, text, tmp_path, capsys):
    assert main(["export", "--onnx", str(tmp_path / "net.onnx"), *arguments]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_folder_and_factor_that_the_network_does_not_serve_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^path: expected a file .*, got a folder: "):
        ExportRequest(path=tmp_path, method="dg")
    with pytest.raises(ValueError, match=r"^scale: expected 4, the network's, got 2"):
        OnnxGraph(random_network("dg")[0], 2)


def test_missing_library_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ValueError, match=r"onnxruntime; pip install .*\[onnx\]"):
        write_onnx(tmp_path / "net.onnx", OnnxGraph(*random_network("dg")), {})
    assert list(tmp_path.iterdir()) == []
