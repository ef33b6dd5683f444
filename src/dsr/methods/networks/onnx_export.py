"""The networks as ONNX files, for programs without PyTorch.

A file takes a photo and a map of inverse depth of any size, and holds everything between: filling of holes,
normalisation, the network, and the way back to the unit of the input. It is one pass of the network: test-time
augmentation, tiles, and the resizing for ratios between the factors are left to the caller.

PyTorch's tracing exporter makes the graph. The other one (``dynamo=True``) gives the same values for the networks of
fixed ranges; for Facets it needs minutes instead of seconds, and rules out sizes because of layouts in memory.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dsr.methods.images import pad_to_multiple
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.network import DisparityNetwork
from dsr.utils.files import replacing
from dsr.utils.guards import refusing
from dsr.utils.versions import how_to_install

INPUTS = ("photo", "inverse_depth", "valid")
RESULT = "inverse_depth_hr"
ERRORS = ("relative_error", "angle_error")
_OPSET = 18  # the first one whose Resize knows the border of Keys' kernel
_TRACED, _CHECKED = (24, 40), (19, 33)  # low-resolution heights and widths that the graph is traced and checked with
_TOLERANCE = 1e-4  # largest difference between the graph's and the network's result, over the range of the result


class OnnxGraph(nn.Module):
    """What an ONNX file computes, as a module: the network at its own scale, or at 1 if it serves that, too."""

    def __init__(self, net: DisparityNetwork, scale: int) -> None:
        super().__init__()
        if scale != net.scale and not net.serves(net.scale, scale):
            raise ValueError(f"scale: expected {net.scale}, the network's, got {scale}")
        self.net, self.scale = net.requires_grad_(False), scale
        self.outputs = (RESULT, *ERRORS) if isinstance(net, FacetsUNet) else (RESULT,)
        self.eval()

    def forward(self, photo: Tensor, inverse_depth: Tensor, valid: Tensor) -> tuple[Tensor, ...]:
        """Return high-resolution inverse depth, (1, 1, H, W) in the unit of the input, and the expected errors.

        The errors are those of Facets: the expected absolute error of the depth over the depth, and that of the normal
        in degrees, (1, 1, H, W) each. The photo is (1, 3, scale h, scale w) in 0..1, inverse depth (1, 1, h, w),
        positive where ``valid``, of the same shape.
        """
        height, width = photo.shape[-2:]
        values = torch.where(valid, inverse_depth, torch.nan)
        if not isinstance(self.net, FacetsUNet):
            return (self.net.upsample(photo, values),)
        if self.scale == 1:  # its pixels are averaged in pairs
            photo, values = pad_to_multiple(photo, 2), pad_to_multiple(values, 2)
        answer = self.net.answer(photo, values)
        results = (answer.disparity, answer.spread, answer.angle * (180 / math.pi))
        return tuple(each[..., :height, :width] for each in results)


@torch.no_grad()
def write_onnx(path: Path, graph: OnnxGraph, facts: Mapping[str, Any]) -> float:
    """Write a network as an ONNX file with facts as metadata, atomically, after comparing its results.

    Return the largest difference for a size that it was not traced with, over the range of the result; a ValueError if
    they differ, or if `onnx` or `onnxruntime` is not installed.
    """
    onnx, runtime = import_library("onnx", "--onnx"), import_library("onnxruntime", "--onnx")
    with replacing(path) as temporary:
        _trace(temporary, graph)
        model = onnx.load(str(temporary))
        onnx.helper.set_model_props(model, {key: str(value) for key, value in facts.items()})
        onnx.save(model, str(temporary))
        session = runtime.InferenceSession(str(temporary), providers=["CPUExecutionProvider"])
        inputs = example_inputs(_CHECKED, graph.scale)
        found = session.run(None, {name: each.numpy() for name, each in zip(INPUTS, inputs, strict=True)})
        differences = []
        for mine, theirs in zip(found, graph(*inputs), strict=True):
            value_range = float(theirs.max() - theirs.min()) or 1
            differences.append((torch.from_numpy(mine) - theirs).abs().max() / value_range)
        difference = float(torch.stack(differences).max())
        if not difference <= _TOLERANCE:
            raise ValueError(
                f"{path}: expected the network's results to {_TOLERANCE:g} of the range, got a difference of "
                f"{difference:g}"
            )
    return difference


def example_inputs(size_lr: tuple[int, int], scale: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return a photo, inverse depth and a valid mask to try a graph with: a disc before a wall, with holes."""
    height, width = size_lr
    rows, columns = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    noise = torch.Generator().manual_seed(0)
    disc = (rows - 0.5) ** 2 + (columns - 0.5) ** 2 < 0.1
    inverse = 0.4 + 0.1 * rows + 0.2 * columns + 0.3 * disc + 0.002 * torch.rand(size_lr, generator=noise)
    valid = torch.ones(size_lr, dtype=torch.bool)
    valid[height // 4 : height // 2, width // 3 : width // 2] = False
    valid[0] = False
    photo = torch.rand((1, 3, scale * height, scale * width), generator=noise)
    return photo, inverse[None, None], valid[None, None]


def _trace(path: Path, graph: OnnxGraph) -> None:
    """Write the graph of a network, with the operators that the exporter lacks."""
    low = {2: "h", 3: "w"}
    high = low if graph.scale == 1 else {2: "H", 3: "W"}
    added: dict[str, Callable[..., Any]] = {
        "aten::asinh": lambda context, x: context.op("Asinh", x),
        "aten::_upsample_bicubic2d_aa": _bicubic,
    }
    for name, function in added.items():
        torch.onnx.register_custom_op_symbolic(name, function, _OPSET)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of sizes that a trace might fix, which the check would find
            torch.onnx.export(
                graph,
                example_inputs(_TRACED, graph.scale),
                str(path),
                input_names=list(INPUTS),
                output_names=list(graph.outputs),
                dynamic_axes={"photo": high, "inverse_depth": low, "valid": low, **dict.fromkeys(graph.outputs, high)},
                opset_version=_OPSET,
                dynamo=False,
            )
    finally:
        for name in added:
            torch.onnx.unregister_custom_op_symbolic(name, _OPSET)


def _bicubic(context: Any, x: Any, size: Any, _align: Any, *_scales: Any) -> Any:
    """Return the node of an enlargement with Keys' kernel, renormalised at the border."""
    start = context.op("Constant", value_t=torch.tensor([0]))
    end = context.op("Constant", value_t=torch.tensor([2]))
    lead = context.op("Slice", context.op("Shape", x), start, end)
    sizes = context.op("Concat", lead, context.op("Cast", size, to_i=7), axis_i=0)  # 7: int64
    empty = context.op("Constant", value_t=torch.tensor([], dtype=torch.float32))
    keys = {"mode_s": "cubic", "cubic_coeff_a_f": -0.5, "exclude_outside_i": 1}
    return context.op("Resize", x, empty, empty, sizes, coordinate_transformation_mode_s="half_pixel", **keys)


def import_library(name: str, wanted_by: str) -> Any:
    """Return a library of the extra ``onnx``; ``wanted_by`` is what the user gave that needs it."""
    with refusing(f"{wanted_by}: expected the library {name}; {how_to_install('onnx')}", ImportError):
        return importlib.import_module(name)
