"""Quality on data with a truth: real and simulated sensors, the paper's scenes, the field's benchmarks.

RMSE_v, DSSIM_v and LPIPS_v are in 1/1000, angles are means in degrees. ``methods`` names methods, ``weights`` a folder
with facets_x2.safetensors and others to measure in their place. ``filters`` measures OpenCV's bilateral filter of the
map, enlarged by cubic interpolation where it is smaller than the photo: ``all`` or WINDOW/METRES/PIXELS, separated by
commas. ``stated`` is the median expected error over the median true one. ``frames`` limits the frames of each source.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, get_args
from unittest.mock import patch

import cv2
import numpy as np
import torch
import yaml
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import interpolate, pad

from dsr.app.upsample.parts import Results
from dsr.data.cleargrasp import ClearGrasp
from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.eight_bit import EightBit
from dsr.data.folder import Folder
from dsr.data.frame_files import read_millimetres, read_picture, to_camera
from dsr.data.icl import ICL
from dsr.data.middlebury import Middlebury
from dsr.data.nyu import NYU
from dsr.data.rendered import Procedural, SimGeo
from dsr.data.rgbdd import RGBDD
from dsr.data.scene_source import SceneSource
from dsr.data.stereo_board import StereoBoard
from dsr.data.sunrgbd import SunRGBD, load_pair
from dsr.degradation import noise as sensor_noise
from dsr.degradation import random_fields
from dsr.degradation.downsampling import Downsampling, Kernel, Measured, make_sample, scene_generator
from dsr.degradation.glass import add_glass
from dsr.degradation.noise import GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.degradation.random_degradation import Everything
from dsr.degradation.random_fields import field_of, near_steps
from dsr.geometry.camera import Camera, RangeType, from_range, to_range
from dsr.geometry.hole_size import window_maxima
from dsr.geometry.surface import angle_between, depth_to_normals, length
from dsr.inference import Fill, upsample_surface, upsampler
from dsr.inference.sequences import View, fuse_views
from dsr.io.images import read_numbers
from dsr.methods.base import Method as BaseMethod
from dsr.methods.base import Surface
from dsr.methods.classical.bilateral import filter_bilateral
from dsr.methods.networks.facets_method import SPECIAL, AnyMap, Edges
from dsr.methods.networks.peers.peer import Peer
from dsr.methods.networks.weight_files import read_header
from dsr.methods.recipe import Known, Run, read_recipe
from dsr.methods.weights import packaged_weights
from dsr.metrics import functional
from dsr.metrics.boundaries import depth_boundaries, depth_boundary_error
from dsr.metrics.calibration import OFF, error_ratios, measured_errors, off_auc, squared_error_share, stated_ratio
from dsr.metrics.catalogue import PROTOCOLS, Metric, catalogue, score_image
from dsr.metrics.formats import WORST
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import load_lpips
from dsr.metrics.sensor import LARGEST_ERROR, SensorComparison, board_errors, compare_board
from dsr.pictures.depth_views import Window, normals_seen_by
from dsr.sample import DepthSample, Scene
from dsr.training.patches import soften
from dsr.utils.configuration import ConfigError
from dsr.utils.files import write_text

Scores = dict[str, float]
Method = Callable[[DepthSample], Surface]
Case = Callable[..., Scores]
CONF = Path(__file__).resolve().parent.parent / "conf"
FILTERS = "19/0.03/3,41/0.05/9,81/0.06/18"
DRAWS = 2  # Simulated sensors of each kind, of ``edges`` and ``flicker``
PAPER = tuple(metric for metric in PROTOCOLS["paper"] if not metric.perceptual)

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


def case_of(part: Callable[[Path, Method, int | None], Scores], name: str, fill: Fill = "none") -> Case:
    """Return the case that measures methods and filters in a part; it fills holes where a boundary would be beside."""

    def case(
        *, shared: Path, device: str = "cpu", methods: str = "facets", weights: str = "", frames: int = 0,
        filters: str = "",
    ) -> Scores:  # fmt: skip
        measured: dict[str, Method] = {"input": lambda sample: Surface(given(sample), None, None, None)}
        for text in (FILTERS if filters == "all" else filters).split(",") if filters else ():
            window, metres, pixels = text.split("/")
            measured[f"bilateral {text}"] = filter_of(int(window), float(metres), float(pixels))
        with tempfile.TemporaryDirectory() as place:
            folder = with_weights(Path(weights), Path(place)) if weights else None
            for label in ("trained",) if weights else filter(None, methods.split(",")):
                measured[label] = method_of(label, device, folder, fill)
            found = {label: part(shared, method, frames or None) for label, method in measured.items()}
        return {f"{label} {key}": value for label, scores in found.items() for key, value in scores.items()}

    case.__name__, case.__doc__ = name, part.__doc__
    return case


def method_of(name: str, device: str, folder: Path | None, fill: Fill) -> Method:
    """Return what ``dsr upsample`` computes with a method, of a folder of configuration if there is one."""
    return lambda sample: upsample_surface(
        sample.rgb, sample.depth_lr, sample.camera, method=name, directories=(folder,) if folder else (),
        device=device, fill=fill,
    )  # fmt: skip


def filter_of(window: int, metres: float, pixels: float) -> Method:
    """Return OpenCV's bilateral filter of a map, which states no error."""
    return lambda sample: Surface(filter_bilateral(given(sample), window, metres, pixels), None, None, None)


