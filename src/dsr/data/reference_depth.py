"""Preparation of reference depth: resizing within surfaces, inpainting of holes, smoothing of integer levels.

*Resizing.* Depth is resized as follows. A new pixel belongs to the surface of the old pixel at its centre; where that
is missing, so is the new pixel. The new depth is that of a plane fitted to the old pixels around it, by weighted least
squares in inverse depth, which is linear in the pixel for a plane. The fit uses the valid pixels of the same surface
only, those whose depth differs from the centre's by less than the fraction ``JUMP``. The weights are triangular, as
wide as in antialiased bilinear resizing, or a little wider where the map is enlarged. So depth is never mixed across a
hole or a depth edge, holes neither grow nor shrink by more than half a pixel, and planes stay planes up to rounding,
also at borders and beside holes.

*Inpainting.* Inside a hole inverse depth solves Laplace's equation with the values at the hole's rim as boundary. Where
the rim has a depth step, as at occlusions in stereo, only its farther part is used, because the background is what the
second camera does not see.

*Levels.* A value with the level L lies between L - 1/2 and L + 1/2. Between pixels of the levels L and L + 1 it is L +
1/2, so the lines between levels are contours of known value. Between them the result is harmonic: it solves Laplace's
equation given the contours, with free boundaries at holes and at edges of surfaces, where levels jump.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage, sparse
from scipy.sparse import linalg
from torch import Tensor
from torch.nn import functional

from dsr.sample import Scene

JUMP = 0.02  # relative difference of depth above which neighbours belong to different surfaces
_MIN_RADIUS = 1.5  # smallest radius of the weights in old pixels: it leaves two pixels at a border, which a slope needs
_RIDGE = 1e-9

_STEP = 0.05  # smallest relative gap between the sorted inverse depths of a rim that is a depth step
_SIDES = ((0, 1), (1, 0), (0, -1), (-1, 0))

_CONTOUR = 2.0  # weight of the value at a contour, which lies half a pixel from the pixels on its sides
_ANCHOR = 1e-6  # weight of the level itself, for plateaus without a contour
_TOLERANCE = 1e-5


def resize(scene: Scene, height: int, width: int) -> Scene:
    """Return a scene at another size, its camera included; measured low-resolution maps are left out."""
    if scene.depth is None:
        raise ValueError(f"{scene.name}: expected a true depth map to resize, there is none (dataset.size=null)")
    if (height, width) == (scene.camera.height, scene.camera.width):
        return replace(scene, measured={})
    photo = functional.interpolate(scene.rgb[None], (height, width), mode="bicubic", antialias=True)[0].clamp(0, 1)
    depth = resize_depth(scene.depth, height, width)
    return replace(scene, rgb=photo, depth=depth, camera=scene.camera.rescale(width, height), measured={})


def fit(scene: Scene, size: int, place: float | None = 0.5, *, enlarge: bool = True) -> Scene:
    """Return a scene resized so that its shorter side is ``size`` pixels long, and cropped to a square.

    ``place`` is the square's position along the longer side, from 0 (top or left) to 1 (bottom or right); None for no
    cropping. Smaller scenes are enlarged only with ``enlarge``.
    """
    height, width = scene.camera.height, scene.camera.width
    shorter = min(height, width)
    if size < shorter or enlarge:
        height, width = (size if side == shorter else round(side * size / shorter) for side in (height, width))
        scene = resize(scene, height, width)
    if place is None:
        return scene
    side = min(height, width)
    window = scene.crop(int((height - side) * place), int((width - side) * place), side, side)
    return replace(window, measured={})


def resize_depth(depth: Tensor, height: int, width: int) -> Tensor:
    """Return a depth map (1, H, W), NaN where missing, resized as the module describes, float64."""
    inverse = depth[0].double().reciprocal()
    rows, columns = _Axis(inverse.shape[0], height), _Axis(inverse.shape[1], width)
    own = inverse[rows.nearest][:, columns.nearest]
    shift_y, shift_x = (rows.nearest - rows.centre)[:, None], (columns.nearest - columns.centre)[None]
    sums = [torch.zeros_like(own) for _ in range(9)]
    for step_y, step_x in itertools.product(rows.steps, columns.steps):
        row, weight_y = rows.neighbour(step_y)
        column, weight_x = columns.neighbour(step_x)
        values = inverse[row][:, column]
        same = ((values - own).abs() <= JUMP * own) & values.isfinite()
        weight = torch.where(same, weight_y[:, None] * weight_x[None], 0)
        value, y, x = torch.where(same, values - own, 0), shift_y + step_y, shift_x + step_x
        terms = (torch.ones_like(y), y, x, y * y, y * x, x * x, value, value * y, value * x)
        sums = [total + weight * term for total, term in zip(sums, terms, strict=True)]
    resized = own + _plane_at_centre(sums, rows.radius * columns.radius)
    return torch.where(resized > 0, resized, own).reciprocal()[None]


class _Axis:
    """New pixels along one axis and the old ones around them."""

    def __init__(self, old: int, new: int) -> None:
        self.radius = max(old / new, _MIN_RADIUS)
        self.centre = (torch.arange(new, dtype=torch.float64) + 0.5) * (old / new) - 0.5
        self.nearest = self.centre.round().long().clamp(0, old - 1)
        most = math.ceil(self.radius + 0.5) - 1
        self.steps = range(-most, most + 1)  # offsets from the nearest old pixel that may have a weight
        self._old = old

    def neighbour(self, step: int) -> tuple[Tensor, Tensor]:
        """Return the old pixels ``step`` from the nearest ones, and their weights, which are 0 beyond the border."""
        index = self.nearest + step
        weight = (1 - (index - self.centre).abs() / self.radius).clamp(min=0)
        inside = (index >= 0) & (index < self._old)
        return index.clamp(0, self._old - 1), torch.where(inside, weight, 0)


def _plane_at_centre(sums: list[Tensor], area: float) -> Tensor:
    """Return the value at 0 of the fitted plane, from sums of w times 1, y, x, yy, yx, xx, v, vy, vx."""
    total, y, x, yy, yx, xx, v, vy, vx = sums
    weight = total.clamp(min=torch.finfo(total.dtype).tiny)
    mean_y, mean_x, mean = y / weight, x / weight, v / weight
    ridge = _RIDGE * area  # makes the slope across a line 0 where all pixels lie in one
    var_y, var_x = yy / weight - mean_y.square() + ridge, xx / weight - mean_x.square() + ridge
    both = yx / weight - mean_y * mean_x
    with_y, with_x = vy / weight - mean * mean_y, vx / weight - mean * mean_x
    determinant = var_y * var_x - both.square()
    slope_y = (with_y * var_x - with_x * both) / determinant
    slope_x = (with_x * var_y - with_y * both) / determinant
    return mean - slope_y * mean_y - slope_x * mean_x


def inpaint_depth(depth: Tensor) -> Tensor:
    """Return a depth map (1, H, W) with its holes, NaN, inpainted, float64; valid pixels are unchanged."""
    inverse = 1 / depth[0].double().numpy()
    holes = np.isnan(inverse)
    if not holes.any():
        return depth.double()
    labels, count = ndimage.label(holes)
    for label, place in zip(range(1, count + 1), ndimage.find_objects(labels), strict=True):
        window = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in place)
        hole = labels[window] == label
        rim = ndimage.binary_dilation(hole) & ~holes[window]
        beside = np.sort(inverse[window][rim])
        gaps = np.diff(beside)
        stepped = gaps.size and gaps.max() > _STEP * beside[0]  # the rim's part beyond a depth step is used
        used = rim & (inverse[window] <= beside[gaps.argmax() if stepped else -1])
        inverse[window][hole] = _solve_laplace(np.where(used, inverse[window], 0), hole, used)
    return torch.from_numpy(1 / inverse)[None]


def _solve_laplace(values: np.ndarray, hole: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Return the harmonic values of the pixels of a hole, given those of its rim."""
    number = np.full(hole.shape, -1)
    number[hole] = np.arange(hole.sum())
    rows, columns, count = [], [], np.zeros(hole.sum())
    right = np.zeros(hole.sum())
    for step in _SIDES:
        there = np.roll(number, step, (0, 1))
        known, beside = np.roll(rim, step, (0, 1)), np.roll(values, step, (0, 1))
        across = slice(None)  # what a roll moved in from the opposite side is cleared
        edge = (across, 0 if step[1] > 0 else -1) if step[1] else (0 if step[0] > 0 else -1, across)
        there[edge], known[edge] = -1, False
        inner = hole & (there >= 0)
        rows.append(number[inner])
        columns.append(there[inner])
        count += ((there >= 0) | known)[hole]
        right += np.where(known, beside, 0)[hole]
    coupling = sparse.csr_matrix(
        (-np.ones(sum(map(len, rows))), (np.concatenate(rows), np.concatenate(columns))), (count.size, count.size)
    )
    solution: np.ndarray = linalg.spsolve((sparse.diags(count) + coupling).tocsc(), right)
    return solution


