"""Test whether a photo and a depth map show the same scene: agreement of their edges, compared with chance.

Both are reduced to a small grid. An edge is a strength and a direction: where the logarithm of depth jumps, or a hole
begins; and where the photo changes more than around it. The agreement at a displacement is the sum of the products of
both strengths, mostly weighted with the cosine of twice the angle between both directions. Fourier transforms give it
for all cyclic displacements of the photo at once; slow changes over displacements are removed. The best of a few pixels
around no displacement, in standard deviations of the same over all other displacements, is the significance.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, from_numpy

from dsr.geometry.registration import JUMP, SHIFT, WORKING_SIZE, Array
from dsr.notes import LIMITS

Size = tuple[int, int]
T = TypeVar("T", Array, Tensor)
_Floats = NDArray[np.float32]

_SIDES = (96, 256)  # least and largest longer side of the grid in pixels; between them, that of the depth map
_REACH = 4  # largest distance in pixels of the grid at which edges count as agreeing: what sensors fatten edges by
_SLOW = 16.0  # standard deviation in pixels of what is removed from the agreement as a slow change
_ANY_DIRECTION = 0.3  # weight of the product of strengths whatever the directions
_GAP = 0.03  # width of the widest hole across which depth may jump, as a fraction of the longer side
_HOLE = 0.5  # strength of the border of a wider hole
# width in pixels of what an edge of a photo is compared with, and least and largest of its values
_AROUND, _FAINT, _STRONGEST = 31, 0.004, 3.0
_CONTOUR = 4.0  # extent in pixels over which the edges of a contour run alike
_FITS = 3.0  # significance from which both surely agree
# a depth map has edges to judge by if its longer side has at least so many pixels, its contours have so many pixels on
# the grid and this mean coherence, and the agreement by chance has a smaller standard deviation than this: 3 of 383
# right pairs get the warning of another photo, and 31 without these conditions
_SIDE, _LENGTH, _COHERENCE, _SPREAD = 80, 300, 0.6, 0.045
_ELSEWHERE, _LEAD = 5.0, 2.0  # significance beyond the reach, and its lead, from which on photo and depth are apart
_SMALLEST = 16  # least side of the grid in pixels
_WAYS: dict[str, tuple[bool, tuple[int, ...]]] = {
    "mirrored left to right": (False, (1,)),
    "mirrored top to bottom": (False, (0,)),
    "turned by 180 degrees": (False, (0, 1)),
    "turned by 90 degrees to the right": (True, (1,)),
    "turned by 90 degrees to the left": (True, (0,)),
}  # what is done to a photo to compare it: whether rows and columns are exchanged, and what is reversed then
# widths of the depth map's field of view over the photo's that are compared as well
_ZOOMS = (0.68, 0.72, 0.76, 0.8, 0.85, 0.9, 1.1, 1.17, 1.24, 1.31, 1.39, 1.47)


class Outlines(NamedTuple):
    """Edges on a grid, (H, W) each: a strength, 0 for no edge, and a complex number with twice the gradient's angle."""

    strength: _Floats
    direction: NDArray[np.complex64]


class Agreement(NamedTuple):
    """How well the edges of depth and photo agree."""

    score: float  # 0 by chance, up to 1 for equal edges
    significance: float  # in standard deviations of what other displacements give
    spread: float  # that standard deviation, as a score
    elsewhere: float  # the largest significance at a displacement beyond the reach
    right: float  # that displacement, from depth edges to the photo's, as a fraction of the width
    down: float  # and of the height


class Verdict(NamedTuple):
    """Evidence from edges on whether a photo and a depth map belong together."""

    kind: Literal["turned", "apart", "other", "fits", "unclear"]  # turned: or of another field of view
    statement: str
    figures: str
    code: str  # of the warning, one of LIMITS; empty without one
    value: float  # what the warning's limit was compared with; without a warning the significance
    as_given: Agreement
    margin: float  # by how much more significant the agreement of the best mirroring, rotation or zoom is
    contours: bool  # whether the depth map has enough of them
    conclusive: bool  # whether a photo of the same would surely agree