def given(sample: DepthSample) -> Tensor:
    """Return a map, enlarged by cubic interpolation where it is smaller than the photo."""
    if sample.scale == 1:
        return sample.depth_lr
    size = (sample.camera.width, sample.camera.height)
    return torch.from_numpy(cv2.resize(sample.depth_lr[0].numpy(), size, interpolation=cv2.INTER_CUBIC))[None]


def with_weights(weights: Path, folder: Path) -> Path:
    """Write a method ``trained``, facets with the weights of a folder, as a folder of configuration."""
    node = yaml.safe_load((CONF / "method" / "facets.yaml").read_text())
    own = node["method"]["weights"]
    own["packaged"] = {str(weights.resolve() / name): factor for name, factor in own["packaged"].items()}
    (folder / "method").mkdir()
    (folder / "method" / "trained.yaml").write_text(f"# @package _global_\n{yaml.safe_dump(node)}")
    return folder


def mean(rows: Sequence[Scores]) -> Scores:
    """Return the means of rows with the same keys, where they are defined."""
    return {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}


def by_source(rows: Mapping[str, Sequence[Scores]], *, geometric: bool = False) -> Scores:
    """Return the means of each source's rows, with its name before theirs."""
    found = {}
    for source, each in rows.items():
        logs = [{key: float(np.log(value)) for key, value in row.items()} for row in each] if geometric else each
        for key, value in (mean(logs) if logs else {}).items():
            found[f"{source}_{key}".rstrip("_")] = float(np.exp(value)) if geometric else value
    return found


def board(shared: Path, method: Method, count: int | None) -> Scores:
    """A stereo camera before a plane: deviation in mm, the same beside the outline, angle, stated error."""
    data, rows = StereoBoard(str(shared / "real" / "stereo_board")), []
    for name in data.scenes()[:count]:
        scene = data.load(name)
        assert scene.depth is not None
        surface = method(without_truth(name, scene.rgb, scene.measured[1], scene.camera))
        maps = surface.depth[None].double(), scene.depth[None].double(), scene.camera.rays()[None]
        whole, border = (SurfacePair(*maps, scene.regions[each][None] > 0) for each in ("board", "border"))
        row = {
            "std": 1e3 * float(board_errors(whole)["std"]),
            "edge": 1e3 * float(board_errors(border)["std"]),
            "angle": float(board_errors(whole)["angle"]),
        }
        if surface.depth_error is not None:
            scored, off = compare_board(whole)
            row["stated"] = float(stated_ratio(surface.depth_error, off.abs().masked_fill(~scored, torch.nan)[0]))
        rows.append(row)
    return mean(rows)


def ddrnet_camera(shared: Path, method: Method, count: int | None) -> Scores:
    """A structured-light camera as ``metrics=sensor`` scores it; and against the truth smoothed by 2 pixels."""
    rows = []
    for name in ddrnet_frames(shared).scenes()[:count]:
        capture = ddrnet(name, (), shared)
        assert capture.truth is not None
        surface = method(capture.sample)
        smoothed = replace(capture, truth=capture.truth._replace(depth=blurred(capture.truth.depth, 2.0)))
        rows.append(score_capture(capture, surface) | {"smoothed": score_capture(smoothed, surface)["RMSE_v"]})
    return mean(rows)


def rgbdd(shared: Path, method: Method, count: int | None) -> Scores:
    """A phone's time-of-flight map against another sensor's."""
    names = sorted(path.stem.partition("_")[0] for path in (shared / "real" / "rgbdd_real" / "RGB").iterdir())
    captures = [rgbdd_real(name, (), shared) for name in names[:count]]
    return mean([score_capture(each, method(each.sample)) for each in captures])


def score_capture(capture: Capture, surface: Surface) -> Scores:
    """Score a result on a capture with a truth, and its stated errors after the median offset is taken off."""
    scores = capture.scores(surface.depth)
    assert scores is not None
    assert capture.truth is not None
    found = {"RMSE_v": 1e3 * scores["RMSE_v"], "angle": scores["angle"], "covered": 100 * scores["covered"]}
    if surface.depth_error is not None:
        off = (surface.depth - capture.truth.depth).double()
        off = (off - np.nanmedian(off)).abs()
        found["stated"] = float(stated_ratio(surface.depth_error, off.masked_fill(off >= LARGEST_ERROR, torch.nan)))
    return found


def blurred(depth: Tensor, deviation: float) -> Tensor:
    """Return depth, (1, H, W), smoothed by a masked Gaussian."""
    values = depth[0].double().numpy()
    known = np.isfinite(values)
    total, weight = (
        cv2.GaussianBlur(each, (0, 0), deviation) for each in (np.where(known, values, 0), known.astype(np.float64))
    )
    return torch.from_numpy(np.where(known, total / np.where(known, weight, 1), np.nan))[None]


