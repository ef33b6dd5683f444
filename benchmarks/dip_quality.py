"""What the choices behind DIP and DIP-V are worth, measured on crops of the paper's scenes.

    python benchmarks/dip_quality.py ablation --scenes DIR [--steps 500] [--only NAME ...]
    python benchmarks/dip_quality.py stopping --scenes DIR [--steps 1500]
    python benchmarks/dip_quality.py warm     --scenes DIR [--steps 500]

``ablation``: rows 64:320, columns 128:384 of Lucy at x4, from the reference experiment to the defaults, one choice
after the other, and single choices changed. ``stopping``: what each rule would have kept, of one and the same
optimisation. ``warm``: how scores fall from a trained network's answer on, and from scratch.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.noise import GaussianMultiplicative
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.dip.problem import ImageProblem
from dsr.methods.dip.stopping import Fixed, Residual, Stopping, Variance
from dsr.methods.dip.upsampler import DeepImagePrior, WarmStarted
from dsr.methods.networks.weight_choice import packaged_weights
from dsr.metrics.classes import visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import DepthSample, Scene
from dsr.utils.compute_device import fast_precision

BOX = Downsampling("box")
NAMES = ("RMSE_d", "DSSIM_v", "RMSE_v", "BadPix_v_5")
DIP = {"data_loss": "mse", "data_weight": 10.0, "w": 0.0}
ORIGINAL = {
    "widths": (128,) * 5, "padding": "reflect", "border": 0, "guide": False, "perturbation": 0.03, "w_intensity": 0.1,
}  # fmt: skip
"""The reference experiment, but for the losses, which count as shares of the low-resolution map's range."""
NARROW = {"widths": (32, 64, 128, 128, 128), "padding": "zeros"}
ABLATION: Mapping[str, Mapping[str, Any]] = {
    "dip: reference": {**ORIGINAL, **DIP},
    "dip": DIP,
    "dip_v: reference": ORIGINAL,
    "  narrow at full resolution, zeros at borders": {**ORIGINAL, **NARROW},
    "  and the photo as input": {**ORIGINAL, **NARROW, "guide": True, "guide_perturbation": 0.0},
    "  and perturbation 0.1": {"border": 0, "w_intensity": 0.1, "guide_perturbation": 0.0},
    "  and of the photo 0.05": {"border": 0, "w_intensity": 0.1},
    "  and w_I 0.01": {"border": 0},
    "dip_v: and a border of 8": {},
    "  w = 0": {"w": 0.0},
    "  w = 3": {"w": 3.0},
    "  w_I = 0": {"w_intensity": 0.0},
    "  learning rate 0.02": {"learning_rate": 0.02},
    "  16, 32, 64, 128, 128 channels": {"widths": (16, 32, 64, 128, 128)},
    "  seed 1": {"seed": 1},
    "  seed 2": {"seed": 2},
    "  border 16": {"border": 16},
    "  perturbation 0.2": {"perturbation": 0.2},
}


def crop(scenes: Path, name: str, rows: tuple[int, int], columns: tuple[int, int]) -> Scene:
    """Return a square window of a scene, as a data set of its own: random numbers follow from its name."""
    (top, bottom), (left, right) = rows, columns
    return replace(Folder(str(scenes), [name]).load(name).crop(top, left, bottom - top, right - left), dataset="crop")


def scores_of(depth: Tensor, sample: DepthSample) -> dict[str, float]:
    """Return the scores of a result."""
    metrics, truth = visual_metrics(), sample.depth
    if truth is not None:
        metrics.update(SurfacePair(depth[None].double(), truth[None].double(), sample.camera.rays()[None]))
    return {name: float(value) for name, value in metrics.compute().items()}


def optimise(sample: DepthSample, every: int, device: torch.device, **settings: Any) -> dict[int, dict[str, float]]:
    """Return the scores of the running average at every validation."""
    kind = WarmStarted if "weights" in settings else DeepImagePrior
    with tempfile.TemporaryDirectory() as folder:
        prior = kind(
            scale=sample.scale,
            downsampling=BOX,
            precision=fast_precision(device),  # type: ignore[arg-type]
            device=device,
            validate_every=every,
            metrics=visual_metrics,
            workspace=Path(folder),
            **settings,
        )
        prior(sample)
        found: dict[int, dict[str, float]] = {}
        with next(Path(folder).rglob("validation.csv")).open(newline="") as file:
            for row in csv.DictReader(file):
                found.setdefault(int(row["step"]), {})[row["metric"]] = float(row["value"])
        return found


