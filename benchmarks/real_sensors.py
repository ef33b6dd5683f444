"""Every yardstick of real sensors in one command, for methods and beside them for simple filters.

    python benchmarks/real_sensors.py [--shared DIR] [--methods facets,...] [--only board,ddrnet,...] [--frames N]
        [--filters] [--weights DIR] [--device cpu]

- ``board``: a stereo camera before an exact plane, means of the frames. Standard deviation about the plane in mm, the
  same 12 to 36 pixels inside the outline (blur across it shows there), the mean angle between the normals and the
  plane's in degrees, and the median stated error over the median error.
- ``ddrnet``: a structured-light camera, scored as ``metrics=sensor`` does: RMSE_v in 1/1000, angle, share of the
  pixels scored in %, RMSE_v against the truth smoothed by 2 pixels, and stated over true error.
- ``rgbdd``: a phone's time-of-flight map against another sensor's: RMSE_v, angle, stated over true error.
- ``floors``: the mean angle between the normals of a floor and their mean, before a phone and a stereo camera.
- ``phone``: a simulated phone, mean angle between normals.
- ``edges``: a simulated phone, at the truth's size, and two scenes of Middlebury 2014 before a simulated stereo camera:
  the mean and the 90th percentile (p90) of the distance in pixels from the result's depth boundaries to the truth's
  (``to``) and back (``from``), of :func:`dsr.metrics.boundaries.depth_boundary_error`. Holes are filled by the method,
  or from the nearest pixel, and results are clipped to the truth's range.
- ``creases``: the mean angle between normals where the truth's turn by more than 30 degrees within 6 pixels, the same
  on the rest, both away from depth steps, and the share of the creases in %: ``ddrnet``, and ICL-NUIM before a
  simulated structured-light camera.
- ``flicker``: still cameras, ICL-NUIM and Middlebury before simulated structured light and stereo, seven frames each:
  the mean standard deviation of a point's depth over frames, of the input in mm, and of the results as a fraction of
  that: of single frames, and of three and of five frames fused before the method, three successive results each; the
  mean of independent noise would have 0.38 and 0.23.
- ``stated``: stated over true error of simulated sensors of all kinds, by source and ratio: geometric means of it, and
  of the factor by which it is off, either way.
- ``clean``: box means of Lucy and Plant at x4 without noise, untold: RMSE_v in 1/1000.
- ``glass``: clear objects before a stereo camera, beside their painted twins: in the objects, the share of pixels off
  by more than 20 mm in %, the share of these stated to be off by less than 5 mm, and how well the stated error sorts
  pixels into these and the others (area under the curve; 0.5 is chance), the same of all pixels (``AUC_all``); and the
  share of the objects' pixels that ``--for robot`` leaves with such depth.
- ``clear``: the same for clear objects as trainings have them, in procedural scenes before a simulated stereo camera;
  means of the scenes in which it is defined.

Filters are OpenCV's bilateral filter of the map, enlarged by cubic interpolation where it is smaller than the photo:
window, standard deviation in metres, in pixels. A filter states no error.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import cv2
import numpy as np
import torch
import yaml
from captures import CAPTURES, Capture, ddrnet, ddrnet_frames, rgbdd_real, without_truth
from flatness import FLOORS, flatness, given
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import pad

from dsr.app.upsample.parts import Results
from dsr.data.cleargrasp import ClearGrasp
from dsr.data.icl import ICL
from dsr.data.middlebury import Middlebury
from dsr.data.rendered import Procedural
from dsr.data.stereo_board import StereoBoard
from dsr.degradation import noise as sensor_noise
from dsr.degradation import random_fields
from dsr.degradation.downsampling import scene_generator
from dsr.degradation.glass import add_glass
from dsr.degradation.noise import Kinect
from dsr.degradation.random_degradation import Everything
from dsr.degradation.random_fields import field_of, near_steps
from dsr.geometry.hole_size import window_maxima
from dsr.geometry.surface import angle_between, depth_to_normals
from dsr.inference import upsample_surface
from dsr.inference.defaults import Fill
from dsr.inference.sequences import View, fuse_views
from dsr.methods.base import Surface
from dsr.methods.classical.bilateral import filter_bilateral
from dsr.metrics import functional
from dsr.metrics.boundaries import depth_boundaries, depth_boundary_error
from dsr.metrics.calibration import OFF, off_auc, stated_ratio
from dsr.metrics.functional import SurfacePair
from dsr.metrics.sensor import LARGEST_ERROR, SensorComparison, board_errors, compare_board
from dsr.sample import DepthSample, Scene

FILTERS = ((19, 0.03, 3.0), (41, 0.05, 9.0), (81, 0.06, 18.0))
SURE = 0.005
"""Metres: pixels stated to be off by less are believed."""
CONF = Path(__file__).resolve().parent.parent / "conf"
PARTS = (
    "board", "ddrnet", "rgbdd", "floors", "phone", "edges", "creases", "flicker", "stated", "glass", "clear", "clean",
)  # fmt: skip
FILLED = ("edges",)
"""Parts that measure results whose holes are filled, as what is beside a hole has no boundary."""
CREASE, REACH, STEP = 30.0, 3, 0.02
"""Degrees by which normals differ across a crease, pixels to either side, and a depth step between neighbours."""
STILL, FUSED, HIDES = 7, (3, 5), 0.05
"""Frames of a still camera, how many are fused, and the range of a point's readings, over depth, of two surfaces."""
CLEAR = {"vessel": 0.75, "ball": 0.1, "box": 0.15}
"""Kinds of clear objects, those that are bodies, and their relative frequency."""
CLEAR_SCENES = 12
DRAWS = 2
"""Simulated sensors of each kind, of ``edges`` and ``flicker``."""
CLEAN = ("lucy_box", "plant_box")
Method = Callable[[DepthSample], Surface]