FLOORS = {
    "iphone_lidar": ((800, 930), (1650, 1000), (1800, 1380), (700, 1380)),
    "depth_camera_0": ((270, 220), (390, 220), (500, 450), (280, 450)),
}  # Corners (u, v) of planes, pixels of the photo


def floors(shared: Path, method: Method, _: int | None) -> Scores:
    """Floors before a phone and a stereo camera: mean angle between their normals and the mean of these."""
    captures = {name: CAPTURES[name](shared).sample for name in FLOORS}
    return {name: flatness(method(each).depth, each.camera, FLOORS[name]) for name, each in captures.items()}


def flatness(depth: Tensor, camera: Camera, polygon: Sequence[tuple[int, int]]) -> float:
    """Return the mean angle between the normals of depth, (1, H, W), inside a polygon and their mean, without holes."""
    inside = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillPoly(inside, [np.array(polygon, np.int32)], 1)
    normals = normals_seen_by(camera, depth)[0][:, torch.from_numpy(inside) > 0]
    normals = normals[:, normals.isfinite().all(dim=0)][..., None]
    average = normals.mean(dim=1, keepdim=True)
    return float(angle_between(normals, average / length(average)).mean())


def phone(shared: Path, method: Method, _: int | None) -> Scores:
    """A simulated phone: mean angle between normals."""
    capture = CAPTURES["simulated_phone"](shared)
    scores = capture.scores(method(capture.sample).depth)
    assert scores is not None
    return {"angle": scores["angle"]}


def clean(shared: Path, method: Method, _: int | None) -> Scores:
    """Box means of Lucy and Plant at x4, not told to be without noise: RMSE_v."""
    found = {}
    for name in ("lucy_box", "plant_box"):
        capture = CAPTURES[name](shared)
        scores = capture.scores(method(capture.sample).depth)
        assert scores is not None
        found[name] = 1e3 * scores["RMSE_v"]
    return found


def middlebury(shared: Path, *names: str) -> list[Scene]:
    """Return scenes of Middlebury 2014, about 740 pixels wide."""
    source = Middlebury(str(shared / "real" / "middlebury2014"), names, size=None)
    return [source.load(name) for name in names]


def icl(shared: Path) -> list[Scene]:
    """Return the frames of ICL-NUIM."""
    source = ICL(str(shared / "real" / "icl_nuim"), "found", size=None)
    return [source.load(name) for name in source.scenes()]


