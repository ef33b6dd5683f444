"""Shapes of clear and mirroring objects in images: vessels, balls, boxes and plates, seen along parallel rays."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.random_fields import chance, draw, normal, uniform


class Pose(NamedTuple):
    """Where an object is and how it stands."""

    u: float  # the middle of its foot in the image
    v: float
    up: tuple[float, float]  # direction of its axis in the image, a unit vector (u, v)
    pitch: float  # sine of the angle at which one looks down on it
    slope: float  # by how many pixels a point is farther for each pixel further up
    depth: float  # of its foot in metres


class Body(NamedTuple):
    """An object in a window of h x w pixels, in coordinates of the image: u right, v down, z towards the camera."""

    rows: slice  # the window in the image
    columns: slice
    mask: Tensor  # (h, w), where the object is
    near: Tensor  # (h, w), by how many pixels its front is nearer than its foot
    far: Tensor  # (h, w), likewise its back
    front: Tensor  # (3, h, w), unit normals on the camera's side
    back: Tensor  # (3, h, w), likewise
    lines: Tensor  # (h, w), rims and edges, 0 to 1
    up: Tensor  # (h, w), pixels along the axis


_PROFILES = {"tumbler": 0.3, "bottle": 0.35, "goblet": 0.12, "bowl": 0.1, "jar": 0.13}
_SAMPLES, _REACH = 256, 9  # of a profile, and by how many of them its corners are rounded


def draw_vessel(pose: Pose, radius: float, size: tuple[int, int], generator: torch.Generator) -> Body | None:
    """Return a random surface of revolution, open at the top; its largest ``radius`` is in pixels of the image."""
    kind = draw(_PROFILES, generator)
    points, aspect = _outline(kind, generator)
    heights, radii = (torch.tensor(each, dtype=torch.float32) for each in zip(*points, strict=True))
    places = torch.linspace(0, 1, _SAMPLES)
    after = torch.searchsorted(heights, places).clamp(1, len(heights) - 1)
    share = ((places - heights[after - 1]) / (heights[after] - heights[after - 1])).clamp(0, 1)
    profile = torch.lerp(radii[after - 1], radii[after], share)
    for _ in range(2):  # round the corners
        padded = functional.pad(profile[None, None], (_REACH, _REACH), mode="replicate")
        profile = functional.avg_pool1d(padded, 2 * _REACH + 1, stride=1)[0, 0]
    rings = [uniform(0.8, 0.97, generator) for _ in range(int(torch.randint(3, (1,), generator=generator)))]
    return _revolve(radius * profile, aspect * radius, [0.0, 1.0, *rings], pose, size)


def ball(pose: Pose, radius: float, size: tuple[int, int]) -> Body | None:
    """Return a ball whose lowest point is the foot."""
    places = torch.linspace(-1, 1, _SAMPLES)
    return _revolve(radius * (1 - places.square()).sqrt(), 2 * radius, [], pose._replace(pitch=0, slope=0), size)


def _outline(kind: str, generator: torch.Generator) -> tuple[list[tuple[float, float]], float]:
    """Return heights and radii, as shares of the height and of the largest radius, and the height over that radius."""

    def some(low: float, high: float) -> float:
        return uniform(low, high, generator)

    if kind == "bottle":
        neck, shoulder = some(0.2, 0.55), some(0.5, 0.75)
        lip = neck + some(0, 0.1)
        end = shoulder + some(0.08, 0.2)
        waist = some(0.85, 1)
        top = [(end, neck), (0.95, neck), (1.0, lip)]
        return [(0.0, 0.88), (0.03, 1.0), (shoulder / 2, waist), (shoulder, 1.0), *top], some(3.2, 6.5)
    if kind == "goblet":
        stem, widest = some(0.3, 0.5), some(0.6, 0.8)
        return [
            (0.0, some(0.6, 0.95)), (0.04, 0.5), (0.07, 0.1), (stem, 0.08), (stem + 0.06, 0.6), (widest, 1.0),
            (1.0, some(0.7, 1)),
        ], some(3.5, 6)  # fmt: skip
    if kind == "bowl":
        flat, places = some(0.2, 0.5), [place / 24 for place in range(25)]
        return [(h, flat + (1 - flat) * math.sqrt(1 - (1 - h) ** 2)) for h in places], some(0.5, 1.2)
    if kind == "jar":
        neck = some(0.7, 0.95)
        return [(0.0, 0.9), (0.05, 1.0), (0.78, 1.0), (0.86, neck), (1.0, neck)], some(1.6, 3)
    foot = some(0.6, 1)
    return [(0.0, 0.95 * foot), (0.02, foot), (1.0, 1.0)], some(1.4, 3.6)


def _window(
    pose: Pose, length: float, radius: float, size: tuple[int, int]
) -> tuple[slice, slice, Tensor, Tensor] | None:
    """Return rows and columns of an object, and the pixels along its axis and across; None if none are in the image."""
    ends = [(pose.u + at * pose.up[0], pose.v + at * pose.up[1]) for at in (0.0, length)]
    edges = []
    for axis, limit in ((1, size[0]), (0, size[1])):
        low, high = min(end[axis] for end in ends) - radius - 1, max(end[axis] for end in ends) + radius + 2
        edges.append(slice(max(0, math.floor(low)), min(limit, math.ceil(high))))
    if any(edge.stop - edge.start < 2 for edge in edges):
        return None
    down = torch.arange(edges[0].start, edges[0].stop, dtype=torch.float32)[:, None] - pose.v
    right = torch.arange(edges[1].start, edges[1].stop, dtype=torch.float32) - pose.u
    along = right * pose.up[0] + down * pose.up[1]
    return edges[0], edges[1], along, -right * pose.up[1] + down * pose.up[0]


def _in_image(parts: tuple[Tensor, Tensor, Tensor], pose: Pose) -> Tensor:
    """Return unit vectors across the axis, level towards the camera, and along the axis, in the image's coordinates."""
    across, level, along = parts
    cosine = math.sqrt(1 - pose.pitch**2)
    raised = cosine * along - pose.pitch * level
    towards = cosine * level + pose.pitch * along
    (x, y) = pose.up
    stacked = torch.stack((raised * x - across * y, raised * y + across * x, towards))
    return stacked / stacked.norm(dim=0).clamp(min=1e-6)


