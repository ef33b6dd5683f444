"""Networks as ONNX files: those of others as a method, and those of dsr for programs without PyTorch.

What a network's authors did to its inputs is no part of its file: which quantity its depth is, what became 0..1, and
how the map was enlarged. The configuration of :class:`NetworkFile` declares it.

A file that dsr writes takes a photo and a map of inverse depth of any size, and holds everything between: filling of
holes, normalisation, one pass of the network, and the way back to the unit of the input. PyTorch's tracing exporter
makes the graph. The other one (``dynamo=True``) needs minutes for Facets, and rules out sizes.
"""

import importlib
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.camera import RANGE_TYPES
from dsr.methods.base import Abilities, Cost, Method
from dsr.methods.external import QUANTITIES, Fit, describe_fit, fit_to_map, from_depth, to_depth, within_limits
from dsr.methods.images import grey, inpaint, normalise, normalise_imagenet, pad_to_multiple, resize_bicubic
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.network import DisparityNetwork
from dsr.sample import DepthSample
from dsr.utils.files import replacing
from dsr.utils.guards import expect_one_of, refusing
from dsr.utils.progress import Steps
from dsr.utils.ratios import round_ratio
from dsr.utils.versions import hash_once, how_to_install

_IMAGES: Mapping[str, Callable[[Tensor], Tensor]] = {
    "image": lambda rgb: rgb,
    "image255": lambda rgb: 255 * rgb,
    "imagenet": normalise_imagenet,
    "grey": grey,
}
_MAPS = ("lr", "up", "valid")
CONTENTS = (*_IMAGES, *_MAPS)
SAME, RESIDUAL, MEASURED = "same", "residual", "measured"
OUTPUTS = (SAME, RESIDUAL, *QUANTITIES)
INPUTS = ("photo", "inverse_depth", "valid")
RESULT = "inverse_depth_hr"
ERRORS = ("relative_error", "angle_error")
_OPSET = 18  # the first one whose Resize knows the border of Keys' kernel
_TRACED, _CHECKED = (24, 40), (19, 33)  # low-resolution heights and widths that the graph is traced and checked with
_TOLERANCE = 1e-4  # largest difference between the graph's and the network's result, over the range of the result


