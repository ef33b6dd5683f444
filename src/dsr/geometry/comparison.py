"""A picture of a result beside its input and the true depth, for logs."""

from __future__ import annotations

import math

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn import functional

from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.shading import render
from dsr.geometry.surface import depth_to_normals

_SHORTEST, _LONGEST = 128, 256
"""The longer side of a panel is at least and at most so long, pixels."""
_LABEL = 16
"""Height of the line above a panel, pixels."""


def comparison(depth: Tensor, truth: Tensor | None, rays: Tensor, rgb: Tensor, depth_lr: Tensor) -> Tensor:
    """Return labelled panels of a result, its input and the true depth; holes are black.

    The first row has the photo, the input, the result and the truth, in the grey levels of the truth's range of depth
    (near is bright); below it are the renderings under the four lights e1 .. e4, a column each: those of the result, of
    the truth, and twice their difference.

    Args:
        depth: (1, 1, H, W) in metres.
        truth: true depth, (1, 1, H, W) in metres, or None: there are only the photo, the input and the result.
        rays: (1, 3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.
        rgb: the photo, (1, 3, H, W) in [0, 1].
        depth_lr: the input, (1, 1, h, w) in metres.

    Returns:
        (3, rows x panel height, 4 x panel width) uint8; the longer side of a panel has 128 to 256 pixels.

    """
    size = depth.shape[-2:]
    shown = depth if truth is None else truth
    low, high = (float(value) for value in (shown.nan_to_num(math.inf).min(), shown.nan_to_num(-math.inf).max()))

    def grey(values: Tensor) -> Tensor:
        return (1 - 0.9 * (values - low) / max(high - low, 1e-9)).clamp(0, 1)

    height, width = depth_lr.shape[-2:]
    coarse = functional.interpolate(depth_lr.to(depth), size, mode="nearest")
    rows = [{"photo": rgb[0], f"input, {width} x {height}": grey(coarse)[0], "result": grey(depth)[0]}]
    result = render(depth_to_normals(depth, rays))[0]  # (4, H, W)
    rows.append({f"result, {name}": each[None] for name, each in zip(LIGHT_NAMES, result, strict=True)})
    if truth is not None:
        rows[0]["truth"] = grey(truth)[0]
        real = render(depth_to_normals(truth, rays))[0]
        rows.append({f"truth, {name}": each[None] for name, each in zip(LIGHT_NAMES, real, strict=True)})
        difference = (2 * (result - real).abs()).clamp(max=1)
        rows.append({f"2 |difference|, {name}": each[None] for name, each in zip(LIGHT_NAMES, difference, strict=True)})
    return torch.cat([_row(each) for each in rows], dim=-2)


def _row(panels: dict[str, Tensor]) -> Tensor:
    """Return up to four panels beside each other with their labels, (3, H, W) uint8."""
    columns = [torch.cat([_label(name, panel.shape[-1]), panel], dim=-2)
               for name, panel in ((name, _panel(values)) for name, values in panels.items())]  # fmt: skip
    columns += [torch.zeros_like(columns[0])] * (len(LIGHT_NAMES) - len(columns))
    return torch.cat(columns, dim=-1)


def _panel(values: Tensor) -> Tensor:
    """Return an image, (C, H, W) in [0, 1] with NaN in holes, as (3, h, w) uint8 of the size of panels."""
    longest = max(values.shape[-2:])
    factor, repeats = math.ceil(longest / _LONGEST), math.ceil(_SHORTEST / longest)
    values = values.detach().float().cpu().nan_to_num(0)[None]
    reduced = functional.avg_pool2d(values, factor, ceil_mode=True, count_include_pad=False)[0]
    enlarged = reduced.repeat_interleave(repeats, dim=-2).repeat_interleave(repeats, dim=-1)
    return (255 * enlarged).round().to(torch.uint8).expand(3, -1, -1)


def _label(text: str, width: int) -> Tensor:
    """Return a line of white text on black, (3, 16, width) uint8; what does not fit is cut off."""
    line = Image.new("L", (width, _LABEL))
    ImageDraw.Draw(line).text((2, 1), text, fill=255, font=ImageFont.load_default(11))
    return torch.frombuffer(bytearray(line.tobytes()), dtype=torch.uint8).view(1, _LABEL, width).expand(3, -1, -1)
