"""The metric study: correlations of metrics with each other and with LPIPS_v over all results, as tables and figures.

Voynov et al., *Perceptual Deep Depth Super-Resolution* (ICCV 2019): every result of any method, scene and scale is a
point; correlations are Pearson's and Spearman's. Beside them stand those of the values in the paper's tables. The
scatter matrix has pairs of metrics below the diagonal, correlations above, densities per method on it.
"""

import colorsys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsr.evaluation.results import Results
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import HEADLINES, LIGHTS_NOTE, PAPER, Formats, by_family, in_tables
from dsr.pictures.canvas import write_figure
from dsr.report.paper import published
from dsr.report.table_layouts import MISSING, aligned, escaped
from dsr.utils.files import write_text

Kind = Literal["pearson", "spearman"]
KINDS: tuple[Kind, ...] = ("pearson", "spearman")
REFERENCE = "LPIPS_v"
DEPTH_LIMIT = 0.5  # limit at which RMSE_d is clipped as in the paper, metres, because of a few outliers
_ABOUT = ["dataset", "scene", "scale", "downsampling", "label", "seed"]
_LEAST = 3  # minimum number of points of a correlation
_STYLE: dict[Any, Any] = {
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "font.size": 8,
    "axes.linewidth": 0.6,
    "axes.unicode_minus": False,
}
_DPI = 200
_PANEL, _ABOVE = 1.35, 0.95  # size of a panel, and height of the title and legend, inches
_HIGHLIGHT, _FRAME = "#fff4d6", "#c98a00"
_STRENGTH = "RdBu_r"
_MANY = 3000  # number of points above which the PDF has them as an image, since it would take minutes to open otherwise
# Colours of the paper's methods and Facets. Any two differ by 16 in CIEDE2000, also to protanopes and deuteranopes.
FIXED = {
    "Bicubic": "#8b8f8f", "SRfS": "#efe845", "EG": "#1b570d", "PDN": "#50ddae", "DG": "#9d54a6", "DIP": "#de9257",
    "DIP-V": "#521b2e", "MSG": "#65b3e6", "MSG-V": "#0f165b", "Facets": "#d52554",
}  # fmt: skip
_FREE = ("#999933", "#c9a0dc", "#004d40", "#f5a3b5", "#7fb800", "#0072b2", "#5c4033", "#000000")
_GOLDEN = 0.618033988749895


def metric_matrix(results: Results) -> pd.DataFrame:
    """Return a table with one row per result and one column per version of a metric, in raw units, NaN where missing.

    Columns are ``DSSIM_v`` for the worst of the four lights, ``DSSIM_v[e1]`` to ``[e4]`` and ``[avg]``, metrics without
    lights by their name. RMSE_d is clipped at 0.5 m.
    """
    scores = results.scores
    variant = scores["variant"].fillna("")
    name = scores["metric"].where(variant.isin(HEADLINES), scores["metric"] + "[" + variant + "]")
    scores = scores.assign(name=name, value=scores["value"].where(np.isfinite(scores["value"])))
    scores = scores.drop_duplicates([*_ABOUT, "name"], keep="last")
    matrix = scores.pivot(index=_ABOUT, columns="name", values="value")
    matrix = matrix.reindex(columns=list(dict.fromkeys(name))).rename_axis(columns=None)
    if "RMSE_d" in matrix:
        matrix["RMSE_d"] = matrix["RMSE_d"].clip(upper=DEPTH_LIMIT)
    return matrix


def correlate(matrix: pd.DataFrame, kind: Kind) -> pd.DataFrame:
    """Return the correlation of each pair of columns; NaN for a constant column or fewer than three rows with both."""
    return matrix.astype(float).corr(method=kind, min_periods=_LEAST)


def pairs(matrix: pd.DataFrame) -> pd.DataFrame:
    """Count for every pair of columns the rows with both values."""
    present = matrix.notna().astype(int)
    return present.T @ present


