"""Range type of a depth map from its planes: distances along the axis or the ray, or values that fall with distance.

If the values s follow z = s / |r|**k, with k = 0 for orthogonal depth, 1 for distance along the ray, and -1 for
orthogonal depth that was divided by |r|, then on a plane 1 / s = (a u + b v + c) / |r|**k. As |r| changes little within
a window, this is nearly 1 / s = a u + b v + c - k log|r| / s. A robust fit to windows of many sizes and positions
estimates k. Windows with a good fit are planar and vote. Disparity and inverse depth, of any scale, are linear over a
plane themselves, and their reciprocals are not.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsr.geometry.camera import ASSUMED_FOV, Camera
from dsr.notes import LIMITS

Array = NDArray[np.float64]

_SIZES = (1.0, 2 / 3, 1 / 2, 1 / 3, 1 / 4, 1 / 6)  # sizes of windows, as fractions of the shorter image side
_CELLS = 16  # cells across a window; values are averaged within cells to reduce noise
_ITERATIONS = 12
_MIN_VALID, _INLIERS = 0.6, 0.55  # minimum fractions of a window's cells that are valid, and that are on the plane
_NOISE = 0.5  # largest deviation of a planar window from its fit, as a fraction of the curvature that k = 1 causes
_NEAR = 0.3  # largest distance of k from the value that a window votes for
_WHOLE = 0.95  # minimum fraction of valid pixels in a cell
_LARGEST = 1e3  # upper limit of inverse depth, as a multiple of the median's
_EXACT = 1e-12
_SIGMA = 1.4826  # standard deviation over the median absolute residual
_LEAST, _LEAD = 4, 3  # minimum number of votes for orthogonal depth, and their minimum ratio to all others
_LEAST_BENT = 6  # votes for another type; none of 28 right maps of sensors and data sets has any
_LEAST_INVERSE = 10  # windows in which values, not reciprocals, are linear; 28 right maps have at most 4
_LINEAR = 2.0  # ratio of the deviations of values and of their reciprocals from a plane above which a window votes
_CURVED = 0.003  # least deviation of the worse one of both, as a fraction of the values
# largest deviation of the better one of both over the spread of its plane: boards at other depths have no slope
_STEEP = 0.25
_REDUCED = 320  # largest size of the longer side of a map that is judged whole; larger ones are thinned out


class _Windows(NamedTuple):
    """Square windows of a map of inverse depth, averaged within cells, (N, cells) each."""

    inverse: Array  # 1 / s, as a multiple of the window's median; 0 where invalid
    valid: np.ndarray
    u: Array  # position within the window, about -1 to 1
    v: Array
    bend: Array  # logarithm of |r|, minus its mean over the window


class RangeVotes(NamedTuple):
    """How many planar windows support orthogonal depth, distance along the ray, and that divided by |r| once more."""

    windows: int
    flat: int
    ray: int
    reverse: int

    @property
    def verdict(self) -> Literal["orthogonal", "ray", "reverse"] | None:
        """What the windows agree on; None if there are too few."""
        if self.ray >= _LEAST_BENT and self.ray > LIMITS["along-the-ray"] * self.windows:
            return "ray"
        if self.reverse >= _LEAST_BENT and self.reverse > LIMITS["along-the-ray"] * self.windows:
            return "reverse"
        enough = self.flat >= _LEAST and self.flat > _LEAD * (self.ray + self.reverse)
        return "orthogonal" if enough else None


class InverseVotes(NamedTuple):
    """In how many windows a map's values are linear and their reciprocals are not, and the other way around."""

    falling: int
    rising: int

    @property
    def ratio(self) -> float:
        """Votes for values that fall with distance over those that rise."""
        return self.falling / max(self.rising, 1)

    @property
    def verdict(self) -> Literal["falls", "rises"] | None:
        """Whether values fall or rise with distance; None if there are too few planes."""
        if self.falling >= _LEAST_INVERSE and self.ratio >= LIMITS["falls-with-distance"]:
            return "falls"
        if self.rising >= _LEAST_INVERSE and self.rising >= LIMITS["falls-with-distance"] * self.falling:
            return "rises"
        return None


