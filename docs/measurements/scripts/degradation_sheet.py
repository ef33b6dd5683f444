# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""The sheet of training degradations, kind by kind, beside maps of real sensors.

python docs/measurements/scripts/degradation_sheet.py --shared DIR [--scale 4] [--columns 4] [--clear 0] -o sheet.png
"""

from __future__ import annotations

import argparse
import sys
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from quality import glasses

from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.frame_files import read_16bit
from dsr.data.frame_files import read_picture as read_photo
from dsr.data.rendered import Procedural
from dsr.data.rgbdd import RGBDD
from dsr.degradation.glass import add_glass
from dsr.degradation.noise import NOISES
from dsr.degradation.random_degradation import Everything
from dsr.geometry.camera import Camera
from dsr.pictures.depth_views import rendering
from dsr.training.patches import soften

SHARED = Path(os.environ.get("DSR_SHARED", "../shared"))


SIDE = 256
GROUPS = ("kernels", "noises", "holes")
FRACTIONS = ("folds", "relief", "displaced", "rounded", "soft", "photo", "textured", "clear")


class Views(NamedTuple):
    """Two pictures and what to write above them."""

    left: np.ndarray
    right: np.ndarray
    titles: tuple[str, str]


def one_kind(kind: str) -> Everything:
    """Return the distribution of one kind of degradation."""
    shares = {group: {"none": 1.0} for group in GROUPS} | {"kernels": {"box": 1.0}}
    shares |= {group: {kind: 1.0} for group in GROUPS if kind in getattr(Everything(), group)}
    if kind == "displaced":  # happens to noisy maps
        shares["noises"] = {"correlated": 1.0}
    if kind == "clear":  # to sensors' maps
        shares["noises"] = {"stereo": 1.0}
    return Everything(**shares, **{name: float(name == kind) for name in FRACTIONS}, told=1)  # type: ignore[arg-type]


def synthetic(kind: str, scale: int, columns: int, seed: int) -> list[Views]:
    """Return pairs of one kind of degradation: the truth and the map, or both photos where those are changed."""
    everything, source = one_kind(kind), Procedural()
    generator, pairs = torch.Generator().manual_seed(seed), []
    for number in range(columns):
        scene = source.load(source.scenes()[7 * number + seed])
        patch = scene.crop(100, 100, SIDE, SIDE)
        if kind == "soft":
            patch = soften(patch, 1.0, halve=False)
        sample, hints = everything(patch, scale, generator)
        assert sample.depth is not None
        if kind in ("photo", "textured"):
            pairs.append(Views(_shown(patch.rgb), _shown(sample.rgb), ("as rendered", kind)))
            continue
        left = rendering(sample.depth.double(), patch.camera, "e1")
        right = rendering(sample.depth_lr.double(), sample.camera_lr, "e1")
        noise = 100 * float(hints.noise.square().mean().sqrt())
        holes = float(sample.depth_lr.isnan().float().mean())
        titles = f"{kind}, {float(sample.depth.nanmedian()):.1f} m", f"{noise:.2f} %, holes {holes:.2f}"
        pairs.append(Views(left, right, titles))
    return pairs


def _shown(rgb: torch.Tensor) -> np.ndarray:
    return rgb.permute(1, 2, 0).numpy()


def clear(count: int, seed: int, columns: int, shared: Path) -> list[list[Views]]:
    """Return rows of patches with clear objects, each two pairs, and of captures."""
    source, generator, pairs = Procedural(), torch.Generator().manual_seed(seed), []
    for number in range(count):
        patch = source.load(source.scenes()[7 * number % 200 + seed]).crop(100, 100, SIDE, SIDE)
        scene, seen = add_glass(patch, generator)
        photo = scene.rgb.mean(dim=0, keepdim=True)
        measured = NOISES["stereo"](seen.float().reciprocal(), photo, generator).reciprocal()
        measured = torch.where(seen.isfinite(), measured, torch.nan)
        pairs.append(Views(_shown(scene.rgb), _lit(scene.depth, scene.camera), ("photo", "truth")))
        pairs.append(Views(_lit(seen, scene.camera), _lit(measured, scene.camera), ("what is seen", "stereo")))
    for capture in glasses(shared) if (shared / "real" / "cleargrasp").is_dir() else ():
        photo, mask = _shown(capture.sample.rgb), capture.mask[0].numpy()
        depths = (_lit(each, capture.sample.camera) for each in (capture.twin, capture.sample.depth_lr))
        rows, columns_of = (slice(*np.flatnonzero(mask.any(axis=axis))[[0, -1]]) for axis in (1, 0))
        photo, twin, found, shown = (each[rows, columns_of] for each in (photo, *depths, mask))
        pairs += [Views(photo, twin, ("photo", "twin")), Views(found, shown, ("measured", "mask"))]
    return [pairs[start : start + columns] for start in range(0, len(pairs), columns)]


def _lit(depth: torch.Tensor | None, camera: Camera) -> np.ndarray:
    """Return depth lit from one side, holes red, (H, W, 3)."""
    assert depth is not None
    lit = np.repeat(rendering(depth.double(), camera, "e1")[..., None], 3, axis=-1).astype(np.float64)
    lit[depth[0].isnan().numpy()] = 0.8, 0.1, 0.1
    return lit


def real(shared: Path, columns: int) -> list[list[Views]]:
    """Return pairs of photos and maps of real sensors."""
    rows = []
    folder = shared / "real"
    sources = DDRNetFrames(str(folder / "ddrnet"), "found"), RGBDD(str(folder / "rgbdd_real"), True, scenes="found")
    for source in sources:
        pairs = []
        for name in source.scenes()[:columns]:
            scene = source.load(name)
            [(ratio, depth)] = scene.measured.items()
            camera = scene.camera.reduce(depth.shape[-1], depth.shape[-2]) if ratio != 1 else scene.camera
            pairs.append(
                Views(_shown(scene.rgb), rendering(depth, camera, "e1"), (f"{source.name} {name}", f"x{ratio:.3g}"))
            )
        rows.append(pairs)
    phone = folder / "iphone_lidar"
    levels, picture = read_16bit(phone / "arkit_depth.png"), read_photo(phone / "image.jpg")
    height, width = levels.shape
    values = torch.from_numpy(np.where(levels > 0, levels / 1000, np.nan))[None]
    camera = Camera.centred(width, height, 1440 * width / picture.shape[-1])
    shown = cv2.resize(picture.permute(1, 2, 0).numpy(), (width, height))
    rows.append([Views(shown, rendering(values, camera, "e1"), ("iphone_lidar", f"{height} x {width}"))])
    return rows


def draw_sheet(rows: list[list[Views]], path: Path) -> None:
    """Write the sheet."""
    columns = max(map(len, rows))
    figure = Figure(figsize=(3.6 * columns, 1.95 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    for row, pairs in enumerate(rows):
        for column, pair in enumerate(pairs):
            for side, (image, title) in enumerate(zip((pair.left, pair.right), pair.titles, strict=True)):
                axes = figure.add_subplot(len(rows), 2 * columns, 2 * (row * columns + column) + side + 1)
                axes.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
                axes.set_title(title, fontsize=7)
                axes.set_axis_off()
    figure.savefig(path, dpi=110)


def degradations(words: Sequence[str]) -> None:
    """Draw what degradation=everything makes of training patches, kind by kind, and maps of real sensors below.

    Each pair of pictures is a true surface and the low-resolution map made of it, both lit from one side; above the map
    are its noise as a share of depth and the share of its holes. Where the photo is changed, it is shown before and
    after. With --clear N, N patches with clear, mirroring and glossy objects are drawn instead: photo and truth, what a
    sensor sees and a stereo camera's map of it, holes red; below, captures of clear objects: photo and depth of their
    painted twins, measured depth and mask.
    """
    parser = argparse.ArgumentParser(prog="degradation_sheet.py", description=degradations.__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clear", type=int, default=0)
    options = parser.parse_args(words)
    if options.clear:
        rows = clear(options.clear, options.seed, options.columns, options.shared)
    else:
        kinds = [name for group in GROUPS for name in getattr(Everything(), group) if name != "none"]
        kinds = [*dict.fromkeys(kinds), *FRACTIONS]
        rows = [synthetic(kind, options.scale, options.columns, options.seed) for kind in kinds]
        rows += real(options.shared, options.columns) if (options.shared / "real").is_dir() else []
    draw_sheet(rows, options.output)


if __name__ == "__main__":
    degradations(sys.argv[1:])
