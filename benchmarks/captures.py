"""Captures of real and simulated sensors, and methods run on them, for benchmarks; not a benchmark itself."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.folder import Folder
from dsr.data.frame_files import read_millimetres, read_picture, to_camera
from dsr.data.rgbdd import RGBDD
from dsr.data.scene_source import SceneSource
from dsr.data.sunrgbd import SunRGBD, load_pair
from dsr.degradation.downsampling import Downsampling, Kernel, Measured, make_sample
from dsr.geometry.camera import Camera
from dsr.geometry.surface import angle_between, depth_to_normals
from dsr.inference import upsampler
from dsr.io.images import read_numbers
from dsr.methods.recipe import read_recipe
from dsr.metrics.catalogue import PROTOCOLS, score_image
from dsr.metrics.formats import WORST
from dsr.pictures.depth_views import Window
from dsr.sample import DepthSample, Scene

RMSE_V = tuple(metric for metric in PROTOCOLS["paper"] if metric.name == "RMSE_v")
XTION = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy in pixels of a sensor of 640 x 480 pixels whose files have no camera: its maker's."""
LIDAR_FOCAL = 1440.0
"""Assumed focal length of the phone's photo of 1920 x 1440, pixels."""


class Truth(NamedTuple):
    """True depth, (1, H, W) in metres, NaN where unknown, and its camera, at any resolution."""

    depth: Tensor
    camera: Camera


@dataclass(frozen=True)
class Capture:
    """A photo and a depth map, and where to look.

    Args:
        sample: the two; its ``depth`` is not used.
        windows: in pixels of the photo, all of one size.
        truth: None where there is none.
        noisy: whether the map has noise.
        measured: whether a real sensor made the map, so that the truth has errors, too.
        keep_holes: whether results have the map's holes: where they are most of the map, what fills them is arbitrary.

    """

    sample: DepthSample
    windows: tuple[Window, ...]
    truth: Truth | None = None
    noisy: bool = True
    measured: bool = True
    keep_holes: bool = False

    def scores(self, depth: Tensor) -> dict[str, float] | None:
        """Score a result, (1, H, W) in metres, on the whole frame; None without a truth.

        Returns:
            ``angle``, the mean angle between the normals in degrees, ``RMSE_v`` and ``covered``, the scored fraction:
            for real sensors as in :mod:`dsr.metrics.sensor`, otherwise over all pixels. A result of another size than
            the truth is resized to it by averaging areas.

        """
        if self.truth is None:
            return None
        target, rays = self.truth.depth.double(), self.truth.camera.rays()
        height, width = target.shape[-2:]
        found = cv2.resize(depth[0].double().numpy(), (width, height), interpolation=cv2.INTER_AREA)
        result = torch.from_numpy(found)[None]
        metrics = PROTOCOLS["sensor"] if self.measured else RMSE_V
        rows = score_image(result, target, rays, metrics, unit=self.sample.unit)
        values = {row.metric: row.value for row in rows if row.variant in ("", WORST)}
        if self.measured:
            names = {"angle": "Sensor_angle_mean", "RMSE_v": "Sensor_RMSE_v", "covered": "Sensor_covered"}
            return {name: values[metric] for name, metric in names.items()}
        angle = angle_between(*(depth_to_normals(each[None], rays[None]) for each in (result, target)))
        covered = float(angle.isfinite().double().mean())
        return {"angle": float(angle.nanmean()), "RMSE_v": values["RMSE_v"], "covered": covered}


def run_method(capture: Capture, name: str, shared: Path, device: str) -> Tensor:
    """Return a method's result as :func:`dsr.inference.upsampler` gives it, (1, H, W) in metres.

    TGV weights a noisy map by its noise, and networks of other authors take their weights from the shared material.
    Holes stay holes where a method does not fill them by itself, or the capture asks for it.
    """
    settings: dict[str, Any] = {}
    node = read_recipe(name).at()
    if name == "tgv" and capture.noisy:
        settings["data_weight"] = "auto"
    if "weights_files" in node:
        settings["weights"] = str(shared / "weights" / "peers")
    sample = capture.sample
    keep = capture.keep_holes or node.get("fill_holes") is False
    run = upsampler(name, settings=settings, fill="none" if keep else "all", device=device)
    return run.upsample(sample.rgb, sample.depth_lr, sample.camera).depth


def measured(source: SceneSource, name: str, windows: tuple[Window, ...]) -> Capture:
    """Return a scene of a data set with a sensor's own map."""
    scene = source.load(name)
    truth = None if scene.depth is None else Truth(scene.depth, scene.camera)
    return Capture(make_sample(scene, "native", Measured(), "disparity"), windows, truth)


def at_own_size(scene: Scene, windows: tuple[Window, ...]) -> Capture:
    """Return a scene whose only map is a sensor's at the photo's size."""
    assert scene.depth is not None
    return Capture(without_truth(scene.name, scene.rgb, scene.depth, scene.camera), windows)


def without_truth(name: str, rgb: Tensor, depth_lr: Tensor, camera: Camera) -> DepthSample:
    """Return the sample of a photo and a map of any smaller size."""
    height, width = depth_lr.shape[-2:]
    ratio = camera.ratio_to(width, height)
    return DepthSample("captures", name, rgb, depth_lr, camera, camera.reduce(width, height), ratio)


