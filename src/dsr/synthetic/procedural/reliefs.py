"""Heightfields, such as reliefs, masonry and cloth, and organic shapes: smooth unions of blobs, lumpy balls, plants.

A heightfield's function takes the coordinates of a grid over [0, 1] x [0, 1], u along columns and v along rows, (R, R)
each. It returns heights in about [0, 1] and a tone for paint, (R, R) each, and the height of 1 as a fraction of the
side.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from dsr.synthetic.procedural.shape import Shape, grid, merge, place_on_ground, surface, tube, unit
from dsr.synthetic.raycast import Array, rotation_about

Heights = tuple[Array, Array, float]


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
        place = (int(rng.integers(0, count // 3)), (k + 1) * count // 4)
        cv2.putText(word, text, place, cv2.FONT_HERSHEY_TRIPLEX, count / 180, 255, 4)
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


class Blobs(NamedTuple):
    """A field, the sum of B Gaussian blobs - 0.5 + K ripples, positive inside."""

    centres: Array  # (B, 3)
    radii: Array  # (B, 3) along the coordinate axes
    weights: Array  # (B,) 1 for a blob, below 0 for a hollow
    waves: Array  # (K, 3) wave vectors of the ripples
    phases: Array  # (K,)
    heights: Array  # (K,)
    ridged: bool  # whether ripples are folds with sharp valleys instead of hills

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Return the field (N,) and its gradient (N, 3) at ``points`` (N, 3)."""
        total, gradient = np.full(len(points), -0.5), np.zeros(points.shape)
        for centre, radius, weight in zip(self.centres, self.radii, self.weights, strict=True):
            off = (points - centre) / radius
            bell = weight * np.exp(-(off**2).sum(1))
            total += bell
            gradient -= 2 * bell[:, None] * off / radius
        phase = points @ self.waves.T + self.phases
        swing, slope = self.shape_ripples(np.sin(phase) @ self.heights)
        return total + swing, gradient + slope[:, None] * ((np.cos(phase) * self.heights) @ self.waves)

    def shape_ripples(self, swing: Array) -> tuple[Array, Array]:
        """Return the ripples and their derivative for sums of waves."""
        if not self.ridged:
            return swing, np.ones_like(swing)
        soft = 0.25 * np.abs(self.heights).sum() + 1e-9
        root = np.sqrt(swing**2 + soft**2)
        return root, swing / root


def polygonise(field: Blobs, cells: int) -> Shape:
    """Return the zero set of a field on z = 0, its longest side ``cells`` cells, with exact vertices and normals."""
    centres, radii, weights, waves, phases, heights, _ = field
    low, high = (centres - 1.9 * radii).min(0), (centres + 1.9 * radii).max(0)
    step = (high - low).max() / cells
    axes = [np.arange(low[i], high[i] + step, step) for i in range(3)]
    # on a lattice, blobs and waves are products of functions of one coordinate
    bells = [np.exp(-(((axis - centres[:, i, None]) / radii[:, i, None]) ** 2)) for i, axis in enumerate(axes)]
    turns = [np.exp(1j * waves[:, i, None] * axis) for i, axis in enumerate(axes)]
    turns[0] = turns[0] * (heights * np.exp(1j * phases))[:, None]
    flat = (weights[:, None] * bells[0]).T @ (bells[1][:, :, None] * bells[2][:, None, :]).reshape(len(centres), -1)
    swing = turns[0].T @ (turns[1][:, :, None] * turns[2][:, None, :]).reshape(len(heights), -1)
    values = (flat - 0.5 + field.shape_ripples(swing.imag)[0]).reshape([len(axis) for axis in axes])
    for i in range(3):  # closed at the border
        np.moveaxis(values, i, 0)[[0, -1]] = -0.1
    vertices, faces, _, _ = marching_cubes(values, 0.0)
    points = low + step * vertices.astype(np.float64)
    for _ in range(3):
        value, gradient = field.evaluate(points)
        move = value / np.maximum((gradient**2).sum(1), 1e-9)
        points -= np.clip(move[:, None] * gradient, -step, step)
    tone = np.clip(0.5 + np.sin(points @ waves.T + phases) @ heights / 0.15, 0, 1)
    chart = np.column_stack((points[:, 0] + 0.3 * points[:, 1], points[:, 2], tone))
    return place_on_ground(Shape(points, faces.astype(np.intp), unit(field.evaluate(points)[1]), chart, points))


def _ripples(rng: np.random.Generator, cells: int) -> tuple[Array, Array, Array]:
    """Return waves, phases and heights of a random relief on a body 1 in size that is made of ``cells``."""
    count = int(rng.integers(5, 12))
    length = np.exp(rng.uniform(np.log(max(0.05, 7 / cells)), np.log(0.5), count))
    squeeze = rng.uniform(0.2, 1.0, 3)  # folds prefer a direction
    waves = unit(rng.normal(size=(count, 3)) * squeeze) * (2 * np.pi / length)[:, None]
    heights = rng.uniform(0.1, 1.2) * rng.uniform(0.3, 1.0, count) * 0.33 * length
    return waves, rng.uniform(0, 6.28, count), heights