def smooth_levels(levels: np.ndarray, largest_step: int = 2) -> np.ndarray:
    """Return a map (H, W) whose values vary smoothly between its levels, whole numbers, within half a level of them.

    ``largest_step`` is the largest difference of neighbours' levels within a surface; NaN stays NaN.
    """
    known = np.isfinite(levels)
    own = levels[known].astype(np.float64)
    number = np.full(levels.shape, -1)
    number[known] = np.arange(own.size)
    first = np.concatenate((number[1:].ravel(), number[:, 1:].ravel()))
    second = np.concatenate((number[:-1].ravel(), number[:, :-1].ravel()))
    both = (first >= 0) & (second >= 0)
    first, second = first[both], second[both]
    step = np.abs(own[first] - own[second])
    level, contour = step == 0, (step > 0) & (step <= largest_step)
    ends = np.concatenate((first[contour], second[contour]))
    values = np.tile((own[first[contour]] + own[second[contour]]) / 2, 2)
    weight = _ANCHOR + np.bincount(np.concatenate((first[level], second[level])), minlength=own.size)
    weight += _CONTOUR * np.bincount(ends, minlength=own.size)
    right = _ANCHOR * own + _CONTOUR * np.bincount(ends, values, minlength=own.size)
    # weight x - (sum of x over the neighbours) = right, by conjugate gradients
    rows, columns = np.concatenate((first[level], second[level])), np.concatenate((second[level], first[level]))
    coupling = sparse.csr_matrix((np.ones(rows.size), (rows, columns)), (own.size, own.size))
    jacobi = sparse.diags(1 / weight)
    solution, _ = linalg.cg(sparse.diags(weight) - coupling, right, own, rtol=_TOLERANCE, maxiter=2000, M=jacobi)
    result = np.full(levels.shape, np.nan)
    result[known] = np.clip(solution, own - 0.5, own + 0.5)
    return result
