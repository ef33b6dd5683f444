"""How right the expected errors of ``method=facets`` are: deciles, and what is left without the least confident pixels.

    python benchmarks/confidence.py --shared DIR [--scale 4] [--draws 2] [--clean box] [--weights FILE] [--picture FILE]

On SimGeo, ICL-NUIM, Lucy and Plant, on which nothing is trained, each scene with several random degradations of all
kinds that the network is trained on, or with ``--clean`` its map without noise, known to be such: box means, or bicubic
maps of scenes with soft depth steps, at half their size.
A ratio of 1 is right; the picture shows all deciles and the sparsification curve.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dsr.data.folder import Folder
from dsr.data.icl import ICL
from dsr.data.rendered import SimGeo
from dsr.data.scene_source import SceneSource
from dsr.degradation.downsampling import Downsampling, Kernel, make_sample
from dsr.degradation.random_degradation import Everything
from dsr.methods.networks.facets_method import SPECIAL
from dsr.methods.recipe import Run, read_recipe
from dsr.metrics.calibration import error_ratios, measured_errors, squared_error_share
from dsr.sample import DepthSample
from dsr.training.patches import soften

CLEAN = dict(SPECIAL.keys())
"""Depth steps of the maps without noise, by their kernel."""
KEPT = 0.8
"""Fraction of the pixels whose share of the squared error is printed."""
_FRACTIONS = [i / 20 for i in range(1, 21)]


def samples(shared: Path, scale: int, draws: int, clean: Kernel | None) -> Iterator[DepthSample]:
    """Yield the scenes with random degradations, or once without noise."""
    generator = torch.Generator().manual_seed(0)
    icl = ICL(str(shared / "real" / "icl_nuim"), "found")
    sources: tuple[SceneSource, ...] = (SimGeo(), icl, Folder(str(shared / "scenes"), ["lucy", "plant"]))
    for source in sources:
        for name in source.scenes():
            scene = source.load(name)
            if clean == "bicubic":
                scene = soften(scene.crop(0, 0, *(n // 2 * 2 for n in scene.rgb.shape[-2:])))
            height, width = (scale * (n // scale) for n in scene.rgb.shape[-2:])
            scene = scene.crop(0, 0, height, width)
            if clean is not None:
                yield make_sample(scene, scale, Downsampling(clean), "disparity")
                continue
            for _ in range(draws):
                yield Everything(told=0)(scene, scale, generator)[0]


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--clean", choices=CLEAN)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    given = {"clean": True, "kernel": arguments.clean, "edges": CLEAN[arguments.clean]} if arguments.clean else {}
    recipe = read_recipe("facets", given).with_weights(arguments.weights)
    method = recipe.build(arguments.scale, Run(device=arguments.device))
    expected: dict[str, list[torch.Tensor]] = {"depth": [], "normal": []}
    measured: dict[str, list[torch.Tensor]] = {"depth": [], "normal": []}
    for sample in samples(arguments.shared, arguments.scale, arguments.draws, arguments.clean):
        surface = method.surface(sample)
        if sample.depth is None or surface.depth_error is None or surface.angle_error is None:
            raise TypeError(f"{sample.scene}: expected a truth and expected errors")
        rays = sample.camera.rays()[None]
        found = measured_errors(surface.depth.double()[None], sample.depth.double()[None], rays)
        for name, off, said in zip(expected, found, (surface.depth_error, surface.angle_error), strict=True):
            expected[name].append(said.double().flatten())
            measured[name].append(off.flatten())
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    deciles, curve = figure.subplots(1, 2)
    for name, parts in expected.items():
        said, off = torch.cat(parts), torch.cat(measured[name])
        ratios = error_ratios(said, off)
        print(f"{name}: measured / expected error of the deciles", " ".join(f"{ratio:.2f}" for ratio in ratios))
        left = 1 - float(squared_error_share(said, off, KEPT))
        print(f"   the most confident {KEPT:.0%} of the pixels leave out {left:.0%} of the squared error")
        deciles.plot(range(1, 11), ratios, marker="o", label=name)
        curve.plot(_FRACTIONS, [float(squared_error_share(said, off, kept)) for kept in _FRACTIONS], label=name)
    deciles.axhspan(0.75, 1.25, color="0.9")
    deciles.set(xlabel="decile by expected error", ylabel="measured / expected", ylim=(0, 2))
    curve.plot([0, 1], [0, 1], color="0.7", linestyle=":", label="without information")
    curve.set(xlabel="most confident fraction of the pixels", ylabel="share of the squared error")
    for axes in (deciles, curve):
        axes.legend()
    if arguments.picture is not None:
        figure.savefig(arguments.picture, dpi=120)


if __name__ == "__main__":
    main()