def with_reference(matrix: pd.DataFrame) -> pd.DataFrame:
    """Correlate every other version of a metric with LPIPS_v: ``metric, pearson, spearman, n``, the largest first."""
    names = [name for name in matrix if not str(name).startswith(REFERENCE)] if REFERENCE in matrix else []
    frame = pd.DataFrame({"metric": pd.Series(names, dtype=str)})
    for kind in KINDS:
        found = correlate(matrix, kind)
        frame[kind] = [float(found.loc[name, REFERENCE]) for name in names]
    counts = pairs(matrix)
    frame["n"] = [int(counts.loc[name, REFERENCE]) for name in names]
    return frame.sort_values("spearman", ascending=False, kind="stable", ignore_index=True)


def write_correlations(folder: Path, results: Results) -> list[Path]:
    """Write the correlations of all versions of all metrics, and return the files.

    They are ``pearson.csv``, ``spearman.csv``, ``pairs.csv`` (number of results per pair), ``with_lpips.csv`` and
    ``with_lpips.md``, both with the correlations in the paper's tables beside ours.
    """
    matrix = metric_matrix(results)
    table = published()
    table = table[~table["scene"].str.startswith("Average")].set_index(["scene", "method", "scale"])
    formats = {name: each for name, each in in_tables(KNOWN_FORMATS).items() if name in table}
    of_paper = table[list(formats)] / [each.factor for each in formats.values()]
    of_paper["RMSE_d"] = of_paper["RMSE_d"].clip(upper=DEPTH_LIMIT)
    paper = with_reference(of_paper).add_prefix("paper_").rename(columns={"paper_metric": "metric"})
    ranking = with_reference(matrix).merge(paper, "left", "metric").astype({"paper_n": "Int64"})
    tables = {kind: correlate(matrix, kind) for kind in KINDS} | {"pairs": pairs(matrix)}
    texts = {f"{name}.csv": table.to_csv(index_label="metric") for name, table in tables.items()}
    texts |= {"with_lpips.csv": ranking.to_csv(index=False), "with_lpips.md": _ranking_text(ranking, len(matrix))}
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


def _ranking_text(ranking: pd.DataFrame, count: int) -> str:
    title = f"## Correlation with {REFERENCE}\n\n"
    if ranking.empty:
        return f"{title}There is no {REFERENCE} in these {count} results (metrics.lpips=true computes it).\n"
    values = [*KINDS, *(f"paper_{kind}" for kind in KINDS)]
    rows = []
    for _, row in ranking.iterrows():
        ours, spearman, *papers = (MISSING if np.isnan(row[name]) else f"{row[name]:.3f}" for name in values)
        rows.append([escaped(str(row["metric"])), ours, spearman, str(row["n"]), *papers])
    paper = ranking["paper_n"].max()
    text = (
        f"Over {count} results of all methods, scenes and scales. {LIGHTS_NOTE}, by a name by itself; "
        f"RMSE_d is clipped at {DEPTH_LIMIT:g} m. n: number of results with both metrics."
    )
    if pd.notna(paper):
        text += f" Paper: the same over the {paper} results in the tables of Voynov et al. 2019."
    head = ["metric", "Pearson", "Spearman", "n", "Pearson, paper", "Spearman, paper"]
    return f"{title}{text}\n\n{aligned(head, rows, 1)}\n"


def save_scatter_matrix(results: Results, folder: Path) -> list[Path]:
    """Draw the ``scatter_matrix`` and, if there is LPIPS_v, ``with_lpips``, each as PDF and PNG; return the files."""
    matrix = metric_matrix(results)
    labels = [label for label in results.methods() if label in matrix.index.get_level_values("label")]
    ranking = with_reference(matrix)
    with mpl.rc_context(_STYLE):
        figures = {"scatter_matrix": scatter_matrix(matrix, labels, by_family(results.formats).get(PAPER, {}))}
        if len(ranking):
            figures["with_lpips"] = _ranking(ranking, len(matrix))
        paths = []
        for name, figure in figures.items():
            for suffix in ("pdf", "png"):
                paths.append(folder / f"{name}.{suffix}")
                write_figure(paths[-1], figure, _DPI, {"CreationDate": None} if suffix == "pdf" else None)
    return paths


