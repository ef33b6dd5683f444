"""A method, a network and metrics from outside the package: one module, and a YAML file of each."""

import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from commands import run_python

from dsr.app.metrics import extra_metrics
from dsr.app.schema import MetricsConfig
from dsr.io.depth_files import read_depth_file
from dsr.utils.configuration import ConfigError

REPOSITORY = Path(__file__).resolve().parents[2]
MODULE = '''
import torch
from torch import nn

from dsr.methods.base import Method
from dsr.methods.networks.network import DisparityNetwork
from dsr.metrics.catalogue import Metric, depth_mask, normal_mask
from dsr.metrics.formats import MetricFormat
from dsr.metrics.functional import rmse_d


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


class Constant(Method):
    """Fills the map with its mean, plus an offset in metres."""

    range_type = "orthogonal"

    def __init__(self, offset: float = 0.0) -> None:
        self.offset = offset

    def __call__(self, sample, progress=None):
        if progress is not None:
            progress(1, 1)
        size = (1, sample.camera.height, sample.camera.width)
        return torch.full(size, float(sample.depth_lr.nanmean()) + self.offset, dtype=sample.depth_lr.dtype)


class Hinted(Constant):
    """Prints the hints on the maps."""

    def __init__(self, kernel: str | None = None, edges: str = "auto", clean: bool = False) -> None:
        super().__init__()
        print(f"hints {kernel} {edges} {clean}")


class Shifted(DisparityNetwork):
    """Repeats the low-resolution disparity and adds a learned number."""

    def __init__(self, scale: int) -> None:
        super().__init__()
        self.scale = scale
        self.shift = nn.Parameter(torch.zeros(()))

    def arguments(self):
        return {"scale": self.scale}

    def upsample(self, rgb, disparity, min_max=None):
        known = torch.where(disparity.isfinite(), disparity, disparity.nanmean())
        return nn.functional.interpolate(known, scale_factor=self.scale) + self.shift
'''
FILES = {
    "modules/outside.py": MODULE,
    "conf/metrics/mine.yaml": "defaults: [paper]\nextra: [outside.PSNR, outside.BRIGHTNESS]\nlpips: false\n",
    "conf/method/constant.yaml": "_target_: outside.Constant\noffset: 0.0\n",
    "conf/method/hinted.yaml": "_target_: outside.Hinted\nkernel: null\nedges: auto\n",
    "conf/model/shifted.yaml": (
        "net:\n  _target_: outside.Shifted\n  scale: ${scale}\n"
        "objective:\n  _target_: dsr.training.objective.DepthObjective\n"
    ),
    "conf/method/shifted.yaml": (
        "_target_: dsr.methods.networks.trained.TrainedNetwork\nmodel: shifted\nensemble: 1\n"
        "weights: training/weights.safetensors\n"
    ),
}
TRAINING = (
    "dataset.count=2", "dataset.size=64", "trainer=smoke", "trainer.max_steps=2", "patches.batch=1", "patches.patch=32",
    "trainer.val_check_interval=2", "patches.validation_scenes=1", "precision=float32", "metrics.lpips=false",
    "device=cpu", "model=shifted", "output_dir=training",
)  # fmt: skip


