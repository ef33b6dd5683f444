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
- ``clean``: box means of Lucy and Plant at x4 without noise, untold: RMSE_v in 1/1000.
- ``glass``: clear objects before a stereo camera, beside their painted twins: in the objects, the share of pixels off
  by more than 20 mm in %, the share of these stated to be off by less than 5 mm, and how well the stated error sorts
  pixels into these and the others (area under the curve; 0.5 is chance).

Filters are OpenCV's bilateral filter of the map, enlarged by cubic interpolation where it is smaller than the photo:
window, standard deviation in metres, in pixels. A filter states no error.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import yaml
from captures import CAPTURES, Capture, ddrnet, ddrnet_frames, rgbdd_real, without_truth
from flatness import FLOORS, flatness, given
from torch import Tensor

from dsr.data.cleargrasp import ClearGrasp
from dsr.data.stereo_board import StereoBoard
from dsr.inference import upsample_surface
from dsr.methods.base import Surface
from dsr.methods.classical.bilateral import filter_bilateral
from dsr.metrics.calibration import OFF, off_auc, stated_ratio
from dsr.metrics.functional import SurfacePair
from dsr.metrics.plane import PlaneComparison, angle, deviation
from dsr.metrics.sensor import LARGEST_ERROR
from dsr.sample import DepthSample

FILTERS = ((19, 0.03, 3.0), (41, 0.05, 9.0), (81, 0.06, 18.0))
SURE = 0.005
"""Metres: pixels stated to be off by less are believed."""
CONF = Path(__file__).resolve().parent.parent / "conf"
PARTS = ("board", "ddrnet", "rgbdd", "floors", "phone", "glass", "clean")
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
    found = {"std": 1e3 * float(deviation(board)), "edge": 1e3 * float(deviation(border)), "angle": float(angle(board))}
    if surface.depth_error is not None:
        comparison = board.derive(PlaneComparison)
        off = comparison.off.abs().masked_fill(~comparison.scored, torch.nan)[0]
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
    depth = capture.truth.depth[0].double().numpy()
    known = np.isfinite(depth)
    total, weight = (
        cv2.GaussianBlur(each, (0, 0), deviation) for each in (np.where(known, depth, 0), known.astype(np.float64))
    )
    blurred = np.where(known, total / np.where(known, weight, 1), np.nan)
    truth = capture.truth._replace(depth=torch.from_numpy(blurred)[None])
    return Capture(capture.sample, capture.windows, truth, capture.noisy, capture.measured, capture.keep_holes)


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


def score_glass(scene: Glass, surface: Surface) -> dict[str, float]:
    """Score a result in the clear objects."""
    inside = scene.mask & scene.twin.isfinite() & surface.depth.isfinite()
    off = (surface.depth - scene.twin).abs()[inside]
    wrong = off > OFF
    found = {"wrong": 100 * float(wrong.double().mean())}
    if surface.depth_error is not None:
        error = surface.depth_error[inside]
        found["believed"] = 100 * float((error[wrong] < SURE).double().mean())
        found["AUC"] = float(off_auc(error, off, OFF))
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
    return mean([score_glass(each, method(each.sample)) for each in glasses(shared)[:count]])


def mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the means of rows with the same keys."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def filtered(sample: DepthSample, window: int, of_depth: float, of_place: float) -> Surface:
    """Return OpenCV's bilateral filter of a map."""
    enlarged = given(Capture(sample, ()))
    return Surface(filter_bilateral(enlarged, window, of_depth, of_place), None, None, None)


def upsampled(sample: DepthSample, name: str, device: str, weights: Path | None = None) -> Surface:
    """Return what ``dsr upsample`` computes, for a method of :func:`with_weights` with those of its folder."""
    return upsample_surface(
        sample.rgb, sample.depth_lr, sample.camera, method=name, directories=(weights,) if weights else (),
        device=device, fill="none",
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
    for name in filter(None, names):
        methods[name] = lambda sample, name=name: upsampled(sample, name, options.device, options.weights)  # type: ignore[misc]
    for part in options.only.split(","):
        for label, method in methods.items():
            scores = measure(part, method, options.shared, options.frames)
            print(f"{part:<8} {label:<24} " + "  ".join(f"{k} {v:.4g}" for k, v in scores.items()), flush=True)


if __name__ == "__main__":
    main()