def line(name: str, values: Mapping[str, float]) -> str:
    """Return a row of a table."""
    return f"| {name} | " + " | ".join(
        f"{1000 * values[each]:.1f}" if each == "RMSE_d" else f"{values[each]:.3f}" for each in NAMES
    ) + " |"  # fmt: skip


def ablation(options: argparse.Namespace) -> None:
    """Print the table of the crop experiment."""
    sample = make_sample(crop(options.scenes, "lucy", (64, 320), (128, 384)), 4, BOX, "orthogonal")
    print(line("bicubic", scores_of(Interpolation("bicubic")(sample), sample)), flush=True)
    for name, settings in ABLATION.items():
        if not options.only or name.strip() in options.only:
            found = optimise(sample, options.steps, options.device, steps=options.steps, **settings)
            print(line(name, found[options.steps]), flush=True)


class Watched(DeepImagePrior):
    """An optimisation that notes what each stopping rule would have kept."""

    watch: Watch

    def _rule(self, problem: ImageProblem) -> Stopping:
        self.watch = Watch(problem, self.patience)
        return self.watch


class Watch(Fixed):
    """All rules at once, none of which stops."""

    def __init__(self, problem: ImageProblem, patience: int) -> None:
        self.rules = {
            "variance": Variance(problem.grey, patience),
            "residual": Residual(problem.depth_lr, problem.residual),
        }
        self.stopped: dict[str, tuple[int, Tensor]] = {}
        self.passes: list[tuple[float, Tensor]] = []

    def observe(self, step: int, depth: Tensor, average: Tensor) -> bool:
        """Ask each rule that has not stopped yet."""
        for name, rule in self.rules.items():
            if name not in self.stopped and rule.observe(step, depth, average):
                self.stopped[name] = (step, rule.result(average).clone())
        return False

    def judge(self, score: float, average: Tensor) -> None:
        """Keep it for the oracle."""
        self.passes.append((score, average.clone()))


def stopping(options: argparse.Namespace) -> None:
    """Print what each rule keeps, on clean and noisy input."""
    for scene, rows, columns in (("lucy", (96, 288), (160, 352)), ("plant", (160, 352), (160, 352))):
        whole = crop(options.scenes, scene, rows, columns)
        for std in (0.0, 0.003, 0.01):
            noise = GaussianMultiplicative(std) if std else None
            sample = make_sample(whole, 4, BOX, "orthogonal", noise)
            for method, loss in (("dip", DIP), ("dip_v", {})):
                prior = Watched(
                    scale=4, downsampling=BOX, steps=options.steps, validate_every=50, patience=options.patience,
                    device=options.device, precision=fast_precision(options.device), **loss,  # type: ignore[arg-type]
                )  # fmt: skip
                final, watch = prior(sample), prior.watch
                kept = {"fixed": (options.steps, final[None])} | watch.stopped
                best = min(range(len(watch.passes)), key=lambda i: watch.passes[i][0])
                kept["oracle"] = ((best + 1) * 50, watch.passes[best][1])
                for rule, (step, depth) in kept.items():
                    title = f"{scene}, noise {std:g}, {method}, {rule}, {step}"
                    print(line(title, scores_of(depth[0], sample)), flush=True)


def warm(options: argparse.Namespace) -> None:
    """Print the scores of the steps from a trained network's answer, and from scratch."""
    for scene, rows, columns in (("lucy", (64, 320), (128, 384)), ("plant", (128, 384), (128, 384))):
        sample = make_sample(crop(options.scenes, scene, rows, columns), 4, BOX, "orthogonal")
        for model in (None, "msg_v", "facets"):
            given = {} if model is None else {"model": model, "weights": packaged_weights(f"{model}_x4")}
            if given:
                start = WarmStarted(scale=4, downsampling=BOX, steps=1, **given).base(sample)  # type: ignore[arg-type]
                print(line(f"{scene}, {model}, 0", scores_of(start, sample)), flush=True)
            every = options.steps // 10
            found = optimise(sample, every, options.device, steps=options.steps, **given)
            for step, values in found.items():
                print(line(f"{scene}, {model or 'from scratch'}, {step}", values), flush=True)


def main() -> None:
    """Read the arguments, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=("ablation", "stopping", "warm"))
    default = os.environ.get("DSR_SCENES")
    parser.add_argument("--scenes", type=Path, default=default, required=default is None)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--patience", type=int, default=200)
    parser.add_argument("--only", nargs="*", help="names of the ablation's rows")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", type=torch.device, default="cpu")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print("| | " + " | ".join(("RMSE_d, mm", *NAMES[1:])) + " |\n" + "| --- " * (len(NAMES) + 1) + "|")
    {"ablation": ablation, "stopping": stopping, "warm": warm}[options.study](options)


if __name__ == "__main__":
    main()