def sun_rgbd(folder: str, windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return a scene of SUN RGB-D."""
    source = SunRGBD(str(shared / "real" / "sunrgbd"), "found", size=None)
    return at_own_size(source.load(folder), windows)


def xtion(windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return a pair in SUN RGB-D's encoding, without a camera."""
    folder = shared / "real" / "sunrgbd" / "open3d_sample"
    scene = load_pair(folder / "SUN_color.jpg", folder / "SUN_depth.png", "sunrgbd", "xtion", XTION)
    return at_own_size(scene, windows)


def depth_camera(name: str, windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return a frame of a stereo depth camera."""
    folder = shared / "real" / "depth_camera" / name
    rgb, depth = read_picture(next(iter(sorted(folder.glob("rgb.*"))))), read_millimetres(folder / "raw_depth.png")
    path = folder / "intrinsics.txt"
    camera = to_camera(path, read_numbers(path, 9).reshape(3, 3), (rgb.shape[1], rgb.shape[2]))
    return Capture(without_truth(f"depth_camera_{name}", rgb, depth, camera), windows)


def iphone_lidar(windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return the phone's capture."""
    folder = shared / "real" / "iphone_lidar"
    rgb, depth = read_picture(folder / "image.jpg"), read_millimetres(folder / "arkit_depth.png")
    camera = Camera.centred(rgb.shape[2], rgb.shape[1], LIDAR_FOCAL)
    return Capture(without_truth("iphone_lidar", rgb, depth, camera), windows)


def simulated_phone(windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return the capture of ``simulate_phone.py``; its truth has a third of the photo's resolution."""
    with tempfile.TemporaryDirectory() as place:
        subprocess.run([sys.executable, str(shared / "simulate_phone.py"), place], check=True)
        folder = Path(place)
        rgb, camera = read_picture(folder / "photo.jpg"), Camera(**json.loads((folder / "info.json").read_text()))
        depth, truth = (torch.from_numpy(np.load(folder / f"{each}.npy"))[None].double() for each in ("depth", "truth"))
    camera_of_truth = camera.downscale(camera.width // truth.shape[-1])
    sample = without_truth("simulated_phone", rgb, depth, camera)
    return Capture(sample, windows, Truth(truth, camera_of_truth), measured=False)


def downsampled(name: str, kernel: Kernel, windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return a scene with exact depth, downsampled to x4."""
    scene = Folder(str(shared / "scenes"), [name]).load(name)
    sample = make_sample(scene, 4, Downsampling(kernel), "disparity")
    assert sample.depth is not None
    return Capture(sample, windows, Truth(sample.depth, sample.camera), noisy=False, measured=False)


def ddrnet(name: str, windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return a frame of a structured-light camera."""
    return replace(measured(ddrnet_frames(shared), name, windows), keep_holes=True)


def ddrnet_frames(shared: Path) -> DDRNetFrames:
    """Return all frames of the structured-light camera."""
    return DDRNetFrames(str(shared / "real" / "ddrnet"), "found")


def rgbdd_real(name: str, windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return a capture of a phone's time-of-flight sensor."""
    return measured(RGBDD(str(shared / "real" / "rgbdd_real"), real=True, scenes="found"), name, windows)


def tofmark(name: str, windows: tuple[Window, ...], shared: Path) -> Capture:
    """Return a scene of ToFMark with its truth, as :mod:`dsr.data.folder` reads it."""
    return measured(Folder(str(shared / "scenes"), [name]), name, windows)


def _windows(height: int, width: int, *corners: tuple[int, int]) -> tuple[Window, ...]:
    """Return windows of one size at (top, left)."""
    return tuple(Window(top, left, height, width) for top, left in corners)


_LUCY, _PLANT = _windows(144, 192, (30, 190), (240, 140)), _windows(144, 192, (80, 270), (260, 200))
_KINECT2 = "2014-12-18_11-31-54_260595134347"
CAPTURES: Mapping[str, Callable[[Path], Capture]] = {
    "ddrnet": partial(ddrnet, "frame_000001", _windows(144, 192, (100, 230), (250, 230))),
    "kinect1": partial(sun_rgbd, "img_0063", _windows(144, 192, (220, 360), (100, 190))),
    "kinect2": partial(sun_rgbd, _KINECT2, _windows(144, 192, (180, 300), (75, 420))),
    "xtion": partial(xtion, _windows(144, 192, (100, 340), (280, 330))),
    "tofmark_books": partial(tofmark, "books", _windows(144, 192, (10, 30), (170, 150))),
    "depth_camera_0": partial(depth_camera, "0", _windows(144, 192, (230, 50), (240, 430))),
    "depth_camera_1": partial(depth_camera, "1", _windows(144, 192, (90, 230), (220, 180))),
    "iphone_lidar": partial(iphone_lidar, _windows(576, 768, (250, 960), (500, 100))),
    "rgbdd_real": partial(rgbdd_real, "20200509114515", _windows(144, 192, (190, 100), (150, 290))),
    "simulated_phone": partial(simulated_phone, _windows(576, 768, (810, 300), (860, 1140))),
    "lucy_box": partial(downsampled, "lucy", "box", _LUCY),
    "lucy_bicubic": partial(downsampled, "lucy", "bicubic", _LUCY),
    "plant_box": partial(downsampled, "plant", "box", _PLANT),
    "plant_bicubic": partial(downsampled, "plant", "bicubic", _PLANT),
}
"""Captures by name, from the directory of the shared material."""
