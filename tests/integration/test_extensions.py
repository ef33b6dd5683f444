"""Methods, data sets, networks and metrics from outside the package: the files and commands of docs/extend.md."""

import json
import os
import re
import shlex
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
PAGE = (REPOSITORY / "docs" / "extend.md").read_text()
EVAL = str(REPOSITORY / "eval.py")
MORE = {
    "more.py": '''
from dsr.metrics.catalogue import Metric, normal_mask
from dsr.metrics.formats import MetricFormat
from mine.method import Blend


def brightness(pair):
    """Return the mean brightness of the prediction under each light, (B, 4)."""
    return pair.renderings[0].double().nanmean(dim=(-2, -1))


BRIGHTNESS = Metric(
    "Brightness", brightness, normal_mask, MetricFormat("Bright", "%", 1e2, 1, higher_is_better=True), per_light=True
)


class Hinted(Blend):
    """Prints the hints on the maps."""

    def __init__(self, kernel: str | None = None, edges: str = "auto", clean: bool = False) -> None:
        super().__init__()
        print(f"hints {kernel} {edges} {clean}")
''',
    "my_conf/method/hinted.yaml": (
        "# @package _global_\nlabel: Hinted\nmethod:\n  _target_: more.Hinted\n  kernel: null\n  edges: auto\n"
    ),
}  # Beside the files of the page
QUICK = ("metrics.lpips=false", "device=cpu")
TRAINING = (
    "dataset.count=2", "dataset.size=64", "trainer=smoke", "patches.batch=1", "patches.validation_scenes=1", *QUICK,
)  # fmt: skip


def run(folder, *command):
    """Run a Python command in a folder with which modules are found."""
    environment = {**os.environ, "PYTHONPATH": f"{REPOSITORY / 'src'}{os.pathsep}.", "OMP_NUM_THREADS": "1"}
    return run_python(*command, cwd=folder, env=environment)


def output_of(folder, *command):
    """Run a command that ends well."""
    done = run(folder, *command)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def example(about):
    """Return the first Python command of the page that contains ``about``."""
    line = next(line for line in PAGE.splitlines() if line.startswith("PYTHONPATH=. python ") and about in line)
    _, _, name, *arguments = shlex.split(line)
    return str(REPOSITORY / name), *arguments


def compare(method):
    """Return the page's command with both metrics, for a method."""
    command = [word.replace("method=blend", f"method={method}") for word in example("metrics=mine")]
    metrics = "metrics.extra=[mine.metric.PSNR,more.BRIGHTNESS]"
    return *command, metrics, "dataset.size=32", *QUICK, f"output_dir=runs/{method}"


def upsample(folder, *arguments):
    """Run ``dsr upsample`` on a small picture."""
    files = ("--rgb", "photo.png", "--depth", "depth.png", "--fov", "60", "--only", "depth")
    return run(folder, "-m", "dsr", "upsample", *files, "--config-dir", "my_conf", *arguments)