def _revolve(profile: Tensor, length: float, rings: list[float], pose: Pose, size: tuple[int, int]) -> Body | None:
    """Return a surface of revolution with radii in pixels at even heights; rings are shares of its height."""
    radius = float(profile.max())
    found = _window(pose, length, radius, size)
    if found is None:
        return None
    rows, columns, along, across = found
    steep = (profile.diff(append=profile[-1:]) * ((len(profile) - 1) / length)).clamp(-3, 3)

    def at(table: Tensor, height: Tensor) -> Tensor:
        place = (height * ((len(profile) - 1) / length)).clamp(0, len(profile) - 1)
        low = place.long().clamp(max=len(profile) - 2)
        return torch.lerp(table[low], table[low + 1], place - low)

    sides, lines = [], torch.zeros_like(along)
    for side in (1, -1):  # what is towards the camera lies lower in the image
        height = (along + side * pose.pitch * radius).clamp(0, length)
        for _ in range(5):
            bulge = (at(profile, height).square() - across.square()).clamp(min=0).sqrt()
            height = 0.5 * (height + along + side * pose.pitch * bulge)
        here = at(profile, height).clamp(min=1e-3)
        valid = (across.abs() < here) & (height >= -0.5) & (height <= length + 0.5)
        near = side * bulge * math.sqrt(1 - pose.pitch**2) - pose.slope * height
        parts = side * across / here, bulge / here, -side * at(steep, height)
        sides.append((valid, near, _in_image(parts, pose)))
        for ring in rings:
            wide = max(0.8, (0.035 if ring in (0.0, 1.0) else 0.015) * radius)
            line = torch.exp(-((height - ring * length) / wide).square()) * (across.abs() < here)
            lines = torch.maximum(lines, line)
    (in_front, near, front), (behind, far, back) = sides
    mask = in_front | behind
    near, front = torch.where(in_front, near, far), torch.where(in_front, front, back)
    far = torch.where(behind, torch.minimum(far, near), near)
    return Body(rows, columns, mask, near, far, front, back, lines, along)


