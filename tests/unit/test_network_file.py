"""Networks of ONNX and TorchScript files: each declaration gives what it says, and what does not fit is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import plane, random_scene, sample_of
from torch import Tensor, nn

from dsr.geometry.camera import to_range
from dsr.methods.base import Method
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.networks.network_file import NetworkFile
from dsr.methods.networks.normalisation import resize_bicubic
from dsr.methods.networks.onnx_export import OnnxGraph, write_onnx
from dsr.sample import DepthSample


@pytest.fixture
def sample() -> DepthSample:
    return sample_of(plane() + 3 * (plane() > 6.5), random_scene(32, 48)[1], scale=4)


def script(folder: Path, function: Any) -> str:
    """Write a TorchScript function."""
    path = folder / "mine.pt"
    torch.jit.script(function).save(str(path))
    return str(path)


def second(rgb: Tensor, depth: Tensor) -> Tensor:
    return depth


def nothing(rgb: Tensor, depth: Tensor) -> Tensor:
    return 0 * depth


def brightness(rgb: Tensor) -> tuple[Tensor, Tensor]:
    return rgb[:, :1] + 1, rgb


def bottom(rgb: Tensor, depth: Tensor) -> Tensor:
    assert rgb.shape[2] % 20 == 0
    assert rgb.shape[3] % 20 == 0
    assert depth.shape[2] * 4 == rgb.shape[2]
    return depth.repeat_interleave(4, 2).repeat_interleave(4, 3)


def enlarged(sample: DepthSample, quantity: str) -> Tensor:
    """Return the map of a quantity, enlarged by the kernel of the field's benchmarks."""
    if quantity == "disparity":
        return resize_bicubic(sample.disparity_lr()[None], (32, 48))
    lr = {"orthogonal": sample.depth_lr, "inverse": 1 / sample.depth_lr}[quantity]
    return resize_bicubic(lr[None], (32, 48))


@pytest.mark.parametrize("quantity", ["disparity", "orthogonal", "inverse"])
@pytest.mark.parametrize("value_range", ["measured", None, [0.0, 3.0]])
@pytest.mark.parametrize("output", ["same", "residual"])
def test_enlarged_map_returns_as_it_came(
    sample: DepthSample, tmp_path: Path, quantity: str, value_range: Any, output: str
) -> None:
    path = script(tmp_path, second if output == "same" else nothing)
    inputs = {"rgb": "image", "depth": "up"}
    depth = NetworkFile(path, inputs, range_type=quantity, range=value_range, output=output)(sample)
    expected = enlarged(sample, quantity)[0]
    got = {"disparity": to_range(depth, sample.camera, "disparity"), "orthogonal": depth, "inverse": 1 / depth}
    torch.testing.assert_close(got[quantity], expected, rtol=1e-4, atol=1e-5)


def test_photo_alone_and_a_quantity_of_its_own(sample: DepthSample, tmp_path: Path) -> None:
    method = NetworkFile(script(tmp_path, brightness), {"rgb": "image"}, output="orthogonal")
    torch.testing.assert_close(method(sample)[0], sample.rgb[0].to(torch.float64) + 1)
    grey = torch.jit.script(lambda_grey())
    grey.save(str(tmp_path / "grey.ts"))
    method = NetworkFile(str(tmp_path / "grey.ts"), {"rgb": "image255", "luma": "grey"}, output="orthogonal")
    luma = 0.299 * sample.rgb[0] + 0.587 * sample.rgb[1] + 0.114 * sample.rgb[2]
    torch.testing.assert_close(method(sample)[0].float(), 255 * sample.rgb[0] + luma + 1, rtol=1e-3, atol=0)


def lambda_grey() -> nn.Module:
    class Sum(nn.Module):
        def forward(self, rgb: Tensor, grey: Tensor) -> Tensor:
            return rgb[:, :1] + grey + 1

    return Sum()


