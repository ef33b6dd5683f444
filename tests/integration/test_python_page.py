"""The lines of docs/python.md, run from top to bottom as those of a notebook."""

import json
import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from PIL import Image
from small_frames import room, walk

import dsr
from dsr.app.upsample.parts import METRES

PAGE = Path(__file__).resolve().parents[2] / "docs" / "python.md"
ELSEWHERE = ("onnxruntime", "import lightning", "from hydra", "from dsr.metrics.classes import DSSIMv")
"""What is in blocks that other tests run: of the examples, and of trainings and metrics in a notebook."""


def blocks():
    found = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    return [block for block in found if not any(each in block for each in ELSEWHERE)]


@pytest.mark.slow
def test_lines_of_the_page_run_from_top_to_bottom(tmp_path, monkeypatch, capsys, dsr_cache):
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    camera = dsr.Camera.from_fov(60, width=64, height=48)
    pose, coarse = walk(1)[0], camera.rescale(32, 24)
    depth = room(camera, pose)
    picture = np.stack([255 * depth / depth.max()] * 3, -1).astype(np.uint8)
    Image.fromarray(picture).save("photo.jpg")
    noise = 1 + 0.003 * np.random.default_rng(0).standard_normal((24, 32))
    Image.fromarray(np.round(1000 * room(coarse, pose) * noise).astype(np.uint16)).save("depth.png")
    np.save("truth.npy", depth.astype(np.float32))
    names = ("width", "height", "fx", "fy", "cx", "cy")
    Path("camera.json").write_text(json.dumps({name: getattr(camera, name) for name in names}))
    known = {}
    for block in blocks():
        quick = block.replace("size=128", "size=64").replace("steps=600", "steps=2")
        exec(compile(quick, PAGE, "exec"), known)
    said = capsys.readouterr().out
    assert re.search(r"^\d+% of the pixels are expected", said, re.MULTILINE)
    assert len(re.findall(r"^\d\.\d{3} m$", said, re.MULTILINE)) == 3
    assert {METRES, "mesh.glb", "info.json", "input.npz"} <= {path.name for path in Path("out").iterdir()}
    assert Path("surface.stl").stat().st_size > 1000
    assert 0 < float(known["metrics"].compute()["RMSE_d"]) < 1000
    assert len(known["points"]) > 1000
