"""Renderings under the paper's four lights, and under a softer one for pictures that people look at."""

from __future__ import annotations

import math

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn import functional

from dsr.geometry.lights import LIGHT_NAMES, LIGHTS, VIEWING_LIGHT
from dsr.geometry.surface import depth_to_normals

_SHORTEST, _LONGEST = 128, 256  # least and largest longer side of a panel, pixels
_LABEL = 16  # height of the line above a panel, pixels


def lights(*, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
    """Return the paper's lights e1..e4 in the camera frame, (4, 3) unit vectors that point from surface to light.

    e1, e2, e3 are orthonormal, so renderings under them are the normal map in another basis; e4 is frontal.
    """
    return torch.tensor([light.direction for light in LIGHTS.values()], dtype=dtype, device=device)


def shade(normals: Tensor, directions: Tensor) -> Tensor:
    """Return the unclipped Lambertian shading e . n in [-1, 1], (B, L, H, W), for (L, 3) unit vectors to lights."""
    return torch.einsum("lc,bchw->blhw", directions, normals)


def render(normals: Tensor) -> Tensor:
    """Return the renderings clip(e . n, 0, 1) under the four lights, (B, 4, H, W) in [0, 1]."""
    return shade(normals, lights(dtype=normals.dtype, device=normals.device)).clamp(0, 1)


# brightness of a surface that faces away from the light and of one that faces it, and the exponent between them
VIEWING_TONES = (0.06, 0.9, 1.25)


def render_for_viewing(normals: Tensor) -> Tensor:
    """Return a rendering, (B, 1, H, W) in (0, 1), in which no direction is clipped: floors and ceilings keep tone.

    The cosine to the light is mapped to a brightness over its whole range from -1 to 1, as in the "half Lambert"
    shading of Mitchell et al., "Shading in Valve's Source Engine", SIGGRAPH 2006 course. It is for pictures alone;
    metrics and the renderings e1 to e4 use :func:`render`.
    """
    low, high, exponent = VIEWING_TONES
    cosine = shade(normals, torch.tensor([VIEWING_LIGHT], dtype=normals.dtype, device=normals.device))
    return low + (high - low) * ((1 + cosine) / 2).clamp(0, 1) ** exponent


def comparison(depth: Tensor, truth: Tensor | None, rays: Tensor, rgb: Tensor, depth_lr: Tensor) -> Tensor:
    """Return labelled panels of a result, its input and the true depth, (3, H', W') uint8; holes are black.

    The first row has the photo, the input, the result and the truth, in the grey levels of the truth's range of depth
    (near is bright); below it are the renderings under the four lights e1 .. e4, a column each: those of the result, of
    the truth, and twice their difference. Without a truth there are only the photo, the input and the result. Depth is
    (1, 1, h, w) in metres, the photo (1, 3, H, W) in [0, 1].
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
    """Return up to four images, (C, H, W) in [0, 1] with NaN in holes, beside each other with labels, (3, H', W')."""
    columns = []
    for name, values in panels.items():
        longest = max(values.shape[-2:])
        factor, repeats = math.ceil(longest / _LONGEST), math.ceil(_SHORTEST / longest)
        opaque = values.detach().float().cpu().nan_to_num(0)[None]
        reduced = functional.avg_pool2d(opaque, factor, ceil_mode=True, count_include_pad=False)[0]
        enlarged = reduced.repeat_interleave(repeats, dim=-2).repeat_interleave(repeats, dim=-1)
        panel = (255 * enlarged).round().to(torch.uint8).expand(3, -1, -1)
        line = Image.new("L", (panel.shape[-1], _LABEL))  # what does not fit is cut off
        ImageDraw.Draw(line).text((2, 1), name, fill=255, font=ImageFont.load_default(11))
        label = torch.frombuffer(bytearray(line.tobytes()), dtype=torch.uint8).view(1, _LABEL, -1).expand(3, -1, -1)
        columns.append(torch.cat([label, panel], dim=-2))
    columns += [torch.zeros_like(columns[0])] * (len(LIGHT_NAMES) - len(columns))
    return torch.cat(columns, dim=-1)
