# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How well DIP-V fills holes: its error inside of them against interpolation after a fill with the nearest known pixel.

    python docs/measurements/scripts/inpainting.py --scenes DIR [--steps 400] [--scale 4] [--picture FILE] [--crop N]
        [--device cpu]

Two kinds of holes are cut into the low-resolution maps of Lucy and Plant: random blobs of 10 % of the pixels, and the
shadows that a second camera 20 cm to the right would leave. Errors are those of the high-resolution pixels under the
holes alone.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.holes import Blobs, Holes, Shadows
from dsr.geometry.surface import depth_to_normals, render
from dsr.methods.recipe import Run, read_recipe
from dsr.metrics.functional import SurfacePair, rmse_d, rmse_v
from dsr.sample import DepthSample, Scene
from dsr.utils.compute_device import fast_precision

BOX = Downsampling("box")
KINDS: dict[str, Holes] = {"blobs": Blobs(0.1, 12.0), "shadows": Shadows(0.2)}


def centre(scene: Scene, size: int) -> Scene:
    """Return the window of ``size`` pixels in the middle of a scene."""
    return scene.crop((scene.camera.height - size) // 2, (scene.camera.width - size) // 2, size, size)


def results(sample: DepthSample, steps: int, device: torch.device) -> dict[str, Tensor]:
    """Return what each method makes of a sample with holes."""
    methods: dict[str, tuple[str, dict[str, Any], str]] = {
        "Bicubic, nearest fill": ("bicubic", {"fill_holes": True}, "float32"),
        "MSG-V": ("msg_v", {}, "float32"),
        "DIP-V": ("dip_v", {"steps": steps, "validate_every": 0}, fast_precision(device)),
    }
    found = {}
    for label, (name, settings, precision) in methods.items():
        recipe = read_recipe(name, settings)
        if name != "msg_v" or sample.scale in recipe.factors:
            method = recipe.build(sample.scale, Run(device=device, precision=precision, downsampling=BOX))
            found[label] = method(sample)
    return found


def errors(depth: Tensor, sample: DepthSample, holes: Tensor) -> tuple[float, float]:
    """Return RMSE_d in mm and RMSE_v of the pixels under holes, (1, H, W) bool."""
    truth = sample.depth
    if truth is None:
        raise ValueError(f"{sample.scene}: expected a true depth map")
    pair = SurfacePair(depth[None].double(), truth[None].double(), sample.camera.rays()[None], holes[None])
    return 1000 * float(rmse_d(pair)), float(rmse_v(pair))


def draw(rows: list[tuple[str, DepthSample, dict[str, Tensor]]], path: Path) -> None:
    """Draw photo, input, and renderings of the results and of the truth."""
    names = [*rows[0][2], "truth"]
    figure = Figure(figsize=(2.6 * (2 + len(names)), 2.75 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), 2 + len(names), squeeze=False)
    for line, (title, sample, found) in zip(axes, rows, strict=True):
        line[0].imshow(sample.rgb.permute(1, 2, 0).numpy())
        colours = mpl.colormaps["viridis"].with_extremes(bad="#d684b4")
        line[1].imshow(sample.depth_lr[0].numpy(), cmap=colours, interpolation="nearest")
        line[0].set_title(title)
        line[1].set_title("input (pink: holes)")
        rays = sample.camera.rays()[None]
        for axis, name in zip(line[2:], names, strict=True):
            depth = sample.depth if name == "truth" else found[name]
            if depth is not None:
                axis.imshow(
                    render(depth_to_normals(depth.double()[None], rays))[0, 0].numpy(), cmap="gray", vmin=0, vmax=1
                )
            axis.set_title(name)
        for axis in line:
            axis.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("DSR_SCENES")
    parser.add_argument("--scenes", type=Path, default=default, required=default is None)
    parser.add_argument("--names", nargs="+", default=["lucy", "plant"])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--crop", type=int, help="the middle of the scenes alone, so many pixels of it")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", type=torch.device, default="cpu")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print("| scene, holes, share | method | RMSE_d in holes, mm | RMSE_v in holes |\n| --- | --- | --- | --- |")
    rows = []
    for name in options.names:
        scene = Folder(str(options.scenes), [name]).load(name)
        scene = scene if options.crop is None else centre(scene, options.crop)
        for kind, holes in KINDS.items():
            sample = make_sample(scene, options.scale, BOX, "orthogonal", holes=holes)
            cut = sample.depth_lr.isnan()
            under = cut.repeat_interleave(options.scale, 1).repeat_interleave(options.scale, 2)
            found = results(sample, options.steps, options.device)
            rows.append((f"{name}, {kind}", sample, found))
            for method, depth in found.items():
                millimetres, visual = errors(depth, sample, under)
                share = f"{100 * float(cut.double().mean()):.1f} %"
                print(f"| {name}, {kind}, {share} | {method} | {millimetres:.0f} | {visual:.3f} |", flush=True)
    if options.picture is not None:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
