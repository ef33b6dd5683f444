"""The TensorBoard log of an evaluation, so that many can be compared in one dashboard.

A scalar's step is what it is plotted over: the number of the scene, or of the light. A run's text ``scenes`` says which
number is which scene. Each data set has charts of its own, so that scenes of different ones do not share a place.
"""

import re

import numpy as np
import pandas as pd
import torch
from matplotlib.colors import Normalize
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from dsr.evaluation.results import Results, Run, method_settings
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.surface import render
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import LOOKS, looks_and_depth, main_first
from dsr.pictures.canvas import colours
from dsr.pictures.depth_views import normals_seen_by, reduced
from dsr.sample import DepthSample
from dsr.utils.files import temporary_folder
from dsr.utils.runs_table import list_run

_EVENTS = "events.out.tfevents.*"
_PANEL = 320  # pixels of the longer side of a rendering in a picture


def save_dashboard(run: Run) -> None:
    """Write the TensorBoard log of a run into its directory, replacing an earlier one.

    Scalars, in the units of the paper's tables: ``score/METRIC``, the mean over the scenes; ``METRIC/SCENE``;
    ``scene/METRIC/DATASET`` over the scenes; ``light/METRIC/SCENE`` over the lights. Pictures of each scene:
    renderings of the result above those of the truth, errors, and expected errors if the method has them. A custom
    layout has a chart per metric; the table of runs (hparams) has settings and means.
    """
    folder = run.folder
    with temporary_folder(folder, "tensorboard") as temporary:
        with SummaryWriter(temporary) as writer:
            _write_scores(writer, run)
            for number, scene in enumerate(run.scenes):
                if run.has_sample(scene):
                    sample, depth = run.sample(scene), run.prediction(scene)
                    _write_pictures(writer, number, sample, depth, run.expected_errors(scene))
        for old in folder.glob(_EVENTS):
            old.unlink()
        for new in temporary.glob(_EVENTS):
            new.replace(folder / new.name)


def _write_scores(writer: SummaryWriter, run: Run) -> None:
    scored = list(run.scores["scene"].unique())
    means: dict[str, float] = {}
    more = {name: KNOWN_FORMATS[name] for name in LOOKS if (run.scores["metric"] == name).any()}
    formats = Results((run,)).formats | more
    by_light: list[str] = []
    for name, each in formats.items():
        rows = run.scores[run.scores["metric"] == name]
        if rows["variant"].isin(LIGHT_NAMES).any():
            by_light.append(name)
        headlines = {scene: each.factor * run.headlines[scene][name] for scene in scored}
        means[name] = float(pd.Series(headlines).mean())
        for number, (scene, value) in enumerate(headlines.items()):
            writer.add_scalar(f"scene/{name}/{run.dataset}", value, number)
            writer.add_scalar(f"{name}/{scene}", value, 0)
        for row in rows[rows["variant"].isin(LIGHT_NAMES)].itertuples():
            light = LIGHT_NAMES.index(row.variant) + 1
            writer.add_scalar(f"light/{name}/{row.scene}", row.value * each.factor, light)
    titles = {name: each.chart_title(by_light=name in by_light) for name, each in formats.items()}
    layout = {
        f"{title}, {run.dataset}": {
            titles[name]: ["Multiline", [f"scene/{name}/{re.escape(run.dataset)}$"]] for name in names
        }
        for title, names in looks_and_depth(formats).items()
    }
    layout[f"By light, {LIGHT_NAMES[0]} to {LIGHT_NAMES[-1]}, {run.dataset}"] = {
        formats[name].title: ["Multiline", [f"light/{name}/.*"]] for name in main_first(by_light)
    }
    writer.add_custom_scalars({title: charts for title, charts in layout.items() if charts})
    writer.add_text("scenes", "\n".join(f"{number}. {scene}" for number, scene in enumerate(scored)))
    settings = {
        **{name: method_settings(run.settings).get(name) for name in ("w", "steps")},
        **{name: getattr(run, name) for name in ("scale", "dataset", "seed")},
    }
    list_run(writer, "evaluation", {**settings, "method": run.label, "degradation": run.downsampling}, means)


def _write_pictures(
    writer: SummaryWriter, number: int, scene: DepthSample, depth: Tensor, errors: tuple[Tensor, Tensor] | None
) -> None:
    """Write a scene's renderings, result above truth, the error of the depth, and the expected one."""
    shades = [render(normals_seen_by(scene.camera, depth))[0]]
    if scene.depth is not None:
        shades.append(render(normals_seen_by(scene.camera, scene.depth))[0])
    rows = [torch.cat(list(reduced(each, _PANEL)), dim=-1) for each in shades]
    grey = colours("gray")(np.ma.masked_invalid(torch.cat(rows, dim=-2).numpy()))  # with holes in their colour
    picture = (grey[..., :3] * 255).round().astype(np.uint8)
    writer.add_image(f"renderings/{scene.scene}", picture, number, dataformats="HWC")
    reference = depth if scene.depth is None else scene.depth
    if scene.depth is not None:
        picture = _error(depth - scene.depth, reference)
        writer.add_image(f"depth_error/{scene.scene}", picture, number, dataformats="HWC")
    if errors is not None:
        picture = _error(torch.where(depth.isfinite(), errors[0], torch.nan), reference)
        writer.add_image(f"expected_error/{scene.scene}", picture, number, dataformats="HWC")


def _error(error: Tensor, reference: Tensor) -> np.ndarray:
    """Draw a signed error, blue where the result is too near, or an expected one, which is red; (H, W, 3) uint8.

    The colour limits are +-1 % of the median of the reference, the true depth if it is known: those of all methods are
    the same, so that runs can be compared.
    """
    limit = 0.01 * float(reference.nanmedian())
    scaled = Normalize(-limit, limit)(np.ma.masked_invalid(reduced(error, _PANEL)[0].numpy()))
    return (colours("RdBu_r")(scaled)[..., :3] * 255).round().astype(np.uint8)