def judge(depth: Array, rgb: Tensor, zooms: Sequence[float] = _ZOOMS) -> Verdict | None:
    """Compare the edges of a depth map with those of a photo: as given, mirrored, rotated, and of other fields of view.

    Depth is (h, w) in any unit of depth or of its reciprocal, NaN in holes; the photo is (3, H, W) in [0, 1]. ``zooms``
    are widths of the depth map's field of view over the photo's. Returns None if one of the two has no edge.
    """
    size = working_size(depth, rgb)
    pixel = max(size) / max(depth.shape)
    outlines, photo = depth_outlines(depth, size), reduce_photo(rgb, size)
    seen = photo_outlines(photo, pixel)
    if not outlines.strength.any() or not seen.strength.any():
        return None
    fields = _transform(outlines)
    across = photo_outlines(np.asarray(cv2.resize(photo.transpose(1, 0, 2), size[::-1]), np.float32), pixel)
    ways = {}
    for name, (exchanged, axes) in _WAYS.items():
        given = across if exchanged else seen
        strength, direction = np.flip(given.strength, axes), np.flip(given.direction, axes)
        reversed_ = Outlines(strength, direction if len(axes) == 2 else direction.conj())
        ways[name] = _compare(fields, _transform(reversed_))
    alike = np.hypot(_blur(outlines.direction.real, _CONTOUR), _blur(outlines.direction.imag, _CONTOUR))
    coherence = alike / (_blur(outlines.strength, _CONTOUR) + 1e-3)  # 1 if neighbours have the same direction
    length = float((outlines.strength * (2 * coherence - 1).clip(0, 1)).sum())
    mean = float((outlines.strength * coherence).sum() / (outlines.strength.sum() + 1e-6))
    contours = max(depth.shape) >= _SIDE and length >= _LENGTH and mean >= _COHERENCE
    if contours and zooms:
        double = min(2 * size[0], rgb.shape[-2]), min(2 * size[1], rgb.shape[-1])
        twice = from_numpy(reduce_photo(rgb, double)).permute(2, 0, 1)
        for zoom in zooms:
            part, view = _middle(depth, zoom), _middle(twice, 1 / zoom)
            edges = photo_outlines(reduce_photo(view, size), max(size) / max(part.shape))
            ways[f"{zoom:g}"] = _compare(_transform(depth_outlines(part, size)), _transform(edges))
    return _conclude(_compare(fields, _transform(seen)), ways, contours=contours, size=tuple(rgb.shape[-2:]))


def _conclude(given: Agreement, ways: dict[str, Agreement], *, contours: bool, size: tuple[int, ...]) -> Verdict:
    way = max(ways, key=lambda name: ways[name].significance)
    margin = ways[way].significance - max(given.significance, 0.0)
    conclusive = contours and given.spread < _SPREAD
    evidence = (given, margin, contours, conclusive)
    code = "photo-turned" if way in _WAYS else "field-of-view"
    if margin >= LIMITS[code]:
        text = f"the depth map's field of view looks {way} times as wide as the photo's"
        if way in _WAYS:
            text = f"the depth map fits better with the photo {way}"
        return Verdict("turned", text, f"{ways[way].score:.2f} against {given.score:.2f}", code, margin, *evidence)
    pixels = max(abs(given.right) * size[1], abs(given.down) * size[0]) * min(WORKING_SIZE / max(size), 1.0)
    lead = given.elsewhere - max(given.significance, 0.0)
    if given.elsewhere >= _ELSEWHERE and lead >= _LEAD and pixels >= SHIFT:
        across = f"{abs(given.right):.0%} of the width to the {'right' if given.right > 0 else 'left'}"
        figures = f"{across}, {abs(given.down):.0%} of the height {'below' if given.down > 0 else 'above'}"
        text = "the photo's edges lie beside the depth edges"
        return Verdict("apart", text, figures, "edges-beside", pixels, *evidence)
    figures = f"{given.score:.2f}, by chance up to {2 * given.spread:.2f}"
    if given.significance < LIMITS["photo-other"] and conclusive:
        text = "the photo seems to show something else than the depth map"
        return Verdict("other", text, figures, "photo-other", given.significance, *evidence)
    text = "the photo's edges match the depth edges"
    if given.significance >= _FITS:
        return Verdict("fits", text, figures, "", given.significance, *evidence)
    return Verdict("unclear", f"{text} no better than by chance", figures, "", given.significance, *evidence)


