"""One network on every kind of map: clean and noisy ones, other kernels, real sensors, a simulated phone, the field's.

    python benchmarks/any_map.py --shared DIR WEIGHTS... [--parts clean,kernels,noise,sensor,phone,field]
        [--hints] [--device cpu]

``WEIGHTS`` are of trainings of ``model=facets``. Figures with _v are in 1/1000, DSSIM_v and LPIPS_v of the worst light;
one pass without augmentation. ``--hints`` gives the network what ``eval.py`` gives, the kernel and that there is no
noise, where that holds, and ``edges=soft`` on the field's benchmarks.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch

from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.eight_bit import EightBit
from dsr.data.folder import Folder
from dsr.data.frame_files import read_picture
from dsr.data.icl import ICL
from dsr.data.rendered import SimGeo
from dsr.data.rgbdd import RGBDD
from dsr.data.scene_source import SceneSource
from dsr.degradation.downsampling import Downsampling, Kernel, Measured, make_sample
from dsr.degradation.noise import GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.geometry.camera import Camera, RangeType
from dsr.geometry.surface import angle_between, depth_to_normals
from dsr.methods.networks.facets_method import AnyMap, Edges
from dsr.methods.networks.weight_files import read_header
from dsr.metrics.catalogue import PROTOCOLS, score_image
from dsr.metrics.formats import WORST
from dsr.sample import DepthSample

SCALES = [4, 8]
PAPER = tuple(metric for metric in PROTOCOLS["paper"] if not metric.perceptual)


class Runner:
    """The method with the weights that suit a map, with the hints that ``eval.py`` gives."""

    def __init__(self, weights: list[Path], *, hints: bool, device: str) -> None:
        self.device = device
        self.hints, self.files = hints, {read_header(path)["arguments"]["scale"]: path for path in weights}
        self.scales = [scale for scale in SCALES if scale in self.files]

    def __call__(
        self, sample: DepthSample, kernel: Any = None, *, soft: bool = False, clean: bool = False
    ) -> torch.Tensor:
        """Return the high-resolution depth, (1, H, W)."""
        weights = self.files[min(scale for scale in self.files if 1.05 * scale >= sample.scale)]
        facts = (kernel, "soft" if soft else "sharp", clean) if self.hints else ()
        return self._method(weights, self.device, *facts)(sample)

    @staticmethod
    @functools.cache
    def _method(weights: Path, device: str, kernel: Any = None, edges: Edges = "auto", clean: bool = False) -> AnyMap:
        """Return the method with these facts."""
        return AnyMap(weights, edges=edges, kernel=kernel, clean=clean, device=device)


def scores(depth: torch.Tensor, sample: DepthSample, metrics: Any = PAPER) -> dict[str, float]:
    """Return the worst-of-four scores."""
    assert sample.depth is not None  # noqa: S101 - for the type checker
    rows = score_image(depth.double(), sample.depth.double(), sample.camera.rays(), metrics, unit=sample.unit)
    return {row.metric: row.value for row in rows if row.variant in ("", WORST)}


def show(name: str, found: dict[str, float]) -> None:
    """Print the main figures."""
    rmse, dssim, depth = 1e3 * found["RMSE_v"], 1e3 * found["DSSIM_v"], 1e3 * found["RMSE_d"]
    print(f"{name:<36} RMSE_v {rmse:6.1f}  DSSIM_v {dssim:6.1f}  RMSE_d {depth:6.2f}", flush=True)


def clean(run: Runner, shared: Path) -> None:
    expected = json.loads((shared / "expected" / "metrics.json").read_text())
    means = []
    for scale in run.scales:
        for name in ("lucy", "plant"):
            sample = make_sample(
                Folder(str(shared / "scenes"), [name]).load(name), scale, Downsampling("box"), "disparity"
            )
            found = scores(run(sample, "box", clean=True), sample)
            theirs = expected[name][f"x{scale}"]["MSG-V"]
            ratios = {
                key: found[key] / (max(theirs[key]) if isinstance(theirs[key], list) else theirs[key])
                for key in ("RMSE_v", "DSSIM_v", "BadPix_v_5", "Bumpiness_d")
            }
            means.append(np.mean(list(ratios.values())))
            show(f"clean box {name} x{scale}", found)
            print("   of the published MSG-V:", "  ".join(f"{key} {value:.3f}" for key, value in ratios.items()))
    print(f"clean: mean of the ratios {np.mean(means):.3f} (without LPIPS_v)")


def kernels(run: Runner, shared: Path) -> None:
    for scale in run.scales:
        for name in ("lucy", "plant"):
            scene = Folder(str(shared / "scenes"), [name]).load(name)
            found = {}
            for kernel in get_args(Kernel):
                sample = make_sample(scene, scale, Downsampling(kernel), "disparity")
                found[kernel] = 1e3 * scores(run(sample, kernel, clean=True), sample)["RMSE_v"]
            worst = max(found.values()) / found["box"]
            print(
                f"kernels {name} x{scale}:", "  ".join(f"{k} {v:.1f}" for k, v in found.items()), f" worst {worst:.2f}"
            )


def noise(run: Runner, shared: Path) -> None:
    for name in ("lucy", "plant"):
        scene = Folder(str(shared / "scenes"), [name]).load(name)
        sample = make_sample(scene, 4, Downsampling("box"), "disparity", GaussianMultiplicative(0.003))
        show(f"multiplicative .003 {name} x4", scores(run(sample, "box"), sample))
    sources: tuple[SceneSource, ...] = (ICL(str(shared / "real" / "icl_nuim"), "found"), SimGeo())
    for source in sources:
        for kind in (Kinect(), TimeOfFlight()):
            rows = []
            for name in source.scenes():
                sample = make_sample(source.load(name), 4, Downsampling("box"), "disparity", kind)
                rows.append(scores(run(sample, "box"), sample))
                if source.name == "icl":
                    show(f"{type(kind).__name__} {name} x4", rows[-1])
            show(f"{type(kind).__name__} {source.name} x4", {k: float(np.mean([r[k] for r in rows])) for k in rows[0]})


def sensor(run: Runner, shared: Path) -> None:
    for source, scale in ((DDRNetFrames(str(shared / "real" / "ddrnet"), "found"), 1),):
        rows = []
        for name in source.scenes():
            sample = make_sample(source.load(name), scale, Measured(), "disparity")
            rows.append(scores(run(sample), sample, PROTOCOLS["sensor"]))
        mean = {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}
        print(f"{source.name}:", "  ".join(f"{key} {value:.4g}" for key, value in mean.items()), flush=True)


def phone(run: Runner, shared: Path) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        subprocess.run([sys.executable, str(shared / "simulate_phone.py"), place], check=True)  # noqa: S603
        photo = read_picture(folder / "photo.jpg")
        depth, truth = np.load(folder / "depth.npy"), np.load(folder / "truth.npy")
        camera = Camera(1920, 1440, 3 * 481.2, 3 * 481.2, 3 * 320 - 0.5, 3 * 240 - 0.5)
        given = torch.from_numpy(depth)[None].double()
        sample = DepthSample("phone", "phone", photo, given, camera, camera.rescale(256, 192), 7.5)
        found = run(sample)[0].numpy()
        small = torch.from_numpy(cv2.resize(found, (640, 480), interpolation=cv2.INTER_AREA))[None].double()
        rays = Camera(640, 480, 481.2, 481.2, 319.5, 239.5).rays()
        a, b = (depth_to_normals(each[None], rays[None]) for each in (small, torch.from_numpy(truth)[None].double()))
        print(f"phone: mean angle {float(angle_between(a, b).nanmean()):.2f} degrees", flush=True)


def field(run: Runner, shared: Path) -> None:
    modern = shared / "modern"
    sources: tuple[tuple[SceneSource, RangeType], ...] = (
        (EightBit(str(modern / "Middlebury"), "middlebury8", "found"), "disparity"),
        (EightBit(str(modern / "Lu"), "lu", "found"), "disparity"),
        (RGBDD(str(modern / "RGBDD"), False, scenes="found"), "orthogonal"),
    )
    for source, kind in sources:
        for scale in run.scales:
            rows = []
            for name in source.scenes():
                sample = make_sample(source.load(name), scale, Downsampling("bicubic", range_type=kind), "disparity")
                found = scores(run(sample, "bicubic", soft=True, clean=True), sample, PROTOCOLS["field"])
                rows.append(found)
            print(
                f"{source.name} x{scale}:", {key: round(float(np.mean([r[key] for r in rows])), 4) for key in rows[0]}
            )


def main() -> None:
    """Measure and print."""
    parts = {"clean": clean, "kernels": kernels, "noise": noise, "sensor": sensor, "phone": phone, "field": field}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, nargs="+")
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--parts", default=",".join(parts))
    parser.add_argument("--scales", default="4,8")
    parser.add_argument("--hints", action="store_true")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    SCALES[:] = map(int, arguments.scales.split(","))
    run = Runner(arguments.weights, hints=arguments.hints, device=arguments.device)
    for part in arguments.parts.split(","):
        parts[part](run, arguments.shared)


if __name__ == "__main__":
    main()