def creature(rng: np.random.Generator, cells: int = 96) -> Shape:
    """Return an organic body: a trunk, limbs and lumps that flow into each other; about 1 high, on z = 0."""
    centres, radii = [], []
    for _ in range(rng.integers(2, 6)):
        steps = int(rng.integers(3, 7))
        start, heading = rng.uniform([-0.2, -0.2, 0.1], [0.2, 0.2, 0.9]), unit(rng.normal(size=3))
        thick = rng.uniform(0.09, 0.24) * np.linspace(1, rng.uniform(0.5, 1.1), steps)
        for k in range(steps):
            centres.append(start)
            radii.append(thick[k] * rng.uniform(0.85, 1.2, 3))
            heading = unit(heading + 0.45 * rng.normal(size=3))
            start = start + 0.75 * thick[k] * heading
    blobs = np.array(centres), np.array(radii), np.ones(len(radii))
    return polygonise(Blobs(*blobs, *_ripples(rng, cells), bool(rng.random() < 0.5)), cells)


_FACE = np.array(
    [  # centre, radii and weight: skull, jaw, hair, nose, brows, eyes, eyeballs, lip, mouth, lip, chin, ears
        [0.00, 0.00, 0.60, 0.30, 0.36, 0.36, 1.0],
        [0.00, -0.12, 0.32, 0.22, 0.24, 0.26, 0.8],
        [0.00, 0.12, 0.74, 0.34, 0.36, 0.30, 0.6],
        [0.00, -0.44, 0.47, 0.055, 0.12, 0.13, 0.9],
        [-0.14, -0.36, 0.66, 0.14, 0.10, 0.06, 0.35],
        [0.14, -0.36, 0.66, 0.14, 0.10, 0.06, 0.35],
        [-0.14, -0.44, 0.57, 0.10, 0.12, 0.06, -0.75],
        [0.14, -0.44, 0.57, 0.10, 0.12, 0.06, -0.75],
        [-0.14, -0.37, 0.57, 0.06, 0.06, 0.045, 0.6],
        [0.14, -0.37, 0.57, 0.06, 0.06, 0.045, 0.6],
        [0.00, -0.37, 0.30, 0.11, 0.09, 0.035, 0.5],
        [0.00, -0.44, 0.262, 0.12, 0.09, 0.022, -0.55],
        [0.00, -0.36, 0.225, 0.09, 0.09, 0.035, 0.5],
        [0.00, -0.34, 0.12, 0.10, 0.10, 0.08, 0.5],
        [-0.36, 0.02, 0.50, 0.05, 0.09, 0.12, 0.8],
        [0.36, 0.02, 0.50, 0.05, 0.09, 0.12, 0.8],
    ]
)


def _head(rng: np.random.Generator, high: float) -> Array:
    """Return the blobs (B, 7) of a head ``high`` metres tall whose neck is at the origin: centre, radii, weight."""
    blobs = _FACE * (1 + 0.07 * rng.normal(size=_FACE.shape) * [0, 1, 0.3, 1, 1, 1, 1])
    hair = rng.normal([0, 0.12, 0.72], [0.25, 0.18, 0.18], (int(rng.integers(0, 26)), 3))
    curls = np.column_stack((hair, rng.uniform(0.05, 0.13, (len(hair), 3)), np.full(len(hair), 0.42)))
    blobs = np.concatenate((blobs, curls[curls[:, 1] > -0.12]))
    blobs[:, :6] *= high
    return blobs


def _body(rng: np.random.Generator) -> Array:
    """Return the blobs (B, 7) of a robed body up to the neck, at a height of 0.82."""
    lean, swing = rng.uniform(-0.05, 0.05, 2), rng.uniform(-0.5, 0.9, 2)
    rows = [[*lean, 0.8, 0.06, 0.06, 0.06, 1], [*lean, 0.7, 0.14, 0.1, 0.1, 1], [*lean, 0.58, 0.13, 0.1, 0.12, 1]]
    for k, z in enumerate(np.linspace(0.45, 0.02, 5)):
        rows.append([0.6 * lean[0] * z, lean[1] * z, z, 0.13 + 0.02 * k, 0.12 + 0.015 * k, 0.12, 1])
    for side, angle in zip((-1, 1), swing, strict=True):
        for k in range(8):
            bent, thick = max(0, k - 3) * 0.045, 0.055 - 0.002 * k
            x = side * (0.15 + 0.015 * k - 0.5 * bent * angle)
            rows.append([x, -bent * (0.5 + angle), 0.74 - 0.042 * k + bent * (0.4 + angle), *[thick] * 3, 1])
    return np.array(rows, dtype=np.float64)


