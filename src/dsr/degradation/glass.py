"""Clear, mirroring and glossy objects: a photo with one in it, its surface, and the depth that a sensor gives there.

A sensor sees what is behind a clear object, nothing, the surface where it reflects enough, or a mixture; in a mirror it
sees the virtual image. Of two captures of ClearGrasp (Sajjan et al., ICRA 2020; a RealSense D435), four bottles and
three boxes, 28 to 65 % of an object's pixels are missing, and of the others 9 to 74 % lie within 20 mm of the surface,
the others behind it, some beyond the background; the shares drawn here are wider.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.glass_shapes import Body, Plate, Pose, ball, draw_box, draw_plate, draw_vessel
from dsr.degradation.random_fields import chance, draw, field_of, normal, power, uniform
from dsr.sample import Scene

# How often each kind of object is drawn
KINDS: Mapping[str, float] = {"vessel": 0.5, "ball": 0.06, "box": 0.1, "pane": 0.12, "mirror": 0.12, "gloss": 0.1}
_PLACES: Mapping[str, float] = {"upright": 0.65, "lying": 0.15, "before": 0.2}
_SIDES: Mapping[str, float] = {"behind": 0.45, "mixed": 0.35, "surface": 0.2}
_HOLES: Mapping[str, float] = {"few": 0.3, "some": 0.5, "most": 0.2}
_REFLECTED = 0.04  # share of the light that glass reflects at normal incidence


class _State(NamedTuple):
    """A photo (3, H, W), the true depth (1, H, W), and the depth that a sensor sees (1, H, W)."""

    rgb: Tensor
    depth: Tensor
    seen: Tensor


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
        plane = _plane_at(depth, v, u, max(3, int(radius / 3)))
        if plane is None:
            continue
        inverse, down, across = plane
        if kind == "upright" and (standing := _standing(scene, (u, v), plane)) is not None:
            return standing
        direction = math.sin(up), -math.cos(up)
        pose = Pose(u, v, direction, pitch, -pitch / math.sqrt(1 - pitch**2), uniform(0.7, 0.98, generator) / inverse)
    if kind == "lying" and pose is not None:
        turn = uniform(-math.pi, math.pi, generator)
        direction = math.sin(turn), -math.cos(turn)
        slope = -scene.camera.fx * (across * direction[0] + down * direction[1]) / inverse
        pose = Pose(u, v, direction, 0.3 * pitch, max(-1.5, min(slope, 1.5)), (1 - radius / scene.camera.fx) / inverse)
    return pose


def _standing(scene: Scene, place: tuple[int, int], plane: tuple[float, float, float]) -> Pose | None:
    """Return the pose of what stands on a plane in the image; None if one looks at it too much from above."""
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


def _plane_at(depth: Tensor, v: int, u: int, reach: int) -> tuple[float, float, float] | None:
    """Return the median inverse depth around a pixel, and by how much it grows downwards and to the right."""
    part = depth[0, max(0, v - reach) : v + reach + 1, max(0, u - reach) : u + reach + 1].float().reciprocal()
    inverse = float(part.nanmedian()) if part.numel() else math.nan
    if not inverse > 0 or min(part.shape) < 2:
        return None
    down, across = (float(part.diff(dim=dim).nanmedian()) for dim in (0, 1))
    return inverse, 0.0 if math.isnan(down) else down, 0.0 if math.isnan(across) else across


class _Room:
    """What surrounds an object, as it reflects it: the photo, turned around and blurred, and one to three lights."""

    def __init__(self, rgb: Tensor, normals: Tensor, mask: Tensor, generator: torch.Generator) -> None:
        self._walls = functional.adaptive_avg_pool2d(rgb, 6).flip((-2, -1))[None] * uniform(0.4, 1.6, generator)
        self.mean = self._walls.mean(dim=(0, 2, 3))[:, None, None]
        self._lights = []
        places = mask.flatten().nonzero()[:, 0]
        for _ in range(1 + int(torch.randint(3, (1,), generator=generator))):
            place = places[int(torch.randint(len(places), (1,), generator=generator))]
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
    bumps = []
    if chance(0.1 if solid else 0.4, generator):
        waves, size = uniform(0.01, 0.08, generator), uniform(2, 8, generator)
        bumps = [waves * field_of(body.near[None], size, generator)[0] for _ in range(2)]
    front = _unit(body.front, bumps)
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
    for normals, weight in ((front, 1.0), (_unit(body.back, bumps), 0.5)):
        share = weight * _fresnel(normals[2])
        lights = share.clamp(max=0.15) * room.lights(normals)
        painted = painted * (1 - share) + share * room.walls(normals) + lights
        bright += lights.mean(dim=0)
    line = body.lines * uniform(0.1, 0.6, generator)
    painted = torch.lerp(painted, room.mean * uniform(0.3, 2, generator) + uniform(0, 0.15, generator), line)
    return painted.clamp(0, 1), (bright + 0.7 * rim + 0.5 * body.lines).clamp(0, 1)


def _unit(normals: Tensor, bumps: list[Tensor]) -> Tensor:
    """Return unit normals, with bumps along u and v."""
    if not bumps:
        return normals
    moved = normals.clone()
    moved[0] += bumps[0]
    moved[1] += bumps[1]
    return moved / moved.norm(dim=0)


def _fresnel(facing: Tensor, least: float = _REFLECTED) -> Tensor:
    """Return the share of light that is reflected (Schlick, 1994), by the cosine of the angle of incidence."""
    return least + (1 - least) * (1 - facing.clamp(0, 1)) ** 5


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
    share = _fresnel(body.front[2], least)
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
        painted, cue = _paint_pane(state.rgb[window], reflected, plate, generator)
        seen = _seen_through(surface, state.seen[window], cue, torch.zeros_like(surface), generator)
    line = plate.edge * uniform(0.1, 0.7, generator)
    painted = torch.lerp(painted, torch.tensor(uniform(0, 1, generator)), line)
    shade = 1 + 0.1 * field_of(surface, (0.5, 4), generator)
    colour = uniform(0, 0.8, generator) + 0.25 * torch.rand((3, 1, 1), generator=generator)
    painted = torch.where(plate.frame, (colour * shade).clamp(0, 1), painted)
    return _put(state, window, mask, painted, surface, torch.where(plate.frame, surface, seen))


def _reflect(state: _State, plate: Plate, surface: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return what a plate reflects, (3, h, w), and the depth of its virtual image, (1, h, w).

    Another part of the photo stands for what is before the plate, as far from it as the scene is from the camera.
    """
    height, width = state.rgb.shape[-2:]
    v, u = uniform(0.2, 0.8, generator) * height, uniform(0.2, 0.8, generator) * width
    middle = float(state.depth.nanmedian())
    smaller = 1 + float(surface.median()) / middle  # the virtual image is farther away, and smaller
    own_v, own_u = (torch.arange(each.start, each.stop) for each in (plate.rows, plate.columns))
    right = u - smaller * plate.right - own_u
    down = v + smaller * plate.down - own_v[:, None]
    rows, columns = _within(own_v[:, None] + down, height), _within(own_u + right, width)
    return _sample(state.rgb, plate, right, down), surface + state.depth[:, rows, columns]


