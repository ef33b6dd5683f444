"""Normals of a depth map, and renderings: under the paper's four lights, and under a softer one for pictures."""

import math

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn import functional

from dsr.geometry.lights import LIGHT_NAMES, LIGHTS, VIEWING_LIGHT
from dsr.utils.compute_device import constant

# brightness of a surface that faces away from the light and of one that faces it, and the exponent between them
VIEWING_TONES = (0.06, 0.9, 1.25)
_SHORTEST, _LONGEST = 128, 256  # least and largest longer side of a panel, pixels
_LABEL = 16  # height of the line above a panel, pixels


def depth_to_normals(depth: Tensor, rays: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Return the unit normals of the surface, (B, 3, H, W), facing the camera (n . r < 0).

    First-order forward differences along u and v, the last column's and row's differences repeated: n = dP/dv x dP/du,
    normalised (Voynov et al. 2019, section 3, with the border as its authors evaluate it). With z' and z'' the depths
    of the neighbours along u and v it is, up to a positive factor, n = (fx (z' - z) z'', fy (z'' - z) z',
    -z' z'' - x n_x - y n_y), as n . r = -z' z''.

    Depth is (B, 1, H, W) in metres; normals that need a NaN are NaN. Rays are (B or 1, 3, H, W), of a pinhole camera
    with z = 1. ``dtype`` is that of the result, None for the depth's; differences, where digits cancel, are taken in
    the depth's.
    """
    if min(depth.shape[-2:]) < 2:
        raise ValueError(f"normals: expected a map of at least 2 x 2 pixels, got {tuple(depth.shape[-2:])}")
    dtype = dtype or depth.dtype
    step_u = _repeat_last(depth.diff(dim=-1).to(dtype), dim=-1)
    step_v = _repeat_last(depth.diff(dim=-2).to(dtype), dim=-2)
    values = depth.to(dtype)  # of the next pixel; the last pixel's is the one before it
    along_u = torch.cat((values[..., 1:], values[..., -2:-1]), dim=-1)
    along_v = torch.cat((values[..., 1:, :], values[..., -2:-1, :]), dim=-2)
    x, y, _ = rays.split(1, dim=-3)
    height, width = depth.shape[-2:]
    fx = ((width - 1) / (x[..., :1, -1:] - x[..., :1, :1])).to(dtype)
    fy = ((height - 1) / (y[..., -1:, :1] - y[..., :1, :1])).to(dtype)
    x, y = x.to(dtype), y.to(dtype)
    nx = fx * step_u * along_v
    ny = fy * step_v * along_u
    nz = -(along_u * along_v + x * nx + y * ny)
    normals = torch.cat((nx, ny, nz), dim=-3)
    return normals / length(normals)


def length(vectors: Tensor) -> Tensor:
    """Return the lengths of (..., 3, H, W) vectors, (..., 1, H, W); much faster on the CPU than ``vector_norm``."""
    x, y, z = vectors.split(1, dim=-3)
    return (x.square() + y.square() + z.square()).sqrt()


def angle_between(first: Tensor, second: Tensor) -> Tensor:
    """Return the angle between unit vectors, (..., 3, H, W), in degrees, (..., 1, H, W), by the precise chord."""
    return torch.rad2deg(2 * (length(first - second) / 2).clamp(max=1).asin())


def normal_mask(mask: Tensor) -> Tensor:
    """Return the mask of normals of a mask of depth, (B, 1, H, W): each needs its pixel and two neighbours."""
    along_u = _repeat_last(mask[..., :, 1:] & mask[..., :, :-1], dim=-1)
    along_v = _repeat_last(mask[..., 1:, :] & mask[..., :-1, :], dim=-2)
    return along_u & along_v


def _repeat_last(values: Tensor, dim: int) -> Tensor:
    """Append a copy of the last slice along ``dim``."""
    return torch.cat((values, values.narrow(dim, -1, 1)), dim)


def lights(*, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
    """Return the paper's lights e1..e4 in the camera frame, (4, 3) unit vectors that point from surface to light."""
    return constant(tuple(light.direction for light in LIGHTS.values()), dtype, torch.device(device))


def shade(normals: Tensor, directions: Tensor) -> Tensor:
    """Return the unclipped Lambertian shading e . n in [-1, 1], (B, L, H, W), for (L, 3) unit vectors to lights."""
    return torch.einsum("lc,bchw->blhw", directions, normals)


def render(normals: Tensor) -> Tensor:
    """Return the renderings clip(e . n, 0, 1) under the four lights, (B, 4, H, W) in [0, 1]."""
    return shade(normals, lights(dtype=normals.dtype, device=normals.device)).clamp(0, 1)


def render_for_viewing(normals: Tensor) -> Tensor:
    """Return a rendering for pictures, (B, 1, H, W) in (0, 1), in which floors keep tone, as in "half Lambert"."""
    low, high, exponent = VIEWING_TONES
    cosine = shade(normals, torch.tensor([VIEWING_LIGHT], dtype=normals.dtype, device=normals.device))
    return low + (high - low) * ((1 + cosine) / 2).clamp(0, 1) ** exponent


def comparison(depth: Tensor, truth: Tensor | None, rays: Tensor, rgb: Tensor, depth_lr: Tensor) -> Tensor:
    """Return labelled panels of a result, its input and the true depth, (3, H', W') uint8; holes are black.

    The first row has the photo, the input, the result and the truth, in the grey levels of the truth's range of depth;
    below it are the renderings under the four lights, a column each: those of the result, of the truth, and twice their
    difference. Depth is (1, 1, h, w) in metres, the photo (1, 3, H, W) in [0, 1].
    """
    size = depth.shape[-2:]
    shown = depth if truth is None else truth
    low, high = float(shown.nan_to_num(math.inf).min()), float(shown.nan_to_num(-math.inf).max())

    def grey(values: Tensor) -> Tensor:
        return (1 - 0.9 * (values - low) / max(high - low, 1e-9)).clamp(0, 1)[0]

    height, width = depth_lr.shape[-2:]
    coarse = functional.interpolate(depth_lr.to(depth), size, mode="nearest")
    rows = [{"photo": rgb[0], f"input, {width} x {height}": grey(coarse), "result": grey(depth)}]
    lit = {"result": render(depth_to_normals(depth, rays))[0]}  # (4, H, W)
    if truth is not None:
        rows[0]["truth"] = grey(truth)
        lit["truth"] = render(depth_to_normals(truth, rays))[0]
        lit["2 |difference|"] = (2 * (lit["result"] - lit["truth"]).abs()).clamp(max=1)
    for kind, panels in lit.items():
        rows.append({f"{kind}, {name}": each[None] for name, each in zip(LIGHT_NAMES, panels, strict=True)})
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
