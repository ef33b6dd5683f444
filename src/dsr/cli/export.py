"""``dsr export``: write a network as an ONNX file."""

from rich.console import Console

import dsr
from dsr.app.requests import ExportRequest
from dsr.methods.networks.network_file import OnnxGraph, write_onnx
from dsr.methods.recipe import read_recipe
from dsr.utils.console import show
from dsr.utils.progress import megabytes


def export_onnx(request: ExportRequest, console: Console) -> list[str]:
    """Write the file, check it, and show its inputs and outputs."""
    net = read_recipe(request.method, None, request.directories).with_weights(request.weights).network(request.scale)
    graph = OnnxGraph(net, request.scale)
    facts = {"dsr": dsr.__version__, "method": request.method, "scale": request.scale, "network": type(net).__name__}
    difference = write_onnx(request.path, graph, facts)
    size = megabytes(request.path.stat().st_size)
    lines = (
        f"{request.method} x{request.scale} -> {request.path}, {size}",
        f"  inputs: photo (1, 3, H, W), inverse_depth and valid (1, 1, H / {request.scale}, W / {request.scale})",
        f"  outputs: {', '.join(graph.outputs)} (1, 1, H, W)",
        f"  onnxruntime differs from PyTorch by at most {difference:.1g} of the range",
    )
    for line in lines:
        show(console, line)
    return []