def range_votes(values: Array, camera: Camera, step: float = 0.0) -> RangeVotes:
    """Count the planar windows of a map, (H, W) positive, by range type; ``step`` is its values' relative step."""
    windows = _windows(values, camera)
    if not windows.inverse.size:
        return RangeVotes(0, 0, 0, 0)
    columns = np.stack((np.ones_like(windows.u), windows.u, windows.v, -windows.bend * windows.inverse), axis=-1)
    scale = np.sqrt(np.square(columns).mean(axis=1, keepdims=True))
    columns = columns / scale
    fit, weight, residual = _robust_fit(columns, windows)
    bent = columns[..., 3] * scale[..., 3]
    linear = _solve(columns[..., :3], weight, bent)
    signal = _spread(bent - (columns[..., :3] @ linear[..., None])[..., 0], weight)
    noise = np.hypot(_spread(residual, weight), step / np.sqrt(12))
    planar = (weight.mean(axis=1) > _INLIERS) & (noise < _NOISE * signal)
    exponents = (fit[:, 3] / scale[:, 0, 3])[planar]
    flat, ray, reverse = (int((np.abs(exponents - k) < _NEAR).sum()) for k in (0, 1, -1))
    return RangeVotes(exponents.size, flat, ray, reverse)


def inverse_votes(values: Array) -> InverseVotes:
    """Count in which windows of a map, (H, W) positive, NaN in holes, its values are linear, or their reciprocals."""
    values, camera = thinned(values, Camera.from_fov(ASSUMED_FOV, values.shape[1], values.shape[0]))
    deviations, planar = [], []
    with np.errstate(over="ignore", divide="ignore"):
        reciprocals = 1 / values
    for each in (values, reciprocals):
        windows = _windows(each, camera)
        if not windows.inverse.size:
            return InverseVotes(0, 0)
        columns = np.stack((np.ones_like(windows.u), windows.u, windows.v), axis=-1)
        fit, weight, residual = _robust_fit(columns, windows)
        deviations.append(_spread(residual, weight))
        rise = _spread((columns[..., 1:] @ fit[:, 1:, None])[..., 0], weight)
        planar.append((weight.mean(axis=1) > _INLIERS) & (deviations[-1] < _STEEP * rise))
    of_reciprocals, of_values = deviations
    curved = np.maximum(of_reciprocals, of_values) > _CURVED
    falling = curved & planar[1] & (_LINEAR * of_values < of_reciprocals)
    rising = curved & planar[0] & (_LINEAR * of_reciprocals < of_values)
    return InverseVotes(int(falling.sum()), int(rising.sum()))


def thinned(values: Array, camera: Camera) -> tuple[Array, Camera]:
    """Return every n-th pixel of a map that is large, and the camera of these pixels."""
    every = math.ceil(max(values.shape) / _REDUCED)
    if every == 1:
        return values, camera
    return values[::every, ::every], camera.decimate(every, 0)