def significances(depths: Sequence[Outlines], photos: Sequence[Outlines]) -> Array:
    """Return the significance of the agreement of each depth map with each photo on the same grid, (N, M)."""
    seen = [_transform(photo) for photo in photos]
    rows = [[_compare(fields, photo).significance for photo in seen] for fields in map(_transform, depths)]
    return np.array(rows, np.float64).reshape(len(depths), len(photos))


def find_misplaced(agreements: Array) -> list[tuple[int, int]]:
    """Return the pairs of a depth map and of another's photo that it fits clearly better, by significances (N, N)."""
    gains = agreements - np.maximum(np.diag(agreements), 0.0)[:, None]
    best = gains.argmax(axis=1) if gains.size else np.empty(0, int)
    least = LIMITS["photo-turned"]
    return [(row, int(column)) for row, column in enumerate(best) if column != row and gains[row, column] >= least]


def working_size(depth: Array, rgb: Tensor) -> Size:
    """Return the size of the grid for a depth map (h, w) and a photo (3, H, W)."""
    height, width = rgb.shape[-2:]
    factor = min(max(*depth.shape, _SIDES[0]), _SIDES[1]) / max(height, width)
    return max(round(height * factor), _SMALLEST), max(round(width * factor), _SMALLEST)


def reduce_photo(rgb: Tensor, size: Size) -> _Floats:
    """Return a photo (3, H, W) at another size, (h, w, 3)."""
    channels = np.ascontiguousarray(rgb.permute(1, 2, 0).cpu().float().numpy())
    larger = channels.shape[0] > size[0]
    small = cv2.resize(channels, size[::-1], interpolation=cv2.INTER_AREA if larger else cv2.INTER_LINEAR)
    return np.asarray(small, np.float32)


def photo_outlines(photo: _Floats, pixel: float) -> Outlines:
    """Return the edges of a photo on the grid, (H, W, 3); ``pixel`` is the width of the depth map's pixel there."""
    right, down = _gradient(photo, max(pixel, 1.0) ** 0.5)
    steepest = (right * right + down * down).argmax(axis=-1)[..., None]
    right = np.take_along_axis(right, steepest, axis=-1)[..., 0]
    down = np.take_along_axis(down, steepest, axis=-1)[..., 0]
    size = np.hypot(right, down)
    around = cv2.blur(size, (_AROUND, _AROUND), borderType=cv2.BORDER_REFLECT)
    return _outlines(np.minimum(size / (around + _FAINT), _STRONGEST), right, down)


def depth_outlines(depth: Array, size: Size) -> Outlines:
    """Return the edges of a depth map, (h, w) in any unit of depth or of its reciprocal, on a grid; from 0 to 1."""
    rows = ((np.arange(size[0]) + 0.5) * depth.shape[0] / size[0]).astype(np.intp)
    columns = ((np.arange(size[1]) + 0.5) * depth.shape[1] / size[1]).astype(np.intp)
    small = _bridge(depth[rows][:, columns].astype(np.float64), max(round(_GAP * max(size)), 1))
    valid = np.isfinite(small)
    if not valid.any():
        return _outlines(np.zeros(size, np.float32), *np.zeros((2, *size), np.float32))
    nearest = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    logarithm = ndimage.median_filter(np.log(small[tuple(nearest)]).astype(np.float32), 3)
    right, down = _gradient(logarithm, 0.7 * max(size[1] / depth.shape[1], 1))
    strength = ((2 * np.hypot(right, down) - JUMP / 2) / JUMP).clip(0, 1)
    strength[ndimage.binary_dilation(~valid)] = 0
    into, below = _gradient(valid.astype(np.float32), 1.0)
    border = _HOLE * (2 * np.hypot(into, below) / 0.35).clip(0, 1)
    beside = border > strength
    right, down = np.where(beside, into, right), np.where(beside, below, down)
    return _outlines(np.where(beside, border, strength), right, down)