@pytest.fixture(scope="module")
def home(tmp_path_factory, dsr_cache):
    """A folder with the files of the page, a picture, and runs of its method on its data set with its metric."""
    folder = tmp_path_factory.mktemp("outside")
    files = dict(re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```', PAGE, re.MULTILINE | re.DOTALL))
    for name, text in (files | MORE).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    cv2.imwrite(str(folder / "photo.png"), np.random.default_rng(0).integers(0, 255, (32, 48, 3), dtype=np.uint8))
    cv2.imwrite(str(folder / "depth.png"), np.full((8, 12), 1500, np.uint16))
    for method in ("blend", "bicubic"):
        (folder / f"{method}.txt").write_text(output_of(folder, *compare(method)))
    return folder


def test_eval_shows_a_metric_from_outside_with_its_unit_and_direction(home):
    assert "lower is better, of PSNR, Bright higher" in (home / "blend.txt").read_text()
    scores = pd.read_csv(home / "runs" / "blend" / "scores.csv", keep_default_na=False)
    assert (set(scores["method"]), set(scores["scene"])) == ({"blend"}, {"long", "short"})
    worst = scores[scores["metric"] == "Brightness"].pivot(index="scene", columns="variant", values="value")
    assert set(worst) == {"e1", "e2", "e3", "e4", "min", "avg"}
    assert (worst["min"] == worst[["e1", "e2", "e3", "e4"]].min(axis=1)).all()
    mean = json.loads((home / "runs" / "blend" / "summary.json").read_text())["mean"]
    assert mean["Brightness"] == pytest.approx(worst["min"].mean(), rel=1e-12)
    error = scores[scores["metric"] == "RMSE_d"].set_index("scene")["value"]
    psnr = scores[scores["metric"] == "PSNR_d"].set_index("scene")["value"]
    assert (10 ** (-psnr / 20) * 10).to_dict() == pytest.approx(error.to_dict(), rel=1e-9)


def test_report_elsewhere_shows_it_after_the_papers_and_ranks_by_its_direction(home, tmp_path):
    runs = str(home / "runs")
    output_of(tmp_path, "-m", "dsr", "report", runs, "-o", "report", "--only", "tables,metrics,page")
    report = tmp_path / "report"
    table = pd.read_csv(report / "tables" / "waves_x4_box.csv")
    of_long = table[table["scene"] == "long"].set_index("method")["PSNR_d [dB]"]
    assert f"**{of_long.max():.1f}**" in (report / "tables" / "waves_x4_box.md").read_text()
    assert '{"id":"PSNR_d","name":"PSNR","unit":"dB","digits":1,"higher":true,' in (report / "index.html").read_text()
    assert "PSNR_d" in (report / "metrics" / "spearman.csv").read_text()


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ("more.brightness", "expected a dsr.metrics.catalogue.Metric"),
        ("more.NONE", "cannot import 'more.NONE'"),
        ("psnr", "expected module.name of a "),
        ("more.BRIGHTNESS,more.BRIGHTNESS", "Brightness: expected metrics of different names"),
    ],
)
def test_extra_metrics_refuse_what_is_no_metric_in_one_line(home, monkeypatch, extra, message):
    monkeypatch.syspath_prepend(str(home))
    with pytest.raises(ConfigError, match=f"^metrics.extra: {message}"):
        extra_metrics(MetricsConfig(extra=extra.split(",")))


def test_changed_code_of_a_method_from_outside_makes_another_run(home):
    output_of(home, *compare("blend"))
    module = home / "mine" / "method.py"
    before = module.read_text()
    try:
        module.write_text(before + "\n# changed\n")
        done = run(home, *compare("blend"))
    finally:
        module.write_text(before)
    assert done.returncode == 2
    assert "holds a run with another outside_code" in done.stderr
    identity = json.loads((home / "runs" / "blend" / "versions.json").read_text())["identity"]
    assert len(identity["outside_code"]) == 16


def test_methods_get_what_is_known_of_the_maps(home):
    hinted = (EVAL, "--config-dir", "my_conf", "method=hinted", "dataset=waves", "dataset.size=32", *QUICK)
    given = ("method.edges=soft", "method.kernel=nearest")
    for more, hints in ((("noise=gaussian_multiplicative",), "box sharp False"), (given, "nearest soft True")):
        assert f"hints {hints}" in output_of(home, *hinted, *more, f"output_dir='hints/{hints}'").splitlines()


def test_upsample_runs_a_method_from_outside_with_settings(home):
    done = upsample(home, "--method", "blend", "--set", "fraction=0.3", "-o", "picture")
    assert (done.returncode, done.stderr) == (0, "")
    np.testing.assert_allclose(read_depth_file(home / "picture" / "depth_metres.tiff"), 1.5, rtol=2e-3)
    for setting, message in (
        ("fractoin=0.3", "--set fractoin: unknown key; method=blend takes fraction"),
        ("fraction=2", "--set fraction: expected 0 to 1, got 2"),
    ):
        done = upsample(home, "--method", "blend", "--set", setting, "-o", "other")
        assert done.returncode == 2
        assert done.stderr.startswith(f"error: {message}")
        assert not (home / "other").exists()


def test_network_from_outside_is_trained_evaluated_and_used(home):
    output_of(home, *example("train.py"), *TRAINING)
    output_of(home, *example("run=outputs"), *QUICK, "output_dir=net/run")
    without = (EVAL, "run=outputs/train/tiny", *QUICK)
    output_of(home, *without, "trust=mine.network.Tiny", "output_dir=net/trusted")
    done = run(home, *without, "output_dir=net/refused")
    assert done.returncode == 2
    assert "outputs/train/tiny/config.yaml: model.net._target_: expected a target of dsr's own" in done.stderr
    assert "if you trust it, trust=mine.network.Tiny allows it" in done.stderr
    done = upsample(home, "--method", "tiny", "-o", "by_network")
    assert done.returncode == 0, done.stderr
    assert read_depth_file(home / "by_network" / "depth_metres.tiff").shape == (32, 48)
    weights = "weights=outputs/train/tiny/weights.safetensors"
    done = run(home, EVAL, "method=facets", weights, "dataset.size=32", *QUICK, "output_dir=net/wrong")
    assert done.returncode == 2
    assert "expected weights of model facets, got those of tiny" in done.stderr


@pytest.mark.nightly
def test_examples_of_an_optimiser_and_a_callback_train(home):
    output_of(home, *example("optimizer=sgd"), *TRAINING, "output_dir=more")
    assert "torch.optim.SGD" in (home / "more" / "config.yaml").read_text()
