# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Which metric sees which error: controlled distortions of true surfaces, all of the same depth error.

    python docs/measurements/scripts/what_sees_what.py [--scenes DIR] [--lpips FILE] -o what_sees_what

Seven distortions, five strengths each. Six of them, of inverse depth, have the same RMSE of relative depth at each
strength, found by bisection: bumps (smooth, 16 pixels wide), grain (alike over 1.5 pixels), white noise, steps
(quantised depth), blur (a Gaussian, which also takes the edges), and a wrong scale. Of the seventh, holes, the strength
is their share. The surfaces are SimGeo's, and those of the folders in DIR.

Writes ``what_sees_what.csv`` (a row a metric, distortion, strength and scene), ``table.md``, ``reaction.png`` (the
table's numbers as colours) and ``surfaces.jpg`` (one scene under all distortions of one depth error). A metric's
*reaction* to a distortion is how far its value moves from that of the truth itself; the table has each distortion's
share of the reactions to the six of the same depth error, at the middle strength, mean over scenes, and how often more
distortion moves the metric further (Kendall's tau of strength and reaction, mean over scenes and distortions).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from panel_grid import Panel, save_panels
from scipy.stats import kendalltau
from torch import Tensor

from dsr.data.folder import Folder
from dsr.data.rendered import SimGeo
from dsr.degradation.random_fields import field_of
from dsr.metrics.catalogue import Metric, catalogue, score_image
from dsr.metrics.formats import HEADLINES, in_tables
from dsr.metrics.lpips import load_lpips
from dsr.pictures.depth_views import rendering
from dsr.sample import Scene
from dsr.utils.console import ConsoleProgress, open_console

ERRORS = (0.0005, 0.001, 0.002, 0.005, 0.01)
"""RMSE of relative depth at each strength."""
SHARES = (0.01, 0.02, 0.05, 0.1, 0.2)
"""Share of holes at each strength."""
MIDDLE = 2
MUCH = 30
"""Percent from which on a share is bold; even ones would be 17."""
SUITE = ("paper", "depth", "normals", "points", "boundaries", "evalmde")
SIMGEO = ("statue", "cube_no_texture")
"""Scenes of different shapes."""
Distortion = Callable[[Tensor, float], Tensor]


def field(depth: Tensor, sigma: float) -> Tensor:
    """Return a random field as large as a map, (1, H, W), of deviation 1."""
    return field_of(depth.float(), sigma, torch.Generator().manual_seed(0)).to(depth)


def blurred(depth: Tensor, sigma: float) -> Tensor:
    """Return depth blurred in inverse depth, with holes left out."""
    from scipy.ndimage import gaussian_filter  # noqa: PLC0415 - a kernel of any width

    known = depth.isfinite()
    filled = torch.where(known, 1 / depth, 0)[0].numpy()
    weight = gaussian_filter(known[0].double().numpy(), sigma, mode="nearest")
    return torch.where(
        known, torch.from_numpy(weight / gaussian_filter(filled, sigma, mode="nearest"))[None], torch.nan
    )


DISTORTIONS: dict[str, tuple[Distortion, float]] = {
    "bumps": (lambda depth, size: depth / (1 + size * field(depth, 16 / 2.355)), 0.1),
    "grain": (lambda depth, size: depth / (1 + size * field(depth, 1.5 / 2.355)), 0.1),
    "noise": (lambda depth, size: depth / (1 + size * field(depth, 0)), 0.1),
    "steps": (lambda depth, size: torch.exp(((depth.log() / size).round()) * size), 0.5),
    "blur": (blurred, 60.0),
    "scale": (lambda depth, size: depth * (1 + size), 0.1),
}
"""By name: the distortion, and a strength beyond those that are used."""
HOLES = "holes"
CAPTION = ("RMSE_d", "RMSE_v")


def relative_error(prediction: Tensor, truth: Tensor) -> float:
    """Return the RMSE of relative depth."""
    return float((prediction / truth - 1).square().nanmean().sqrt())


def at_error(distort: Distortion, most: float, depth: Tensor, error: float) -> Tensor:
    """Return the distorted map that is off by an RMSE of relative depth, by bisection."""
    low, high = 0.0, most
    for _ in range(25):
        middle = (low + high) / 2
        low, high = (middle, high) if relative_error(distort(depth, middle), depth) < error else (low, middle)
    return distort(depth, high)


def with_holes(depth: Tensor, share: float) -> Tensor:
    """Return a map with holes of a share of its area, 12 pixels wide."""
    values = field(depth, 12 / 2.355)
    return depth.masked_fill(values > values.quantile(1 - share), torch.nan)


def distorted(scene: Scene) -> Iterator[tuple[str, int, Tensor]]:
    """Yield the name of each distortion, its strength's number and the map."""
    assert scene.depth is not None  # noqa: S101 - for the type checker
    depth = scene.depth.double()
    for name, (distort, most) in DISTORTIONS.items():
        for number, error in enumerate(ERRORS):
            yield name, number, at_error(distort, most, depth, error)
    for number, share in enumerate(SHARES):
        yield HOLES, number, with_holes(depth, share)


def values_of(prediction: Tensor, scene: Scene, metrics: tuple[Metric, ...]) -> dict[str, float]:
    """Return the value of each metric, of the worst light."""
    assert scene.depth is not None  # noqa: S101 - for the type checker
    rows = score_image(prediction, scene.depth.double(), scene.camera.rays(), metrics)
    return {row.metric: row.value for row in rows if row.variant in HEADLINES}


def measure(scenes: list[Scene], metrics: tuple[Metric, ...]) -> pd.DataFrame:
    """Return the reaction of each metric to each distortion of each scene."""
    rows = []
    progress = ConsoleProgress(open_console())
    with progress.task("maps", len(scenes) * (len(DISTORTIONS) + 1) * len(ERRORS)) as step:
        done = 0
        for scene in scenes:
            assert scene.depth is not None  # noqa: S101 - for the type checker
            best = values_of(scene.depth.double(), scene, metrics)
            for name, number, prediction in distorted(scene):
                for metric, value in values_of(prediction, scene, metrics).items():
                    reaction = abs(value - best[metric])
                    rows.append((metric, name, number, scene.name, value, reaction))
                done += 1
                step(done, len(scenes) * (len(DISTORTIONS) + 1) * len(ERRORS))
    return pd.DataFrame(rows, columns=["metric", "distortion", "strength", "scene", "value", "reaction"])


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Return a row a metric: shares of the reactions at the middle strength in percent, and how well it ranks."""
    middle = table[(table["strength"] == MIDDLE) & (table["distortion"] != HOLES)]
    wide = middle.pivot_table(index=["metric", "scene"], columns="distortion", values="reaction", sort=False)
    shares = 100 * wide.div(wide.sum(axis=1), axis=0).groupby("metric", sort=False).mean()

    def tau(group: pd.DataFrame) -> float:
        return float(kendalltau(group["strength"], group["reaction"]).statistic) if group["reaction"].any() else 0.0

    taus = table.groupby(["metric", "distortion", "scene"], sort=False)[["strength", "reaction"]].apply(tau)
    ranks = taus.groupby(["metric", "distortion"], sort=False).mean().unstack("distortion")
    shares["ranks"] = ranks[list(DISTORTIONS)].mean(axis=1)
    shares["ranks holes"] = ranks[HOLES]
    return shares


def write(folder: Path, table: pd.DataFrame, summary: pd.DataFrame, metrics: tuple[Metric, ...]) -> None:
    """Write the table in its layouts."""
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(folder / "what_sees_what.csv", index=False)
    shown = in_tables({metric.name: metric.format for metric in metrics})
    names = [name for name in summary.index if name in shown and summary.loc[name, list(DISTORTIONS)].notna().any()]
    heads = [f"{shown[name].family}: {shown[name].title}" for name in names]
    kinds = list(DISTORTIONS)
    lines = [f"| metric | {' | '.join(kinds)} | ranks | ranks holes |", "| --- " + "| ---: " * (len(kinds) + 2) + "|"]
    for name, head in zip(names, heads, strict=True):
        row = summary.loc[name]
        cells = [f"**{row[kind]:.0f}**" if row[kind] >= MUCH else f"{row[kind]:.0f}" for kind in kinds]
        lines.append(f"| {head} | {' | '.join(cells)} | {row['ranks']:.2f} | {row['ranks holes']:.2f} |")
    (folder / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    figure = Figure(figsize=(7, 0.24 * len(names) + 1.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    image = axes.imshow(summary.loc[names, kinds].to_numpy(), aspect="auto", cmap="viridis", vmin=0, vmax=100)
    axes.set_xticks(range(len(kinds)), kinds)
    axes.set_yticks(range(len(names)), heads, fontsize=7)
    axes.xaxis.tick_top()
    figure.colorbar(image, label="share of the reactions to six distortions of the same depth error, %")
    figure.savefig(folder / "reaction.png")


def draw(path: Path, scene: Scene, metrics: tuple[Metric, ...]) -> None:
    """Draw a scene under all distortions of the middle strength."""
    assert scene.depth is not None  # noqa: S101 - for the type checker
    panels = [Panel("truth", rendering(scene.depth.double(), scene.camera))]
    for name, number, prediction in distorted(scene):
        if number == MIDDLE:
            found = values_of(prediction, scene, metrics)
            caption = f"{name}\nRMSE_d {1e3 * found['RMSE_d']:.1f} mm, RMSE_v {1e3 * found['RMSE_v']:.0f}"
            panels.append(Panel(caption, rendering(prediction, scene.camera)))
    save_panels(path, panels, 4, width=300)


def main(arguments: list[str]) -> None:
    """Measure, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, help="a directory of scenes beside SimGeo's, as of dataset=folder")
    parser.add_argument("--only", nargs="+", help="names of its scenes")
    parser.add_argument("--lpips", type=Path, help="AlexNet's weights")
    parser.add_argument("-o", "--output", type=Path, required=True)
    asked = parser.parse_args(arguments)
    source = SimGeo("data/simgeo")
    scenes = [source.load(name) for name in SIMGEO]
    if asked.scenes is not None:
        folder = Folder(str(asked.scenes), asked.only)
        scenes += [folder.load(name) for name in folder.scenes()]
    metrics = catalogue(None if asked.lpips is None else load_lpips(asked.lpips), protocols=SUITE)
    table = measure(scenes, metrics)
    write(asked.output, table, summarise(table), metrics)
    draw(asked.output / "surfaces.jpg", scenes[0], tuple(each for each in metrics if each.name in CAPTION))


if __name__ == "__main__":
    main(sys.argv[1:])
