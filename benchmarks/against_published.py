"""The weights that come with dsr against the published MSG-V: the paper's Lucy and Plant, x4 and x8, box downsampling.

    python benchmarks/against_published.py --shared DIR [--methods msg_v,facets] [--weights FILE ...]
        [--ensemble N] [--csv FILE] [--device cpu]

``DIR`` has ``scenes/lucy``, ``scenes/plant``, ``expected/metrics.json`` with the published network's scores, and
``weights/alexnet_imagenet_features.pth`` for LPIPS_v. Each figure is ours / published, lower is better; none of these
scenes was trained on or chosen with.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import pandas as pd
import torch

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.networks.weight_files import read_header
from dsr.methods.recipe import Known, Run, read_recipe
from dsr.methods.weights import packaged_weights
from dsr.metrics.catalogue import Metric, catalogue, score_image
from dsr.metrics.formats import WORST
from dsr.metrics.lpips import load_lpips

SCENES = ("lucy", "plant")
METRICS = ("RMSE_v", "DSSIM_v", "BadPix_v_5", "Bumpiness_d", "LPIPS_v", "RMSE_d")


def scores(
    shared: Path, name: str, weights: Path, scene: str, metrics: tuple[Metric, ...], ensemble: int | None, device: str
) -> dict[str, float]:
    """Return the worst-of-four scores of a method's network on one scene."""
    scale = read_header(weights)["arguments"]["scale"]
    recipe = read_recipe(name)
    if ensemble is not None and "ensemble" in recipe.at():
        recipe = read_recipe(name, {"ensemble": ensemble})
    run = Run(device=device, known=Known("box", "sharp", clean=True))
    method = recipe.with_weights(weights).build(scale, run)
    sample = make_sample(
        Folder(str(shared / "scenes"), [scene]).load(scene), scale, Downsampling("box"), method.range_type
    )
    depth = method(sample)
    with torch.inference_mode():
        rows = score_image(depth, sample.depth, sample.camera.rays(), metrics)
        return {row.metric: row.value for row in rows if row.variant in ("", WORST)}


def table(
    shared: Path, methods: list[str], scales: list[int], files: dict[str, Path], ensemble: int | None, device: str
) -> pd.DataFrame:
    """Return the ratios: a row per method, scale and scene, a column per metric."""
    expected = json.loads((shared / "expected" / "metrics.json").read_text())
    metrics = catalogue(load_lpips(shared / "weights" / "alexnet_imagenet_features.pth"))
    rows = []
    for method in methods:
        for scale in scales:
            name = f"{method}_x{scale}"
            weights = files.get(name) or packaged_weights(name)
            for scene in SCENES if weights is not None else ():
                ours, theirs = (
                    scores(shared, method, weights, scene, metrics, ensemble, device),
                    expected[scene][f"x{scale}"]["MSG-V"],
                )
                worst = {metric: max(value) if isinstance(value, list) else value for metric, value in theirs.items()}
                ratios = {metric: ours[metric] / worst[metric] for metric in METRICS}
                rows.append({"method": method, "scale": scale, "scene": scene, **ratios})
    return pd.DataFrame(rows)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--methods", default="msg_v,facets,msg")
    parser.add_argument("--scales", type=int, nargs="+", default=[4, 8])
    parser.add_argument("--weights", type=Path, nargs="*", default=[], help="files to take instead of packaged ones")
    parser.add_argument(
        "--ensemble", type=int, help="passes to average where the method can; that of eval.py unless given"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--csv", type=Path, help="where to write the table to")
    arguments = parser.parse_args()
    if not (arguments.shared / "expected" / "metrics.json").is_file():
        print(f"skipped: needs the published network's scores, there are none in {arguments.shared}")
        return
    heads = {path: read_header(path) for path in arguments.weights}
    files = {f"{head['model']}_x{head['arguments']['scale']}": path for path, head in heads.items()}
    methods = arguments.methods.split(",")
    ratios = table(arguments.shared, methods, arguments.scales, files, arguments.ensemble, arguments.device)
    if arguments.csv:
        ratios.to_csv(arguments.csv, index=False)
    for method, group in ratios.groupby("method", sort=False):
        print(f"\n{method}: ours / published MSG-V")
        print(group.drop(columns="method").to_string(index=False, float_format="%.3f"))
        print("average ", "  ".join(f"{metric} {group[metric].mean():.3f}" for metric in METRICS))


if __name__ == "__main__":
    main()
