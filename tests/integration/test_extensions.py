"""A metric and a data set from outside the package: one module, and a YAML file of each."""

import json
import os
import re
from pathlib import Path

import pandas as pd
import pytest
from commands import run_python

from dsr.app.metrics import extra_metrics
from dsr.app.schema import MetricsConfig
from dsr.utils.configuration import ConfigError

REPOSITORY = Path(__file__).resolve().parents[2]
MODULE = '''
import torch

from dsr.geometry.camera import Camera
from dsr.metrics.catalogue import Metric, depth_mask, normal_mask
from dsr.metrics.formats import MetricFormat
from dsr.metrics.functional import rmse_d
from dsr.sample import Scene


def psnr(pair):
    """Return the peak signal-to-noise ratio of depth for a peak of 10 m, (B,) in dB."""
    return 20 * torch.log10(10 / rmse_d(pair))


def brightness(pair):
    """Return the mean brightness of the prediction under each light, (B, 4)."""
    return pair.renderings[0].double().nanmean(dim=(-2, -1))


PSNR = Metric("PSNR_d", psnr, depth_mask, MetricFormat("PSNR", "dB", digits=1, higher_is_better=True), min_size=1)
BRIGHTNESS = Metric(
    "Brightness", brightness, normal_mask, MetricFormat("Bright", "%", 1e2, 1, higher_is_better=True), per_light=True
)


class Waves:
    """Scenes of a wavy surface."""

    name, evaluation = "waves", True

    def __init__(self, size: int = 32) -> None:
        self.size = size

    def scenes(self):
        return ["long", "short"]

    def load(self, scene):
        across = torch.arange(self.size, dtype=torch.float64) / self.size
        depth = 2 + 0.1 * torch.sin((8 if scene == "long" else 20) * (across[None, :, None] + across[None, None, :]))
        camera = Camera(self.size, self.size, 40.0, 40.0, (self.size - 1) / 2, (self.size - 1) / 2)
        return Scene(self.name, scene, torch.full((3, self.size, self.size), 0.5), camera, depth)

    def fingerprint(self, scene):
        return f"{scene} {self.size}"
'''
METRICS = "defaults: [paper]\nextra: [outside.PSNR, outside.BRIGHTNESS]\nlpips: false\n"
DATASET = "_target_: outside.Waves\nsize: 32\n"


def run(folder, *command, outside):
    """Run a Python command in a folder, with or without the module outside of the package."""
    paths = [str(REPOSITORY / "src"), *([str(folder / "modules")] if outside else [])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    return run_python(*command, cwd=folder, env=environment)


@pytest.fixture(scope="module")
def home(tmp_path_factory, dsr_cache):
    """A folder with the module, its configuration, two runs that use them and their report."""
    folder = tmp_path_factory.mktemp("extension")
    for name, text in {
        "modules/outside.py": MODULE,
        "conf/metrics/mine.yaml": METRICS,
        "conf/dataset/waves.yaml": DATASET,
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for method in ("nearest", "bicubic"):
        done = run(
            folder, str(REPOSITORY / "eval.py"), "--config-dir", "conf", "dataset=waves", "metrics=mine",
            f"method={method}", "device=cpu", f"output_dir=runs/{method}", outside=True,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        (folder / f"{method}.txt").write_text(done.stdout)
    done = run(folder, "-m", "dsr", "report", "runs", "-o", "report", outside=False)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


def test_eval_shows_a_metric_from_outside_with_its_unit_and_direction(home):
    text = (home / "nearest.txt").read_text()
    assert "lower is better, of PSNR, Bright higher" in text
    assert re.search(r"PSNR\s+Bright", text)
    scores = pd.read_csv(home / "runs" / "nearest" / "scores.csv", keep_default_na=False)
    worst = scores[scores["metric"] == "Brightness"].pivot(index="scene", columns="variant", values="value")
    assert set(worst) == {"e1", "e2", "e3", "e4", "min", "avg"}
    assert (worst["min"] == worst[["e1", "e2", "e3", "e4"]].min(axis=1)).all()
    mean = json.loads((home / "runs" / "nearest" / "summary.json").read_text())["mean"]
    assert mean["Brightness"] == pytest.approx(worst["min"].mean(), rel=1e-12)
    error = scores[scores["metric"] == "RMSE_d"].set_index("scene")["value"]
    psnr = scores[scores["metric"] == "PSNR_d"].set_index("scene")["value"]
    assert (10 ** (-psnr / 20) * 10).to_dict() == pytest.approx(error.to_dict(), rel=1e-9)


def test_report_elsewhere_shows_it_after_the_papers_and_ranks_by_its_direction(home):
    table = pd.read_csv(home / "report" / "tables" / "waves_x4_box.csv")
    of_long = table[table["scene"] == "long"].set_index("method")["PSNR_d [dB]"]
    best = of_long.idxmax()
    text = (home / "report" / "tables" / "waves_x4_box.md").read_text()
    heading = text.splitlines()[2]
    assert heading.index("RMSE_v (1/1000)") < heading.index("PSNR (dB)") < heading.index("Bright (%)")
    assert f"**{of_long[best]:.1f}**" in text
    assert "Lower is better, of PSNR, Bright higher." in text
    assert "paper" not in text.casefold()
    page = (home / "report" / "index.html").read_text()
    assert '{"id":"PSNR_d","name":"PSNR","unit":"dB","digits":1,"higher":true,' in page
    assert "PSNR_d" in (home / "report" / "metrics" / "spearman.csv").read_text()
    assert (home / "report" / "figures" / "depth_waves_x4_box_1.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ("outside.psnr", "expected a dsr.metrics.catalogue.Metric"),
        ("outside.NONE", "cannot import 'outside.NONE'"),
        ("psnr", "expected module.name of a "),
        ("outside.PSNR,outside.PSNR", "PSNR_d: expected metrics of different names"),
    ],
)
def test_extra_metrics_refuse_what_is_no_metric_in_one_line(home, monkeypatch, extra, message):
    monkeypatch.syspath_prepend(str(home / "modules"))
    with pytest.raises(ConfigError, match=f"^metrics.extra: {message}"):
        extra_metrics(MetricsConfig(extra=extra.split(",")))