def test_pictures_are_continued_to_a_multiple(sample: DepthSample, tmp_path: Path) -> None:
    method = NetworkFile(script(tmp_path, bottom), {"rgb": "image", "depth": "lr"}, range=None, multiple=20)
    expected = sample.disparity_lr().repeat_interleave(4, 1).repeat_interleave(4, 2)
    torch.testing.assert_close(to_range(method(sample), sample.camera, "disparity"), expected, rtol=1e-5, atol=0)


def test_graph_that_dsr_exports_gives_what_the_network_does(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    torch.manual_seed(0)
    net = MSGNet(4)
    write_onnx(tmp_path / "msg.onnx", OnnxGraph(net, 4), {})
    problem = sample_of(plane(), random_scene(32, 48)[1], scale=4)
    problem.depth_lr[:, 2:4, 3:5] = torch.nan
    inputs = {"photo": "image", "inverse_depth": "lr", "valid": "valid"}
    method: Method = NetworkFile(str(tmp_path / "msg.onnx"), inputs, range_type="inverse", range=None)
    expected = NetworkUpsampler(net)(problem)
    torch.testing.assert_close(method(problem), expected.to(torch.float64), rtol=1e-4, atol=0)
    assert (method.name, len(method.content("set", "hall", 4) or "")) == ("msg", 64)
    with pytest.raises(ValueError, match=r"inputs: expected photo, inverse_depth, valid, as .* got rgb, depth"):
        NetworkFile(str(tmp_path / "msg.onnx"), {"rgb": "image", "depth": "up"})
    with pytest.raises(ValueError, match=r"result: expected one of inverse_depth_hr, got 'depth'"):
        NetworkFile(str(tmp_path / "msg.onnx"), inputs, result="depth")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"path": "nowhere.onnx"}, "path: expected a network's file"),
        ({"path": "net.h5"}, "path: expected a file .onnx"),
        ({"inputs": {"rgb": "picture"}}, "inputs.rgb: expected one of image"),
        ({"inputs": {}}, "inputs: expected one of"),
        ({"range_type": "depth"}, "range_type: expected one of"),
        ({"range": [2, 1]}, "range: expected measured"),
        ({"range": "truth"}, "range: expected measured"),
        ({"output": "log"}, "output: expected one of same"),
        ({"fit": "cubic"}, "fit: expected one of null, scale, affine"),
        ({"size": [20, 20]}, "size: expected null"),
        ({"size": [20], "inputs": {"rgb": "image"}}, "size: expected null, or"),
        ({"multiple": 0}, "multiple: expected 1 or more"),
        ({"result": "depth"}, "result: expected null"),
    ],
)
def test_declaration_is_checked(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    given = {"path": script(tmp_path, second), "inputs": {"rgb": "image", "depth": "up"}}
    with pytest.raises(ValueError, match=message):
        NetworkFile(**{**given, **settings})


class Relative(nn.Module):
    """Seven times the inverse depth that the photo's red channel holds, minus a shift."""

    def forward(self, rgb: Tensor) -> Tensor:
        return 7 * rgb[:, 0] - 0.5


@pytest.mark.parametrize("output", ["inverse", "disparity"])
def test_relative_result_is_fitted_to_the_coarse_map_without_the_truth(
    sample: DepthSample, tmp_path: Path, output: str
) -> None:
    torch.jit.script(Relative()).save(str(tmp_path / "mine.pt"))
    assert sample.depth is not None
    disparity = to_range(sample.depth, sample.camera, "disparity")[0]
    problem = sample_of(disparity, (disparity / 20).float().expand(3, 32, 48), scale=4)
    object.__setattr__(problem, "depth", None)
    method = NetworkFile(str(tmp_path / "mine.pt"), {"rgb": "image"}, output=output, fit="affine")
    torch.testing.assert_close(method(problem), sample.depth, rtol=1e-3, atol=0)
    assert "affine" in method.describe(problem)
    with pytest.raises(ValueError, match=r"mine.pt: expected values that rise"):
        NetworkFile(str(tmp_path / "mine.pt"), {"rgb": "image"}, output="orthogonal", fit="affine")(problem)


def of_one_size(rgb: Tensor) -> Tensor:
    assert rgb.shape[2] == 24
    assert rgb.shape[3] == 40
    return 4 + rgb[:, :1]


def test_photo_is_resized_for_a_network_that_sees_it_alone(tmp_path: Path) -> None:
    ramp = torch.linspace(0.2, 0.8, 48).expand(3, 32, 48)
    path, inputs = script(tmp_path, of_one_size), {"rgb": "image"}
    for output, factor in (("orthogonal", 1), ("disparity", 48 / 40)):
        method = NetworkFile(path, inputs, output=output, size=[24, 40], multiple=8)
        problem = sample_of(plane(), ramp, scale=4)
        found = method(problem)
        found = found if output == "orthogonal" else to_range(found, problem.camera, "disparity")
        inner = (slice(None), slice(None), slice(4, -4))  # the kernel ends at the border
        torch.testing.assert_close(found[inner], factor * (4 + ramp[:1].double())[inner], rtol=0, atol=1e-3)


def test_content_follows_weights_that_lie_beside_the_graph(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    found = []
    for value in (1.0, 0.5):
        shape = ["n", 1, "h", "w"]
        maps = [helper.make_tensor_value_info(name, kind, shape) for name in ("depth", "out")]
        weight = helper.make_tensor("w", kind, [256], np.full(256, value, "<f4").tobytes(), raw=True)
        nodes = [
            helper.make_node("ReduceMean", ["w"], ["m"], keepdims=0),
            helper.make_node("Mul", ["depth", "m"], ["out"]),
        ]
        model = helper.make_model(
            helper.make_graph(nodes, "g", maps[:1], maps[1:], [weight]),
            opset_imports=[helper.make_opsetid("", 18)], ir_version=9,
        )  # fmt: skip
        beside = {"save_as_external_data": True, "location": "net.data", "size_threshold": 0}
        (tmp_path / "net.data").unlink(missing_ok=True)
        onnx.save_model(model, str(tmp_path / "net.onnx"), **beside)
        found.append((
            (tmp_path / "net.onnx").read_bytes(),
            NetworkFile(str(tmp_path / "net.onnx"), {"depth": "up"}).content("set", "hall", 4),
        ))  # fmt: skip
    assert found[0][0] == found[1][0]
    assert found[0][1] != found[1][1]
    (tmp_path / "net.data").unlink()
    with pytest.raises(ValueError, match=r"net.onnx: expected its weights in .*net.data"):
        NetworkFile(str(tmp_path / "net.onnx"), {"depth": "up"})


@pytest.mark.parametrize("name", ["bad.onnx", "bad.pt"])
def test_damaged_file_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"PK\x03\x04 no network")
    with pytest.raises(ValueError, match=rf"{name}: expected an? .* file, got a damaged or foreign one"):
        NetworkFile(str(tmp_path / name), {"rgb": "image"})


def small(rgb: Tensor, depth: Tensor) -> Tensor:
    return depth[:, :, ::2]


def failing(rgb: Tensor, depth: Tensor) -> Tensor:
    return rgb @ rgb


def test_network_that_returns_no_map_or_fails_is_named(sample: DepthSample, tmp_path: Path) -> None:
    inputs = {"rgb": "image", "depth": "up"}
    with pytest.raises(ValueError, match=r"mine.pt: expected a map of 32 x 48, got \(1, 1, 16, 48\)"):
        NetworkFile(script(tmp_path, small), inputs)(sample)
    with pytest.raises(ValueError, match=r"mine.pt: expected a network for 32 x 48 pixels, it failed"):
        NetworkFile(script(tmp_path, failing), inputs)(sample)
