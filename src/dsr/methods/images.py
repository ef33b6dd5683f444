"""Operations on images and maps that methods share: values, sizes, holes, noise and cosine transforms.

While a network is exported to ONNX, some of them do the same in another way: in a graph no size depends on values.
"""

import math
import sys
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.utils.compute_device import constant

LUMA = (0.299, 0.587, 0.114)  # weights of red, green and blue in the luma (ITU-R BT.601)
_IMAGENET_MEAN, _IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_REACH = 2  # half width of Keys' kernel in low-resolution pixels
_CONTRAST = 0.02  # standard deviation of the difference of the colours of a surface's neighbouring pixels in [0, 1]
_ALIKE = 0.3  # affinity from which two pixels count as of one surface
_LEAST = 1e-4  # affinity of pixels of different surfaces


def exporting() -> bool:
    """Return whether a network is being exported, without importing the exporter, which takes a while."""
    return "torch.onnx" in sys.modules and bool(torch.onnx.is_in_onnx_export())


def grey(rgb: Tensor, weights: Sequence[float] = LUMA) -> Tensor:
    """Return the weighted sum of the channels of (B, 3, H, W) images, by default the luma, (B, 1, H, W)."""
    return (rgb * constant(tuple(weights), rgb.dtype, rgb.device)[:, None, None]).sum(dim=1, keepdim=True)


def normalise_imagenet(rgb: Tensor) -> Tensor:
    """Return images, (B, 3, H, W) in 0..1, minus the mean colour of ImageNet, divided by its standard deviation."""
    mean, deviation = (
        constant(values, rgb.dtype, rgb.device).view(3, 1, 1) for values in (_IMAGENET_MEAN, _IMAGENET_DEVIATION)
    )
    return (rgb - mean) / deviation


class Normalised(NamedTuple):
    """A map normalised to 0..1 per sample, (B, 1, H, W), and its minimum and range, (B, 1, 1, 1), to undo it."""

    values: Tensor
    minimum: Tensor
    value_range: Tensor


def normalise(x: Tensor, min_max: Tensor | None = None) -> Normalised:
    """Return (x - min) / (max - min) per sample of (B, 1, H, W), over the finite values; the others become 0.

    A constant map becomes 0 with a range of 0. Without a finite value, the minimum is NaN. ``min_max`` (B, 2, 1, 1) is
    what to use in place of the map's own.
    """
    min_max = compute_min_max(x) if min_max is None else min_max.to(x)
    minimum = min_max[:, :1]
    value_range = min_max[:, 1:] - minimum  # -inf where nothing is finite
    values = torch.where(x.isfinite(), x - minimum, 0) / torch.where(value_range > 0, value_range, 1)
    return Normalised(values, torch.where(value_range >= 0, minimum, torch.nan), value_range)


def compute_min_max(x: Tensor) -> Tensor:
    """Return the minimum and maximum finite value of each map (B, 1, H, W), (B, 2, 1, 1), else inf and -inf."""
    invalid, dims = ~x.isfinite(), (-3, -2, -1)
    lowest = x.masked_fill(invalid, torch.inf).amin(dims, keepdim=True)
    return torch.cat((lowest, x.masked_fill(invalid, -torch.inf).amax(dims, keepdim=True)), dim=1)


def mean3x3(x: Tensor) -> Tensor:
    """Return the 3 x 3 mean of (B, C, H, W); edge pixels are repeated."""
    return functional.avg_pool2d(functional.pad(x, (1, 1, 1, 1), mode="replicate"), 3, stride=1)


def box_mean(x: Tensor, scale: int) -> Tensor:
    """Return the mean of each scale x scale block, (B, C, H, W) -> (B, C, H / scale, W / scale)."""
    return functional.avg_pool2d(x, scale)


def repeat_blocks(x: Tensor, scale: int) -> Tensor:
    """Repeat each pixel as a scale x scale block, (B, C, h, w) -> (B, C, scale h, scale w)."""
    batch, channels, height, width = x.shape
    blocks = x[:, :, :, None, :, None].expand(batch, channels, height, scale, width, scale)
    return blocks.reshape(batch, channels, height * scale, width * scale)


