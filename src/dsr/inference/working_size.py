"""The size at which a sensor's map is upsampled: smaller than the map where its noise is correlated over many pixels.

A network takes correlated noise that is wider than its receptive field for shape. At a size at which the noise of
neighbouring pixels is independent again the network averages it; the details lost there were hidden by the noise.

Noise is distinguished from shape by its correlation in windows of increasing size, after a plane in inverse depth is
subtracted: noise is correlated over the same number of pixels in each, while bends of surfaces are over a third of the
window, whatever its size. The flattest tenth of the windows counts. A surface that is covered with bumps may look the
same; but a sensor's noise is never as smooth, since depth is counted in steps, and no window is free of it.
"""

import math
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.sensors import Identified, identify
from dsr.geometry.hole_size import window_maxima
from dsr.inference.resizing import resize_nearest, size_of
from dsr.methods.base import InverseSurface, MapNoise, NoiseLaw

T = TypeVar("T", float, Tensor)
SIZES = (1, 2, 4, 8, 16)  # by what the size of a sensor's map may be divided before it is worked on
_LARGEST_BLOCK = 16
_NOISY = 0.4  # standard deviation of a sensor's disparity in its steps, at least; rounding alone has 0.29
CORRELATED = 5.0  # pixels over which noise is correlated that a network takes for shape in part
_WINDOWS = (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384)  # pixels
_LARGEST_WINDOW = 0.6  # of the map's smaller side
_MOST, _MOST_CORRELATED = 1500, 200  # about how many windows of a size are looked at, and the flattest for correlation
_FEWEST = 6
_KNOWN = 0.95  # share of a window's pixels that has to be known
_WIDTHS = 5  # windows are as many correlation lengths wide, or wider, where they hold noise
_LEAST, _LARGEST = 2e-4, 0.02  # standard deviations relative to the depth that count as noise
# least noise in windows of 8 pixels over that in the windows of noise: 0.06 to 0.4 for sensors, less than 0.01 for
# bumpy surfaces that are rendered, computed or rounded
_FINE = 0.03
_LEVEL = 0.4  # least noise of any window over that of the tenth in order: 0.55 to 0.95 for sensors, 0.1 for bumpy ones
_LENGTHS = 2.3  # correlation lengths over the factor: noise of that full width is nearly independent after it
# standard deviation of the result's error over that of correlated noise of the map, where surfaces are calm: 0.35 to
# 0.7 before an exact plane, 0.3 to 0.65 for simulated sensors
_LEFT = 0.45
# expected errors over their median up to which they are of noise, and from which on they are of something else
_CALM, _UNSURE = 1.5, 4.0
_LARGE = 2**19  # pixels from which on a map is looked at in half its size


def enlarged_by(values: Tensor) -> int:
    """Return the factor by which a map, (..., H, W), was enlarged by repeating pixels; 1 for none."""
    filled = values.nan_to_num(nan=-1.0)
    if bool((filled == filled.flatten()[0]).all()):
        return 1
    for block in range(_LARGEST_BLOCK, 1, -1):
        for part in (filled[..., :block, :], filled):  # the first rows decide mostly
            repeated = part[..., ::block, ::block].repeat_interleave(block, -2).repeat_interleave(block, -1)
            if not torch.equal(part, repeated[..., : part.shape[-2], : part.shape[-1]]):
                break
        else:  # squares of equal values, up to the border
            return block
    return 1


class _Planes(NamedTuple):
    """Planes a u + b v + c of square windows of inverse depth, (n,) each, and how far the pixels are from them."""

    rows: Tensor  # of the upper left pixels
    columns: Tensor
    a: Tensor
    b: Tensor
    c: Tensor
    mean: Tensor
    deviation: Tensor  # root mean square, relative to the mean


