"""``dsr export``: a network as a file for programs without PyTorch."""

from __future__ import annotations

from rich.console import Console

from dsr.app.requests import ExportRequest
from dsr.cli.command import Command

_DESCRIPTION = """\
Write a method's network as an ONNX file, which takes a photo and a depth map of any size, and check it with
onnxruntime. The libraries are an extra: pip install dsr[onnx]."""
_EXAMPLES = """\
examples:
  dsr export --onnx facets_x4.onnx
  dsr export --onnx facets_x1.onnx --scale 1               for depth maps of the photo's own size
  dsr export --onnx msg_v_x8.onnx --method msg_v --scale 8
  dsr export --onnx mine.onnx --method pdn --weights outputs/train/mine/weights.safetensors

Inputs: photo (1, 3, H, W) in 0..1, inverse_depth (1, 1, h, w) in 1 / metres, valid (1, 1, h, w) bool, with H = N h and
W = N w. Output: inverse_depth_hr (1, 1, H, W); of facets also relative_error, that of the depth, and angle_error in
degrees. docs/export.md has a program that runs such a file.
"""


def _run(request: ExportRequest, console: Console, _: object) -> list[str]:
    """Write the file."""
    from dsr.app.export import export_onnx  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return export_onnx(request, console)


add = Command(
    "export", "a network as a file for programs without PyTorch", ExportRequest, _run, _EXAMPLES, _DESCRIPTION
).add