def scatter_matrix(matrix: pd.DataFrame, labels: list[str], formats: Formats) -> Figure:
    """Draw the scatter matrix of some metrics; ``labels`` are the methods in the order of the legend."""
    names = [name for name in formats if name in matrix and name != REFERENCE]
    names += [REFERENCE] if REFERENCE in matrix else []
    values = matrix[names] * [formats[name].factor for name in names]
    method = matrix.index.get_level_values("label").to_numpy()
    colours = method_colours(labels)
    size = max(len(names), 2) * _PANEL
    height = size + _ABOVE + 0.5
    figure = Figure(figsize=(size + 0.7, height))
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(names), len(names), squeeze=False)
    figure.subplots_adjust(0.6 / (size + 0.7), 0.45 / height, 1 - 0.1 / (size + 0.7), 1 - _ABOVE / height, 0.09, 0.09)
    limits = {name: _limits(values[name]) for name in names}
    order = np.random.default_rng(0).permutation(len(matrix))  # so that no method covers another
    dots = [colours[label] for label in method[order]]
    tables = (correlate(matrix[names], "pearson"), correlate(matrix[names], "spearman"), pairs(matrix[names]))
    for row, vertical in enumerate(names):
        for column, across in enumerate(names):
            axis = axes[row, column]
            if row == column:
                _densities(axis, values[across].to_numpy(), method, colours, limits[across])
            elif row > column:
                points = values[[across, vertical]].to_numpy()[order].T
                axis.scatter(*points, s=7, c=dots, alpha=0.75, linewidths=0, rasterized=len(matrix) > _MANY)
                axis.set(xlim=limits[across], ylim=limits[vertical])
            else:
                pearson, spearman, count = (float(table.loc[vertical, across]) for table in tables)
                _coefficients(axis, pearson, spearman, "" if count == len(matrix) else f"n = {count:.0f}")
            if REFERENCE in (vertical, across):
                if row >= column:
                    axis.set_facecolor(_HIGHLIGHT)
                for spine in axis.spines.values():
                    spine.set(color=_FRAME, linewidth=1.2)
            _label(axis, row, column, len(names))
            for write, name, outer in (
                (axis.set_xlabel, across, row == len(names) - 1),
                (axis.set_ylabel, vertical, column == 0),
            ):
                if outer:
                    weight = "bold" if name == REFERENCE else "normal"
                    write(formats[name].title, fontweight=weight, parse_math=False)
    _head(figure, len(matrix), colours, has_reference=REFERENCE in names)
    return figure


def method_colours(labels: Sequence[str]) -> dict[str, str]:
    """Return a colour per label as ``#rrggbb``: that of a method in ``FIXED``, or the next free one."""
    others = [label for label in dict.fromkeys(labels) if label not in FIXED]
    free = dict(zip(others, _FREE, strict=False))
    for number, label in enumerate(others[len(_FREE) :], len(_FREE)):
        # Successive hues are a golden section apart, in three alternating lightnesses.
        rgb = colorsys.hls_to_rgb(number * _GOLDEN % 1, (0.38, 0.55, 0.72)[number % 3], 0.6)
        free[label] = "#" + "".join(f"{round(255 * each):02x}" for each in rgb)
    return {label: FIXED.get(label) or free[label] for label in labels}


def _limits(values: pd.Series) -> tuple[float, float]:
    finite = values.dropna()
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    margin = 0.06 * (high - low) or 0.06 * abs(high) or 0.5
    return low - margin, high + margin


def _densities(
    axis: Axes, values: np.ndarray, method: np.ndarray, colours: Mapping[str, str], limits: tuple[float, float]
) -> None:
    """Draw a Gaussian kernel density (Scott's bandwidth) per method, scaled to its maximum; ticks without one."""
    from scipy.stats import gaussian_kde  # noqa: PLC0415 - it takes half a second to import

    grid = np.linspace(*limits, 200)
    for label, colour in colours.items():
        own = values[(method == label) & np.isfinite(values)]
        density = gaussian_kde(own)(grid) if len(np.unique(own)) > 2 else np.zeros(1)
        if not (density.max() > 0 and np.isfinite(density).all()):
            axis.plot(own, np.full(len(own), 0.05), "|", color=colour, markersize=7, markeredgewidth=1)
        else:
            axis.plot(grid, density / density.max(), color=colour, linewidth=1.1)
            axis.fill_between(grid, density / density.max(), color=colour, alpha=0.08, linewidth=0)
    axis.set(xlim=limits, ylim=(0, 1.12))