class NetworkFile(Method):
    """A method that is a network's file; docs/evaluate.md explains its options."""

    abilities = Abilities(ratios="any", own_size=True, cost=Cost(1000))

    def __init__(
        self,
        path: str,
        inputs: Mapping[str, str],
        range_type: str = "disparity",
        range: str | Sequence[float] | None = MEASURED,  # noqa: A002 - the key's name
        output: str = SAME,
        fit: str | None = None,
        result: str | None = None,
        size: Sequence[int] | None = None,
        multiple: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        self._path = Path(path).expanduser()
        if self._path.suffix.lower() != ".onnx" or not self._path.is_file():
            raise ValueError(f"path: expected an existing file *.onnx, got {path}")
        expect_one_of("range_type", range_type, QUANTITIES)
        expect_one_of("output", output, OUTPUTS)
        expect_one_of("fit", fit, (None, *get_args(Fit)))
        for name, content in inputs.items():
            expect_one_of(f"inputs.{name}", content, CONTENTS)
        self._inputs, self._limits = dict(inputs), None
        if range not in (None, MEASURED):
            if isinstance(range, str) or len(range) != 2 or not range[0] < range[1]:
                raise ValueError(f"range: expected {MEASURED}, null or two numbers that rise, got {range!r}")
            self._limits = torch.tensor([float(each) for each in range], dtype=torch.float64).view(1, 2, 1, 1)
        if multiple < 1:
            raise ValueError(f"multiple: expected 1 or more, got {multiple}")
        sees_map = set(self._inputs.values()) & set(_MAPS) or output == RESIDUAL
        if size is not None and (len(size) != 2 or min(size) < 1 or sees_map):
            raise ValueError(f"size: expected null, or [height, width] for inputs {', '.join(_IMAGES)}, got {size}")
        self._size = None if size is None else (int(size[0]), int(size[1]))
        self.name = self._path.stem
        self.range_type = range_type if range_type in RANGE_TYPES else "disparity"
        self._quantity, self._scaled, self._output, self._fit = range_type, range is not None, output, fit
        self._result, self._multiple, self.device = result, multiple, torch.device(device)
        self._files = [self._path, *self._weights()]
        self._sessions: dict[int, Any] = {}  # by process: a worker has one of its own
        self._session(threads=1)  # its errors, before anything is computed

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres on the sample's device."""
        photo_size = sample.camera.height, sample.camera.width
        size = self._size or photo_size
        rgb = sample.rgb.to(self.device, torch.float32)[None]
        if size != photo_size:
            rgb = resize_bicubic(rgb, size).clamp(0, 1)
        values_lr = inpaint(from_depth(sample.depth_lr, sample, self._quantity)[None]).to(self.device)
        low, lowest, span = normalise(values_lr, self._limits) if self._scaled else (values_lr, 0.0, 1.0)
        enlarged = resize_bicubic(low.float(), photo_size)
        maps = {"lr": low.float(), "up": enlarged, "valid": sample.mask_lr[None].to(self.device)}
        inputs = {}
        for name, content in self._inputs.items():
            picture = maps[content] if content in maps else _IMAGES[content](rgb)
            inputs[name] = self._padded(picture, size).cpu().numpy()
        if os.getpid() not in self._sessions:
            self._sessions[os.getpid()] = self._session(torch.get_num_threads())
        session = self._sessions[os.getpid()]
        with refusing(f"{self._path}: expected a network for {size[0]} x {size[1]} pixels, it failed", Exception):
            found = torch.from_numpy(session.run([self._result or session.get_outputs()[0].name], inputs)[0])
        found = found.reshape(1, 1, *found.shape[-2:]) if found.numel() == found.shape[-2:].numel() else found
        if found.dim() != 4 or found.shape[:2] != (1, 1) or found.shape[-2] < size[0] or found.shape[-1] < size[1]:
            raise ValueError(f"{self._path}: expected a map of {size[0]} x {size[1]}, got {tuple(found.shape)}")
        values, quantity = found[..., : size[0], : size[1]].to(values_lr), self._output
        if self._output == RESIDUAL:
            values = values + enlarged
        if self._output in (SAME, RESIDUAL):
            values, quantity = values * span + lowest, self._quantity
        if size != photo_size:
            factor = photo_size[1] / size[1] if quantity == "disparity" else 1.0  # in pixels of the photo
            values = functional.interpolate(values, photo_size, mode="bilinear", align_corners=False) * factor
        if progress is not None:
            progress(1, 1)
        if self._fit is None:
            return to_depth(values[0], sample.camera, quantity).to(sample.depth_lr)
        fitted = fit_to_map(values[0].cpu(), sample, quantity, self._fit, self._path)
        return within_limits(to_depth(fitted, sample.camera, quantity)).to(sample.depth_lr)

    def describe(self, sample: DepthSample) -> str:
        """Return how the result was fitted."""
        return describe_fit(self._fit)

    def content(self, dataset: str, scene: str, scale: float) -> str:
        """Return the SHA-256 of the network's file, and of those that hold its weights."""
        return ", ".join(map(hash_once, self._files))

    def _weights(self) -> list[Path]:
        """Return the files beside an ONNX file that hold its weights, as those of more than 2 GB do."""
        onnx = import_library("onnx", f"method.path={self._path}")
        with refusing(f"{self._path}: expected an ONNX file, got a damaged or foreign one", Exception):
            weights = onnx.load(str(self._path), load_external_data=False).graph.initializer
            outside = [entry.value for each in weights for entry in each.external_data if entry.key == "location"]
        found = [self._path.parent / name for name in dict.fromkeys(outside)]
        for file in found:
            if not file.is_file():
                raise ValueError(f"{self._path}: expected its weights in {file}, there is no such file")
        return found

    def _padded(self, picture: Tensor, size: tuple[int, int]) -> Tensor:
        """Return a picture continued to as many pixels as make the photo's size a multiple."""
        ratio = size[0] / picture.shape[-2]
        down, across = (-each % self._multiple / ratio for each in size)
        if not down.is_integer() or not across.is_integer():
            raise ValueError(f"multiple: expected one that x{round_ratio(ratio)} divides, got {self._multiple}")
        return functional.pad(picture.float(), (0, int(across), 0, int(down)), mode="replicate").to(picture.dtype)

    def _session(self, threads: int) -> Any:
        """Return a session of onnxruntime, whose inputs and outputs are those that are declared."""
        runtime = import_library("onnxruntime", f"method.path={self._path}")
        options = runtime.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = threads, 3
        providers = ["CUDAExecutionProvider"] if self.device.type == "cuda" else []
        with refusing(f"{self._path}: expected an ONNX file, got a damaged or foreign one", Exception):
            session = runtime.InferenceSession(str(self._path), options, providers=[*providers, "CPUExecutionProvider"])
        names = [each.name for each in session.get_inputs()]
        if set(names) != set(self._inputs):
            raise ValueError(f"inputs: expected {', '.join(names)}, as {self._path} has, got {', '.join(self._inputs)}")
        results = [each.name for each in session.get_outputs()]
        if self._result is not None and self._result not in results:
            raise ValueError(f"result: expected one of {', '.join(results)}, got {self._result!r}")
        return session


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
        """Return high-resolution inverse depth, (1, 1, H, W) in the unit of the input, and Facets' expected errors.

        These are the absolute error of the depth over the depth, and that of the normal in degrees. The photo is
        (1, 3, scale h, scale w) in 0..1, inverse depth (1, 1, h, w), positive where ``valid``.
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
    """Write a network as an ONNX file with facts as metadata, atomically; a ValueError if its results differ.

    Return the largest difference for a size that it was not traced with, over the range of the result.
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
            raise ValueError(f"{path}: expected results within {_TOLERANCE:g} of the range, got {difference:g}")
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
