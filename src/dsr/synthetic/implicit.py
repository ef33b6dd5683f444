"""Implicit surfaces for the ray caster: sphere tracing on a lattice, then the exact root."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from dsr.synthetic.surfaces import Array, Box, Field, Surface

_CELL = 0.0125  # metres between the samples of an implicit surface's lattice


@dataclass(frozen=True, eq=False)
class Implicit(Surface):
    """The zero set of a continuous function, positive outside.

    Args:
        distance: maps points (3, N) to (N,), about the distance in metres.
        bounds: a box that contains the surface.
        caution: fraction of ``distance`` that is safe to step; 1 for a true distance function.

    """

    distance: Field
    bounds: Box
    caution: float = 0.7

    @cached_property
    def _samples(self) -> NDArray[np.float32]:
        """Return ``distance`` on a lattice of 12.5 mm over the bounds."""
        nx, ny, nz = (math.ceil(2 * half / _CELL) + 1 for half in self.bounds.half)
        lattice = _CELL * np.indices((ny, nz)).reshape(2, -1)
        low = self.bounds.centre - self.bounds.half
        out = np.empty((nx, ny, nz), np.float32)
        for i in range(nx):
            points = low[:, None] + np.vstack((np.full_like(lattice[:1], i * _CELL), lattice))
            out[i] = self.distance(points).reshape(ny, nz)
        return out

    def _about(self, points: Array) -> Array:
        """Return ``distance`` interpolated from the lattice: quick, and right within about a cell."""
        place = (points - (self.bounds.centre - self.bounds.half)[:, None]) / _CELL
        return np.asarray(map_coordinates(self._samples, place, np.float64, order=1, mode="nearest"))

    def _limits(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return when the rays are within the bounds, from t = 0 on."""
        enter, leave = self.bounds.span(self.bounds.local(origin), self.bounds.axes.T @ direction)
        return np.maximum(enter, 0.0), leave

    def hit(self, origin: Array, direction: Array) -> Array:
        """Return the first sign change along the rays, by sphere tracing, refined to a root."""
        scale = np.sqrt((direction**2).sum(0))
        t, leave = self._limits(origin, direction)
        out, before = np.full(t.shape, np.inf), t.copy()
        live = np.flatnonzero(t < leave)
        while live.size:
            value = self._about(origin[:, live] + t[live] * direction[:, live]) - 1.5 * _CELL
            near = np.flatnonzero(value < 0.25 * _CELL)
            at = live[near]
            value[near] = self.distance(origin[:, at] + t[at] * direction[:, at])
            out[live[value < 0]] = t[live[value < 0]]
            live, value = live[value >= 0], value[value >= 0]
            before[live] = t[live]
            t[live] += np.maximum(self.caution * value, 5e-4) / scale[live]
            live = live[t[live] < leave[live]]
        found = np.flatnonzero(np.isfinite(out))
        out[found] = self._root(origin[:, found], direction[:, found], before[found], out[found])
        return out

    def _root(self, origin: Array, direction: Array, low: Array, high: Array) -> Array:
        """Return the root between ``low`` (outside) and ``high`` (inside): false position and bisection in turn."""
        out, live = high.copy(), np.arange(high.size)
        f_low, f_high = (self.distance(origin + t * direction) for t in (low, high))
        while np.any(early := f_low < 0):  # the lattice had promised too much
            low = np.where(early, low - _CELL / 4, low)
            f_low = self.distance(origin + low * direction)
        for step in range(80):
            weight = 0.5 if step % 3 == 2 else f_low / np.maximum(f_low - f_high, 1e-300)
            out[live] = middle = low + weight * (high - low)
            value = self.distance(origin[:, live] + middle * direction[:, live])
            outside = value >= 0
            low, f_low = np.where(outside, middle, low), np.where(outside, value, f_low)
            high, f_high = np.where(outside, high, middle), np.where(outside, f_high, value)
            on = np.abs(value) >= 1e-11
            live, low, high, f_low, f_high = live[on], low[on], high[on], f_low[on], f_high[on]
            if not live.size:
                break
        return out

    def normal(self, points: Array) -> Array:
        """Return the normalised gradient by differences over 0.3 mm at the corners of a tetrahedron."""
        corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=np.float64)
        gradient = sum(c[:, None] * self.distance(points + 3e-4 * c[:, None]) for c in corners)
        return np.asarray(gradient / np.maximum(np.sqrt(np.sum(gradient**2, axis=0)), 1e-300))

    def visibility(self, origin: Array, direction: Array, spread: float) -> Array:
        """Return the share of the patch that the nearest passage of the ray leaves free, on the lattice."""
        length = np.sqrt((direction**2).sum(0))
        t, leave = self._limits(origin, direction)
        t, leave = np.maximum(t, 1.6 * _CELL / length), np.minimum(leave, 1.0)
        clear = np.ones(t.shape)
        live = np.flatnonzero(t < leave)
        while live.size:
            value = self._about(origin[:, live] + t[live] * direction[:, live]) + 0.15 * _CELL
            clear[live] = np.minimum(clear[live], value / (t[live] * spread))
            t[live] += np.maximum(self.caution * np.abs(value), 6e-3) / length[live]
            live = live[(t[live] < leave[live]) & (clear[live] > -1)]
        clear = np.maximum(clear, -1.0)
        return 0.25 * (1 + clear) ** 2 * (2 - clear)

    def openness(self, points: Array, normals: Array) -> Array:
        """Compare the distance at a few heights above the surface with the heights."""
        lost = np.zeros(points.shape[1])
        for height, weight in ((0.012, 8.0), (0.035, 4.0), (0.08, 2.0)):
            lost += weight * np.maximum(height - self.distance(points + height * normals), 0.0)
        return np.exp(-2.2 * lost)