def _windows(values: Array, camera: Camera) -> _Windows:
    valid = np.isfinite(values)
    with np.errstate(over="ignore"):
        inverse = np.where(valid, np.nanmedian(values) / values, 0).clip(max=_LARGEST)
    places = []
    height, width = values.shape
    for fraction in _SIZES:  # windows overlap by half
        size = int(min(height, width) * fraction)
        if size >= _CELLS:
            tops = np.linspace(0, height - size, round(2 * (height - size) / size) + 1).astype(int)
            lefts = np.linspace(0, width - size, round(2 * (width - size) / size) + 1).astype(int)
            places += [(top, left, size) for top in tops for left in lefts]
    tops, lefts, sizes = np.array(places, dtype=int).reshape(-1, 3).T
    ends = np.round(np.arange(_CELLS + 1) * sizes[:, None] / _CELLS).astype(int)
    rows, columns = tops[:, None] + ends, lefts[:, None] + ends
    count = _totals(valid.astype(np.float64), rows, columns)
    whole = count > _WHOLE * np.diff(rows)[:, :, None] * np.diff(columns)[:, None, :]
    enough = whole.mean(axis=(1, 2)) > _MIN_VALID
    rows, columns, whole, count = rows[enough], columns[enough], whole[enough], count[enough]
    means = np.where(whole, _totals(inverse, rows, columns) / np.maximum(count, 1), 0)
    v, u = ((rows[:, 1:] + rows[:, :-1]) - 1) / 2, ((columns[:, 1:] + columns[:, :-1]) - 1) / 2
    slopes = np.square((u - camera.cx) / camera.fx)[:, None, :] + np.square((v - camera.cy) / camera.fy)[:, :, None]
    bend = np.log1p(slopes) / 2
    bend -= bend.mean(axis=(1, 2), keepdims=True)
    u, v = (2 * (part - part.mean(axis=1, keepdims=True)) / sizes[enough, None] for part in (u, v))
    u, v = np.broadcast_to(u[:, None, :], bend.shape), np.broadcast_to(v[:, :, None], bend.shape)
    means, whole, u, v, bend = (field.reshape(len(means), _CELLS**2) for field in (means, whole, u, v, bend))
    return _Windows(means / _medians(means, whole), whole, u, v, bend)


def _totals(values: Array, rows: np.ndarray, columns: np.ndarray) -> Array:
    """Return the sums over the cells with borders at rows (N, n + 1) and columns (N, n + 1), (N, n, n)."""
    sums = np.pad(values.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    totals: Array = np.diff(np.diff(sums[rows[:, :, None], columns[:, None, :]], axis=1), axis=2)
    return totals


def _robust_fit(columns: Array, windows: _Windows) -> tuple[Array, Array, Array]:
    """Return coefficients (N, k), weights (N, cells), 1 for inliers and 0 for outliers, and residuals (N, cells)."""
    valid = windows.valid.astype(np.float64)
    weight = valid
    for iteration in range(_ITERATIONS + 1):
        fit = _solve(columns, weight, windows.inverse)
        residual = windows.inverse - (columns @ fit[..., None])[..., 0]
        size = np.abs(residual)
        scale = _SIGMA * _medians(size, windows.valid) + _EXACT
        if iteration < _ITERATIONS // 2:  # of absolute deviations, which tolerates half of the cells as outliers
            weight = valid * (1 / np.maximum(size / scale, 0.05))
        elif iteration < _ITERATIONS:  # Tukey's biweight
            weight = valid * np.square((1 - np.square(size / scale / 4)).clip(min=0))
    return fit, valid * (size < 3 * scale), residual


def _medians(values: Array, valid: np.ndarray) -> Array:
    """Return the medians of the valid values of each window, (N, 1)."""
    ordered, count = np.sort(np.where(valid, values, np.inf), axis=1), valid.sum(axis=1, keepdims=True)
    middles = np.take_along_axis(ordered, np.concatenate(((count - 1) // 2, count // 2), axis=1), axis=1)
    medians: Array = middles.mean(axis=1, keepdims=True)
    return medians


def _solve(columns: Array, weight: Array, target: Array) -> Array:
    """Return the weighted least-squares coefficients (N, k) of columns (N, cells, k)."""
    weighted = columns.swapaxes(1, 2) * weight[:, None, :]
    ridge = _EXACT * np.eye(columns.shape[-1]) * (1 + weight.sum(axis=1))[:, None, None]
    solution: Array = np.linalg.solve(weighted @ columns + ridge, weighted @ target[..., None])[..., 0]
    return solution


def _spread(values: Array, weight: Array) -> Array:
    """Return the weighted root mean square, (N,)."""
    return np.sqrt((np.square(values) * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1))
