"""Heightfields: reliefs, masonry, folds, crumpled cloth, ground.

Each function takes the coordinates of a grid over [0, 1] x [0, 1], u along columns and v along rows, (R, R) each. It
returns heights in about [0, 1] and a tone for paint, (R, R) each, and the height of 1 as a fraction of the side.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from dsr.synthetic.procedural.shape import Shape, grid, surface
from dsr.synthetic.raycast import Array

Heights = tuple[Array, Array, float]
_FACE = cv2.FONT_HERSHEY_TRIPLEX


def spectrum(rng: np.random.Generator, count: int, slope: float, squeeze: float = 1.0) -> Array:
    """Return a periodic random surface (count, count) whose amplitudes fall with frequency**-slope, from 0 to 1."""
    fy, fx = np.meshgrid(np.fft.fftfreq(count), np.fft.rfftfreq(count) * squeeze, indexing="ij")
    frequency = np.hypot(fx, fy) * count
    fall = np.maximum(frequency, 1.0) ** -slope
    waves = np.fft.rfft2(rng.normal(size=(count, count))) * fall * np.exp(-((frequency / 90) ** 2))
    waves[0, 0] = 0
    out = np.fft.irfft2(waves, s=(count, count))
    return np.asarray((out - out.min()) / np.ptp(out))


def _step(value: Array, soft: float) -> Array:
    """Return a smooth step at 0, ``soft`` wide."""
    return 0.5 + 0.5 * np.tanh(value / soft)


def ground(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return hills, dunes or rough ground."""
    height = spectrum(rng, len(u), rng.uniform(1.6, 2.5), rng.choice([1.0, 1.0, 0.4]))
    if rng.random() < 0.3:  # ridges
        height = gaussian_filter(1 - np.abs(2 * height - 1), 1.0)
    return height, height, rng.uniform(0.02, 0.13)


