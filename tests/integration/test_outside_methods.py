"""A method and a network from outside the package: one module, and a YAML file of each."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import run_python

from dsr.io.depth_files import read_depth_file

REPOSITORY = Path(__file__).resolve().parents[2]
MODULE = '''
import torch
from torch import nn

from dsr.methods.base import Method
from dsr.methods.networks.network import DisparityNetwork


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
    "conf/method/constant.yaml": (
        "# @package _global_\nlabel: Constant\nmethod:\n  _target_: outside.Constant\n  offset: 0.0\n"
    ),
    "conf/method/hinted.yaml": (
        "# @package _global_\nlabel: Hinted\nmethod:\n  _target_: outside.Hinted\n  kernel: null\n  edges: auto\n"
    ),
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


def run(folder, *command):
    """Run a Python command in a folder, with the module outside of the package on the path."""
    paths = os.pathsep.join([str(REPOSITORY / "src"), str(folder / "modules")])
    return run_python(*command, cwd=folder, env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"})


def evaluate(folder, *arguments):
    """Run ``eval.py`` on a small scene."""
    small = ("dataset.size=32", "dataset.scenes=[statue]", "metrics.lpips=false", "device=cpu")
    flags = [each for each in arguments if each.startswith("-")]
    keys = [each for each in arguments if not each.startswith("-")]
    return run(folder, str(REPOSITORY / "eval.py"), *flags, "--config-dir", "conf", *small, *keys)


def upsample(folder, *arguments):
    """Run ``dsr upsample`` on a small picture."""
    files = ("--rgb", "photo.png", "--depth", "depth.png", "--fov", "60", "--only", "depth")
    return run(folder, "-m", "dsr", "upsample", *files, "--config-dir", "conf", *arguments)


@pytest.fixture(scope="module")
def home(tmp_path_factory, dsr_cache):
    """A folder with the module, its configuration, a picture, and a run of the method."""
    folder = tmp_path_factory.mktemp("outside")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    cv2.imwrite(str(folder / "photo.png"), np.random.default_rng(0).integers(0, 255, (32, 48, 3), dtype=np.uint8))
    cv2.imwrite(str(folder / "depth.png"), np.full((8, 12), 1500, np.uint16))
    done = evaluate(folder, "method=constant", "output_dir=runs/constant")
    assert (done.returncode, done.stderr) == (0, "")
    return folder


def test_changed_code_of_a_method_from_outside_makes_another_run(home):
    assert evaluate(home, "method=constant", "output_dir=runs/constant").returncode == 0
    module = home / "modules" / "outside.py"
    try:
        module.write_text(MODULE + "\n# changed\n")
        done = evaluate(home, "method=constant", "output_dir=runs/constant")
    finally:
        module.write_text(MODULE)
    assert done.returncode == 2
    assert "holds a run with another outside_code" in done.stderr
    identity = json.loads((home / "runs" / "constant" / "versions.json").read_text())["identity"]
    assert len(identity["outside_code"]) == 16


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (
            ("-m", "downsampling=box,bicubic", "noise=none,gaussian_multiplicative",
             "output_dir=runs/${hydra:runtime.choices.downsampling}_${hydra:runtime.choices.noise}"),
            ["box sharp True", "box sharp False", "bicubic sharp True", "bicubic sharp False"],
        ),
        (("method.edges=soft", "method.kernel=nearest", "output_dir=runs/said"), ["nearest soft True"]),
    ],
)  # fmt: skip
def test_methods_get_what_is_known_of_the_maps(home, arguments, reported):
    done = evaluate(home, "method=hinted", *arguments)
    assert (done.returncode, done.stderr) == (0, "")
    lines = [line.removeprefix("hints ") for line in done.stdout.splitlines() if line.startswith("hints ")]
    assert lines == (2 * reported if "-m" in arguments else reported)  # a multirun checks its jobs first


def test_upsample_runs_a_method_from_outside_with_settings(home):
    done = upsample(home, "--method", "constant", "--set", "offset=0.001", "-o", "picture")
    assert (done.returncode, done.stderr) == (0, "")
    np.testing.assert_allclose(read_depth_file(home / "picture" / "depth_metres.tiff"), 1.501, rtol=1e-6)
    done = upsample(home, "--method", "constant", "--set", "ofset=0.001", "-o", "other")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --set ofset: unknown key; method=constant takes offset")
    assert not (home / "other").exists()


@pytest.mark.slow
def test_network_from_outside_is_trained_evaluated_and_used(home):
    program = str(REPOSITORY / "eval.py")
    small = ("dataset.size=32", "metrics.lpips=false", "device=cpu")
    for command in (
        (str(REPOSITORY / "train.py"), "--config-dir", "conf", *TRAINING),
        (program, "run=training", "metrics.lpips=false", "device=cpu", "output_dir=runs/run", "trust=outside.Shifted"),
        (program, "--config-dir", "conf", "method=shifted", *small, "output_dir=runs/shifted"),
    ):
        done = run(home, *command)
        assert done.returncode == 0, done.stderr
    done = run(home, program, "run=training", "output_dir=runs/refused")
    assert done.returncode == 2
    assert "training/config.yaml: model.net._target_: expected a target of dsr's own" in done.stderr
    assert "if you trust it, trust=outside.Shifted allows it" in done.stderr
    done = upsample(home, "--method", "shifted", "-o", "by_network")
    assert done.returncode == 0, done.stderr
    assert read_depth_file(home / "by_network" / "depth_metres.tiff").shape == (32, 48)
    done = run(home, program, "method=facets", "weights=training/weights.safetensors", *small, "output_dir=runs/wrong")
    assert done.returncode == 2
    assert "expected weights of model facets, got those of shifted" in done.stderr