def run(folder, *command, outside=True):
    """Run a Python command in a folder, with or without the module outside of the package on the path."""
    paths = [str(REPOSITORY / "src"), *([str(folder / "modules")] if outside else [])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    return run_python(*command, cwd=folder, env=environment)


def evaluate(folder, *arguments):
    """Run ``eval.py`` on a small scene."""
    small = ("dataset.size=32", "dataset.scenes=[statue]", "metrics.lpips=false", "device=cpu")
    several = ["-m"] if "-m" in arguments else []
    keys = [each for each in arguments if each != "-m"]
    return run(folder, str(REPOSITORY / "eval.py"), *several, "--config-dir", "conf", *small, *keys)


def upsample(folder, *arguments):
    """Run ``dsr upsample`` on a small picture."""
    files = ("--rgb", "photo.png", "--depth", "depth.png", "--fov", "60", "--only", "depth")
    return run(folder, "-m", "dsr", "upsample", *files, "--config-dir", "conf", *arguments)


@pytest.fixture(scope="module")
def home(tmp_path_factory, dsr_cache):
    """A folder with the module, its configuration, a picture, and runs of the method and the metrics."""
    folder = tmp_path_factory.mktemp("outside")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    cv2.imwrite(str(folder / "photo.png"), np.random.default_rng(0).integers(0, 255, (32, 48, 3), dtype=np.uint8))
    cv2.imwrite(str(folder / "depth.png"), np.full((8, 12), 1500, np.uint16))
    for method in ("constant", "bicubic"):
        given = ("metrics=mine", "dataset.scenes=[statue,cube_no_texture]", f"output_dir=runs/{method}")
        done = evaluate(folder, f"method={method}", *given)
        assert (done.returncode, done.stderr) == (0, "")
        (folder / f"{method}.txt").write_text(done.stdout)
    return folder


def test_eval_shows_a_metric_from_outside_with_its_unit_and_direction(home):
    text = (home / "bicubic.txt").read_text()
    assert "lower is better, of PSNR, Bright higher" in text
    assert re.search(r"PSNR\s+Bright", text)
    scores = pd.read_csv(home / "runs" / "bicubic" / "scores.csv", keep_default_na=False)
    worst = scores[scores["metric"] == "Brightness"].pivot(index="scene", columns="variant", values="value")
    assert set(worst) == {"e1", "e2", "e3", "e4", "min", "avg"}
    assert (worst["min"] == worst[["e1", "e2", "e3", "e4"]].min(axis=1)).all()
    mean = json.loads((home / "runs" / "bicubic" / "summary.json").read_text())["mean"]
    assert mean["Brightness"] == pytest.approx(worst["min"].mean(), rel=1e-12)
    error = scores[scores["metric"] == "RMSE_d"].set_index("scene")["value"]
    psnr = scores[scores["metric"] == "PSNR_d"].set_index("scene")["value"]
    assert (10 ** (-psnr / 20) * 10).to_dict() == pytest.approx(error.to_dict(), rel=1e-9)


def test_report_elsewhere_shows_it_after_the_papers_and_ranks_by_its_direction(home):
    done = run(home, "-m", "dsr", "report", "runs", "-o", "report", "--only", "tables,metrics,page", outside=False)
    assert (done.returncode, done.stderr) == (0, "")
    table = pd.read_csv(home / "report" / "tables" / "simgeo_x4_box.csv")
    of_statue = table[table["scene"] == "statue"].set_index("method")["PSNR_d [dB]"]
    text = (home / "report" / "tables" / "simgeo_x4_box.md").read_text()
    heading = text.splitlines()[2]
    assert heading.index("RMSE_v (1/1000)") < heading.index("PSNR (dB)") < heading.index("Bright (%)")
    assert f"**{of_statue.max():.1f}**" in text
    assert "Lower is better, of PSNR, Bright higher." in text
    page = (home / "report" / "index.html").read_text()
    assert '{"id":"PSNR_d","name":"PSNR","unit":"dB","digits":1,"higher":true,' in page
    assert "PSNR_d" in (home / "report" / "metrics" / "spearman.csv").read_text()


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


def test_changed_code_of_a_method_from_outside_makes_another_run(home):
    given = ("method=constant", "metrics=mine", "dataset.scenes=[statue,cube_no_texture]", "output_dir=runs/constant")
    assert evaluate(home, *given).returncode == 0
    module = home / "modules" / "outside.py"
    try:
        module.write_text(MODULE + "\n# changed\n")
        done = evaluate(home, *given)
    finally:
        module.write_text(MODULE)
    assert done.returncode == 2
    assert "holds a run with another outside_code" in done.stderr
    identity = json.loads((home / "runs" / "constant" / "versions.json").read_text())["identity"]
    assert len(identity["outside_code"]) == 16


def test_methods_get_what_is_known_of_the_maps(home):
    choices = "${hydra:runtime.choices.downsampling}_${hydra:runtime.choices.noise}"
    several = ("-m", "downsampling=box,bicubic", "noise=none,gaussian_multiplicative", f"output_dir=hinted/{choices}")
    done = evaluate(home, "method=hinted", *several)
    assert (done.returncode, done.stderr) == (0, "")
    lines = [line.removeprefix("hints ") for line in done.stdout.splitlines() if line.startswith("hints ")]
    expected = ["box sharp True", "box sharp False", "bicubic sharp True", "bicubic sharp False"]
    assert lines == 2 * expected  # a multirun checks its jobs first
    done = evaluate(home, "method=hinted", "method.edges=soft", "method.kernel=nearest", "output_dir=hinted/given")
    assert "hints nearest soft True" in done.stdout.splitlines()


def test_upsample_runs_a_method_from_outside_with_settings(home):
    done = upsample(home, "--method", "constant", "--set", "offset=0.001", "-o", "picture")
    assert (done.returncode, done.stderr) == (0, "")
    np.testing.assert_allclose(read_depth_file(home / "picture" / "depth_metres.tiff"), 1.501, rtol=1e-6)
    done = upsample(home, "--method", "constant", "--set", "ofset=0.001", "-o", "other")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --set ofset: unknown key; method=constant takes offset")
    assert not (home / "other").exists()


def test_network_from_outside_is_trained_evaluated_and_used(home):
    program = str(REPOSITORY / "eval.py")
    small = ("dataset.size=32", "dataset.scenes=[statue]", "metrics.lpips=false", "device=cpu")
    for command in (
        (str(REPOSITORY / "train.py"), "--config-dir", "conf", *TRAINING),
        (program, "run=training", *small[2:], "output_dir=net/run", "trust=outside.Shifted"),
        (program, "--config-dir", "conf", "method=shifted", *small, "output_dir=net/shifted"),
    ):
        done = run(home, *command)
        assert done.returncode == 0, done.stderr
    done = run(home, program, "run=training", "output_dir=net/refused")
    assert done.returncode == 2
    assert "training/config.yaml: model.net._target_: expected a target of dsr's own" in done.stderr
    assert "if you trust it, trust=outside.Shifted allows it" in done.stderr
    done = upsample(home, "--method", "shifted", "-o", "by_network")
    assert done.returncode == 0, done.stderr
    assert read_depth_file(home / "by_network" / "depth_metres.tiff").shape == (32, 48)
    done = run(home, program, "method=facets", "weights=training/weights.safetensors", *small, "output_dir=net/wrong")
    assert done.returncode == 2
    assert "expected weights of model facets, got those of shifted" in done.stderr
