"""Scenes of the benchmarks of the field are detected in one folder, each once and by its own reader."""

import cv2
import numpy as np
import pytest

from dsr.data.detection import find_scenes

SIZE = (480, 640)
LAYOUTS = {
    "lu": ("RGB/RGBD_01_ouput_color.png", "Depth/RGBD_01_output_depth.png"),
    "middlebury8": ("RGB/Middlebury_01_output_color.png", "Depth/Middlebury_01_output_depth.png"),
    "nyu": ("RGB/1000.jpg", "Depth/1000.npy"),
    "rgbdd": ("RGB/20200509112638_RGB.jpg", "Depth/20200509112638_HR_gt.png"),
    "ddrnet": ("color_map/a.png", "depth_map/a.png", "high_quality_depth/a.png"),
}


def write(path, *, photo, bits):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, np.full(SIZE, 2, np.float32))
    else:
        cv2.imwrite(str(path), np.full((*SIZE, 3) if photo else SIZE, 51, f"uint{bits}"))


@pytest.mark.parametrize("together", [False, True])
def test_benchmarks_are_detected_each_once_and_by_its_own_reader(tmp_path, together):
    for dataset, files in LAYOUTS.items():
        bits = 8 if dataset in ("lu", "middlebury8") else 16
        for number, file in enumerate(files):
            write(tmp_path / ("" if together else dataset) / file, photo=not number, bits=8 if not number else bits)
    scenes = [load() for _, load in find_scenes(tmp_path)]
    assert sorted(scene.dataset for scene in scenes) == sorted(LAYOUTS)
    units = {scene.dataset: scene.unit.name for scene in scenes}
    assert {name for name, unit in units.items() if unit == "levels"} == {"lu", "middlebury8"}
