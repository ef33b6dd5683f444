# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Measure how metrics of renderings react to grain: white noise that is added to a method's depth.

    python docs/measurements/scripts/grain.py --scenes DIR [--method facets] [--scale 4] [--levels 0,0.0001,0.0002,0.0005]
        [--device cpu]

Noise is normal, its standard deviation a fraction of the depth. Prints a Markdown table; metrics with _v but RMSE_v
are of the worst of four lights. LPIPS_v needs AlexNet's weights, see docs/metrics.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from dsr.app.metrics import chosen_metrics
from dsr.app.schema import MetricsConfig
from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.recipe import Run, read_recipe
from dsr.metrics.catalogue import score_image
from dsr.metrics.formats import HEADLINES

SHOWN = (("RMSE_v", 1e3, 0), ("DSSIM_v", 1e3, 0), ("LPIPS_v", 1e3, 0), ("RMSE_d", 1e3, 1))


def main() -> None:
    """Score the method's depth with each level of noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True, help="a folder of scenes, as dataset=folder reads it")
    parser.add_argument("--names", default="lucy,plant")
    parser.add_argument("--method", default="facets")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--levels", default="0,0.0001,0.0002,0.0005")
    parser.add_argument("--lpips-trunk", help="AlexNet's weights; without it, as for eval.py")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    box = Downsampling("box")
    method = read_recipe(options.method).build(options.scale, Run(device=options.device, downsampling=box))
    metrics = chosen_metrics(MetricsConfig(lpips_trunk=options.lpips_trunk))
    print("| scene | grain | RMSE_v | DSSIM_v | LPIPS_v | RMSE_d, mm |\n| --- | --- | ---: | ---: | ---: | ---: |")
    for name in options.names.split(","):
        sample = make_sample(Folder(str(options.scenes), [name]).load(name), options.scale, box, method.range_type)
        depth = method(sample).double()
        noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0), dtype=depth.dtype)
        for level in map(float, options.levels.split(",")):
            noisy = depth * (1 + level * noise)
            assert sample.depth is not None  # noqa: S101 - scenes of a folder have their depth
            scores = list(score_image(noisy, sample.depth.double(), sample.camera.rays(), metrics))
            found = {each.metric: each.value for each in scores if each.variant in HEADLINES}
            cells = [f"{factor * found[metric]:.{digits}f}" for metric, factor, digits in SHOWN if metric in found]
            print(f"| {name} | {100 * level:g} % | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
