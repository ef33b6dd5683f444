"""Depth maps on other pixels without blurring depth steps: of another size, and as another camera sees them.

*Another size*: along each axis, a line is fitted to the old pixels around each new one, with triangular weights wide
enough for antialiasing; the new pixel is the value of the line at its centre. Planes stay planes, up to the border. A
second difference above ``JUMP`` times the value at one of these old pixels is a depth step: the new pixel then takes,
of the four old ones around its centre, the value nearest to the fitted one.

*Another camera*: neighbouring pixels of one surface span triangles, two per square of four pixels, which are rasterised
with a z-buffer, so surfaces have no pinholes at any ratio of the resolutions. Pixels beside a depth step, a hole or the
border cover the square of their own area instead, continued at the slope of their surface.
"""

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera

JUMP = 0.02  # relative second difference of inverse depth; between 0.01 and 0.04 scores hardly change
# radius in old pixels beyond the outermost centre, for new pixels outside it: a line needs two pixels
_BORDER_RADIUS = 1.25
_STRIP = 256  # rows that are resized at a time
# change of inverse depth between neighbours, beyond the slopes on both sides, that is a step; relative to it
STEP = 0.03
_NEAREST = 1e-3  # nearest depth in metres that the other camera sees
_RIM = 0.02  # relative difference of depth from which a pixel's square may hide a triangle
_INSIDE = -1e-6  # smallest barycentric coordinate inside a triangle: neighbouring triangles leave no gap
_FRAGMENTS = 1 << 21  # pairs of triangle and pixel that are rasterised at a time


def resize_inverse_depth(inverse: Tensor, size: tuple[int, int], jump: float = JUMP) -> Tensor:
    """Resize inverse depth, (1, H, W) in 1/m without holes; infinite ``jump`` averages across depth steps, too."""
    if tuple(inverse.shape[-2:]) == size:
        return inverse
    rows, row_weights = _find_taps(inverse.shape[-2], size[0], inverse)
    columns = _find_taps(inverse.shape[-1], size[1], inverse)
    parts = []
    for index, weight in zip(rows.split(_STRIP), row_weights.split(_STRIP), strict=True):
        first, end = max(int(index.min()) - 1, 0), int(index.max()) + 2  # a row more for second differences
        parts.append(_resize_strip(inverse[:, first:end], (index - first, weight), columns, jump))
    return torch.cat(parts, dim=-2)


def pad_inverse_depth(inverse: Tensor, factor: int) -> Tensor:
    """Pad inverse depth, (..., H, W), at the right and the bottom to a multiple of a factor; planes are continued."""
    for dim in (-2, -1):
        more, size = -inverse.shape[dim] % factor, inverse.shape[dim]
        if not more:
            continue
        last = inverse.narrow(dim, size - 1, 1)
        slope = (last - inverse.narrow(dim, max(size - 1 - factor, 0), 1)) / min(factor, max(size - 1, 1))
        slope = torch.where(slope.abs() * factor <= 0.1 * last, slope, 0)  # a depth step or a hole, not a plane
        steps = torch.arange(1, more + 1, dtype=inverse.dtype, device=inverse.device)
        further = last + slope * (steps[:, None] if dim == -2 else steps)
        inverse = torch.cat((inverse, further), dim)
    return inverse


