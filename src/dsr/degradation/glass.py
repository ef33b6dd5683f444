"""Clear, mirroring and glossy objects: a photo with one in it, its surface, and the depth that a sensor gives there.

A sensor sees what is behind a clear object, nothing, the surface where it reflects enough, or a mixture; in a mirror it
sees the virtual image. The shares drawn here are wider than those of ClearGrasp (Sajjan et al., ICRA 2020; a RealSense
D435), where 28 to 65 % of an object's pixels are missing. Shapes are seen along parallel rays.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.random_fields import chance, draw, field_of, integer, normal, power, uniform
from dsr.sample import Scene

# How often each kind of object is drawn
KINDS: Mapping[str, float] = {"vessel": 0.5, "ball": 0.06, "box": 0.1, "pane": 0.12, "mirror": 0.12, "gloss": 0.1}
_PLACES: Mapping[str, float] = {"upright": 0.65, "lying": 0.15, "before": 0.2}
_SIDES: Mapping[str, float] = {"behind": 0.45, "mixed": 0.35, "surface": 0.2}
_HOLES: Mapping[str, float] = {"few": 0.3, "some": 0.5, "most": 0.2}
_REFLECTED = 0.04  # share of the light that glass reflects at normal incidence
_PROFILES = {"tumbler": 0.3, "bottle": 0.35, "goblet": 0.12, "bowl": 0.1, "jar": 0.13}
_SAMPLES, _REACH = 256, 9  # of a profile, and by how many of them its corners are rounded


class _State(NamedTuple):
    """A photo (3, H, W), the true depth (1, H, W), and the depth that a sensor sees (1, H, W)."""

    rgb: Tensor
    depth: Tensor
    seen: Tensor


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


def add_glass(scene: Scene, generator: torch.Generator, kinds: Mapping[str, float] = KINDS) -> tuple[Scene, Tensor]:
    """Return a scene with up to four clear, mirroring or glossy objects, and the depth that a sensor measures there.

    The scene's true depth is that of the objects' surfaces. The depth that a sensor sees, (1, H, W) in metres, is NaN
    where it sees nothing. ``kinds`` are the relative frequencies of the kinds of objects.
    """
    state = _State(scene.rgb.float(), scene.true_depth, scene.true_depth)
    kind = draw(kinds, generator)
    count = 1 if kind in ("pane", "mirror") else 1 + int(4 * uniform(0, 1, generator) ** 2)
    for _ in range(count):
        if kind in ("pane", "mirror"):
            state = _add_plate(state, scene.camera.fx, kind, generator)
        else:
            state = _add_body(state, scene, kind, generator)
    rgb = state.rgb.clamp(0, 1).to(scene.rgb)
    return replace(scene, rgb=rgb, depth=state.depth), state.seen


def _add_body(state: _State, scene: Scene, kind: str, generator: torch.Generator) -> _State:
    """Add a vessel, a ball or a box, clear, or opaque and glossy."""
    size = scene.camera.height, scene.camera.width
    radius = min(size) * power(-1.4, -0.65, generator)
    pose = _draw_pose(scene, state.depth, radius, generator)
    shape = draw({"vessel": 0.6, "ball": 0.15, "box": 0.25}, generator) if kind == "gloss" else kind
    if pose is None:
        return state
    if shape == "ball":
        body = ball(pose, radius, size)
    else:
        body = (draw_box if shape == "box" else draw_vessel)(pose, radius, size, generator)
    if body is None or not bool(body.mask.any()):
        return state
    window = slice(None), body.rows, body.columns
    surface = (pose.depth / (1 + body.near / scene.camera.fx).clamp(min=0.2))[None].to(state.depth)
    mask = body.mask & ~(surface >= state.depth[window])[0]
    if kind == "gloss":
        painted, cue = _paint_gloss(state.rgb, body, generator)
        burnt = cue[None] > uniform(0.2, 0.8, generator)
        seen = surface.masked_fill(burnt, torch.nan)
        if not chance(0.5, generator):  # wrong in highlights, not missing
            largest = power(-2.3, -0.8, generator)
            shift = largest * (normal(generator) + field_of(surface, power(0, 1, generator), generator))
            seen = torch.where(burnt, surface * (1 + shift.clamp(-0.5, 1)), surface)
    else:
        painted, cue = _paint_clear(state.rgb, body, radius, solid=shape == "ball", generator=generator)
        through = (body.near - body.far).clamp(min=0)[None] * (pose.depth / scene.camera.fx)
        seen = _seen_through(surface, state.seen[window], cue, through, generator)
    return _put(state, window, mask, painted, surface, seen)


def _put(
    state: _State, window: tuple[slice, slice, slice], mask: Tensor, painted: Tensor, surface: Tensor, seen: Tensor
) -> _State:
    """Return a photo and both depths with an object in a window, (h, w), where its mask, (h, w), is."""
    alpha = functional.avg_pool2d(mask.float()[None], 3, 1, 1, count_include_pad=False) * mask
    state = _State(*(each.clone() for each in state))
    state.rgb[window] = torch.where(mask, torch.lerp(state.rgb[window], painted, alpha), state.rgb[window])
    state.depth[window] = torch.where(mask, surface, state.depth[window])
    state.seen[window] = torch.where(mask, seen.to(surface), state.seen[window])
    return state


def _draw_pose(scene: Scene, depth: Tensor, radius: float, generator: torch.Generator) -> Pose | None:
    """Return a pose on a surface of the scene, upright or lying, or before it; None where no depth is known."""
    kind = draw(_PLACES, generator)
    up = 0.2 * normal(generator) if chance(0.8, generator) else uniform(-math.pi, math.pi, generator)
    pitch = uniform(0, 0.6, generator)
    pose = None
    for _ in range(4 if kind == "upright" else 1):
        u, v = (round(uniform(0.05, 0.98, generator) * (size - 1)) for size in (depth.shape[-1], depth.shape[-2]))
        reach = max(3, int(radius / 3))
        part = depth[0, max(0, v - reach) : v + reach + 1, max(0, u - reach) : u + reach + 1].float().reciprocal()
        inverse = float(part.nanmedian())
        if not inverse > 0 or min(part.shape) < 2:
            continue
        down, across = (float(part.diff(dim=dim).nanmedian().nan_to_num(0)) for dim in (0, 1))  # by how much it grows
        if kind == "upright" and (standing := _standing(scene, (u, v), (inverse, down, across))) is not None:
            return standing
        nearer = uniform(0.7, 0.98, generator)
        if kind == "lying":
            up = uniform(-math.pi, math.pi, generator)
            slope = -scene.camera.fx * (across * math.sin(up) - down * math.cos(up)) / inverse
            pitch, slope, nearer = 0.3 * pitch, max(-1.5, min(slope, 1.5)), 1 - radius / scene.camera.fx
        else:
            slope = -pitch / math.sqrt(1 - pitch**2)
        pose = Pose(u, v, (math.sin(up), -math.cos(up)), pitch, slope, nearer / inverse)
    return pose


def _standing(scene: Scene, place: tuple[int, int], plane: tuple[float, float, float]) -> Pose | None:
    """Return the pose of what stands on a plane, of inverse depth; None if one looks at it too much from above."""
    inverse, down, across = plane
    camera = scene.camera
    x, y = (place[0] - camera.cx) / camera.fx, (place[1] - camera.cy) / camera.fy
    a, b = across * camera.fx, down * camera.fy  # the inverse depth of a plane is n (x, y, 1) / distance
    c = inverse - a * x - b * y
    length = math.sqrt(a * a + b * b + c * c)
    a, b, c = -a / length, -b / length, -c / length
    right, below = a - c * x, b - c * y
    cosine = math.hypot(right, below)
    sine = -(a * x + b * y + c) / math.sqrt(1 + x * x + y * y)
    if not 0 < sine < 0.85 or cosine < 0.5:
        return None
    return Pose(place[0], place[1], (right / cosine, below / cosine), sine, c / cosine, 1 / inverse)


class _Room:
    """What surrounds an object, as it reflects it: the photo, turned around and blurred, and one to three lights."""

    def __init__(self, rgb: Tensor, normals: Tensor, mask: Tensor, generator: torch.Generator) -> None:
        self._walls = functional.adaptive_avg_pool2d(rgb, 6).flip((-2, -1))[None] * uniform(0.4, 1.6, generator)
        self.mean = self._walls.mean(dim=(0, 2, 3))[:, None, None]
        self._lights = []
        places = mask.flatten().nonzero()[:, 0]
        for _ in range(integer(1, 3, generator)):
            place = places[integer(0, len(places) - 1, generator)]
            middle = normals[:2].flatten(1)[:, place] + 0.05 * torch.randn(2, generator=generator)
            half = [power(-1.6, -0.65, generator) for _ in range(2)]
            colour = power(0.3, 1.45, generator) * (1 + 0.1 * torch.randn((3, 1, 1), generator=generator))
            self._lights.append((middle.tolist(), half, power(-2, -1, generator), colour))

    def walls(self, normals: Tensor) -> Tensor:
        """Return the light from the walls that a surface of these normals reflects, (3, h, w)."""
        places = normals[:2].permute(1, 2, 0)[None]
        return functional.grid_sample(self._walls, places, padding_mode="border", align_corners=False)[0]

    def lights(self, normals: Tensor) -> Tensor:
        """Return the light from the lights, (3, h, w)."""
        total = torch.zeros_like(normals)
        for middle, half, soft, colour in self._lights:
            sides = [((half[i] - (normals[i] - middle[i]).abs()) / (soft / 2)).sigmoid() for i in range(2)]
            total += colour * (sides[0] * sides[1])
        return total


def _paint_clear(
    rgb: Tensor, body: Body, radius: float, *, solid: bool, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return the photo of a clear object in its window, and how much of a cue for sensors each pixel is, (h, w)."""
    front, back = body.front, body.back
    if chance(0.1 if solid else 0.4, generator):  # bumps along u and v
        waves, size = uniform(0.01, 0.08, generator), uniform(2, 8, generator)
        bumps = torch.stack([waves * field_of(body.near[None], size, generator)[0] for _ in range(2)])
        front, back = (torch.cat((normals[:2] + bumps, normals[2:])) for normals in (front, back))
        front, back = front / front.norm(dim=0), back / back.norm(dim=0)
    room = _Room(rgb, front, body.mask, generator)
    facing = front[2].clamp(0.02, 1)
    turned = 1 + uniform(0.3, 1, generator)  # a full object shows what is behind upside down
    bend = uniform(0.05, 0.5, generator) * (1 - facing) ** uniform(1, 2, generator)
    full = torch.full_like(facing, float(solid))
    if not solid and chance(0.25, generator):  # liquid
        full = (body.up < uniform(0.2, 0.8, generator) * float(body.up.max())).to(facing)
    pull = radius * torch.lerp(bend, turned * torch.ones_like(facing), full)
    painted = _sample(rgb, body, -front[0] * pull, -front[1] * pull)
    colour = power(-2.5, -0.7, generator) * (1 + 0.5 * torch.randn((3, 1, 1), generator=generator)).clamp(min=0)
    path = 1 / facing.clamp(min=0.15) + full * (body.near - body.far) / radius
    painted = painted * torch.exp(-colour * path)
    rim = ((0.55 - facing) / 0.55).clamp(min=0) ** uniform(1, 2.5, generator) * uniform(0.3, 1, generator)
    painted = torch.lerp(painted, room.walls(front * 1.5) * uniform(0.3, 1.7, generator), rim)
    bright = torch.zeros_like(facing)
    for normals, weight in ((front, 1.0), (back, 0.5)):
        share = weight * _reflectance(normals, _REFLECTED)
        lights = share.clamp(max=0.15) * room.lights(normals)
        painted = painted * (1 - share) + share * room.walls(normals) + lights
        bright += lights.mean(dim=0)
    line = body.lines * uniform(0.1, 0.6, generator)
    painted = torch.lerp(painted, room.mean * uniform(0.3, 2, generator) + uniform(0, 0.15, generator), line)
    return painted.clamp(0, 1), (bright + 0.7 * rim + 0.5 * body.lines).clamp(0, 1)


