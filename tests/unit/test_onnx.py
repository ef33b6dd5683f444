"""Networks as ONNX files: what dsr writes computes what PyTorch does, and files of others are declared and checked."""

import functools
import sys

import numpy as np
import pytest
import torch
from small_scenes import plane, random_scene, sample_of
from torch import nn
from torch.nn import functional

from dsr.app.requests import ExportRequest
from dsr.cli import main
from dsr.geometry.camera import to_range
from dsr.methods.images import resize_bicubic
from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.dynamic_guidance import DynamicGuidance
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.networks.network_file import INPUTS, NetworkFile, OnnxGraph, example_inputs, write_onnx
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.methods.networks.trained import NETWORKS

onnx = pytest.importorskip("onnx", reason="pip install -e '.[onnx]'")
onnxruntime = pytest.importorskip("onnxruntime", reason="pip install -e '.[onnx]'")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the exporter

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


@pytest.mark.slow
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


@pytest.fixture
def sample():
    return sample_of(plane() + 3 * (plane() > 6.5), random_scene(32, 48)[1], scale=4)


def network(folder, function, *inputs, size=None):
    """Write a function of a photo, 12 x 16 or of a fixed size, and of a map of a quarter of it, as an ONNX file."""

    class Module(nn.Module):
        def forward(self, *given):
            return function(*given)

    path, (height, width) = folder / "mine.onnx", size or (12, 16)
    of_low = {"depth": (1, 1, height // 4, width // 4), "grey": (1, 1, height, width)}
    given = tuple(torch.rand(of_low.get(name, (1, 3, height, width))) for name in inputs)
    axes = {name: {2: f"h_{name}", 3: f"w_{name}"} for name in inputs}
    torch.onnx.export(
        Module(), given, str(path), input_names=list(inputs), opset_version=18, dynamo=False,
        dynamic_axes=None if size else axes,
    )  # fmt: skip
    return str(path)


def second(rgb, depth):
    return depth + 0 * rgb.mean()


@pytest.mark.parametrize("quantity", ["disparity", "orthogonal", "inverse"])
@pytest.mark.parametrize("value_range", ["measured", None, [0.0, 3.0]])
@pytest.mark.parametrize("output", ["same", "residual"])
def test_enlarged_map_returns_as_it_came(sample, tmp_path, quantity, value_range, output):
    nothing = lambda rgb, depth: 0 * depth + 0 * rgb.mean()  # noqa: E731
    path = network(tmp_path, second if output == "same" else nothing, "rgb", "depth")
    inputs = {"rgb": "image", "depth": "up"}
    depth = NetworkFile(path, inputs, range_type=quantity, range=value_range, output=output)(sample)
    lr = {"disparity": sample.disparity_lr(), "orthogonal": sample.depth_lr, "inverse": 1 / sample.depth_lr}[quantity]
    expected = resize_bicubic(lr[None], (32, 48))[0]  # by the kernel of the field's benchmarks
    got = {"disparity": to_range(depth, sample.camera, "disparity"), "orthogonal": depth, "inverse": 1 / depth}
    torch.testing.assert_close(got[quantity], expected, rtol=1e-4, atol=1e-5)


def test_photo_alone_and_a_quantity_of_its_own(sample, tmp_path):
    path = network(tmp_path, lambda rgb: (rgb[:, :1] + 1, rgb), "rgb")
    torch.testing.assert_close(
        NetworkFile(path, {"rgb": "image"}, output="orthogonal")(sample)[0], sample.rgb[0].to(torch.float64) + 1
    )
    path = network(tmp_path, lambda rgb, grey: rgb[:, :1] + grey + 1, "rgb", "grey")
    method = NetworkFile(path, {"rgb": "image255", "grey": "grey"}, output="orthogonal")
    luma = 0.299 * sample.rgb[0] + 0.587 * sample.rgb[1] + 0.114 * sample.rgb[2]
    torch.testing.assert_close(method(sample)[0].float(), 255 * sample.rgb[0] + luma + 1, rtol=1e-3, atol=0)


def test_pictures_are_continued_to_a_multiple(sample, tmp_path):
    larger = lambda rgb, depth: functional.interpolate(depth, scale_factor=4, mode="nearest") + 0 * rgb  # noqa: E731
    path = network(tmp_path, lambda *given: larger(*given)[:, :1], "rgb", "depth", size=(40, 60))
    method = NetworkFile(path, {"rgb": "image", "depth": "lr"}, range=None, multiple=20)
    expected = sample.disparity_lr().repeat_interleave(4, 1).repeat_interleave(4, 2)
    torch.testing.assert_close(to_range(method(sample), sample.camera, "disparity"), expected, rtol=1e-5, atol=0)


def test_graph_that_dsr_exports_gives_what_the_network_does(tmp_path):
    torch.manual_seed(0)
    net = MSGNet(4)
    write_onnx(tmp_path / "msg.onnx", OnnxGraph(net, 4), {})
    problem = sample_of(plane(), random_scene(32, 48)[1], scale=4)
    problem.depth_lr[:, 2:4, 3:5] = torch.nan
    inputs = {"photo": "image", "inverse_depth": "lr", "valid": "valid"}
    method = NetworkFile(str(tmp_path / "msg.onnx"), inputs, range_type="inverse", range=None)
    expected = NetworkUpsampler(net)(problem)
    torch.testing.assert_close(method(problem), expected.to(torch.float64), rtol=1e-4, atol=0)
    assert (method.name, len(method.content("set", "hall", 4) or "")) == ("msg", 64)
    with pytest.raises(ValueError, match=r"inputs: expected"):
        NetworkFile(str(tmp_path / "msg.onnx"), {"rgb": "image", "depth": "up"})
    with pytest.raises(ValueError, match=r"result: expected"):
        NetworkFile(str(tmp_path / "msg.onnx"), inputs, result="depth")


@pytest.mark.parametrize(
    ("key", "settings"),
    [
        ("path", {"path": "nowhere.onnx"}), ("inputs.rgb", {"inputs": {"rgb": "picture"}}), ("inputs", {"inputs": {}}),
        ("range_type", {"range_type": "depth"}), ("range", {"range": [2, 1]}), ("range", {"range": "truth"}),
        ("output", {"output": "log"}), ("fit", {"fit": "cubic"}), ("size", {"size": [20, 20]}),
        ("size", {"size": [20], "inputs": {"rgb": "image"}}), ("multiple", {"multiple": 0}),
        ("result", {"result": "depth"}),
    ],
)  # fmt: skip
def test_declaration_is_checked(tmp_path, key, settings):
    given = {"path": network(tmp_path, second, "rgb", "depth"), "inputs": {"rgb": "image", "depth": "up"}}
    with pytest.raises(ValueError, match=f"{key}: expected"):
        NetworkFile(**{**given, **settings})


@pytest.mark.parametrize("output", ["inverse", "disparity"])
def test_relative_result_is_fitted_to_the_coarse_map_without_the_truth(sample, tmp_path, output):
    path = network(tmp_path, lambda rgb: 7 * rgb[:, 0] - 0.5, "rgb")
    disparity = to_range(sample.depth, sample.camera, "disparity")[0]
    problem = sample_of(disparity, (disparity / 20).float().expand(3, 32, 48), scale=4)
    object.__setattr__(problem, "depth", None)
    method = NetworkFile(path, {"rgb": "image"}, output=output, fit="affine")
    torch.testing.assert_close(method(problem), sample.depth, rtol=1e-3, atol=0)
    assert "affine" in method.describe(problem)
    with pytest.raises(ValueError, match=r"mine.onnx: expected values that rise"):
        NetworkFile(path, {"rgb": "image"}, output="orthogonal", fit="affine")(problem)


def test_photo_is_resized_for_a_network_that_sees_it_alone(tmp_path):
    ramp = torch.linspace(0.2, 0.8, 48).expand(3, 32, 48)
    path, inputs = network(tmp_path, lambda rgb: 4 + rgb[:, :1], "rgb", size=(24, 40)), {"rgb": "image"}
    for output, factor in (("orthogonal", 1), ("disparity", 48 / 40)):
        method = NetworkFile(path, inputs, output=output, size=[24, 40], multiple=8)
        problem = sample_of(plane(), ramp, scale=4)
        found = method(problem)
        found = found if output == "orthogonal" else to_range(found, problem.camera, "disparity")
        inner = (slice(None), slice(None), slice(4, -4))  # the kernel ends at the border
        torch.testing.assert_close(found[inner], factor * (4 + ramp[:1].double())[inner], rtol=0, atol=1e-3)


def test_content_follows_weights_that_lie_beside_the_graph(tmp_path):
    path, beside = tmp_path / "net.onnx", tmp_path / "net.data"
    inputs, found = {"photo": "image", "inverse_depth": "lr", "valid": "valid"}, []
    for seed in range(2):
        torch.manual_seed(seed)
        write_onnx(tmp_path / "whole.onnx", OnnxGraph(MSGNet(2), 2), {})
        beside.unlink(missing_ok=True)
        onnx.save_model(
            onnx.load(tmp_path / "whole.onnx"), path, save_as_external_data=True, location=beside.name, size_threshold=0
        )
        found.append((path.read_bytes(), NetworkFile(str(path), inputs).content("set", "hall", 4)))
    assert found[0][0] == found[1][0]
    assert found[0][1] != found[1][1]
    beside.unlink()
    with pytest.raises(ValueError, match=r"net.onnx: expected its weights in .*net.data"):
        NetworkFile(str(path), inputs)
    path.write_bytes(b"PK\x03\x04 no network")
    with pytest.raises(ValueError, match=r"net.onnx: expected an ONNX file"):
        NetworkFile(str(path), inputs)


def test_network_that_returns_no_map_or_fails_is_named(sample, tmp_path):
    narrow = lambda rgb, depth: depth[:, :, ::2] + 0 * rgb.mean()  # noqa: E731
    for function, size in ((narrow, None), (second, (12, 16))):
        path = network(tmp_path, function, "rgb", "depth", size=size)
        with pytest.raises(ValueError, match=r"mine.onnx: expected"):
            NetworkFile(path, {"rgb": "image", "depth": "up"})(sample)