def _find_taps(old: int, new: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the old pixels around each new one, the middle two beside its centre, and weights, (new, taps) each."""
    centre = (torch.arange(new, dtype=torch.float64) + 0.5) * (old / new) - 0.5
    outside = (centre - centre.clamp(0, old - 1)).abs()
    radius = torch.where(outside > 0, outside + _BORDER_RADIUS, 1.0).clamp(min=old / new)
    most = math.ceil(float(radius.max()))
    index = centre.floor().long()[:, None] + torch.arange(1 - most, most + 1)
    offset = index - centre[:, None]
    weight = (1 - offset.abs() / radius[:, None]).clamp(min=0)
    weight = torch.where((index >= 0) & (index < old), weight, 0)
    total = weight.sum(dim=1, keepdim=True)  # of the weighted least-squares line, the value at offset 0
    mean = (weight * offset).sum(dim=1, keepdim=True) / total
    variance = (weight * (offset - mean).square()).sum(dim=1, keepdim=True) / total
    slope = torch.where(variance > 1e-9, -mean / variance.clamp(min=1e-9), 0)
    weight = (weight / total * (1 + slope * (offset - mean))).to(like)
    return index.clamp(0, old - 1).to(like.device), weight


def _resize_strip(x: Tensor, rows: tuple[Tensor, Tensor], columns: tuple[Tensor, Tensor], jump: float) -> Tensor:
    """Resize (1, H, W) to (1, new rows, new columns)."""
    bend = torch.zeros_like(x)  # the larger of the second differences along the rows and the columns
    for dim in (-2, -1):
        if x.shape[dim] > 2:
            inner = bend.narrow(dim, 1, x.shape[dim] - 2)
            torch.maximum(inner, x.diff(n=2, dim=dim).abs_(), out=inner)
    mean, bend = _along(*_along(x, bend, *columns, -1), *rows, -2)
    best = torch.full_like(mean, torch.inf)
    nearest = mean.clone()
    beside = [index.T[index.shape[1] // 2 - 1 :][:2] for index, _ in (rows, columns)]
    for row, column in itertools.product(*beside):
        value = x[:, row][:, :, column]
        distance = (value - mean).abs()
        nearest = torch.where(distance < best, value, nearest)
        best = torch.minimum(best, distance)
    return torch.where(bend > jump * mean.abs(), nearest, mean)


def _along(x: Tensor, bend: Tensor, indices: Tensor, weights: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Return the weighted mean of the old pixels around each new one along ``dim``, and the largest bend."""
    size = list(x.shape)
    size[dim] = len(indices)
    mean, largest = x.new_zeros(size), x.new_zeros(size)
    weights = weights.T[:, :, None] if dim == -2 else weights.T
    for index, weight in zip(indices.T, weights, strict=True):
        mean.addcmul_(x.index_select(dim, index), weight)
        torch.maximum(largest, bend.index_select(dim, index) * (weight != 0), out=largest)
    return mean, largest


class _Corners(NamedTuple):
    """Triangles: their corners' places and inverse depth, (N, 3) each, clockwise as seen, and their maps, (N,)."""

    u: Tensor
    v: Tensor
    inverse: Tensor
    item: Tensor


def warp_depth(depth: Tensor, camera: Camera, transforms: Tensor, target: Camera) -> Tensor:
    """Return depth maps, (B, 1, h, w) metres, NaN in holes, as another camera sees their surfaces, (B, 1, H, W).

    The transforms, (B or 1, 4, 4) in metres, are rigid, from the frame of ``camera`` to that of ``target``. The result
    is the nearest surface at each pixel centre, NaN without one, in the dtype of ``depth``.
    """
    batch, size = depth.shape[0], (camera.height, camera.width)
    if min(size) < 2:
        raise ValueError(f"depth: expected a map of at least 2 x 2 pixels, got {size[0]} x {size[1]}")
    if depth.dim() != 4 or tuple(depth.shape[1:]) != (1, *size):
        raise ValueError(f"depth: expected shape (B, 1, {size[0]}, {size[1]}), got {tuple(depth.shape)}")
    if transforms.dim() != 3 or tuple(transforms.shape[1:]) != (4, 4) or len(transforms) not in (1, batch):
        raise ValueError(f"transforms: expected shape ({batch}, 4, 4), got {tuple(transforms.shape)}")
    inverse = depth[:, 0].double().reciprocal()  # (B, h, w)
    inverse = torch.where(inverse.isfinite() & (inverse > 0), inverse, torch.nan)
    transforms = transforms.to(inverse).expand(batch, 4, 4)
    across, down = _joined(inverse), _joined(inverse.mT).mT
    surfaces = _rasterise(_project(_triangles(inverse, across, down), camera, transforms, target), batch, target)
    rims = _rasterise(_project(_squares(inverse, across, down), camera, transforms, target), batch, target)
    hidden = (surfaces > 0) & (rims <= (1 + _RIM) * surfaces)
    nearest = torch.where(hidden, surfaces, rims)
    seen = torch.where(nearest > 0, nearest, torch.nan).reciprocal()
    return seen.view(batch, 1, target.height, target.width).to(depth.dtype)


def source_pixels(depth: Tensor, camera: Camera, transforms: Tensor, target: Camera) -> tuple[Tensor, Tensor]:
    """Return the columns and rows in ``camera`` that a map of :func:`warp_depth` is from, (B, H, W) float64 each."""
    inverse = torch.linalg.inv(transforms.double())
    points = depth.double() * target.rays(device=depth.device)  # (B, 3, H, W)
    turned = torch.einsum("bij,bjhw->bihw", inverse[:, :3, :3].expand(len(depth), 3, 3), points)
    x, y, z = (turned + inverse[:, :3, 3][:, :, None, None]).unbind(1)
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def registered_camera(camera: Camera, photo: Camera) -> Camera:
    """Return the camera of a map with the photo's field of view, and pixels as fine as the coarser camera's."""
    scale = min(max(camera.fx / photo.fx, camera.fy / photo.fy), 1.0)
    return photo.rescale(max(round(scale * photo.width), 2), max(round(scale * photo.height), 2))


def _joined(inverse: Tensor) -> Tensor:
    """Return whether each pixel and the next one in its row are on one surface, (B, h, w - 1)."""
    steps = inverse.diff(dim=-1)
    before = functional.pad(steps[..., :-1], (1, 0), value=torch.nan)
    after = functional.pad(steps[..., 1:], (0, 1), value=torch.nan)
    beyond = torch.stack((steps.abs(), (steps - before).abs(), (steps - after).abs())).nan_to_num(torch.inf).amin(0)
    return steps.isfinite() & (beyond <= STEP * torch.maximum(inverse[..., :-1], inverse[..., 1:]))


def _triangles(inverse: Tensor, across: Tensor, down: Tensor) -> _Corners:
    """Return two triangles for every square of four joined pixels, and one where only three are joined."""
    top, bottom, left, right = across[:, :-1], across[:, 1:], down[:, :, :-1], down[:, :, 1:]
    # corners as (row, column) offsets, clockwise on the screen; a triangle needs the two sides at its right angle
    upper_left = (top & left, ((0, 0), (0, 1), (1, 0)))
    lower_right = (bottom & right, ((1, 1), (1, 0), (0, 1)))
    upper_right = (top & right & ~(left & bottom), ((0, 1), (1, 1), (0, 0)))
    lower_left = (bottom & left & ~(top & right), ((1, 0), (0, 0), (1, 1)))
    parts = []
    for exists, corners in (upper_left, lower_right, upper_right, lower_left):
        item, row, column = torch.nonzero(exists, as_tuple=True)
        rows = torch.stack([row + i for i, _ in corners], 1)
        columns = torch.stack([column + j for _, j in corners], 1)
        parts.append(_Corners(columns.to(inverse), rows.to(inverse), inverse[item[:, None], rows, columns], item))
    return _Corners(*(torch.cat(each) for each in zip(*parts, strict=True)))


def _squares(inverse: Tensor, across: Tensor, down: Tensor) -> _Corners:
    """Return the squares of pixels that are not the corner of four squares of joined pixels, two triangles each."""
    whole = across[:, :-1] & across[:, 1:] & down[:, :, :-1] & down[:, :, 1:]
    complete = torch.zeros_like(inverse, dtype=torch.bool)
    complete[:, 1:-1, 1:-1] = whole[:, :-1, :-1] & whole[:, :-1, 1:] & whole[:, 1:, :-1] & whole[:, 1:, 1:]
    item, row, column = torch.nonzero(inverse.isfinite() & ~complete, as_tuple=True)
    centre = inverse[item, row, column]
    slope_u = _slope(inverse, across)[item, row, column]
    slope_v = _slope(inverse.mT, down.mT)[item, column, row]
    parts = []
    for corners in (((-1, -1), (-1, 1), (1, -1)), ((1, 1), (1, -1), (-1, 1))):  # (down, right), in half pixels
        dv, du = (torch.tensor(each).to(inverse) / 2 for each in zip(*corners, strict=True))
        value = centre[:, None] + slope_u[:, None] * du + slope_v[:, None] * dv
        parts.append(_Corners(column[:, None] + du, row[:, None] + dv, value.clamp(min=0.5 * centre[:, None]), item))
    return _Corners(*(torch.cat(each) for each in zip(*parts, strict=True)))


def _slope(inverse: Tensor, joined: Tensor) -> Tensor:
    """Return the mean change to the neighbours in the row that are on the same surface, 0 without one."""
    steps, count = torch.where(joined, inverse.diff(dim=-1), 0), joined.to(inverse)
    total = functional.pad(steps, (0, 1)) + functional.pad(steps, (1, 0))
    return total / (functional.pad(count, (0, 1)) + functional.pad(count, (1, 0))).clamp(min=1)


def _project(corners: _Corners, camera: Camera, transforms: Tensor, target: Camera) -> _Corners:
    """Return triangles as the target sees them, without those that it sees from behind or that reach behind it."""
    depth = corners.inverse.reciprocal()
    x, y = (corners.u - camera.cx) / camera.fx * depth, (corners.v - camera.cy) / camera.fy * depth
    m = transforms[corners.item][:, :3]  # (N, 3, 4)
    x, y, z = (m[:, i, 0, None] * x + m[:, i, 1, None] * y + m[:, i, 2, None] * depth + m[:, i, 3, None]
               for i in range(3))  # fmt: skip
    u, v = target.fx * x / z + target.cx, target.fy * y / z + target.cy
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    kept = (z > _NEAREST).all(1) & (area > 1e-12)
    return _Corners(u[kept], v[kept], z[kept].reciprocal(), corners.item[kept])


def _rasterise(corners: _Corners, batch: int, target: Camera) -> Tensor:
    """Return the largest inverse depth of the triangles at each pixel, (B * H * W,), 0 where there is none."""
    buffer = corners.inverse.new_zeros(batch * target.height * target.width)
    first_u, last_u = corners.u.amin(1).ceil().clamp(min=0), corners.u.amax(1).floor().clamp(max=target.width - 1)
    first_v, last_v = corners.v.amin(1).ceil().clamp(min=0), corners.v.amax(1).floor().clamp(max=target.height - 1)
    wide = (last_u - first_u + 1).clamp(min=0)
    counts = (wide * (last_v - first_v + 1).clamp(min=0)).long()
    chosen = torch.nonzero(counts)[:, 0]
    ends = counts[chosen].cumsum(0)
    start = 0
    while start < len(chosen):
        done = int(ends[start - 1]) if start else 0
        stop = max(int(torch.searchsorted(ends, done + _FRAGMENTS)), start + 1)
        part = chosen[start:stop]
        number = torch.repeat_interleave(counts[part])  # of the triangle of each fragment within the part
        within = torch.arange(len(number), device=number.device) - (ends[start:stop] - counts[part] - done)[number]
        one = part[number]
        across = wide[one].long()
        u, v = first_u[one] + within % across, first_v[one] + within // across
        (u0, u1, u2), (v0, v1, v2) = corners.u[one].unbind(1), corners.v[one].unbind(1)
        area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
        second = ((u - u0) * (v2 - v0) - (u2 - u0) * (v - v0)) / area
        third = ((u1 - u0) * (v - v0) - (u - u0) * (v1 - v0)) / area
        weights = torch.stack((1 - second - third, second, third), 1)
        inverse, inside = (weights * corners.inverse[one]).sum(1), (weights >= _INSIDE).all(1)
        place = (corners.item[one] * target.height + v.long()) * target.width + u.long()
        buffer.scatter_reduce_(0, place[inside], inverse[inside], "amax")
        start = stop
    return buffer
