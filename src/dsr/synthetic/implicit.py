"""Implicit surfaces for the ray caster: sphere tracing on a lattice, followed by a search for the exact root."""

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
        distance: function from points (3, N) to approximate distances (N,) in metres.
        bounds: box that contains the surface.
        step_fraction: fraction of ``distance`` that is a safe step; 1 for a true distance function.

    """

    distance: Field
    bounds: Box
    step_fraction: float = 0.7

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

    def _interpolate_distance(self, points: Array) -> Array:
        """Return ``distance`` interpolated from the lattice, which is fast and correct within about a cell."""
        place = (points - (self.bounds.centre - self.bounds.half)[:, None]) / _CELL
        return np.asarray(map_coordinates(self._samples, place, np.float64, order=1, mode="nearest"))

    def _intersect_bounds(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return the parameters t >= 0 at which the rays enter and leave the bounds."""
        enter, leave = self.bounds.intersect_local(self.bounds.to_local(origin), self.bounds.axes.T @ direction)
        return np.maximum(enter, 0.0), leave

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return the first root along the rays, found by sphere tracing."""
        scale = np.sqrt((direction**2).sum(0))
        t, leave = self._intersect_bounds(origin, direction)
        out, before = np.full(t.shape, np.inf), t.copy()
        live = np.flatnonzero(t < leave)
        while live.size:
            value = self._interpolate_distance(origin[:, live] + t[live] * direction[:, live]) - 1.5 * _CELL
            near = np.flatnonzero(value < 0.25 * _CELL)
            at = live[near]
            value[near] = self.distance(origin[:, at] + t[at] * direction[:, at])
            out[live[value < 0]] = t[live[value < 0]]
            live, value = live[value >= 0], value[value >= 0]
            before[live] = t[live]
            t[live] += np.maximum(self.step_fraction * value, 5e-4) / scale[live]
            live = live[t[live] < leave[live]]
        found = np.flatnonzero(np.isfinite(out))
        out[found] = self._root(origin[:, found], direction[:, found], before[found], out[found])
        return out

    def _root(self, origin: Array, direction: Array, low: Array, high: Array) -> Array:
        """Return the root between ``low`` (outside) and ``high`` (inside), by false position and bisection in turn."""
        out, live = high.copy(), np.arange(high.size)
        f_low, f_high = (self.distance(origin + t * direction) for t in (low, high))
        while np.any(early := f_low < 0):  # the interpolated distance was too large
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
        """Return the visible fraction of the patch, estimated from the smallest lattice distance to the ray."""
        length = np.sqrt((direction**2).sum(0))
        t, leave = self._intersect_bounds(origin, direction)
        t, leave = np.maximum(t, 1.6 * _CELL / length), np.minimum(leave, 1.0)
        clear = np.ones(t.shape)
        live = np.flatnonzero(t < leave)
        while live.size:
            value = self._interpolate_distance(origin[:, live] + t[live] * direction[:, live]) + 0.15 * _CELL
            clear[live] = np.minimum(clear[live], value / (t[live] * spread))
            t[live] += np.maximum(self.step_fraction * np.abs(value), 6e-3) / length[live]
            live = live[(t[live] < leave[live]) & (clear[live] > -1)]
        clear = np.maximum(clear, -1.0)
        return 0.25 * (1 + clear) ** 2 * (2 - clear)

    def openness(self, points: Array, normals: Array) -> Array:
        """Return the openness, estimated from the distances at three heights above the surface."""
        lost = np.zeros(points.shape[1])
        for height, weight in ((0.012, 8.0), (0.035, 4.0), (0.08, 2.0)):
            lost += weight * np.maximum(height - self.distance(points + height * normals), 0.0)
        return np.exp(-2.2 * lost)