def folds(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return cloth with folds that run across, meet and fade."""
    warp = spectrum(rng, len(u), 2.6)
    total = np.zeros(u.shape)
    for _ in range(rng.integers(2, 5)):
        angle = rng.normal(0, 0.5)
        phase = (np.cos(angle) * u + np.sin(angle) * v) * rng.uniform(3, 14) + rng.uniform(1, 5) * warp
        total += rng.uniform(0.4, 1) * np.sqrt(0.02 + np.sin(np.pi * phase) ** 2) * (0.3 + spectrum(rng, len(u), 2.4))
    total = gaussian_filter(total, 1.0)
    total -= total.min()
    return total / total.max(), total / total.max(), rng.uniform(0.02, 0.1)


def crumple(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return crumpled paper or cloth: facets between creases."""
    total = np.zeros(u.shape)
    for k in range(14):
        a, b = rng.normal(size=2) * (1.5 + 0.6 * k), rng.uniform(0, 1)
        total += np.abs(((a[0] * u + a[1] * v + b + 0.25 * spectrum(rng, len(u), 2.8)) % 1) - 0.5) / (1.5 + 0.6 * k)
    total = gaussian_filter(total, 1.2)
    total = (total - total.min()) / np.ptp(total)
    return total, total, rng.uniform(0.04, 0.16)


def masonry(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return courses of bricks, ashlars or planks."""
    rows = int(rng.integers(4, 16))
    aspect = float(rng.choice([1.0, 2.2, 3.0, 5.0]))
    shift = float(rng.choice([0.0, 0.5, 0.33]))
    row = np.floor(v * rows).astype(np.intp)
    across = u * rows / aspect + shift * row
    column = np.floor(across).astype(np.intp)
    table = rng.random((64, 64, 4))[row % 64, column % 64]
    x, y = across - column - 0.5, v * rows - row - 0.5
    edge = np.minimum((0.5 - np.abs(x)) * aspect, 0.5 - np.abs(y))
    inside = np.clip((edge - rng.uniform(0.02, 0.06)) / rng.uniform(0.03, 0.12), 0, 1)
    inside = inside * inside * (3 - 2 * inside)
    tilt = rng.uniform(0, 0.5) * ((table[..., 1] - 0.5) * x + (table[..., 2] - 0.5) * y)
    grain = rng.uniform(0, 0.25) * spectrum(rng, len(u), rng.uniform(1.0, 2.0))
    height = inside * (1 - rng.uniform(0, 0.6) * table[..., 0] + tilt) + grain
    return height, inside * (0.3 + 0.7 * table[..., 3]), rng.uniform(0.1, 0.3) / rows


def cobbles(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return rounded stones of random shape."""
    seeds = rng.random((int(rng.integers(30, 260)), 2)) * 1.2 - 0.1
    warp = 0.02 * spectrum(rng, len(u), 2.0)
    near, which = cKDTree(seeds).query(np.stack((u + warp, v - warp), axis=-1), k=2)
    gap = (near[..., 1] - near[..., 0]) * np.sqrt(len(seeds))
    dome = np.sqrt(np.clip(gap / rng.uniform(0.5, 1.4), 0, 1))
    lift = rng.random(len(seeds))[which[..., 0]]
    height = gaussian_filter(dome * (0.6 + 0.4 * lift), 1.0) + 0.1 * spectrum(rng, len(u), 1.8)
    return height, np.clip(dome, 0, 1) * (0.4 + 0.6 * lift), rng.uniform(0.3, 0.8) / np.sqrt(len(seeds))


def ornament(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return a repeated motif: rings, flowers, studs, pyramids, flutes, basketry."""
    repeat = int(rng.integers(2, 10))
    x, y = (u * repeat) % 1 - 0.5, (v * repeat) % 1 - 0.5
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    petals = int(rng.integers(3, 9))
    soft = 0.012 * repeat
    motif = (
        lambda: np.exp(-(((radius - 0.3) / 0.07) ** 2)) + np.exp(-((radius / 0.1) ** 2)),
        lambda: _step(0.28 + 0.12 * np.cos(petals * angle) - radius, soft) * (1 - radius),
        lambda: np.sqrt(np.maximum(0.0, 1 - (radius / 0.38) ** 2)),
        lambda: 1 - 2 * np.maximum(np.abs(x), np.abs(y)),
        lambda: np.abs(np.sin(np.pi * u * repeat)),
        lambda: np.where((np.floor(u * repeat) + np.floor(v * repeat)) % 2, np.cos(np.pi * x), np.cos(np.pi * y)),
    )[rng.integers(6)]()
    height = gaussian_filter(motif, 1.0)
    height += rng.uniform(0, 0.3) * spectrum(rng, len(u), 2.2)
    return height, np.clip(height, 0, 1), rng.uniform(0.08, 0.3) / repeat


def panels(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return a wall or door with recessed fields, mouldings, steps and lettering."""
    count, height = len(u), np.zeros(u.shape)
    soft = 1.2 / count
    for _ in range(rng.integers(2, 8)):
        cx, cy, hx, hy = rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9), *rng.uniform(0.05, 0.35, 2)
        edge = np.minimum(hx - np.abs(u - cx), hy - np.abs(v - cy))
        if rng.random() < 0.3:
            edge = min(hx, hy) - np.hypot(u - cx, v - cy)
        height += rng.uniform(-0.4, 0.6) * _step(edge, soft * rng.choice([1.0, 1.0, 6.0]))
    word = np.zeros(u.shape, np.uint8)
    for k in range(int(rng.integers(0, 4))):
        text = "".join(rng.choice(list("AEGHKMNORSTUVX"), 6))
        cv2.putText(word, text, (int(rng.integers(0, count // 3)), (k + 1) * count // 4), _FACE, count / 180, 255, 4)
    height += rng.uniform(0.2, 0.5) * gaussian_filter(word[::-1] / 255.0, 1.2)
    height -= height.min()
    tone = np.clip(height / max(height.max(), 1e-6), 0, 1)
    return height, tone, rng.uniform(0.02, 0.08)


def quilt(rng: np.random.Generator, u: Array, v: Array) -> Heights:
    """Return padded upholstery with buttons or seams."""
    repeat = int(rng.integers(3, 9))
    a, b = (u + v, u - v) if rng.random() < 0.5 else (u, v)
    height = np.sqrt(np.abs(np.sin(np.pi * a * repeat) * np.sin(np.pi * b * repeat)) + 0.01)
    height = gaussian_filter(height, 1.3) + 0.15 * spectrum(rng, len(u), 2.5)
    return height, np.clip(height, 0, 1), rng.uniform(0.1, 0.3) / repeat


Maker = Callable[[np.random.Generator, Array, Array], Heights]
RELIEFS: tuple[Maker, ...] = (masonry, cobbles, ornament, panels, folds, crumple, quilt, ground)


def relief(rng: np.random.Generator, maker: Maker, side: float, count: int = 300, bend: float = 0.0) -> Shape:
    """Return a square relief of ``side`` metres around the origin, its middle ``bend`` sides above the edges in x."""
    u, v = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    height, tone, amplitude = maker(rng, u, v)
    z = side * (amplitude * height + bend * (1 - (2 * u - 1) ** 2))
    return surface(grid(side * (u - 0.5), side * (v - 0.5), z), tone=tone)


def blanket(rng: np.random.Generator, size: Array, thick: float, count: int = 150) -> Shape:
    """Return a rumpled cushion or blanket of ``size`` (2,) metres, about ``thick`` in the middle, 0 at the edge."""
    u, v = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    pillow = ((1 - (2 * u - 1) ** 6) * (1 - (2 * v - 1) ** 6)) ** 0.5
    height, tone, _ = (folds, crumple, quilt, ground)[rng.integers(4)](rng, u, v)
    z = thick * pillow * (0.75 + 0.35 * height)
    return surface(grid(size[0] * (u - 0.5), size[1] * (v - 0.5), z), tone=tone)


def curtain(rng: np.random.Generator, width: float, height: float) -> Shape:
    """Return a hanging curtain in the plane y = 0, from z = 0 to ``height``, x from 0 to ``width``."""
    columns, rows = 220, 60
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    waves = max(3.0, width / rng.uniform(0.08, 0.2))
    drift = sum(rng.uniform(-0.5, 0.5) * np.sin(k * (u * 3 + 0.5 * v) + rng.uniform(0, 6)) for k in (1, 2, 3))
    phase = 2 * np.pi * waves * u + drift * (1 + (1 - v))
    deep = rng.uniform(0.15, 0.4) * width / waves
    y = deep * (np.sin(phase) + 0.25 * np.sin(2 * phase + 3 * drift)) * (0.7 + 0.6 * (1 - v) * rng.uniform(0, 1))
    x = width * u + 0.3 * deep * np.cos(phase)
    return surface(grid(x, y, height * v), tone=0.5 + 0.5 * np.sin(phase))