class Plane(NamedTuple):
    """A frame before the board: the sample, the plane's true depth, (1, H, W), and the board and its border."""

    sample: DepthSample
    depth: Tensor
    regions: Mapping[str, Tensor]


def boards(shared: Path, count: int | None) -> list[Plane]:
    """Return the frames before the board."""
    data, found = StereoBoard(str(shared / "real" / "stereo_board")), []
    for name in data.scenes()[:count]:
        scene = data.load(name)
        assert scene.depth is not None  # noqa: S101 - for the type checker
        sample = without_truth(name, scene.rgb, scene.measured[1], scene.camera)
        found.append(Plane(sample, scene.depth, scene.regions))
    return found


def score_board(frame: Plane, surface: Surface) -> dict[str, float]:
    """Score a result before the board."""
    maps = surface.depth[None].double(), frame.depth[None].double(), frame.sample.camera.rays()[None]
    board, border = (SurfacePair(*maps, frame.regions[each][None] > 0) for each in ("board", "border"))
    found = {
        "std": 1e3 * float(board_errors(board)["std"]),
        "edge": 1e3 * float(board_errors(border)["std"]),
        "angle": float(board_errors(board)["angle"]),
    }
    if surface.depth_error is not None:
        scored, off = compare_board(board)
        off = off.abs().masked_fill(~scored, torch.nan)[0]
        found["stated"] = float(stated_ratio(surface.depth_error, off))
    return found


def score_capture(capture: Capture, surface: Surface) -> dict[str, float]:
    """Score a result on a capture with a truth, and its stated errors after the median offset is taken off."""
    scores = capture.scores(surface.depth)
    assert scores is not None  # noqa: S101 - for the type checker
    found = {"RMSE_v": 1e3 * scores["RMSE_v"], "angle": scores["angle"], "covered": 100 * scores["covered"]}
    assert capture.truth is not None  # noqa: S101 - for the type checker
    if surface.depth_error is not None:
        off = (surface.depth - capture.truth.depth).double()
        off = (off - np.nanmedian(off)).abs()
        found["stated"] = float(stated_ratio(surface.depth_error, off.masked_fill(off >= LARGEST_ERROR, torch.nan)))
    return found


def smoothed(capture: Capture, deviation: float = 2.0) -> Capture:
    """Return a capture whose truth is smoothed by a masked Gaussian."""
    assert capture.truth is not None  # noqa: S101 - for the type checker
    truth = capture.truth._replace(depth=blurred(capture.truth.depth, deviation))
    return Capture(capture.sample, capture.windows, truth, capture.noisy, capture.measured, capture.keep_holes)


def blurred(depth: Tensor, deviation: float) -> Tensor:
    """Return depth, (1, H, W), smoothed by a masked Gaussian."""
    values = depth[0].double().numpy()
    known = np.isfinite(values)
    total, weight = (
        cv2.GaussianBlur(each, (0, 0), deviation) for each in (np.where(known, values, 0), known.astype(np.float64))
    )
    return torch.from_numpy(np.where(known, total / np.where(known, weight, 1), np.nan))[None]


class Glass(NamedTuple):
    """A capture of clear objects, the depth of their painted twins (1, H, W) in metres, and where they are."""

    sample: DepthSample
    twin: Tensor
    mask: Tensor