def _within(places: Tensor, size: int) -> Tensor:
    """Return whole places in an image of a size, turned back at its borders as a photo's are."""
    folded = places.round().long().remainder(2 * (size - 1)) if size > 1 else torch.zeros_like(places).long()
    return torch.minimum(folded, 2 * (size - 1) - folded)


def _paint_pane(behind: Tensor, reflected: Tensor, plate: Plate, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return the photo of a pane, and how well each pixel can be seen, (h, w)."""
    share = power(-1.2, -0.4, generator)
    tint = 1 - uniform(0, 0.2, generator) * torch.rand((3, 1, 1), generator=generator)
    painted = behind * tint * (1 - share) + share * reflected * uniform(0.7, 1.8, generator)
    glare = torch.zeros_like(plate.right)
    for _ in range(int(torch.randint(3, (1,), generator=generator))):  # streaks of light
        angle, wide = uniform(-math.pi, math.pi, generator), power(-1.5, -0.4, generator) * max(plate.right.shape)
        across = math.cos(angle) * plate.right + math.sin(angle) * plate.down + 0.5 * wide * normal(generator)
        glare += power(-1.3, -0.2, generator) * torch.exp(-((across / wide) ** 4))
    return (painted + glare).clamp(0, 1), (glare + 0.5 * share).clamp(0, 1)