def figure(rng: np.random.Generator, cells: int = 120) -> Shape:
    """Return a robed human figure, or a bust; about 1 high, on z = 0, facing -y."""
    count = int(rng.integers(4, 9))
    if rng.random() < 0.5:
        head = _head(rng, 0.75)
        chest = np.array([[0, 0.0, -0.02, 0.17, 0.16, 0.2, 1], [0, 0.02, -0.26, 0.36, 0.2, 0.15, 1]])
        blobs = np.concatenate((head, chest))
        waves, heights = rng.normal(size=(count, 3)) * [40, 25, 30], rng.uniform(0.0, 0.012, count)
    else:
        head = _head(rng, 0.2)
        head[:, 2] += 0.8
        blobs = np.concatenate((head, _body(rng)))
        waves, heights = rng.normal(size=(count, 3)) * [60, 40, 9], rng.uniform(0.005, 0.03, count)
    phases = rng.uniform(0, 6.28, count)
    field = Blobs(blobs[:, :3], blobs[:, 3:6], blobs[:, 6], waves, phases, heights, bool(rng.random() < 0.5))
    shape = polygonise(field, cells)
    return shape.scale(1 / float(shape.vertices[:, 2].max()))


def pebble(rng: np.random.Generator, cells: int = 56) -> Shape:
    """Return a lumpy ball such as a stone, a fruit, a bread or crumpled paper; about 1 in size, on z = 0."""
    size = rng.uniform(0.3, 0.5, 3)
    rough = rng.uniform(0.0, 0.25) ** 1.3
    waves, phases, heights = _ripples(rng, cells)
    blob = np.zeros((1, 3)), size[None] * 1.2, np.ones(1)
    return polygonise(Blobs(*blob, waves, phases, heights * rough * 4, bool(rng.random() < 0.5)), cells)


def leaf(rng: np.random.Generator, length: float, wide: float) -> Shape:
    """Return a bent leaf that grows from the origin along x, curving down."""
    s, t = np.linspace(0, 1, 13), np.linspace(-1, 1, 7)
    half = wide * np.sin(np.pi * np.clip(s, 0.02, 0.985) ** rng.uniform(0.6, 1.2))
    droop, fold, roll = rng.uniform(0.2, 1.6), rng.uniform(0.0, 0.5), rng.uniform(-0.6, 0.6)
    angle = droop * s
    x, z = np.cumsum(np.cos(angle)) * length / 13, -np.cumsum(np.sin(angle)) * length / 13
    rise = z[:, None] + half[:, None] * (fold * np.abs(t) + roll * t)
    return surface(grid(x[:, None], half[:, None] * t, rise), tone=np.abs(t))


def plant(rng: np.random.Generator) -> list[Shape]:
    """Return [leaves, stems] of a plant about 1 high that grows from the origin."""
    slender = rng.random() < 0.4
    leaves, stems = [], []
    for _ in range(rng.integers(5, 11)):
        yaw, rise = rng.uniform(0, 360), rng.uniform(0.35, 0.9)
        s = np.linspace(0, 1, 8)
        out = rng.uniform(0.1, 0.35)
        path = np.column_stack((out * s**1.8, 0.05 * np.sin(4 * s), rise * s)) @ rotation_about(2, yaw).T
        stems.append(tube(path, 0.012, 8))
        for at in rng.uniform(0.35, 1.0, 2 if slender else 4):
            spot = path[int(at * 7)]
            size = rng.uniform(0.35, 0.6) if slender else rng.uniform(0.15, 0.3)
            blade = leaf(rng, size, size * (0.08 if slender else rng.uniform(0.22, 0.4)))
            turn = rotation_about(2, yaw + rng.uniform(-90, 90)) @ rotation_about(1, -rng.uniform(0, 70))
            leaves.append(blade.rotate(turn).translate(*spot))
    return [merge(leaves), merge(stems)]


def branches(rng: np.random.Generator) -> Shape:
    """Return a bare tree, coral or tangle of wire about 1 high that grows from the origin."""
    parts: list[Shape] = []
    tips = [(np.zeros(3), np.array([0.0, 0.0, 1.0]), rng.uniform(0.25, 0.45), rng.uniform(0.012, 0.04))]
    spread, bend = rng.uniform(0.4, 0.9), rng.uniform(0.1, 0.5)
    while tips and len(parts) < 40:
        start, way, length, radius = tips.pop(0)
        s = np.linspace(0, 1, 9)[:, None]
        path = start + length * (s * way + bend * s**2 * rng.normal(size=3) * [0.5, 0.5, 0.25])
        parts.append(tube(path, radius * np.linspace(1, 0.7, 9), 10))
        if length > 0.07:
            for _ in range(2 + int(rng.random() < 0.3)):
                heading = unit(way + spread * rng.normal(size=3))
                tips.append((path[-1], heading, length * rng.uniform(0.55, 0.9), 0.7 * radius))
    return merge(parts)