def glasses(shared: Path) -> list[Glass]:
    """Return the captures of clear objects."""
    data, found = ClearGrasp(str(shared / "real" / "cleargrasp"), synthetic=False), []
    for name in data.scenes():
        scene = data.load(name)
        assert scene.depth is not None  # noqa: S101 - for the type checker
        sample = without_truth(name, scene.rgb, scene.measured[1], scene.camera)
        found.append(Glass(sample, scene.depth, scene.regions["glass"] > 0))
    return found


def clear_objects(count: int | None) -> list[Glass]:
    """Return procedural scenes with clear objects, before a simulated stereo camera."""
    source, found = Procedural(CLEAR_SCENES, seed=77), []
    for number, name in enumerate(source.scenes()[:count]):
        scene, generator = source.load(name), torch.Generator().manual_seed(number)
        full, seen = add_glass(scene, generator, CLEAR)
        assert full.depth is not None  # noqa: S101 - for the type checker
        rgb = full.rgb.float()
        inverse = sensor_noise.NOISES["stereo"](seen.float().reciprocal(), rgb.mean(dim=0, keepdim=True), generator)
        depth = (1e3 / inverse).round() / 1e3
        sample = without_truth(name, rgb, depth.masked_fill(~(depth > 0) | depth.isinf(), torch.nan), scene.camera)
        found.append(Glass(sample, full.depth, full.depth.ne(torch.as_tensor(scene.depth))))
    return found


def score_glass(scene: Glass, surface: Surface) -> dict[str, float]:
    """Score a result in the clear objects."""
    inside = scene.mask & scene.twin.isfinite() & surface.depth.isfinite()
    off = (surface.depth - scene.twin).abs()
    wrong = inside & (off > OFF)
    found = {"wrong": 100 * float(wrong[inside].double().mean())}
    if surface.depth_error is not None:
        error = surface.depth_error
        found["believed"] = 100 * float((error[wrong] < SURE).double().mean())
        found["AUC"] = float(off_auc(error[inside], off[inside], OFF))
        found["AUC_all"] = float(off_auc(error, off, OFF))
        left = wrong & surface.without_dubious(Results.max_error / 100).depth.isfinite()
        found["robot"] = 100 * float(left.sum() / (scene.mask & scene.twin.isfinite()).sum())
    return found


def angles_of_floors(shared: Path, method: Method) -> dict[str, float]:
    """Return how flat floors are, by name."""
    captures_of = {name: CAPTURES[name](shared) for name in FLOORS}
    return {
        name: flatness(method(each.sample).depth, each.sample.camera, FLOORS[name])
        for name, each in captures_of.items()
    }


def scores_of_clean(shared: Path, method: Method) -> dict[str, float]:
    """Return RMSE_v of maps without noise, by name."""
    found = {}
    for name in CLEAN:
        capture = CAPTURES[name](shared)
        scores = capture.scores(method(capture.sample).depth)
        assert scores is not None  # noqa: S101 - for the type checker
        found[name] = 1e3 * scores["RMSE_v"]
    return found


def with_weights(folder: Path) -> str:
    """Add a method, facets with the weights of a folder, to ``folder/method``, and return its name."""
    node = yaml.safe_load((CONF / "method" / "facets.yaml").read_text())
    weights = node["method"]["weights"]
    weights["packaged"] = {str(folder.resolve() / name): factor for name, factor in weights["packaged"].items()}
    (folder / "method").mkdir(exist_ok=True)
    (folder / "method" / "trained.yaml").write_text(f"# @package _global_\n{yaml.safe_dump(node)}")
    return "trained"


def angle_of_phone(shared: Path, method: Method) -> dict[str, float]:
    """Return the score of the simulated phone."""
    capture = CAPTURES["simulated_phone"](shared)
    scores = capture.scores(method(capture.sample).depth)
    assert scores is not None  # noqa: S101 - for the type checker
    return {"angle": scores["angle"]}


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


def filled(depth: Tensor) -> Tensor:
    """Return depth, (1, H, W), with the nearest known value in each hole."""
    places = distance_transform_edt(~depth[0].isfinite().numpy(), return_distances=False, return_indices=True)
    return depth[:, places[0], places[1]]


def score_edges(result: Tensor, truth: Tensor) -> dict[str, float]:
    """Score where the depth boundaries of a result are; where the truth, (1, H, W), is unknown, neither has any."""
    known = truth.isfinite()
    height, width = truth.shape[-2:]
    resized = cv2.resize(filled(result)[0].double().numpy(), (width, height), interpolation=cv2.INTER_AREA)
    shown = torch.from_numpy(resized)[None].clamp(truth[known].min(), truth[known].max()).masked_fill(~known, torch.nan)
    both = depth_boundaries(shown[None]), depth_boundaries(truth[None])
    (to, back), (far_to, far_back) = (depth_boundary_error(*both, quantile) for quantile in (None, 0.9))
    return {"to": float(to), "to_p90": float(far_to), "from": float(back), "from_p90": float(far_back)}