def _reflectance(normals: Tensor, least: float) -> Tensor:
    """Return the share of light that a surface reflects by the cosine of the angle of incidence (Schlick, 1994)."""
    return least + (1 - least) * (1 - normals[2].clamp(0, 1)) ** 5


def _sample(rgb: Tensor, window: Body | Plate, right: Tensor, down: Tensor) -> Tensor:
    """Return the photo in a window, each pixel from a place ``right`` and ``down`` of it, (3, h, w)."""
    u = torch.arange(window.columns.start, window.columns.stop) + right
    v = torch.arange(window.rows.start, window.rows.stop)[:, None] + down
    height, width = rgb.shape[-2:]
    grid = torch.stack((2 * u / (width - 1) - 1, 2 * v / (height - 1) - 1), dim=-1)
    return functional.grid_sample(rgb[None], grid[None], padding_mode="reflection", align_corners=True)[0]


def _seen_through(surface: Tensor, behind: Tensor, cue: Tensor, through: Tensor, generator: torch.Generator) -> Tensor:
    """Return the depth that a sensor gives in a clear object, (1, h, w)."""
    lean = {"behind": uniform(2, 4, generator), "mixed": uniform(-1, 1.5, generator), "surface": -2.0}
    side = draw(_SIDES, generator)
    size = min(surface.shape[1:])
    field = field_of(surface, size * power(-1.5, -0.4, generator), generator)
    places = field + lean[side] - uniform(0, 4, generator) * cue
    share = torch.sigmoid(power(-0.3, 1.3, generator) * places)
    pushed = behind + through * uniform(-0.1, 0.6, generator)
    waves = 1 + power(-3, -1.7, generator) * field_of(surface, size * power(-1.5, -0.7, generator), generator)
    seen = (surface + share * (pushed - surface)) * waves
    return seen.masked_fill(_missing(surface, cue, generator), torch.nan)