class _Fields(NamedTuple):
    """The Fourier transforms of outlines, of the strength without its mean, and the norm of the strength."""

    strength: NDArray[np.complex64]
    direction: NDArray[np.complex64]
    norm: float


def _transform(outlines: Outlines) -> _Fields:
    strength, direction = outlines
    strong = np.fft.fft2(strength - strength.mean()).astype(np.complex64)
    return _Fields(strong, np.fft.fft2(direction).astype(np.complex64), float(np.linalg.norm(strength)))


def _compare(depth: _Fields, photo: _Fields) -> Agreement:
    height, width = depth.strength.shape
    v, u = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]  # frequencies, and displacements over the size
    fast = (1 - np.exp(-2 * (np.pi * _SLOW) ** 2 * (v * v + u * u))).astype(np.float32)
    far = 2 * _REACH + 2
    beyond = (np.abs(v * height) > far) | (np.abs(u * width) > far)
    spectrum = _ANY_DIRECTION * depth.strength.conj() * photo.strength + depth.direction.conj() * photo.direction
    scores = np.fft.ifft2(spectrum * fast).real / max(depth.norm * photo.norm, 1e-9)
    best = ndimage.maximum_filter(scores, 2 * _REACH + 1, mode="wrap")
    others = best[beyond]
    mean, spread = float(others.mean()), max(float(others.std()), 1e-6)
    row, column = np.unravel_index(np.where(beyond, scores, -np.inf).argmax(), scores.shape)
    return Agreement(
        float(best[0, 0]) / (1 + _ANY_DIRECTION),
        (float(best[0, 0]) - mean) / spread,
        spread / (1 + _ANY_DIRECTION),
        (float(others.max()) - mean) / spread,
        float(u[0, column]),
        float(v[row, 0]),
    )


def _outlines(strength: _Floats, right: _Floats, down: _Floats) -> Outlines:
    """Return outlines of strengths and gradients, without the border of the grid."""
    inside = np.zeros(strength.shape, np.float32)
    inside[2:-2, 2:-2] = strength[2:-2, 2:-2]
    angle = 2 * np.arctan2(down, right)
    return Outlines(inside, (inside * (np.cos(angle) + 1j * np.sin(angle))).astype(np.complex64))


def _middle(values: T, ratio: float) -> T:
    """Return the middle of a map or photo, (..., H, W), whose sides are smaller by a ratio; all if it is at most 1."""
    rows, columns = (round(n * min(1 / ratio, 1)) for n in values.shape[-2:])
    top, left = (values.shape[-2] - rows) // 2, (values.shape[-1] - columns) // 2
    return values[..., top : top + rows, left : left + columns]


def _bridge(depth: Array, gap: int) -> Array:
    """Return a map whose narrow holes have the farther of the two ends: a sensor's shadow is behind the nearer one."""
    for _ in range(2):  # along rows, then along columns
        columns = np.arange(depth.shape[1])
        valid = np.isfinite(depth)
        before = np.maximum.accumulate(np.where(valid, columns, -1), axis=1)
        after = np.minimum.accumulate(np.where(valid, columns, len(columns))[:, ::-1], axis=1)[:, ::-1]
        narrow = ~valid & (before >= 0) & (after < len(columns)) & (after - before <= gap + 1)
        ends = [np.take_along_axis(depth, each.clip(0, len(columns) - 1), axis=1) for each in (before, after)]
        depth = np.where(narrow, np.fmax(*ends), depth).T
    return depth


def _blur(values: _Floats, deviation: float) -> _Floats:
    return np.asarray(cv2.GaussianBlur(np.ascontiguousarray(values), (0, 0), deviation))


def _gradient(values: _Floats, blur: float) -> tuple[_Floats, _Floats]:
    """Return the change of blurred values to the right and down per pixel, from three rows and columns."""
    smooth = _blur(values, blur)
    right = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8, borderType=cv2.BORDER_REPLICATE)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(right, np.float32), np.asarray(down, np.float32)