def scores_of_edges(shared: Path, method: Method, count: int | None) -> dict[str, float]:
    """Return the distances of depth boundaries, by source."""
    phone = CAPTURES["simulated_phone"](shared)
    assert phone.truth is not None  # noqa: S101 - for the type checker
    rows = {"phone": [score_edges(method(phone.sample).depth, phone.truth.depth)], "stereo": []}
    for scene in middlebury(shared, "motorcycle", "playroom")[:count]:
        assert scene.depth is not None  # noqa: S101 - for the type checker
        samples = [simulated(scene, "stereo", draw=draw) for draw in range(DRAWS)]
        rows["stereo"] += [score_edges(method(each).depth, scene.depth) for each in samples]
    return by_source(rows)


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


def score_creases(result: Tensor, truth: Tensor, rays: Tensor, *, measured: bool) -> dict[str, float]:
    """Score normals at creases and elsewhere; for a measured truth as :mod:`dsr.metrics.sensor` compares them."""
    pair = SurfacePair(result[None].double(), truth[None].double(), rays[None])
    if measured:
        comparison = SensorComparison(pair)
        off = functional.angle(comparison.surfaces).masked_fill(~comparison.scored, torch.nan)[0]
    else:
        off = angle_between(*(depth_to_normals(each[None].double(), rays[None]) for each in (result, truth)))[0]
    creases, rest = find_creases(truth.double(), rays)
    share = 100 * float(creases.sum() / truth.isfinite().sum())
    return {"crease": float(off[creases].nanmean()), "rest": float(off[rest].nanmean()), "share": share}


def scores_of_creases(shared: Path, method: Method, count: int | None) -> dict[str, float]:
    """Return the angles at creases and elsewhere, by source."""
    rows: dict[str, list[dict[str, float]]] = {"ddrnet": [], "icl": []}
    for name in ddrnet_frames(shared).scenes()[:count]:
        capture = ddrnet(name, (), shared)
        assert capture.truth is not None  # noqa: S101 - for the type checker
        truth = capture.truth
        result = method(capture.sample).depth
        rows["ddrnet"].append(score_creases(result, truth.depth, truth.camera.rays(), measured=True))
    for scene in icl(shared)[:count]:
        assert scene.depth is not None  # noqa: S101 - for the type checker
        seen = Kinect()(scene.depth, scene_generator(0, scene.name)).float()
        result = method(without_truth(scene.name, scene.rgb, seen, scene.camera)).depth
        rows["icl"].append(score_creases(result, scene.depth, scene.camera.rays(), measured=False))
    return by_source(rows)


def still(scene: Scene, kind: str, draw: int) -> Iterator[DepthSample]:
    """Yield the frames of a still camera: one sensor, whose constants are drawn once, and new fields of noise."""
    for frame in range(STILL):
        fresh = scene_generator(draw, scene.name, kind, "frame", frame)

        def anew(like: Tensor, sigma: float | tuple[float, float], _: object, fresh: torch.Generator = fresh) -> Tensor:
            return field_of(like, sigma, fresh)

        with patch.object(random_fields, "field_of", anew), patch.object(sensor_noise, "field_of", anew):
            yield simulated(scene, kind, draw=draw)


def score_flicker(frames: Sequence[DepthSample], method: Method) -> dict[str, float]:
    """Score how still the results of a still camera are, see the module; mm is that of the input."""
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


def scores_of_flicker(shared: Path, method: Method, count: int | None) -> dict[str, float]:
    """Return the flicker of still cameras, by kind of noise, as geometric means."""
    scenes = [icl(shared)[0], *middlebury(shared, "piano")][:count]
    rows = {
        kind: [score_flicker(list(still(each, kind, draw)), method) for each in scenes for draw in range(DRAWS)]
        for kind in ("structured", "stereo")
    }
    return by_source(rows, geometric=True)


def scores_of_stated(shared: Path, method: Method, count: int | None) -> dict[str, float]:
    """Return stated over true errors, by source and ratio, as geometric means; none of a method that states none."""
    random_scenes = Procedural(3, seed=1)
    sources = {
        "middlebury": middlebury(shared, "motorcycle", "playroom"),
        "icl": icl(shared),
        "procedural": [random_scenes.load(name) for name in random_scenes.scenes()],
    }
    rows: dict[str, list[dict[str, float]]] = {}
    for name, scenes in sources.items():
        for scale in (1, 4):
            found = rows.setdefault(f"{name}_x{scale}", [])
            for sample in (simulated(each, kind, scale) for each in scenes[:count] for kind in sensor_noise.NOISES):
                surface = method(sample)
                if surface.depth_error is None:
                    return {}
                assert sample.depth is not None  # noqa: S101 - for the type checker
                ratio = float(stated_ratio(surface.depth_error, (surface.depth - sample.depth).abs()))
                found.append({"": ratio, "off": max(ratio, 1 / ratio)})
    return by_source(rows, geometric=True)