def _missing(surface: Tensor, cue: Tensor, generator: torch.Generator) -> Tensor:
    """Return the mask of the pixels of which a sensor gives nothing, (1, h, w)."""
    kind = draw(_HOLES, generator)
    low, high = {"few": (0.0, 0.15), "some": (0.15, 0.8), "most": (0.8, 1.0)}[kind]
    share = uniform(low, high, generator)
    limit = math.sqrt(2) * float(torch.erfinv(torch.tensor(2 * share - 1).clamp(-0.9999, 0.9999)))
    field = field_of(surface, min(surface.shape[1:]) * power(-1.5, -0.4, generator), generator)
    return field + uniform(-1, 1, generator) * (cue - cue.mean()) < limit


def _paint_gloss(rgb: Tensor, body: Body, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return the photo of an opaque object with burnt highlights, or of metal, and where the highlights are, (h, w)."""
    room = _Room(rgb, body.front, body.mask, generator)
    shine = room.lights(body.front)
    if chance(0.4, generator):  # metal
        pull = uniform(2, 5, generator) * float(body.near.max() - body.near.min() + 1)
        around = _sample(rgb.flip((-2, -1)), body, body.front[0] * pull, body.front[1] * pull)
        base, least = around * uniform(0.5, 1, generator), uniform(0.3, 0.7, generator)
    else:
        side = torch.randn((3, 1, 1), generator=generator)
        lit = ((side / side.norm()).mul(body.front).sum(dim=0) * side[2].sign()).clamp(min=0)
        albedo = (uniform(0.05, 0.8, generator) + 0.15 * torch.randn((3, 1, 1), generator=generator)).clamp(0.02, 1)
        base, least = albedo * (0.3 + uniform(0.3, 0.9, generator) * lit), power(-1.4, -0.7, generator)
    share = _reflectance(body.front, least)
    shine = shine * share.clamp(max=0.5)
    painted = base * (1 - 0.5 * share) + 0.5 * share * room.walls(body.front) + shine
    return painted.clamp(0, 1), shine.mean(dim=0).clamp(0, 1)


def _add_plate(state: _State, focal: float, kind: str, generator: torch.Generator) -> _State:
    """Add a pane or a mirror, with or without a frame."""
    plate = draw_plate((state.rgb.shape[-2], state.rgb.shape[-1]), focal, generator)
    window = slice(None), plate.rows, plate.columns
    whole = plate.inside | plate.frame
    if not bool((state.depth[window].isfinite() & whole).any()):
        return state
    inverse = (state.depth[window].float().reciprocal() / plate.nearness)[0][whole]
    inverse = inverse[inverse.isfinite()]
    nearest = float(inverse.kthvalue(max(1, int(uniform(0.9, 1, generator) * len(inverse)))).values)
    surface = (1 / (nearest * (1 + power(-2.5, -0.5, generator)) * plate.nearness))[None].to(state.depth)
    mask = whole & ~(surface >= state.depth[window])[0]
    reflected, virtual = _reflect(state, plate, surface, generator)
    if kind == "mirror":
        painted, seen = reflected * uniform(0.7, 0.97, generator), virtual
        if chance(0.3, generator):  # dust shows the surface in places
            seen = torch.where(field_of(surface, power(0.3, 1.2, generator), generator) > 1.3, surface, virtual)
        seen = seen.masked_fill(_missing(surface, torch.zeros_like(surface[0]), generator), torch.nan)
    else:
        share = power(-1.2, -0.4, generator)
        tint = 1 - uniform(0, 0.2, generator) * torch.rand((3, 1, 1), generator=generator)
        painted = state.rgb[window] * tint * (1 - share) + share * reflected * uniform(0.7, 1.8, generator)
        glare = torch.zeros_like(plate.right)
        for _ in range(integer(0, 2, generator)):  # streaks of light
            angle, wide = uniform(-math.pi, math.pi, generator), power(-1.5, -0.4, generator) * max(plate.right.shape)
            across = math.cos(angle) * plate.right + math.sin(angle) * plate.down + 0.5 * wide * normal(generator)
            glare += power(-1.3, -0.2, generator) * torch.exp(-((across / wide) ** 4))
        painted, cue = (painted + glare).clamp(0, 1), (glare + 0.5 * share).clamp(0, 1)
        seen = _seen_through(surface, state.seen[window], cue, torch.zeros_like(surface), generator)
    line = plate.edge * uniform(0.1, 0.7, generator)
    painted = torch.lerp(painted, torch.tensor(uniform(0, 1, generator)), line)
    shade = 1 + 0.1 * field_of(surface, (0.5, 4), generator)
    colour = uniform(0, 0.8, generator) + 0.25 * torch.rand((3, 1, 1), generator=generator)
    painted = torch.where(plate.frame, (colour * shade).clamp(0, 1), painted)
    return _put(state, window, mask, painted, surface, torch.where(plate.frame, surface, seen))


def _reflect(state: _State, plate: Plate, surface: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return what a plate reflects, (3, h, w), and the depth of its virtual image, (1, h, w)."""
    # Another part of the photo stands for what is before the plate, as far from it as the scene is from the camera.
    height, width = state.rgb.shape[-2:]
    v, u = uniform(0.2, 0.8, generator) * height, uniform(0.2, 0.8, generator) * width
    middle = float(state.depth.nanmedian())
    smaller = 1 + float(surface.median()) / middle  # the virtual image is farther away, and smaller
    own_v, own_u = (torch.arange(each.start, each.stop) for each in (plate.rows, plate.columns))
    right = u - smaller * plate.right - own_u
    down = v + smaller * plate.down - own_v[:, None]
    whole = []
    for places, size in ((own_v[:, None] + down, height), (own_u + right, width)):  # turned back at the borders
        folded = places.round().long().remainder(2 * (size - 1)) if size > 1 else torch.zeros_like(places).long()
        whole.append(torch.minimum(folded, 2 * (size - 1) - folded))
    rows, columns = whole
    return _sample(state.rgb, plate, right, down), surface + state.depth[:, rows, columns]


def draw_vessel(pose: Pose, radius: float, size: tuple[int, int], generator: torch.Generator) -> Body | None:
    """Return a random surface of revolution, open at the top; its largest ``radius`` is in pixels of the image."""
    points, aspect = _outline(draw(_PROFILES, generator), generator)
    heights, radii = (torch.tensor(each, dtype=torch.float32) for each in zip(*points, strict=True))
    places = torch.linspace(0, 1, _SAMPLES)
    after = torch.searchsorted(heights, places).clamp(1, len(heights) - 1)
    share = ((places - heights[after - 1]) / (heights[after] - heights[after - 1])).clamp(0, 1)
    profile = torch.lerp(radii[after - 1], radii[after], share)
    for _ in range(2):  # round the corners
        padded = functional.pad(profile[None, None], (_REACH, _REACH), mode="replicate")
        profile = functional.avg_pool1d(padded, 2 * _REACH + 1, stride=1)[0, 0]
    rings = [uniform(0.8, 0.97, generator) for _ in range(integer(0, 2, generator))]
    return _revolve(radius * profile, aspect * radius, [0.0, 1.0, *rings], pose, size)


def ball(pose: Pose, radius: float, size: tuple[int, int]) -> Body | None:
    """Return a ball whose lowest point is the foot."""
    places = torch.linspace(-1, 1, _SAMPLES)
    return _revolve(radius * (1 - places.square()).sqrt(), 2 * radius, [], pose._replace(pitch=0, slope=0), size)


def _outline(kind: str, generator: torch.Generator) -> tuple[list[tuple[float, float]], float]:
    """Return heights and radii, as shares of the height and of the largest radius, and the height over that radius."""
    some = partial(uniform, generator=generator)
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
