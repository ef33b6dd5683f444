"""The weights that come with dsr, on scenes that they were neither trained on nor chosen with."""

import json
import re
from pathlib import Path

import pandas as pd
import pytest
import torch
from commands import run_python

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.recipe import read_recipe
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.formats import WORST

REPOSITORY = Path(__file__).resolve().parents[2]
VISUAL = ("RMSE_v", "DSSIM_v", "BadPix_v_5", "Bumpiness_d", "LPIPS_v")


@pytest.fixture(scope="module")
def ratios(shared, tmp_path_factory):
    """Ours / published MSG-V on Lucy and Plant at x4, one pass each, as the benchmark prints them."""
    file = tmp_path_factory.mktemp("ratios") / "ratios.json"
    script = str(REPOSITORY / "benchmarks" / "run.py")
    options = ("published", "--shared", str(shared), "--json", str(file), "--set", "scales=4", "ensemble=1")
    done = run_python(script, *options, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    found = json.loads(file.read_text())["results"]["published"]
    rows = [(*key.split(), value) for key, value in found.items()]
    table = pd.DataFrame(rows, columns=["method", "scale", "scene", "metric", "ratio"])
    return table.pivot_table("ratio", ["method", "scale", "scene"], "metric").reset_index()


@pytest.mark.parametrize(("method", "rmse_v", "all_metrics"), [("msg_v", 0.85, 0.93), ("facets", 0.75, 0.80)])
def test_our_networks_beat_the_published_one_in_every_visual_metric_of_every_case(ratios, method, rmse_v, all_metrics):
    ours = ratios[ratios["method"] == method]
    assert len(ours) == 2
    assert float(ours[[*VISUAL]].max().max()) < 1.0
    assert float(ours["RMSE_v"].mean()) < rmse_v
    assert float(ours[[*VISUAL]].mean().mean()) < all_metrics


def test_visual_loss_shows_on_lucy_and_plant(ratios):
    cases = ratios.set_index(["scale", "scene"])
    gain = cases[cases["method"] == "msg_v"][[*VISUAL]] / cases[cases["method"] == "msg"][[*VISUAL]]
    assert gain.shape == (2, len(VISUAL))
    assert float(gain.max().max()) < 1.0
    assert float(gain["RMSE_v"].max()) < 0.9


@pytest.mark.parametrize(
    "name",
    ["sparse_to_dense_x4", "sparse_to_dense_x8", "ddrnet_x4", pytest.param("ddrnet_x8", marks=pytest.mark.nightly)],
)
def test_scores_on_lucy_are_those_that_the_recipe_expects(load_scene, name):
    header = (REPOSITORY / "conf" / "experiment" / f"{name}.yaml").read_text(encoding="utf-8")
    found = re.search(r"Expected: .*Lucy (\d+) / (\d+) / (\d+),", header)
    model, _, scale = name.rpartition("_x")
    method = read_recipe(model).build(int(scale))
    sample = make_sample(load_scene("lucy"), int(scale), Downsampling("box"), method.range_type)
    with torch.inference_mode():
        rows = score_image(method(sample), sample.depth, sample.camera.rays(), catalogue())
    scores = {row.metric: row.value for row in rows if row.variant in ("", WORST)}
    measured = [1000 * scores["RMSE_v"], 1000 * scores["DSSIM_v"], 1000 * scores["RMSE_d"]]
    assert measured == pytest.approx([float(each) for each in found.groups()], abs=0.6)