def by_source(rows: Mapping[str, Sequence[dict[str, float]]], *, geometric: bool = False) -> dict[str, float]:
    """Return the means of each source's rows, with its name before theirs."""
    found = {}
    for source, each in rows.items():
        logs = [{key: float(np.log(value)) for key, value in row.items()} for row in each] if geometric else each
        for key, value in (mean(logs) if logs else {}).items():
            found[f"{source}_{key}".rstrip("_")] = float(np.exp(value)) if geometric else value
    return found


def measure(part: str, method: Method, shared: Path, count: int | None) -> dict[str, float]:
    """Return the scores of a method in one part, means over its frames."""
    if part == "board":
        return mean([score_board(each, method(each.sample)) for each in boards(shared, count)])
    if part == "ddrnet":
        rows = []
        for name in ddrnet_frames(shared).scenes()[:count]:
            capture = ddrnet(name, (), shared)
            surface = method(capture.sample)
            again = score_capture(smoothed(capture), surface)
            rows.append({**score_capture(capture, surface), "smoothed": again["RMSE_v"]})
        return mean(rows)
    if part == "rgbdd":
        names = sorted(path.stem.partition("_")[0] for path in (shared / "real" / "rgbdd_real" / "RGB").iterdir())
        captures = [rgbdd_real(name, (), shared) for name in names[:count]]
        return mean([score_capture(each, method(each.sample)) for each in captures])
    whole = {"floors": angles_of_floors, "phone": angle_of_phone, "clean": scores_of_clean}
    if part in whole:
        return whole[part](shared, method)
    some = {
        "edges": scores_of_edges, "creases": scores_of_creases, "flicker": scores_of_flicker,
        "stated": scores_of_stated,
    }  # fmt: skip
    if part in some:
        return some[part](shared, method, count)
    scenes = clear_objects(count) if part == "clear" else glasses(shared)[:count]
    return mean([score_glass(each, method(each.sample)) for each in scenes])


def mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the means of rows with the same keys, where they are defined."""
    return {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}


def filtered(sample: DepthSample, window: int, of_depth: float, of_place: float) -> Surface:
    """Return OpenCV's bilateral filter of a map."""
    enlarged = given(Capture(sample, ()))
    return Surface(filter_bilateral(enlarged, window, of_depth, of_place), None, None, None)


def upsampled(sample: DepthSample, name: str, device: str, weights: Path | None = None, fill: Fill = "none") -> Surface:
    """Return what ``dsr upsample`` computes, for a method of :func:`with_weights` with those of its folder."""
    return upsample_surface(
        sample.rgb, sample.depth_lr, sample.camera, method=name, directories=(weights,) if weights else (),
        device=device, fill=fill,
    )  # fmt: skip


def main() -> None:
    """Measure and print a row for each part and method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--methods", default="facets")
    parser.add_argument(
        "--weights", type=Path, help="folder of weights for facets, in place of methods: facets_x2.safetensors, ..."
    )
    parser.add_argument("--only", default=",".join(PARTS), help="parts to measure; all are the default")
    parser.add_argument("--frames", type=int, help="number of frames of each part; all are the default")
    parser.add_argument("--filters", action="store_true", help="measure the filters, too")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    methods: dict[str, Method] = {"input": lambda sample: Surface(given(Capture(sample, ())), None, None, None)}
    if options.filters:
        for each in FILTERS:
            methods[f"bilateral {each}"] = lambda sample, each=each: filtered(sample, *each)  # type: ignore[misc]
    names = [with_weights(options.weights)] if options.weights else options.methods.split(",")
    for part in options.only.split(","):
        fill = "all" if part in FILLED else "none"
        for name in filter(None, names):
            methods[name] = lambda sample, name=name, fill=fill: upsampled(  # type: ignore[misc]
                sample, name, options.device, options.weights, fill
            )
        for label, method in methods.items():
            scores = measure(part, method, options.shared, options.frames)
            if not scores:
                continue
            print(f"{part:<8} {label:<24} " + "  ".join(f"{k} {v:.4g}" for k, v in scores.items()), flush=True)


if __name__ == "__main__":
    main()
