"""``dsr export``: a network as a file for programs without PyTorch."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

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


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "export",
        help="a network as a file for programs without PyTorch",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--onnx", type=Path, required=True, metavar="FILE", help="the file to write")
    parser.add_argument("--method", default="facets", metavar="NAME", help="facets (default), msg_v, pdn, ddrnet, ...")
    parser.add_argument("--scale", type=int, default=4, metavar="N", help="upsampling factor (default: 4)")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="of a training (default: those of the method)")
    parser.add_argument(
        "--config-dir",
        action="append",
        type=Path,
        default=[],
        metavar="DIR",
        help="a folder with a method/ of your own YAML files; may be repeated",
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Write the file."""
    from dsr.app.requests import ExportRequest  # noqa: PLC0415 - it is needed for few commands

    request = ExportRequest(options.onnx, options.method, options.scale, options.weights, tuple(options.config_dir))
    from dsr.app.export import export_onnx  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    export_onnx(request, console)
    return []
