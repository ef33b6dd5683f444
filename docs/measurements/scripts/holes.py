# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How holes are filled: today's filling, the farther depth of the rim, and what the colours say; sheets are counted.

    python docs/measurements/scripts/holes.py [--shared DIR] [--ratio 4] [--method facets] [--rules NAME...] [--kinds NAME...]
        [--scenes NAME...] [--pictures DIR] [--seed 1]

Holes are cut into low-resolution maps, box means of the inverse depth of scenes of Middlebury 2014 and ICL-NUIM:
``loops`` (a ring of another photo's colours is put before the scene, and what is seen through it is lost), ``gaps``
(what lies between nearer surfaces of the scene itself), ``shadows`` of a second camera or projector 5 to 20 cm beside
the first, ``steps`` (a pixel on both sides of depth steps), ``slopes`` (discs in smooth slopes, around which the range
of depth is large, without a step), ``blobs``, and ``floors`` (blobs; the photo lies on a floor that recedes to five
times its least distance). Of the high-resolution pixels under holes: the mean relative error of those that are filled,
the share that is off by more than 5 %, the share that is left open, and the share of sheets: filled pixels that are off
by more than 5 % and lie between the nearer and the farther surface around them, by 5 % of their depth from both.
``expected`` is the mean expected error, ``dubious`` the share of filled pixels that are expected to be off by more than
2 %, ``left in`` the share of the others that is off by more than 5 %; ``elsewhere`` the error outside of the holes.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.data import icl, middlebury
from dsr.degradation.downsampling import Downsampling
from dsr.degradation.holes import Blobs, Shadows
from dsr.geometry.camera import Camera
from dsr.geometry.hole_size import distance_to_known
from dsr.inference import any_ratio, upsampler
from dsr.inference.resizing import resize_nearest
from dsr.inference.rims import Settled, settle_holes
from dsr.methods.base import Surface
from dsr.sample import Scene

KINDS = ("loops", "gaps", "shadows", "steps", "slopes", "blobs", "floors")

STEP = 1.15
"""Ratio of two depths from which they are two surfaces."""
BEND = 0.01
"""Second difference of inverse depth, relative to it, up to which a surface is smooth."""
OFF = 0.05
SCENES = ("Adirondack", "Motorcycle", "Playtable", "living", "office")


class Case(NamedTuple):
    """A problem: (3, H, W) photo, (1, H, W) true depth, (1, h, w) the map, (1, h, w) what was cut, and the camera."""

    rgb: Tensor
    truth: Tensor
    depth: Tensor
    cut: Tensor
    camera: Camera


def depth_of(scene: Scene) -> Tensor:
    """Return the true depth of a scene, (1, H, W)."""
    if scene.depth is None:
        raise ValueError(f"{scene.name}: expected true depth")
    return scene.depth


def read_scene(shared: Path, name: str, ratio: int) -> Scene:
    """Return a scene whose sides the ratio divides."""
    real = shared / "real"
    if (real / "middlebury2014" / name).is_dir():
        scene = middlebury.load_2014(real / "middlebury2014" / name, "middlebury", name)
    else:
        frames = icl.find_frames(real / "icl_nuim")
        found = next(each for each in frames if each.startswith(name))
        scene = icl.load_frame(*frames[found], "icl", name)
    height, width = (n // ratio * ratio for n in depth_of(scene).shape[-2:])
    return scene.crop(0, 0, height, width)


def put_rings(scene: Scene, other: Scene, ratio: int, rng: np.random.Generator) -> tuple[Scene, Tensor]:
    """Return a scene with rings before it, of another scene's colours, and what is inside of them, (1, h, w) bool."""
    height, width = depth_of(scene).shape[-2:]
    rgb, depth = scene.rgb.clone(), depth_of(scene).clone()
    inside = torch.zeros(1, height // ratio, width // ratio, dtype=torch.bool)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    for _ in range(14):
        inner, thick = ratio * rng.uniform(1.5, 4.5), ratio * rng.uniform(2, 5)
        row, column = (rng.uniform(inner + thick, n - inner - thick) for n in (height, width))
        aspect = rng.uniform(0.6, 1.6)
        radius = ((rows - row).square() * aspect + (columns - column).square() / aspect).sqrt()
        ring = ((radius >= inner) & (radius < inner + thick))[None]
        here = depth[(radius < inner + thick)[None]]
        if not bool(here.isfinite().any()):
            continue
        near = float(here[here.isfinite()].min()) * rng.uniform(0.6, 0.85)
        shift = [int(rng.integers(n)) for n in other.rgb.shape[-2:]]
        paint = torch.roll(other.rgb, shift, (1, 2)).repeat(1, 3, 3)[:, :height, :width]
        rgb = torch.where(ring, paint.to(rgb), rgb)
        depth = depth.masked_fill(ring, near)
        lr = torch.nn.functional.max_pool2d((radius < inner)[None, None].float(), ratio)[0] > 0
        inside |= lr
    return Scene(scene.dataset, scene.name, rgb, scene.camera, depth), inside


def between(depth: Tensor, reach: int = 5) -> Tensor:
    """Return the pixels with nearer surfaces on two opposite sides, (1, h, w), and a pixel around them."""
    values = depth.nan_to_num(torch.inf)
    padded = torch.nn.functional.pad(values[None], (reach,) * 4, value=torch.inf)[0]
    height, width = depth.shape[-2:]

    def nearest(down: int, right: int) -> Tensor:
        steps = [
            padded[:, reach + i * down : reach + i * down + height, reach + i * right : reach + i * right + width]
            for i in range(1, reach + 1)
        ]
        return torch.stack(steps).amin(0)

    found = torch.zeros_like(depth, dtype=torch.bool)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        found |= torch.maximum(nearest(down, right), nearest(-down, -right)) * STEP < values
    found &= depth.isfinite()
    return torch.nn.functional.max_pool2d(found[None].float(), 3, 1, 1)[0] > 0


def steps(depth: Tensor) -> Tensor:
    """Return the pixels beside depth steps, (1, h, w)."""
    values = depth[None].double()
    far = torch.nn.functional.max_pool2d(values.nan_to_num(0), 3, 1, 1)
    near = -torch.nn.functional.max_pool2d(-values.nan_to_num(torch.inf), 3, 1, 1)
    return (far / near)[0] > STEP


def slopes(depth: Tensor, rng: np.random.Generator) -> Tensor:
    """Return discs of 3 to 9 pixels around which the depth, (1, h, w), has a range of 10 % without step or crease."""
    pool = torch.nn.functional.max_pool2d
    inverse = torch.nn.functional.pad(depth.double().reciprocal()[None], (1, 1, 1, 1), value=torch.nan)[0]
    middle = inverse[:, 1:-1, 1:-1]
    bends = (inverse[:, 2:, 1:-1] + inverse[:, :-2, 1:-1], inverse[:, 1:-1, 2:] + inverse[:, 1:-1, :-2])
    smooth = torch.stack([(each / middle - 2).abs() < BEND for each in bends]).all(0)
    rows, columns = torch.meshgrid(*map(torch.arange, depth.shape[-2:]), indexing="ij")
    cut = torch.zeros_like(smooth)
    for radius in (1.5, 2.5, 3.5, 4.5):
        reach = int(2 * radius) + 3
        away = ((~smooth).double()[None], middle[None].nan_to_num(0), -middle[None].nan_to_num(torch.inf))
        rough, high, low = (pool(each, 2 * reach + 1, 1, reach)[0] for each in away)
        places = torch.nonzero(((rough == 0) & (high > -1.1 * low))[0])
        for row, column in places[torch.from_numpy(rng.permutation(len(places)))].tolist()[:200]:
            distance = ((rows - row).square() + (columns - column).square()).sqrt()[None]
            if not bool((cut & (distance < reach + 5)).any()):
                cut |= distance <= radius
    return cut


def make_case(kind: str, scene: Scene, other: Scene, ratio: int, seed: int) -> Case:
    """Return a scene with holes of a kind."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    inside = torch.zeros(0)
    if kind == "loops":
        scene, inside = put_rings(scene, other, ratio, rng)
    if kind == "floors":
        rows = torch.linspace(0.2, 1, depth_of(scene).shape[1])[:, None].expand(depth_of(scene).shape)
        scene = Scene(scene.dataset, scene.name, scene.rgb, scene.camera, rows.reciprocal())
    depth = Downsampling("box")(depth_of(scene).reciprocal(), ratio).reciprocal()
    camera_lr = scene.camera.downscale(ratio)
    if kind == "loops":
        cut = inside
    elif kind == "gaps":
        cut = between(depth)
    elif kind == "shadows":
        cut = Shadows(float(rng.choice([-1, 1]) * rng.uniform(0.05, 0.2)))(depth, camera_lr, generator)
        cut = cut & (torch.nn.functional.avg_pool2d(cut[None].float(), 3, 1, 1)[0] > 0.3)
    elif kind == "steps":
        cut = steps(depth)
    elif kind == "slopes":
        cut = slopes(depth, rng)
    else:
        cut = Blobs(0.08, 6.0)(depth, camera_lr, generator)
    cut = cut & depth.isfinite()
    return Case(
        scene.rgb.float(), depth_of(scene).float(), depth.masked_fill(cut, torch.nan).float(), cut, scene.camera
    )


def farther(inverse: Tensor, rgb: Tensor, holes: Tensor) -> Settled:
    """Fill the holes between two surfaces with the farthest value of the rim."""
    known = inverse.isfinite()
    result = inverse.clone()
    away = distance_to_known(known)[0]
    for row, column in torch.nonzero((holes & ~known)[0]).tolist():
        reach = int(1.5 * float(away[row, column])) + 3
        around = inverse[0, max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        values = around[around.isfinite()]
        if float(values.max()) > STEP * float(values.min()):
            result[0, row, column] = values.min()
    return Settled(result, torch.zeros_like(inverse))


def unsettled(inverse: Tensor, rgb: Tensor, holes: Tensor) -> Settled:
    """Leave all holes to the method."""
    return Settled(inverse, torch.zeros_like(inverse))


RULES: dict[str, Callable[[Tensor, Tensor, Tensor], Settled]] = {
    "method alone": unsettled, "farther of the rim": farther, "colours": settle_holes,
}  # fmt: skip


def measure(case: Case, surface: Surface, ratio: int) -> dict[str, float]:
    """Return the figures of a result in the pixels under holes, in percent."""
    under = case.cut.repeat_interleave(ratio, 1).repeat_interleave(ratio, 2) & case.truth.isfinite()
    filled = under & surface.depth.isfinite()
    reach = 2 * ratio
    near, far = (
        sign
        * torch.nn.functional.max_pool2d(sign * case.truth.nan_to_num(-sign * 1e9)[None], 2 * reach + 1, 1, reach)[0]
        for sign in (-1, 1)
    )
    depth = surface.depth[filled]
    off = (depth / case.truth[filled] - 1).abs()
    sheet = (off > OFF) & (depth > near[filled] * (1 + OFF)) & (depth < far[filled] / (1 + OFF))
    expected = (surface.depth_error / surface.depth)[filled] if surface.depth_error is not None else torch.zeros(1)
    kept = ~under & surface.depth.isfinite() & case.truth.isfinite()
    return {
        "error": 100 * float(off.clamp(max=1).mean()),
        "off": 100 * float((off > OFF).float().mean()),
        "open": 100 * float(1 - filled.sum() / under.sum()),
        "sheets": 100 * float(sheet.float().mean()),
        "expected": 100 * float(expected.clamp(max=1).mean()),
        "left in": 100 * float((off > OFF)[expected <= 0.02].float().mean()),
        "dubious": 100 * float((expected > 0.02).float().mean()),
        "elsewhere": 100 * float((surface.depth[kept] / case.truth[kept] - 1).abs().mean()),
    }


def main() -> None:
    """Print a table of the kinds of holes and the rules, and draw pictures."""
    shared = Path(os.environ.get("DSR_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=shared)
    parser.add_argument("--ratio", type=int, default=4)
    parser.add_argument("--method", default="facets")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--rules", nargs="+", default=list(RULES), choices=RULES)
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    method = upsampler(options.method, device="cpu")
    scenes = [read_scene(options.shared, name, options.ratio) for name in options.scenes]
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    for i, scene in enumerate(scenes):
        for kind in options.kinds:
            case = make_case(kind, scene, scenes[(i + 1) % len(scenes)], options.ratio, options.seed)
            surfaces = {}
            for rule in options.rules:
                any_ratio.settle_holes = RULES[rule]  # type: ignore[assignment]
                surfaces[rule] = method.upsample(case.rgb, case.depth, case.camera)
                found.setdefault((kind, rule), []).append(measure(case, surfaces[rule], options.ratio))
            if options.pictures is not None:
                draw(options.pictures / f"{options.scenes[i]}_{kind}.png", case, surfaces)
    names = list(next(iter(found.values()))[0])
    print(f"| holes | rule | {' | '.join(names)} |\n| --- | --- |{' --- |' * len(names)}")
    for (kind, rule), figures in found.items():
        values = (np.nanmean([each[name] for each in figures]) for name in names)
        print(f"| {kind} | {rule} | {' | '.join(f'{value:.2f}' for value in values)} |")


def draw(path: Path, case: Case, surfaces: dict[str, Surface]) -> None:
    """Draw photo, map, results and truth side by side, in inverse depth."""
    size = (case.truth.shape[-2], case.truth.shape[-1])
    inverse = [resize_nearest(case.depth, size), *(each.depth for each in surfaces.values()), case.truth]
    values = [each[0].reciprocal().numpy() for each in inverse]
    low, high = np.nanpercentile(values[-1], (1, 99))
    shades = [np.nan_to_num(255 * (each - low) / (high - low), nan=0).clip(0, 255).astype(np.uint8) for each in values]
    colours = [cv2.applyColorMap(each, cv2.COLORMAP_TURBO) for each in shades]
    for picture, each in zip(colours, values, strict=True):
        picture[np.isnan(each)] = 255
    photo = (255 * case.rgb.permute(1, 2, 0).numpy()[..., ::-1]).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(
        str(path), np.vstack([np.hstack([photo, *colours[:2]]), np.hstack([*colours[2:], photo])[:, : 3 * size[1]]])
    )


if __name__ == "__main__":
    main()
