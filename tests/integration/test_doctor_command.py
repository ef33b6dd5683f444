"""The real ``dsr doctor DIR``: what it prints, and its exit codes."""

import json

import cv2
import numpy as np
import pytest

from dsr.cli import main
from dsr.synthetic.simgeo import render_scene


@pytest.fixture(scope="module")
def cube():
    return render_scene("cube_no_texture", 192)


def write(folder, rendering, depth, **entries):
    """Write a scene in the folder layout, of a rendering with another depth."""
    folder.mkdir(parents=True)
    camera = rendering.camera
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps({**numbers, **entries}))
    cv2.imwrite(str(folder / "rgb.png"), rendering.rgb[:, :, ::-1])
    np.save(folder / "depth.npy", depth)


def test_findings_are_printed_with_advice(tmp_path, cube, capsys):
    rays = cube.camera.ray_lengths().numpy()
    write(tmp_path / "ray", cube, cube.depth * rays)
    write(tmp_path / "ray_described", cube, cube.depth * rays, range_type="perspective")
    write(tmp_path / "unit", cube, cube.depth * 1000)
    write(tmp_path / "unit_described", cube, cube.depth * 1000, depth_unit="mm")
    assert main(["doctor", str(tmp_path)]) == 1
    output, errors = capsys.readouterr()
    assert errors == ""
    text = " ".join(output.split())
    assert "ray: 1 problem" in text
    assert "depth looks like distance along the ray" in text
    assert '-> set "range_type": "perspective" in camera.json' in text
    assert "ray_described: fine" in text
    assert "unit: 1 problem" in text
    assert "-> x 0.001 would make the median" in text
    assert "unit_described: fine" in text
    assert output.endswith("4 scenes: 2 fine, 2 with problems\n")
    assert main(["doctor", str(tmp_path), "--most", "2"]) == 1
    assert capsys.readouterr().out.startswith("2 of 4 scenes, at equal distances\nray: 1 problem")


def test_published_scenes_pass(shared, capsys):
    assert main(["doctor", str(shared / "scenes")]) == 0
    output, errors = capsys.readouterr()
    assert errors == ""
    for name in ("books", "lucy", "plant"):
        assert f"{name}: fine" in output
    assert output.endswith("3 scenes: 3 fine\n")