def find_noise(depth: Tensor) -> MapNoise | None:
    """Return the noise of a sensor's map, (1, h, w) in metres; None where it has none that differs from shape."""
    inverse = depth[0].double().reciprocal()
    step = 2 if inverse.numel() > _LARGE else 1
    if step > 1:
        inverse = inverse[: inverse.shape[0] // 2 * 2, : inverse.shape[1] // 2 * 2]
        inverse = functional.avg_pool2d(inverse[None, None], 2)[0, 0]  # a hole makes a hole
    sums, found, before, finest = _sum_up(inverse), None, (0, 0.0), 0.0
    for size in _WINDOWS:
        planes = _fit_planes(sums, size) if size <= _LARGEST_WINDOW * min(inverse.shape) else None
        if planes is None:
            break
        count = max(_FEWEST, len(planes.deviation) // 10)
        deviations, order = planes.deviation.sort()
        deviation = float(deviations[:count].median())
        finest = finest or max(float(deviations[len(deviations) // 10]), 1e-12)
        steeper = before[1] > _LEAST and deviation > 1.05 * before[1] * (size / before[0]) ** 2
        if deviation > _LARGEST or steeper:
            break  # surfaces bend, or end, within the windows
        if deviation > _LEAST:
            flattest = order[: min(count, _MOST_CORRELATED)]
            extent = _extent(inverse, planes, flattest, size, deviation)
            if extent <= size / _WIDTHS:
                level = float(deviations[0] / deviations[len(deviations) // 10])
                fine = finest / deviation
                distance = 1 / float(planes.mean[flattest].median())
                noise = MapNoise(deviation * distance, step * extent, distance)
                found = noise if level >= _LEVEL and fine >= _FINE else None
        before = (size, deviation)
    return found


def find_sensor(depth: Tensor, name: str = "auto", device_name: str = "") -> Identified | None:
    """Return the sensor of a map, see :func:`dsr.degradation.sensors.identify`.

    The values alone identify it only where the map has a sensor's noise: computed disparity may have the same steps.

    Args:
        depth: (1, h, w) in metres, NaN in holes, as it was read.
        name: of a sensor or a device; ``auto``, or ``none`` for none.
        device_name: of the device, as its files state it; empty where they do not.

    Example:
        >>> import torch
        >>> from dsr.inference import find_sensor
        >>> wall = torch.full((1, 48, 64), 2.0)
        >>> find_sensor(wall) is None, find_sensor(wall, "Kinect v2").by
        (True, 'request')

    """
    found = identify(depth, name, device_name)
    if found is None or found.by != "values" or found.constant is None:
        return found
    noise = find_noise(depth)
    steps = 0.0 if noise is None else found.constant * noise.deviation / noise.distance**2
    return found if steps >= _NOISY else None


def known_noise(sensor: Identified | None, noise: MapNoise | None, factor: int) -> NoiseLaw | None:
    """Return the noise that a method is given because it may take it for shape; None for noise that it judges better.

    That is correlated noise of a sensor that counts disparity; the size of the map is divided by ``factor``.
    """
    counts = sensor is not None and sensor.sensor.stereo_constant is not None
    if not counts or noise is None or noise.extent < max(CORRELATED, factor):
        return None
    return noise.deviation / noise.distance**2, 2.0


def working_size_of(extent: float) -> int:
    """Return the divisor of the map's size, 1 or a power of 2 from 4 on, for noise of a full width at half maximum."""
    factor = 2 ** int(math.log2(max(extent / _LENGTHS, 1)))
    return 1 if factor < SIZES[2] else min(factor, SIZES[-1])


def reduce_by_medians(inverse: Tensor, factor: int) -> Tensor:
    """Return the medians of blocks of inverse depth, (1, h, w), holes where less than a quarter of a block is known."""
    _, height, width = inverse.shape
    blocks = inverse.view(height // factor, factor, width // factor, factor).transpose(1, 2).flatten(2)
    known = blocks.isfinite().sum(dim=2) >= factor**2 / 4
    return torch.where(known, blocks.nanmedian(dim=2).values, torch.nan)[None]


def left_of(deviation: T) -> T:
    """Return the expected absolute error that is left of noise of a standard deviation, in the same unit."""
    return _LEFT * math.sqrt(2 / math.pi) * deviation


def limit_to_noise(spread: Tensor, noise: MapNoise, measured: Tensor, stereo: Tensor | None = None) -> Tensor:
    """Return expected relative errors, (1, H, W), reduced to what the noise of the map leaves, where all is calm.

    A network that does not know over how many pixels noise is correlated expects more of it to remain. ``measured``,
    (1, h, w), is the map's inverse depth, NaN in holes; ``stereo``, (1, H, W), is that of the result, for noise that
    grows with the square of the distance.
    """
    at = measured.nanmedian().to(spread) if stereo is None else noise.distance**-2 / stereo.clamp(min=1e-6)
    left = left_of(noise.deviation) * at
    share, median = _find_calm(spread, measured)
    return spread * torch.lerp(torch.ones_like(spread), (left / median).clamp(max=1).expand_as(spread), share)


def mix_where_calm(found: InverseSurface, smoother: InverseSurface, measured: Tensor, reach: int) -> InverseSurface:
    """Return a result, (1, H, W), and where all is calm a smoother one; both state their errors.

    The one turns into the other over ``reach`` pixels; for ``measured``, see :func:`limit_to_noise`.
    """
    if found.spread is None or smoother.spread is None or found.angle is None or smoother.angle is None:
        return found
    share = _find_calm(torch.maximum(found.spread, smoother.spread), measured)[0].nan_to_num(0)
    least = -window_maxima(-share, reach)  # a mean of minima is nowhere more than the share itself
    share = functional.avg_pool2d(least, 2 * reach + 1, stride=1, padding=reach, count_include_pad=False)
    return InverseSurface(
        torch.lerp(found.inverse, smoother.inverse, share),
        torch.lerp(found.spread, smoother.spread, share),
        torch.lerp(found.angle, smoother.angle, share),
        found.noise,
    )


def _find_calm(spread: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Return how calm all is by the expected relative errors, from 0 to 1, and their median over measured pixels."""
    known = resize_nearest(measured.isfinite(), size_of(spread)).to(spread.device)
    median = spread.masked_fill(~known, torch.nan).nanmedian()
    return ((_UNSURE - spread / median) / (_UNSURE - _CALM)).clamp(0, 1), median


def _sum_up(inverse: Tensor) -> Tensor:
    """Return sums of 1, x, y, xx, xy, yy, v, vx, vy, vv of the known pixels above and left of corners, (10, h+1, w+1).

    x and y are columns and rows over the width, v is the inverse depth.
    """
    height, width = inverse.shape
    known = inverse.isfinite()
    m, v = known.to(inverse), torch.where(known, inverse, 0)
    x = torch.arange(width, dtype=v.dtype, device=v.device) / width
    y = (torch.arange(height, dtype=v.dtype, device=v.device) / width)[:, None]
    products = (m, m * x, m * y, m * x * x, m * x * y, m * y * y, v, v * x, v * y, v * v)
    sums = v.new_zeros(len(products), height + 1, width + 1)
    for place, values in zip(sums, products, strict=True):
        place[1:, 1:] = values.cumsum(dim=0).cumsum(dim=1)
    return sums


def _fit_planes(sums: Tensor, size: int) -> _Planes | None:
    """Return the planes of windows that are known, by least squares of :func:`_sum_up`; None for too few."""
    _, height, width = (n - 1 for n in sums.shape)
    stride = max(size // 2, int(math.sqrt(height * width / _MOST)))
    top, bottom = slice(0, height - size + 1, stride), slice(size, height + 1, stride)
    left, right = slice(0, width - size + 1, stride), slice(size, width + 1, stride)
    means = sums[:, bottom, right] - sums[:, top, right] - sums[:, bottom, left] + sums[:, top, left]
    means = means / size**2
    rows, columns = torch.nonzero(means[0] >= _KNOWN, as_tuple=True)
    if len(rows) < _FEWEST:
        return None
    means = means[:, rows, columns]
    _, mx, my, xx, xy, yy, mean, vx, vy, vv = means / means[0]
    xx, xy, yy, vx, vy, vv = xx - mx * mx, xy - mx * my, yy - my * my, vx - mx * mean, vy - my * mean, vv - mean * mean
    determinant = xx * yy - xy * xy
    a, b = (vx * yy - vy * xy) / determinant, (vy * xx - vx * xy) / determinant
    deviation = (vv - a * vx - b * vy).clamp(min=0).sqrt() / mean
    return _Planes(rows * stride, columns * stride, a / width, b / width, mean - a * mx - b * my, mean, deviation)


def _extent(inverse: Tensor, planes: _Planes, chosen: Tensor, size: int, deviation: float) -> float:
    """Return the full width at half maximum of the autocorrelation within windows; their size if it is wider."""
    places = torch.arange(size, device=inverse.device)
    rows, columns = planes.rows[chosen, None, None] + places[:, None], planes.columns[chosen, None, None] + places
    plane = planes.a[chosen, None, None] * columns + planes.b[chosen, None, None] * rows + planes.c[chosen, None, None]
    rest = inverse[rows, columns] - plane
    scale = planes.mean[chosen] * planes.deviation[chosen].clamp(min=deviation / 3)  # all windows count alike
    known = rest.isfinite()
    rest, known = torch.where(known, rest / scale[:, None, None], 0).float(), known.float()
    power, before = float(rest.square().sum() / known.sum()), 1.0
    for lag in range(1, size // 2 + 1):
        now = 0.0
        for dim in (1, 2):
            pairs = [each.narrow(dim, lag, size - lag) * each.narrow(dim, 0, size - lag) for each in (rest, known)]
            now += float(pairs[0].sum() / pairs[1].sum()) / power / 2
        if now < 0.5:
            return 2 * (lag - 1 + (before - 0.5) / (before - now))
        before = now
    return float(size)
