"""Other lights are one change in one place: metrics, files, pictures, pages and choices follow."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from dsr.geometry import lights

OTHER = {
    "left": (-0.8, 0.0, -0.6),
    "below": (0.0, 0.6, -0.8),
    "right": (0.6, 0.48, -0.64),
    "upper": (0.0, -0.96, -0.28),
}
"""Neither orthonormal nor frontal, by other names."""
PROGRAM = """
import importlib.util, json, sys
from pathlib import Path

spec = importlib.util.spec_from_file_location("dsr.geometry.lights", sys.argv[1])
sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)

import torch
import dsr.pictures.panels as panels
from dsr.cli import main
from dsr.evaluation.run_files import load_results
from dsr.geometry.camera import Camera
from dsr.io.exports import write_renderings
from dsr.metrics.catalogue import catalogue
from dsr.metrics.functional import SurfacePair

folder, found = Path(sys.argv[2]), {}
for command in (["report", "--only", "figures,page"], ["study", "build"]):
    for light in ("below", "e1"):
        out = folder / command[0] / light
        found[f"{command[0]} {light}"] = main([*command, str(folder / "runs"), "-o", str(out), "--light", light])
camera = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
rays = camera.rays()[None]
wall, slope = torch.full((1, 1, 6, 8), 2.0).double(), 2 / (1 + 0.3 * rays[:, :1])  # z = 2 and z + 0.3 x = 2
found["files"] = sorted(path.name for path in write_renderings(folder / "files", wall[0], camera))
pair = SurfacePair(slope, wall, rays)
[metric] = [each for each in catalogue() if each.name == "RMSE_v1"]
found["scores"] = {name: float(value) for name, value in metric.variants(pair).items()}
run = load_results([folder / "runs"]).runs[0]
panels.write_figure = lambda _, figure, __: found.update(panels=[text.get_text() for text in figure.texts])
panels.save_picture(folder / "x.png", run.sample("statue"), run.prediction("statue"), {}, "ours", {})
(folder / "found.json").write_text(json.dumps(found))
"""


@pytest.fixture(scope="module")
def made(make_run, tmp_path_factory):
    """The folder of what a program of its own has made under the other lights."""
    folder = tmp_path_factory.mktemp("lights")
    for label in ("Bicubic", "MSG-V"):
        make_run(folder / "runs" / label, method=label.lower(), label=label, scenes=("statue",), size=48)
    source = Path(lights.__file__).read_text(encoding="utf-8")
    others = {name: f'Light({direction}, "{name}")' for name, direction in OTHER.items()}
    entries = ", ".join(f'"{name}": {light}' for name, light in others.items())
    changed, count = re.subn(r"^LIGHTS = \{.*?^\}", f"LIGHTS = {{{entries}}}", source, flags=re.DOTALL | re.MULTILINE)
    assert count == 1
    (folder / "lights.py").write_text(changed, encoding="utf-8")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder / "lights.py"), str(folder)],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def found(made):
    return json.loads((made / "found.json").read_text())


def test_metrics_have_a_value_for_each_of_the_other_lights(found):
    n = -np.array([[0.3, 0, 1] / np.hypot(0.3, 1), [0, 0, 1]])  # of the slope and the wall
    expected = {name: abs((n[0] - n[1]) @ direction) for name, direction in OTHER.items()}
    scores = {name: found["scores"][name] for name in OTHER}
    assert scores == pytest.approx(expected, abs=1e-9)
    assert found["scores"].keys() == {*OTHER, "max", "avg"}


def test_files_and_panels_are_named_and_lit_by_the_other_lights(made, found):
    assert found["files"] == sorted(f"{name}.png" for name in OTHER)
    for name, direction in OTHER.items():
        grey = cv2.imread(str(made / "files" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert abs(int(grey[3, 4].ravel()[0]) + 255 * direction[2]) <= 0.51
        assert {f"ours under {name}", f"truth under {name}"} <= set(found["panels"])