def _coefficients(axis: Axes, pearson: float, spearman: float, count: str) -> None:
    """Write Pearson's and Spearman's coefficients; size and background show the strength."""
    if np.isfinite(pearson):
        axis.set_facecolor(mpl.colormaps[_STRENGTH](0.5 + 0.27 * (pearson + spearman) / 2))
    for value, letter, height in ((pearson, "r", 0.66), (spearman, "\N{GREEK SMALL LETTER RHO}", 0.34)):
        finite = bool(np.isfinite(value))
        text = f"{letter} = {value:.2f}" if finite else f"{letter} \N{EN DASH}"
        size = 7 + 6 * abs(value) if finite else 7
        axis.text(0.5, height, text, ha="center", va="center", fontsize=size, transform=axis.transAxes)
    axis.text(0.5, 0.09, count, ha="center", va="center", fontsize=6, transform=axis.transAxes)


def _label(axis: Axes, row: int, column: int, count: int) -> None:
    """Write tick labels at the outer panels only."""
    axis.tick_params(length=2, width=0.5, labelsize=6, pad=1.5)
    axis.locator_params(nbins=4)
    if row < count - 1:
        axis.set_xticklabels([])
    if column > 0 or row == 0:
        axis.set_yticklabels([])
    if row == column:
        axis.set_yticks([])
    if row < column:
        axis.set(xticks=[], yticks=[])
    axis.xaxis.set_label_coords(0.5, -0.17)
    axis.yaxis.set_label_coords(-0.24, 0.5)


def _head(figure: Figure, count: int, colours: Mapping[str, str], *, has_reference: bool) -> None:
    width, height = figure.get_size_inches()
    reference = f"{REFERENCE} is highlighted" if has_reference else f"no {REFERENCE} in these results"
    text = (
        f"{count} results; {LIGHTS_NOTE}; RMSE_d clipped at {1000 * DEPTH_LIMIT:g} mm; {reference}\n"
        "r: Pearson, \N{GREEK SMALL LETTER RHO}: Spearman; on the diagonal kernel densities, each scaled to its maximum"
    )
    figure.text(0.6 / width, 1 - 0.12 / height, text, va="top", fontsize=8, parse_math=False)
    handles: list[Any] = [
        Line2D([], [], marker="o", linestyle="", markersize=4, color=each) for each in colours.values()
    ]
    columns = max(1, int(width / (0.45 + 0.075 * max(map(len, colours), default=0))))
    legend = figure.legend(
        handles, list(colours), loc="upper left", bbox_to_anchor=(0.6 / width - 0.01, 1 - 0.42 / height),
        ncols=min(columns, len(handles)), frameon=False, handletextpad=0.1, columnspacing=1.2,
    )  # fmt: skip
    for name in legend.get_texts():
        name.set_parse_math(False)


def _ranking(ranking: pd.DataFrame, count: int) -> Figure:
    rows = len(ranking)
    height = 0.19 * rows + 0.85
    figure = Figure(figsize=(5.6, height))
    FigureCanvasAgg(figure)
    axis = figure.add_axes((0.3, 0.5 / height, 0.66, 1 - 0.85 / height))
    places = np.arange(rows)[::-1]
    axis.hlines(places, 0, 1, color="#e6e6e6", linewidth=0.6, zorder=0)
    axis.barh(places, ranking["spearman"], height=0.62, color="#0f165b", alpha=0.85, label="Spearman")
    axis.plot(ranking["pearson"], places, "D", color="#d52554", markersize=4, markeredgecolor="white",
              markeredgewidth=0.5, label="Pearson")  # fmt: skip
    axis.set_yticks(places, [str(name) for name in ranking["metric"]], parse_math=False)
    low = min(0.0, float(np.nanmin(ranking[["pearson", "spearman"]].to_numpy(), initial=0)))
    axis.set(xlim=(low - 0.05 * (low < 0), 1.0), ylim=(-0.7, rows - 0.3))
    axis.set_xlabel(f"correlation with {REFERENCE} over {count} results", parse_math=False)
    axis.tick_params(length=0, axis="y")
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.axvline(0, color="black", linewidth=0.6)
    axis.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, borderaxespad=0.2)
    return figure
