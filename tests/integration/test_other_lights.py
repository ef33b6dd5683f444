"""Other lights are one change in one place: metrics, files, pictures, pages and choices follow."""

import base64
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dsr.evaluation.run_files import load_results
from dsr.geometry import lights
from dsr.geometry.shading import shade
from dsr.pictures.depth_views import normals_seen_by

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


def brightness(folder, light):
    """Return the truth of the scene under one of the lights, (H, W) in [0, 1]."""
    sample = load_results([folder / "runs"]).runs[0].sample("statue")
    direction = torch.tensor([OTHER[light]], dtype=torch.float64)
    return shade(normals_seen_by(sample.camera, sample.depth), direction)[0, 0].clamp(0, 1).numpy()


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


def test_command_line_takes_the_other_lights_alone(made, found):
    assert {name: found[name] for name in ("report below", "report e1", "study below", "study e1")} == {
        "report below": 0, "report e1": 2, "study below": 0, "study e1": 2,
    }  # fmt: skip
    assert json.loads((made / "study" / "below" / "key.json").read_text())["light"] == "below"
    text = (made / "study" / "below" / "index.html").read_text(encoding="utf-8")
    picture = base64.b64decode(re.search(r'"truth":"([^"]+)"', text).group(1))
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_UNCHANGED)
    grey, shown = (image if image.ndim == 2 else image[..., 0]), brightness(made, "below")
    known = np.isfinite(shown)
    assert np.abs(grey[known].astype(float) - 1 - 254 * shown[known]).max() <= 0.51


def test_page_of_a_report_offers_and_shows_the_other_lights(made, browser):
    page = browser.new_page()
    wrong = []
    page.on("console", lambda message: wrong.append(message.text))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto((made / "report" / "below" / "index.html").as_uri())
    page.wait_for_selector(".stage[data-shown]")
    assert page.locator("[data-light]").all_inner_texts() == [*OTHER, "free"]
    page.locator("#scenes select.right").select_option(label="truth")
    for number, name in enumerate(OTHER, start=1):
        page.keyboard.press(str(number))
        page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        url = page.evaluate("document.querySelector('.pane-right canvas').toDataURL()")
        drawn = cv2.imdecode(np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)[..., 0]
        assert np.abs(drawn - 255 * brightness(made, name)).max() <= 2.3
    assert wrong == []
    page.close()