def draw_box(pose: Pose, radius: float, size: tuple[int, int], generator: torch.Generator) -> Body | None:
    """Return a random box; arguments as for :func:`draw_vessel`."""
    turn, height = uniform(0, math.pi / 2, generator), radius * uniform(0.4, 3, generator)
    half = torch.tensor([radius * 0.7, radius * uniform(0.3, 0.7, generator), height / 2])
    found = _window(pose, height + radius, radius, size)
    if found is None:
        return None
    rows, columns, along, across = found
    cosine = math.sqrt(1 - pose.pitch**2)
    centred = along - cosine * height / 2
    level = torch.stack((across, -pose.pitch * centred, cosine * centred))
    ray = torch.tensor([0.0, cosine, pose.pitch])
    spin = torch.tensor([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    start, step = torch.einsum("ij,jhw->ihw", spin, level), spin @ ray
    step = torch.where(step.abs() < 1e-4, 1e-4, step)[:, None, None]
    one, other = (-half[:, None, None] - start) / step, (half[:, None, None] - start) / step
    leave, enter = torch.maximum(one, other), torch.minimum(one, other)
    near, in_front = leave.min(dim=0)
    far, behind = enter.max(dim=0)
    sides = [
        _in_image(tuple((spin.T * step[:, 0, 0].sign()).T[face].unbind(-1)), pose)  # type: ignore[arg-type]
        for face in (in_front, behind)
    ]
    lit = torch.stack((along * pose.up[0] - across * pose.up[1], along * pose.up[1] + across * pose.up[0])) / radius
    varied = uniform(0.15, 0.5, generator)  # a flat face reflects a part of the room that changes from place to place
    sides = [torch.cat((normals[:2] + varied * lit, normals[2:])) for normals in sides]
    sides = [normals / normals.norm(dim=0) for normals in sides]
    gaps = (leave.sort(dim=0).values[1] - near) * 0.7, (far - enter.sort(dim=0).values[1]) * 0.7
    wide = max(1.0, 0.03 * radius)
    lines = torch.maximum(torch.exp(-(gaps[0] / wide).square()), 0.6 * torch.exp(-(gaps[1] / wide).square()))
    lean = (pose.slope + pose.pitch / cosine) * along - pose.pitch * height / 2  # from the middle to the foot
    return Body(rows, columns, near > far, near - lean, far - lean, sides[0], sides[1], lines, along)


class Plate(NamedTuple):
    """A plane with an outline, in a window of h x w pixels."""

    rows: slice
    columns: slice
    inside: Tensor  # (h, w), the plate
    frame: Tensor  # (h, w), what surrounds it
    edge: Tensor  # (h, w), where both meet, 0 to 1
    right: Tensor  # (h, w), pixels from its middle
    down: Tensor
    nearness: Tensor  # (h, w), its inverse depth over that of its middle


def draw_plate(size: tuple[int, int], focal: float, generator: torch.Generator) -> Plate:
    """Return a random rectangle or ellipse, flat and tilted by up to about 50 degrees, with a frame in most cases."""
    half = [uniform(0.1, 0.4, generator) * min(size) for _ in range(2)]
    middle = [uniform(0.1, 0.9, generator) * length for length in size]
    turn, shear = 0.15 * normal(generator), 0.2 * normal(generator)
    reach = 1.2 * math.hypot(*half) + 2
    rows, columns = (
        slice(max(0, int(at - reach)), min(length, int(at + reach) + 1))
        for at, length in zip(middle, size, strict=True)
    )
    down = torch.arange(rows.start, rows.stop, dtype=torch.float32)[:, None] - middle[0]
    right = torch.arange(columns.start, columns.stop, dtype=torch.float32) - middle[1]
    down, right = torch.broadcast_tensors(down, right)
    x = (math.cos(turn) * right + math.sin(turn) * down) / half[1]
    y = (math.cos(turn) * down - math.sin(turn) * right) / half[0] + shear * x
    reached = (x.square() + y.square()).sqrt() if chance(0.2, generator) else torch.maximum(x.abs(), y.abs())
    wide = uniform(0.03, 0.15, generator) if chance(0.65, generator) else 0.0
    slopes = [math.tan(uniform(-0.9, 0.9, generator)) / focal for _ in range(2)]
    nearness = (1 + slopes[0] * right + slopes[1] * down).clamp(0.4, 2.5)
    edge = torch.exp(-((1 - wide - reached) * min(half) / 1.5).square())
    inside, frame = reached <= 1 - wide, (reached > 1 - wide) & (reached <= 1)
    return Plate(rows, columns, inside, frame, edge, right, down, nearness)
