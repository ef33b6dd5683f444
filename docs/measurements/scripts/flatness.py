# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Measure how flat methods leave two floors that real sensors saw, and beside it how true they leave a person.

    python docs/measurements/scripts/flatness.py --shared DIR [--methods facets,bilateral,...] [--device cpu]

Flatness is the mean angle in degrees between the normals inside a polygon, which is a plane, and their mean: of a
phone's map at x7.5 (``iphone_lidar``) and of a stereo depth camera's at x1 (``depth_camera_0``). As blur is flat, too,
the last columns are the metrics of ``metrics=sensor`` over the frames of ``ddrnet``: angle, RMSE_v in 1/1000 and the
share of pixels scored. The first rows are the input, the phone's enlarged by cubic interpolation, and OpenCV's
bilateral filter of that, with a window of 19 pixels and standard deviations of 0.05 m and 5 pixels for the floors, 0.03
m and 3 pixels for ``ddrnet``. ``DIR`` holds ``real/iphone_lidar``, ``real/depth_camera/0`` and ``real/ddrnet``.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from captures import CAPTURES, Capture, ddrnet, ddrnet_frames, run_method
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.surface import angle_between, length
from dsr.methods.classical.bilateral import filter_bilateral
from dsr.methods.recipe import read_recipe
from dsr.pictures.depth_views import normals_seen_by

METHODS = "bilateral,msg_v,msg_v_noisy,tgv,facets_box,facets"
FLOORS = {
    "iphone_lidar": ((800, 930), (1650, 1000), (1800, 1380), (700, 1380)),
    "depth_camera_0": ((270, 220), (390, 220), (500, 450), (280, 450)),
}
"""Corners (u, v) of the polygons, pixels of the photo."""
Result = Callable[[Capture], Tensor]
"""From a capture to its depth at the photo's size, (1, H, W) in metres, NaN in holes."""


def flatness(depth: Tensor, camera: Camera, polygon: Sequence[tuple[int, int]]) -> float:
    """Return the mean angle in degrees between the normals inside a polygon and their mean; holes are left out.

    Args:
        depth: (1, H, W) in metres.
        camera: of the depth.
        polygon: corners (u, v) in pixels.

    """
    inside = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillPoly(inside, [np.array(polygon, np.int32)], 1)
    normals = normals_seen_by(camera, depth)[0][:, torch.from_numpy(inside) > 0]
    normals = normals[:, normals.isfinite().all(dim=0)][..., None]
    mean = normals.mean(dim=1, keepdim=True)
    return float(angle_between(normals, mean / length(mean)).mean())


def given(capture: Capture) -> Tensor:
    """Return the capture's own map, enlarged by cubic interpolation where it is smaller than the photo."""
    sample = capture.sample
    if sample.scale == 1:
        return sample.depth_lr
    size = (sample.camera.width, sample.camera.height)
    enlarged = cv2.resize(sample.depth_lr[0].numpy(), size, interpolation=cv2.INTER_CUBIC)
    return torch.from_numpy(enlarged)[None]


def filtered(capture: Capture) -> Tensor:
    """Return OpenCV's bilateral filter of :func:`given`."""
    deviations = (0.05, 5.0) if capture.truth is None else (0.03, 3.0)
    return filter_bilateral(given(capture), 19, *deviations)


def row_of(label: str, result: Result, floors: dict[str, Capture], frames: list[Capture]) -> str:
    """Return a row of the table."""
    cells = [f"{flatness(result(each), each.sample.camera, FLOORS[name]):.1f}" for name, each in floors.items()]
    scores = [found for each in frames if (found := each.scores(result(each))) is not None]
    angle, rmse, covered = (np.mean([found[name] for found in scores]) for name in ("angle", "RMSE_v", "covered"))
    return f"| {label} | {' | '.join(cells)} | {angle:.1f} | {1e3 * rmse:.0f} | {100 * covered:.0f} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--floors", default=",".join(FLOORS), help="the floors to measure; both are the default")
    parser.add_argument("--frames", type=int, help="number of frames of ddrnet; all are the default")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    shared = options.shared
    floors = {name: CAPTURES[name](shared) for name in options.floors.split(",")}
    names = ddrnet_frames(shared).scenes()[: options.frames]
    frames = [replace(ddrnet(name, (), shared), keep_holes=False) for name in names]
    print(f"| | {' | '.join(floors)} | ddrnet: angle | RMSE_v | scored, % |")
    print("| --- |" + " ---: |" * (len(floors) + 3))
    print(row_of("input", given, floors, frames), flush=True)
    print(row_of("bilateral filter of OpenCV", filtered, floors, frames), flush=True)
    for name in filter(None, options.methods.split(",")):

        def result(capture: Capture, name: str = name) -> Tensor:
            return run_method(capture, name, shared, options.device)

        print(row_of(read_recipe(name).label or name, result, floors, frames), flush=True)


if __name__ == "__main__":
    main()