def simulated(scene: Scene, kind: str, scale: int = 1, draw: int = 0) -> DepthSample:
    """Return a scene with the map of a simulated sensor in whole millimetres, box means but for its noise."""
    sensor = Everything(
        kernels={"box": 1}, noises={kind: 1}, holes={"none": 1}, folds=0, relief=0, displaced=0, rounded=0, soft=0,
        photo=0, textured=0, told=0,
    )  # fmt: skip
    height, width = (n // scale * scale for n in scene.rgb.shape[-2:])
    sample, _ = sensor(scene.crop(0, 0, height, width), scale, scene_generator(draw, scene.name, kind, scale))
    return replace(sample, depth_lr=(1e3 * sample.depth_lr).round().clamp(min=1) / 1e3)


def edges(shared: Path, method: Method, count: int | None) -> Scores:
    """Pixels from the result's depth boundaries to the truth's and back: a simulated phone, simulated stereo.

    Holes are filled, by the method or from the nearest pixel, and results clipped to the truth's range.
    """
    capture = CAPTURES["simulated_phone"](shared)
    assert capture.truth is not None
    rows = {"phone": [score_edges(method(capture.sample).depth, capture.truth.depth)], "stereo": []}
    for scene in middlebury(shared, "motorcycle", "playroom")[:count]:
        assert scene.depth is not None
        samples = [simulated(scene, "stereo", draw=draw) for draw in range(DRAWS)]
        rows["stereo"] += [score_edges(method(each).depth, scene.depth) for each in samples]
    return by_source(rows)


def score_edges(result: Tensor, truth: Tensor) -> Scores:
    """Score where the depth boundaries of a result are; where the truth, (1, H, W), is unknown, neither has any."""
    known = truth.isfinite()
    places = distance_transform_edt(~result[0].isfinite().numpy(), return_distances=False, return_indices=True)
    filled = result[0, places[0], places[1]].double().numpy()
    resized = cv2.resize(filled, truth.shape[:-3:-1], interpolation=cv2.INTER_AREA)
    shown = torch.from_numpy(resized)[None].clamp(truth[known].min(), truth[known].max()).masked_fill(~known, torch.nan)
    both = depth_boundaries(shown[None]), depth_boundaries(truth[None])
    (to, back), (far_to, far_back) = (depth_boundary_error(*both, quantile) for quantile in (None, 0.9))
    return {"to": float(to), "to_p90": float(far_to), "from": float(back), "from_p90": float(far_back)}


CREASE, REACH, STEP = 30.0, 3, 0.02  # Degrees across a crease, pixels to either side, and a step between neighbours


def creases(shared: Path, method: Method, count: int | None) -> Scores:
    """Angles where the truth turns by 30 degrees within 6 pixels, elsewhere, and the share of creases in %."""
    rows: dict[str, list[Scores]] = {"ddrnet": [], "icl": []}
    for name in ddrnet_frames(shared).scenes()[:count]:
        capture = ddrnet(name, (), shared)
        assert capture.truth is not None
        truth, rays = capture.truth.depth, capture.truth.camera.rays()
        rows["ddrnet"].append(score_creases(method(capture.sample).depth, truth, rays, measured=True))
    for scene in icl(shared)[:count]:
        assert scene.depth is not None
        seen = Kinect()(scene.depth, scene_generator(0, scene.name)).float()
        result = method(without_truth(scene.name, scene.rgb, seen, scene.camera)).depth
        rows["icl"].append(score_creases(result, scene.depth, scene.camera.rays(), measured=False))
    return by_source(rows)


def score_creases(result: Tensor, truth: Tensor, rays: Tensor, *, measured: bool) -> Scores:
    """Score normals at creases and elsewhere; for a measured truth as :mod:`dsr.metrics.sensor` compares them."""
    pair = SurfacePair(result[None].double(), truth[None].double(), rays[None])
    if measured:
        comparison = SensorComparison(pair)
        off = functional.angle(comparison.surfaces).masked_fill(~comparison.scored, torch.nan)[0]
    else:
        off = angle_between(*(depth_to_normals(each[None].double(), rays[None]) for each in (result, truth)))[0]
    crease, rest = find_creases(truth.double(), rays)
    share = 100 * float(crease.sum() / truth.isfinite().sum())
    return {"crease": float(off[crease].nanmean()), "rest": float(off[rest].nanmean()), "share": share}


def find_creases(truth: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the creases of a truth, (1, H, W), and the rest without them, depth steps and borders, (1, H, W) bool."""
    normals = depth_to_normals(blurred(truth, 1.5)[None], rays[None])[0]
    turn = torch.zeros_like(truth, dtype=torch.float64)
    for dim in (-2, -1):
        inside = turn.narrow(dim, REACH, turn.shape[dim] - 2 * REACH)
        sides = [normals.narrow(dim, start, inside.shape[dim]) for start in (0, 2 * REACH)]
        inside.copy_(torch.maximum(inside, angle_between(*sides).nan_to_num(0)))
    beside = near_steps(truth, 1, STEP) | truth.isnan()
    calm = window_maxima(pad(beside.double(), (1, 1, 1, 1), value=1), 2 * REACH)[..., 1:-1, 1:-1] == 0
    return calm & (turn > CREASE), calm & (turn <= CREASE)


STILL, FUSED, HIDES = 7, (3, 5), 0.05  # Frames, how many are fused, and a point's range over depth of two surfaces


def flicker(shared: Path, method: Method, count: int | None) -> Scores:
    """Still simulated cameras: deviation of a point over frames, of the input in mm, of results over that.

    Results are of single frames, and of three and five frames fused before the method, three successive results each;
    the mean of independent noise would have 0.38 and 0.23. Geometric means.
    """
    scenes = [icl(shared)[0], *middlebury(shared, "piano")][:count]
    rows = {
        kind: [score_flicker(list(still(each, kind, draw)), method) for each in scenes for draw in range(DRAWS)]
        for kind in ("structured", "stereo")
    }
    return by_source(rows, geometric=True)


def still(scene: Scene, kind: str, draw: int) -> Iterator[DepthSample]:
    """Yield the frames of a still camera: one sensor, whose constants are drawn once, and new fields of noise."""
    for frame in range(STILL):
        fresh = scene_generator(draw, scene.name, kind, "frame", frame)

        def anew(like: Tensor, sigma: float | tuple[float, float], _: object, fresh: torch.Generator = fresh) -> Tensor:
            return field_of(like, sigma, fresh)

        with patch.object(random_fields, "field_of", anew), patch.object(sensor_noise, "field_of", anew):
            yield simulated(scene, kind, draw=draw)


def score_flicker(frames: Sequence[DepthSample], method: Method) -> Scores:
    """Score how still the results of a still camera are; mm is that of the input."""
    views = [View(each.depth_lr, each.camera_lr, np.eye(4)) for each in frames]
    given_maps = torch.stack([each.depth_lr for each in frames])
    single = torch.stack([method(each).depth for each in frames])
    edge = max(FUSED) // 2
    pairs = {"single": (single, given_maps)}
    for count in FUSED:
        fused = []
        for middle in range(edge, STILL - edge):
            near = views[middle - count // 2 : middle + count // 2 + 1]
            depth_lr = fuse_views(near.pop(count // 2), near).depth
            fused.append(method(replace(frames[middle], depth_lr=depth_lr)).depth)
        pairs[f"fused{count}"] = (torch.stack(fused), given_maps[edge:-edge])
    calm = given_maps.amax(dim=0) - given_maps.amin(dim=0) < HIDES * given_maps.amin(dim=0)  # NaN is not
    static = calm & torch.cat([each for each, _ in pairs.values()]).isfinite().all(dim=0)
    means = {name: [float(each.double().std(dim=0)[static].mean()) for each in pair] for name, pair in pairs.items()}
    return {"mm": 1e3 * means["single"][1]} | {name: now / before for name, (now, before) in means.items()}


def stated(shared: Path, method: Method, count: int | None) -> Scores:
    """Stated over true error before all simulated sensors, and the factor by which it is off; geometric means."""
    random_scenes = Procedural(3, seed=1)
    sources = {
        "middlebury": middlebury(shared, "motorcycle", "playroom"),
        "icl": icl(shared),
        "procedural": [random_scenes.load(name) for name in random_scenes.scenes()],
    }
    rows: dict[str, list[Scores]] = {}
    for name, scenes in sources.items():
        for scale in (1, 4):
            found = rows.setdefault(f"{name}_x{scale}", [])
            for sample in (simulated(each, kind, scale) for each in scenes[:count] for kind in sensor_noise.NOISES):
                surface = method(sample)
                if surface.depth_error is None:
                    return {}
                assert sample.depth is not None
                ratio = float(stated_ratio(surface.depth_error, (surface.depth - sample.depth).abs()))
                found.append({"": ratio, "off": max(ratio, 1 / ratio)})
    return by_source(rows, geometric=True)


class Glass(NamedTuple):
    """A capture of clear objects, the depth of their painted twins (1, H, W) in metres, and where they are."""

    sample: DepthSample
    twin: Tensor
    mask: Tensor


def glass(shared: Path, method: Method, count: int | None) -> Scores:
    """Clear objects before a stereo camera, beside their painted twins.

    The share of the objects' pixels off by more than 20 mm in %, the share of these stated to be off by less than 5 mm,
    how well the stated error sorts pixels into these and the others (area under the curve; 0.5 is chance), the same of
    all pixels, and the share of the objects' pixels that ``--for robot`` leaves with such depth.
    """
    return mean([score_glass(each, method(each.sample)) for each in glasses(shared)[:count]])


def clear(shared: Path, method: Method, count: int | None) -> Scores:
    """The same as glass for clear objects as trainings have them, in procedural scenes before simulated stereo."""
    del shared
    rows, source = [], Procedural(12, seed=77)
    for number, name in enumerate(source.scenes()[:count]):
        scene, generator = source.load(name), torch.Generator().manual_seed(number)
        full, seen = add_glass(scene, generator, {"vessel": 0.75, "ball": 0.1, "box": 0.15})
        assert full.depth is not None
        rgb = full.rgb.float()
        inverse = sensor_noise.NOISES["stereo"](seen.float().reciprocal(), rgb.mean(dim=0, keepdim=True), generator)
        depth = (1e3 / inverse).round() / 1e3
        sample = without_truth(name, rgb, depth.masked_fill(~(depth > 0) | depth.isinf(), torch.nan), scene.camera)
        object_ = Glass(sample, full.depth, full.depth.ne(torch.as_tensor(scene.depth)))
        rows.append(score_glass(object_, method(sample)))
    return mean(rows)


def glasses(shared: Path) -> list[Glass]:
    """Return the captures of clear objects."""
    data, found = ClearGrasp(str(shared / "real" / "cleargrasp"), synthetic=False), []
    for name in data.scenes():
        scene = data.load(name)
        assert scene.depth is not None
        sample = without_truth(name, scene.rgb, scene.measured[1], scene.camera)
        found.append(Glass(sample, scene.depth, scene.regions["glass"] > 0))
    return found


def score_glass(scene: Glass, surface: Surface) -> Scores:
    """Score a result in the clear objects."""
    inside = scene.mask & scene.twin.isfinite() & surface.depth.isfinite()
    off = (surface.depth - scene.twin).abs()
    wrong = inside & (off > OFF)
    found = {"wrong": 100 * float(wrong[inside].double().mean())}
    if surface.depth_error is not None:
        error = surface.depth_error
        found["believed"] = 100 * float((error[wrong] < 0.005).double().mean())
        found["AUC"] = float(off_auc(error[inside], off[inside], OFF))
        found["AUC_all"] = float(off_auc(error, off, OFF))
        left = wrong & surface.without_dubious(Results.max_error / 100).depth.isfinite()
        found["robot"] = 100 * float(left.sum() / (scene.mask & scene.twin.isfinite()).sum())
    return found


class AnyWeights:
    """Facets with the weights that suit a map, one pass, with the hints that ``eval.py`` gives if they are wanted."""

    def __init__(self, weights: str, *, hints: int, device: str) -> None:
        files = [Path(each) for each in weights.split(",")] if weights else map(packaged_weights, PACKAGED)
        self._files = {read_header(path)["arguments"]["scale"]: path for path in files if path is not None}
        self._hints, self._device = hints, device

    def __call__(
        self, sample: DepthSample, kernel: Any = None, *, soft: bool = False, clean: bool = False
    ) -> Tensor:  # fmt: skip
        """Return the high-resolution depth, (1, H, W)."""
        weights = self._files[min(scale for scale in self._files if 1.05 * scale >= sample.scale)]
        facts = (kernel, "soft" if soft else "sharp", clean) if self._hints else ()
        return any_map(weights, self._device, *facts)(sample)


PACKAGED = ("facets_x2", "facets_x4", "facets_x8")


@cache
def any_map(weights: Path, device: str, kernel: Any = None, edges: Edges = "auto", clean: bool = False) -> AnyMap:
    """Return the method with these facts."""
    return AnyMap(weights, edges=edges, kernel=kernel, clean=clean, device=device)


def scene_of(shared: Path, name: str) -> Scene:
    """Return one of the paper's scenes."""
    if not (shared / "scenes" / name).is_dir():
        raise FileNotFoundError(f"needs {shared / 'scenes' / name}")
    return Folder(str(shared / "scenes"), [name]).load(name)


def worst_scores(depth: Tensor, sample: DepthSample, metrics: Sequence[Metric] = PAPER) -> Scores:
    """Return the scores, of the worst light."""
    assert sample.depth is not None
    rows = score_image(depth.double(), sample.depth.double(), sample.camera.rays(), metrics, unit=sample.unit)
    return {row.metric: row.value for row in rows if row.variant in ("", WORST)}


def kernels(*, shared: Path, device: str = "cpu", weights: str = "", hints: int = 1, scales: str = "4,8") -> Scores:
    """RMSE_v of Lucy and Plant by the kernel of the downsampling, and the worst of them over that of box means."""
    run, found = AnyWeights(weights, hints=hints, device=device), {}
    for scale in map(int, scales.split(",")):
        for name in ("lucy", "plant"):
            scene, of_kernel = scene_of(shared, name), {}
            for kernel in get_args(Kernel):
                sample = make_sample(scene, scale, Downsampling(kernel), "disparity")
                of_kernel[kernel] = 1e3 * worst_scores(run(sample, kernel, clean=True), sample)["RMSE_v"]
            of_kernel["worst / box"] = max(of_kernel.values()) / of_kernel["box"]
            found |= {f"{name} x{scale} {kernel}": value for kernel, value in of_kernel.items()}
    return found


def noise(*, shared: Path, device: str = "cpu", weights: str = "", hints: int = 1) -> Scores:
    """RMSE_v, DSSIM_v and RMSE_d in mm of noisy box means at x4: Lucy, Plant, ICL-NUIM and SimGeo."""
    run = AnyWeights(weights, hints=hints, device=device)
    multiplicative = GaussianMultiplicative(0.003)
    maps: list[tuple[str, list[Scene], Any]] = [
        (f"multiplicative .003 {name}", [scene_of(shared, name)], multiplicative) for name in ("lucy", "plant")
    ]
    for source in (ICL(str(shared / "real" / "icl_nuim"), "found"), SimGeo()):
        loaded = [source.load(name) for name in source.scenes()]
        maps += [(f"{type(kind).__name__} {source.name}", loaded, kind) for kind in (Kinect(), TimeOfFlight())]
    found = {}
    for title, scenes, kind in maps:
        samples = [make_sample(scene, 4, Downsampling("box"), "disparity", kind) for scene in scenes]
        scores = mean([worst_scores(run(sample, "box"), sample) for sample in samples])
        found |= {f"{title} {key}": 1e3 * scores[key] for key in ("RMSE_v", "DSSIM_v", "RMSE_d")}
    return found


def field_sources(shared: Path) -> list[tuple[SceneSource, RangeType]]:
    """Return the field's benchmarks, and the range type of their levels or depths, which are downsampled."""
    modern = shared / "modern"
    return [
        (EightBit(str(modern / "Middlebury"), "middlebury8", "found"), "disparity"),
        (EightBit(str(modern / "Lu"), "lu", "found"), "disparity"),
        (RGBDD(str(modern / "RGBDD"), False, scenes="found"), "orthogonal"),
        (NYU(str(modern / "NYU"), "found", split="test"), "orthogonal"),
    ]


def field(*, shared: Path, device: str = "cpu", weights: str = "", hints: int = 1, scales: str = "4,8") -> Scores:
    """The field's benchmarks by ``metrics=field``: bicubic maps of Middlebury, Lu, RGB-D-D and NYU, soft steps."""
    run, found = AnyWeights(weights, hints=hints, device=device), {}
    for source, kind in field_sources(shared):
        for scale in map(int, scales.split(",")):
            rows = []
            for name in source.scenes():
                sample = make_sample(source.load(name), scale, Downsampling("bicubic", range_type=kind), "disparity")
                result = run(sample, "bicubic", soft=True, clean=True)
                rows.append(worst_scores(result, sample, PROTOCOLS["field"]))
            found |= {f"{source.name} x{scale} {key}": value for key, value in mean(rows).items()}
    return found


PEERS = "cubic_convolution,facets,msg,pgsr,dctnet,dornet,fdkn,svlrm"
ANCHORS = CONF.parent / "docs" / "measurements" / "published.csv"


def peers(
    *, shared: Path, device: str = "cpu", methods: str = PEERS, scales: str = "4,8,16", kernel: str = "bicubic",
    ranges: str = "measured,truth", out: str = "",
) -> Scores:  # fmt: skip
    """The field's benchmarks: published figures beside ours, of its networks with their authors' weights, bicubic rows.

    ``ranges`` is what a network's map is normalised by: ``(true-range)`` marks the true map's, as most authors do.
    ``kernel`` is one of dsr's; ``aliased``, bicubic interpolation by torch without antialiasing; or ``corner``, the
    last pixel of each block, taken for its mean. ``out`` is a file for tables: each figure of ``published.csv`` with
    ours, and the RMSE and RMSE_v of all methods. A network without weights for a scale is left out.
    """
    found: dict[str, Scores] = {}
    metrics = (*PROTOCOLS["field"], *(each for each in PAPER if each.name in ("RMSE_v", "DSSIM_v")))
    for source, kind in field_sources(shared):
        scenes = [source.load(name) for name in source.scenes()]
        for scale in map(int, scales.split(",")):
            for name in methods.split(","):
                for label, method in peer(name, scale, kind, kernel, ranges.split(","), shared / "weights", device):
                    samples = (field_sample(scene, scale, kind, kernel, method.range_type) for scene in scenes)
                    scores = mean([worst_scores(method(each), each, metrics) for each in samples])
                    found[f"{source.name} x{scale} {label}{f' ({kernel})' * (kernel != 'bicubic')}"] = {
                        key.replace("_cm", "").replace("_levels", ""): value for key, value in scores.items()
                    }
    if out:
        write_text(
            Path(out), "\n".join([*published_table(found), "", *grid(found, "RMSE"), "", *grid(found, "RMSE_v")])
        )
    return {f"{title} {key}": value for title, scores in found.items() for key, value in scores.items()}


def field_sample(scene: Scene, scale: int, kind: RangeType, kernel: str, range_type: RangeType) -> DepthSample:
    """Return a scene with a low-resolution map that a kernel made of its levels or depth."""
    model = Downsampling(kernel if kernel in get_args(Kernel) else "bicubic", range_type=kind)  # type: ignore[arg-type]
    sample = make_sample(scene, scale, model, range_type)
    if kernel == model.kernel:
        return sample
    assert sample.depth is not None
    values = to_range(sample.depth, sample.camera, kind) / (scale if kind == "disparity" else 1)
    if kernel == "corner":
        low = values[:, scale - 1 :: scale, scale - 1 :: scale]
    else:
        low = interpolate(values[None], scale_factor=1 / scale, mode="bicubic")[0]
    return replace(sample, depth_lr=from_range(low, sample.camera_lr, kind))


def peer(
    name: str, scale: int, kind: RangeType, kernel: str, ranges: Sequence[str], weights: Path, device: str
) -> Iterator[tuple[str, BaseMethod]]:  # fmt: skip
    """Yield a method as the field's protocol uses it, a published network with the ranges of :class:`Peer`."""
    node, known = read_recipe(name).at(), Known(kernel if kernel in get_args(Kernel) else None, "soft", clean=True)
    folder = weights / "peers" if "peer" in node else weights if name == "msg" else None
    given: dict[str, Any] = {"range_type": kind} if "range_type" in node else {}
    for settings in ({**given, "range": each} for each in ranges) if "range" in node else (given,):
        recipe = read_recipe(name, settings).with_weights(folder)
        try:
            method = recipe.build(scale, Run(device=device, known=known))
        except ConfigError:  # no weights for the scale
            return
        if not isinstance(method, Peer) or method.net.scale == scale:
            yield f"{recipe.label}{' (true-range)' * (settings.get('range') == 'truth')}", method


def published_table(found: Mapping[str, Scores]) -> Iterator[str]:
    """Yield the lines of a table: each figure of ``published.csv``, in levels or cm, beside ours.

    The last but one column has both over the bicubic row of the same images, which differs less between subsets.
    """
    yield "| benchmark | network | border | published | ours | difference, % | bicubic row | over it | from |"
    yield "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |"
    with ANCHORS.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        at, key = f"{row['dataset']} x{row['scale']}", "RMSE" + f"_border{row['border']}" * bool(row["border"])
        ours, base = (found.get(f"{at} {name}", {}).get(key) for name in (row["method"], "Cubic convolution"))
        theirs, their_base = (float(row[name]) if row[name] else None for name in ("published", "bicubic"))
        cells = [at, row["method"], row["border"] or "-", row["published"], "-", "-", "-", "-", row["source"]]
        if ours and base and theirs:
            cells[4:7] = f"{ours:.3f}", f"{100 * (ours / theirs - 1):+.1f}", f"{row['bicubic'] or '-'} / {base:.3f}"
            cells[7] = f"{theirs / their_base:.3f} / {ours / base:.3f}" if their_base else "-"
        yield f"| {' | '.join(cells)} |"


def grid(found: Mapping[str, Scores], key: str) -> Iterator[str]:
    """Yield the lines of a table of one score, the scales of each benchmark in one cell."""
    parts = [title.split(" ", 2) for title in found]
    names, sources, scales = (list(dict.fromkeys(part[number] for part in parts)) for number in (2, 0, 1))
    yield f"| {key}, {' / '.join(scales)} | {' | '.join(sources)} |"
    yield "| --- |" + " --- |" * len(sources)
    for name in names:
        cells = [[found.get(f"{source} {scale} {name}", {}).get(key) for scale in scales] for source in sources]
        texts = [" / ".join("-" if each is None else f"{each:.3g}" for each in cell) for cell in cells]
        yield f"| {name} | {' | '.join(texts)} |"


def published(
    *, shared: Path, device: str = "cpu", methods: str = "msg_v,facets,msg", weights: str = "", scales: str = "4,8",
    ensemble: int = 0,
) -> Scores:  # fmt: skip
    """Ours / published MSG-V on the paper's Lucy and Plant, box means; lower is better.

    None of these scenes was trained on or chosen with. ``weights`` are files to take instead of packaged ones,
    ``ensemble`` the passes to average where the method can.
    """
    path, trunk = shared / "expected" / "metrics.json", shared / "weights" / "alexnet_imagenet_features.pth"
    if not path.is_file():
        raise FileNotFoundError(f"needs the published network's scores, {path}")
    expected, metrics = json.loads(path.read_text()), catalogue(load_lpips(trunk))
    heads = {Path(each): read_header(Path(each)) for each in weights.split(",") if each}
    files = {f"{head['model']}_x{head['arguments']['scale']}": path for path, head in heads.items()}
    found: Scores = {}
    for method in methods.split(","):
        recipe = read_recipe(method)
        if ensemble and "ensemble" in recipe.at():
            recipe = read_recipe(method, {"ensemble": ensemble})
        for scale in map(int, scales.split(",")):
            file = files.get(f"{method}_x{scale}") or packaged_weights(f"{method}_x{scale}")
            if file is None:
                continue
            run = Run(device=device, known=Known("box", "sharp", clean=True))
            built = recipe.with_weights(file).build(scale, run)
            for scene in ("lucy", "plant"):
                sample = make_sample(scene_of(shared, scene), scale, Downsampling("box"), built.range_type)
                with torch.inference_mode():
                    ours = worst_scores(built(sample), sample, metrics)
                for metric in ("RMSE_v", "DSSIM_v", "BadPix_v_5", "Bumpiness_d", "LPIPS_v", "RMSE_d"):
                    theirs = np.max(expected[scene][f"x{scale}"]["MSG-V"][metric])
                    found[f"{method} x{scale} {scene} {metric}"] = float(ours[metric] / theirs)
    return found


def confidence(
    *, shared: Path, device: str = "cpu", scale: int = 4, draws: int = 2, clean: str = "", weights: str = ""
) -> Scores:
    """Measured over expected errors of ``facets`` by decile, and the squared error outside the best 80 %.

    On SimGeo, ICL-NUIM, Lucy and Plant, each scene with several random degradations of all kinds that the network is
    trained on, or with ``clean=box`` or ``bicubic`` without noise, known to be such; bicubic maps are of scenes with
    soft depth steps, at half their size. A ratio of 1 is right.
    """
    hints = {"clean": True, "kernel": clean, "edges": dict(SPECIAL.keys())[clean]} if clean else {}  # type: ignore[index]
    recipe = read_recipe("facets", hints).with_weights(Path(weights) if weights else None)
    method = recipe.build(scale, Run(device=device))
    expected: dict[str, list[Tensor]] = {"depth": [], "normal": []}
    measured: dict[str, list[Tensor]] = {"depth": [], "normal": []}
    for sample in degraded(shared, scale, draws, clean):
        surface = method.surface(sample)
        assert sample.depth is not None
        assert surface.depth_error is not None
        assert surface.angle_error is not None
        rays = sample.camera.rays()[None]
        errors = measured_errors(surface.depth.double()[None], sample.depth.double()[None], rays)
        for name, off, said in zip(expected, errors, (surface.depth_error, surface.angle_error), strict=True):
            expected[name].append(said.double().flatten())
            measured[name].append(off.flatten())
    found = {}
    for name, parts in expected.items():
        said, off = torch.cat(parts), torch.cat(measured[name])
        found |= {f"{name}, decile {n}": float(each) for n, each in enumerate(error_ratios(said, off), 1)}
        found[f"{name}, squared error left out"] = 1 - float(squared_error_share(said, off, 0.8))
    return found


def degraded(shared: Path, scale: int, draws: int, clean: str) -> Iterator[DepthSample]:
    """Yield the scenes with random degradations, or once without noise."""
    generator = torch.Generator().manual_seed(0)
    own = Folder(str(shared / "scenes"), ["lucy", "plant"])
    sources: tuple[SceneSource, ...] = (SimGeo(), ICL(str(shared / "real" / "icl_nuim"), "found"), own)
    for source in sources:
        for name in source.scenes():
            scene = source.load(name)
            if clean == "bicubic":
                scene = soften(scene.crop(0, 0, *(n // 2 * 2 for n in scene.rgb.shape[-2:])))
            scene = scene.crop(0, 0, *(scale * (n // scale) for n in scene.rgb.shape[-2:]))
            if clean:
                yield make_sample(scene, scale, Downsampling(clean), "disparity")  # type: ignore[arg-type]
            else:
                yield from (Everything(told=0)(scene, scale, generator)[0] for _ in range(draws))


CASES: Sequence[Case] = (
    case_of(board, "board"), case_of(ddrnet_camera, "ddrnet"), case_of(rgbdd, "rgbdd"), case_of(floors, "floors"),
    case_of(phone, "phone"), case_of(edges, "edges", "all"), case_of(creases, "creases"), case_of(flicker, "flicker"),
    case_of(stated, "stated"), case_of(glass, "glass"), case_of(clear, "clear"), case_of(clean, "clean"),
    published, kernels, noise, field, peers, confidence,
)  # fmt: skip