def resize_bicubic(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge (B, 1, h, w) to (B, 1, *size) as Pillow does: Keys' cubic kernel with a = -0.5, cut off at the border."""
    return functional.interpolate(x, size=size, mode="bicubic", align_corners=False, antialias=True)


def upsample_bicubic(x: Tensor, scale: int) -> Tensor:
    """Upsample (B, 1, h, w) to (B, 1, scale h, scale w), as :func:`resize_bicubic` does."""
    height, width = x.shape[-2:]
    return resize_bicubic(x, (scale * height, scale * width))


def upsample_linear_border(lr: Tensor, scale: int) -> Tensor:
    """Upsample (B, 1, h, w) bicubically to (B, 1, scale h, scale w); planes are exact up to the border."""
    if scale == 1:
        return lr.clone()
    edge = _REACH * scale
    return upsample_bicubic(extend_linearly(lr, _REACH), scale)[..., edge:-edge, edge:-edge].contiguous()


def extend_linearly(x: Tensor, border: int) -> Tensor:
    """Extrapolate (B, C, h, w) linearly by ``border`` pixels on each side; planes are continued exactly."""
    for dim in (-1, -2):
        count = x.shape[dim]
        first, last = x.narrow(dim, 0, 1), x.narrow(dim, count - 1, 1)
        before = first - x.narrow(dim, min(1, count - 1), 1)  # 0 where there is a single pixel
        after = last - x.narrow(dim, max(count - 2, 0), 1)
        steps = torch.arange(1, border + 1, dtype=x.dtype, device=x.device).view(-1, *[1] * (-1 - dim))
        x = torch.cat((first + steps.flip(0) * before, x, last + steps * after), dim=dim)
    return x


def pad_to_multiple(x: Tensor, factor: int) -> Tensor:
    """Repeat the last row and column of (B, C, h, w) so that both sizes become multiples of ``factor``."""
    height, width = x.shape[-2:]
    if not exporting():
        if width % factor == height % factor == 0:
            return x
        return functional.pad(x, (0, -width % factor, 0, -height % factor), mode="replicate")
    more = functional.pad(x, (0, factor - 1, 0, factor - 1), mode="replicate")
    rows, columns = (factor * ((n + factor - 1) // factor) for n in (height, width))
    return more[..., :rows, :columns]


def lr_coordinates(camera: Camera, camera_lr: Camera, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
    """Return the low-resolution row of each high-resolution row, (H,), and likewise the columns, (W,), in float64."""
    rows = torch.arange(camera.height, dtype=torch.float64, device=device)
    columns = torch.arange(camera.width, dtype=torch.float64, device=device)
    return (
        (rows - camera.cy) / camera.fy * camera_lr.fy + camera_lr.cy,
        (columns - camera.cx) / camera.fx * camera_lr.fx + camera_lr.cx,
    )


def inpaint(x: Tensor, photo: Tensor | None = None) -> Tensor:
    """Replace the non-finite values of (B, 1, h, w) by means of the valid ones in 3 x 3 pixels, from outside in.

    With a photo, (B, 3, H, W) in [0, 1] of any size, the means are weighted by how alike the colours are, and pixels of
    the colour of a valid neighbour are filled before others. An image without a valid value stays unchanged.
    """
    if not exporting() and bool(x.isfinite().all()):
        return x
    if photo is None:
        known = x.isfinite()
        values, weight = _fill_evenly(torch.where(known, x, 0), known.to(x.dtype))
        return torch.where(weight > 0, values, torch.nan)
    if exporting():  # one factor for both axes
        colours = mean3x3(functional.avg_pool2d(photo.to(x.dtype), int(photo.shape[-1] // x.shape[-1])))
        difference = (_neighbours_of(colours) - colours[:, None]).square().sum(dim=2)  # (B, 8, h, w)
        affinity = (difference / (-2 * _CONTRAST**2)).exp().clamp(min=_LEAST)
        return _fill_by_colour_in_graph(x, affinity, _ALIKE)
    colours = mean3x3(functional.adaptive_avg_pool2d(photo.to(x.dtype), (x.shape[-2], x.shape[-1])))
    return torch.stack([_fill_by_colour(each[0], colour) for each, colour in zip(x, colours, strict=True)])[:, None]


@torch.jit.script_if_tracing
def _fill_evenly(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fill maps, (B, 1, h, w), which are 0 where ``weight`` is, with means of known values; a graph keeps the loop."""
    more = True
    while more:
        total = functional.avg_pool2d(values, [3, 3], [1, 1], [1, 1])
        fraction = functional.avg_pool2d(weight, [3, 3], [1, 1], [1, 1])
        new = (weight == 0) & (fraction > 0)
        more = bool(new.any())
        values = torch.where(new, total / fraction.clamp(min=0.01), values)  # a ninth or more where it counts
        weight = weight.masked_fill(new, 1.0)
    return values, weight


def _fill_by_colour(x: Tensor, colours: Tensor) -> Tensor:
    """Return a map, (h, w), filled with means weighted by the colours, (3, h, w)."""
    height, width = x.shape
    values = functional.pad(x, (1, 1, 1, 1), value=torch.nan).flatten()
    colour = functional.pad(colours, (1, 1, 1, 1)).flatten(1)
    inside = functional.pad(torch.ones_like(x, dtype=torch.bool), (1, 1, 1, 1)).flatten()
    steps = [row * (width + 2) + column for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]
    around = torch.tensor(steps, device=x.device)
    unknown = values.isnan() & inside
    known = values.isfinite()
    places = unknown.nonzero()[:, 0]
    front = places[known[places[:, None] + around].any(dim=1)]  # beside what has just become known
    waiting, every = torch.zeros_like(known), False  # beside known pixels, none of which is alike
    while front.numel():
        beside = front[:, None] + around  # (n, 8)
        difference = (colour[:, beside] - colour[:, front, None]).square().sum(dim=0)
        affinity = (difference / (-2 * _CONTRAST**2)).exp().clamp(min=_LEAST) * known[beside]
        first = (affinity.amax(dim=1) >= _ALIKE) | every
        waiting[front] = ~first
        filled, affinity, beside = front[first], affinity[first], beside[first]
        values[filled] = (affinity * values[beside].nan_to_num(0)).sum(dim=1) / affinity.sum(dim=1)
        known[filled] = True
        unknown[filled] = False
        beside = beside.flatten()
        front = beside[unknown[beside]].unique()
        every = not front.numel()
        if every:
            front = waiting.nonzero()[:, 0]
    return values.view(height + 2, width + 2)[1:-1, 1:-1]


@torch.jit.script_if_tracing  # so that a graph keeps its loop
def _fill_by_colour_in_graph(x: Tensor, affinity: Tensor, alike: float) -> Tensor:
    """Fill a map, (1, 1, h, w), as :func:`inpaint` does with a photo; ``affinity`` (1, 8, h, w) is of neighbours."""
    known = torch.isfinite(x).to(affinity.dtype)
    values = torch.where(known > 0, x, torch.zeros_like(x))
    before = torch.zeros_like(known.sum()) - 1
    while bool(known.sum() != before):
        before = known.sum()
        weights = affinity * _neighbours_of(known)[:, :, 0]
        nearest = weights.amax(dim=1, keepdim=True)
        front = (known == 0) & (nearest > 0)
        likely = front & (nearest >= alike)
        first = likely | (front & ~likely.any())
        total = weights.sum(dim=1, keepdim=True)
        mean = (weights * _neighbours_of(values)[:, :, 0]).sum(dim=1, keepdim=True)
        values = torch.where(first, mean / torch.where(total > 0, total, torch.ones_like(total)), values)
        known = torch.where(first, torch.ones_like(known), known)
    return torch.where(known > 0, values, torch.full_like(values, float("nan")))


def _neighbours_of(x: Tensor) -> Tensor:
    """Return the eight neighbours of each pixel, row by row, (B, C, h, w) to (B, 8, C, h, w); 0 beyond the border."""
    height, width = x.shape[-2], x.shape[-1]
    padded = functional.pad(x, [1, 1, 1, 1])
    around = []
    for down in range(3):
        for across in range(3):
            if down != 1 or across != 1:
                around.append(padded[:, :, down : down + height, across : across + width])
    return torch.stack(around, dim=1)


def estimate_noise(depth_lr: Tensor) -> float:
    """Return the standard deviation of the relative noise of a depth map, (1, 1, h, w) in metres, NaN in holes.

    Immerkaer, *Fast Noise Variance Estimation*, CVIU 1996: the difference of two Laplacians, which is 0 on planes and
    on straight edges; here of the logarithm of depth, with the 10th percentile instead of the mean.
    """
    # a tenth of a normal variable's absolute values are below 0.12566 standard deviations
    return _low_quantile(depth_lr.double().log(), 1, 0.1) / 0.12566 / 6


def estimate_sensor_noise(values: Tensor) -> float:
    """Return the standard deviation of a map's noise, also where a sensor rounds its values or neighbours share noise.

    As :func:`estimate_noise`, with a quarter of the responses, because rounding makes many of them 0, and the larger of
    the estimates from neighbouring pixels and from every second one, because the first misses correlated noise.
    ``values`` (1, 1, h, w) are in a unit in which planes are linear and noise is alike everywhere.
    """
    # a quarter of a normal variable's absolute values are below 0.31864 standard deviations
    return max(_low_quantile(values.double(), stride, 0.25) for stride in (1, 2)) / 0.31864 / 6


def _low_quantile(values: Tensor, stride: int, fraction: float) -> float:
    """Return a quantile of the absolute differences of two Laplacians of a map, whose taps are ``stride`` apart."""
    if min(values.shape[-2:]) < 2 * stride + 1:
        return 0.0
    row = torch.tensor([1.0, -2.0, 1.0], dtype=torch.float64, device=values.device)
    responses = functional.conv2d(values, torch.outer(row, row)[None, None], dilation=stride).abs()
    valid = responses[responses.isfinite()]
    if not len(valid):
        return 0.0
    return float(valid.kthvalue(max(round(fraction * len(valid)), 1)).values)


def normal_noise_deg(noise: float, camera: Camera) -> float:
    """Return a frontal normal's standard deviation in degrees under relative depth noise s: a slope of sqrt(2) s f."""
    return math.degrees(math.atan(math.sqrt(2) * noise * camera.fx))


def dct2(x: Tensor) -> Tensor:
    """Return the discrete cosine transform, type II, of the last two axes of a real tensor, (..., H, W).

    The coefficient (k, l) is 4 sum x(i, j) cos(pi k (2i + 1) / 2H) cos(pi l (2j + 1) / 2W). Makhoul, *A fast cosine
    transform in one and two dimensions*, IEEE TASSP 28(1), 1980: along each axis, the values with even indices are put
    first and those with odd indices follow in reverse order. With V the Fourier transform of the result, a(k) =
    exp(-i pi k / 2H) and b(l) = exp(-i pi l / 2W), the cosine transform is 2 Re T for T(k, l) = b(l) (a(k) V(k, l) +
    conj(a(k)) V(-k, l)), and at W - l it is -2 Im T(k, l), so half of the spectrum is enough.
    """
    height, width = x.shape[-2:]
    half = width // 2 + 1
    spectrum = torch.fft.rfft2(x[..., _order(height, x)[:, None], _order(width, x)])  # (..., H, W // 2 + 1)
    spectrum = spectrum * (2 * _phase(height, height, x)[:, None] * _phase(width, half, x))
    # conj(a(k)) V(-k, l), since a(H - k) = -i conj(a(k))
    mirrored = torch.cat((spectrum[..., :1, :], 1j * spectrum[..., 1:, :].flip(-2)), dim=-2)
    packed = spectrum + mirrored
    return torch.cat((packed.real, -packed.imag[..., 1 : (width + 1) // 2].flip(-1)), dim=-1)


def idct2(coefficients: Tensor) -> Tensor:
    """Return the inverse of :func:`dct2`, the type III transform divided by 4HW, for (..., H, W)."""
    height, width = coefficients.shape[-2:]
    half = width // 2 + 1
    reverse = -coefficients[..., width - half + 1 :].flip(-1)
    imaginary = torch.cat((torch.zeros_like(coefficients[..., :1]), reverse), dim=-1)
    packed = torch.complex(coefficients[..., :half], imaginary)
    # T(H - k, l) for k > 0; there is no such term for k = 0
    mirrored = torch.cat((torch.zeros_like(packed[..., :1, :]), packed[..., 1:, :].flip(-2)), dim=-2)
    phase = _phase(height, height, packed)[:, None] * _phase(width, half, packed)
    spectrum = (packed - 1j * mirrored) * (phase.conj() / 4)
    shuffled = torch.fft.irfft2(spectrum, s=(height, width))
    rows, columns = (_order(size, shuffled).argsort() for size in (height, width))
    return shuffled[..., rows[:, None], columns]


def laplacian_eigenvalues(height: int, width: int, like: Tensor) -> Tensor:
    """Return the eigenvalues, none positive, of the five-point Laplacian in the basis of :func:`dct2`, (H, W)."""
    rows, columns = (
        torch.cos(math.pi / size * torch.arange(size, dtype=torch.float64, device=like.device))
        for size in (height, width)
    )
    return (2 * (rows[:, None] + columns - 2)).to(like)


def _order(size: int, like: Tensor) -> Tensor:
    """Return the indices of an axis, the even ones first and then the odd ones in reverse order, (size,)."""
    indices = torch.arange(size, device=like.device)
    return torch.cat((indices[::2], indices[1::2].flip(0)))


def _phase(size: int, count: int, like: Tensor) -> Tensor:
    """Return exp(-i pi k / 2 size) for k < count, (count,), in the precision of ``like``."""
    angle = torch.arange(count, dtype=torch.float64, device=like.device) * (-math.pi / (2 * size))
    return torch.polar(torch.ones_like(angle), angle).to(like.dtype.to_complex())
