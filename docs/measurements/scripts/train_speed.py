# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How much faster a training step of MSG-V is than in a plain float32 loop, data included; and where its time goes.

    python docs/measurements/scripts/train_speed.py [--patch 96] [--batch 5] [--steps 9] [--device cuda]
    python docs/measurements/scripts/train_speed.py --profile [--steps 40] [--device cuda] [model=facets degradation=everything ...]

With --profile a training as train.py does it, with its log and checks, is timed: the network and its losses forward and
backward, the patches, the optimiser, and everything else. Other arguments are overrides of train.py's configuration.

The plain way is what a tutorial would write: float32, PyTorch's default memory layout, its own PReLU. Both take turns
within the run on the same patches; the ratio of the medians is the result.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
import torch
from lightning.pytorch.callbacks import Callback
from torch import nn

from dsr.app.schema import TrainConfig, plain_config, register
from dsr.app.train import _Training, find_processes
from dsr.data.rendered import SimGeo
from dsr.degradation.downsampling import Downsampling
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import Answer
from dsr.training.degradation import Batch, Degradation
from dsr.training.objective import DepthObjective, Objective
from dsr.training.patches import Patches
from dsr.training.settings import PatchSettings
from dsr.utils.checkpoints import BestCheckpoint
from dsr.utils.checkpoints import fit

SCALE = 4


class PlainPReLU(nn.PReLU):
    """The library's own, which MSG-Net would replace on the CPU."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return prelu(x) by way of a slope per channel."""
        return nn.functional.prelu(x, self.weight.expand(x.shape[1]))


def plain(net: MSGNet) -> MSGNet:
    """Return a copy without any measure for speed."""
    net = copy.deepcopy(net).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    for layer in net.modules():
        if hasattr(layer, "activation") and isinstance(layer.activation, nn.PReLU):
            layer.activation = nn.Sequential(PlainPReLU())
    return net


def step(net: MSGNet, objective: Objective, batch: Batch, *, mixed: bool) -> float:
    """Do forward, loss and backward; return the seconds."""
    start = time.perf_counter()
    with torch.autocast(batch["rgb"].device.type, torch.bfloat16, enabled=mixed):
        disparity = net.upsample(batch["rgb"], batch["disparity_lr"], batch["min_max"])
    objective(Answer(disparity.float()), batch)["loss"].backward()
    net.zero_grad(set_to_none=True)
    wait(batch["rgb"].device)
    return time.perf_counter() - start


def wait(device: torch.device) -> None:
    """Wait until a device has done what it was asked to."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class StepTimes(Callback):
    """Collects the seconds of the parts of each step; the last part is what no other has."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.now: dict[str, float] = {}
        self.steps: list[dict[str, float]] = []
        self._begun = 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Add the time of this context to a part."""
        start = time.perf_counter()
        yield
        wait(self._device)
        self.now[name] = self.now.get(name, 0.0) + time.perf_counter() - start

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function with its time added to a part."""

        def call(*arguments: Any, **named: Any) -> Any:
            with self.part(name):
                return function(*arguments, **named)

        return call

    def end_step(self) -> None:
        """Close the account of a step."""
        now = time.perf_counter()
        if self._begun:
            self.now["everything else"] = now - self._begun - sum(self.now.values())
            self.steps.append(self.now)
        self.now, self._begun = {}, now


class LastCallback(Callback):
    """Ends the account of a step after all other callbacks."""

    def __init__(self, times: StepTimes) -> None:
        self._times = times

    def on_train_batch_end(self, *_: Any) -> None:
        """End it."""
        self._times.end_step()


def profile(steps: int, device: torch.device, overrides: Sequence[str]) -> None:
    """Time the parts of the steps of a training, and print their medians."""
    register()
    conf = Path(__file__).resolve().parents[1] / "conf"
    with hydra.initialize_config_dir(str(conf), version_base="1.3"):
        small = [
            "dataset.count=8",
            "metrics.lpips=false",
            f"trainer.max_steps={steps}",
            f"trainer.val_check_interval={steps}",
        ]
        plain = plain_config(hydra.compose("train", [*small, *overrides]))
    plain["precision"] = "float32" if plain["precision"] == "auto" else plain["precision"]
    times = StepTimes(device)
    with tempfile.TemporaryDirectory() as folder:
        plain["output_dir"] = folder
        prepared = _Training(plain, TrainConfig.of(plain), device, find_processes(device, 1))
        trainer, module, data = prepared.trainer, prepared.module, prepared.data
        data.setup()
        without = [each for each in trainer.callbacks if not isinstance(each, BestCheckpoint)]  # type: ignore[attr-defined]
        trainer.callbacks = [*without, LastCallback(times)]  # type: ignore[attr-defined]
        trainer.limit_val_batches = 0
        network = "network and losses"
        module.loss_terms = times.timed(network, module.loss_terms)  # type: ignore[method-assign]
        module.backward = times.timed(network, module.backward)  # type: ignore[method-assign]
        Patches.__getitem__ = times.timed("patches", Patches.__getitem__)  # type: ignore[method-assign]
        module.optimizer_step = times.timed("optimiser", module.optimizer_step)  # type: ignore[method-assign]
        fit(trainer, module, data)
    print_parts(times.steps[len(times.steps) // 4 :])


def print_parts(steps: Sequence[dict[str, float]]) -> None:
    """Print the median of each part, and the fraction of the step."""
    for step in steps:  # the optimiser's step calls the closure with everything else in it
        step["optimiser"] = max(step["optimiser"] - step["network and losses"], 0.0)
        step["everything else"] += step["network and losses"]
    medians = {name: statistics.median(step[name] for step in steps) for name in steps[0]}
    total = statistics.median(sum(step.values()) for step in steps)
    for name, each in medians.items():
        print(f"{name:<20} {1000 * each:8.1f} ms   {100 * each / total:5.1f} %")
    print(f"{'outside the network':<20} {1000 * (total - medians['network and losses']):8.1f} ms   "
          f"{100 * (1 - medians['network and losses'] / total):5.1f} %")  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--patch", type=int, default=96)
    parser.add_argument("--batch", type=int, default=5)
    parser.add_argument("--steps", type=int, default=9)
    parser.add_argument("--device", type=torch.device, default="cpu")
    arguments = parser.parse_args()
    if arguments.profile:
        profile(arguments.steps, arguments.device, arguments.overrides)
        return
    source = SimGeo(size=2 * arguments.patch)
    scenes = [source.load(name) for name in source.scenes()]
    settings = PatchSettings(patch=arguments.patch, batch=arguments.batch)
    patches = Patches([scenes], settings, Degradation(SCALE, Downsampling("box")))
    start = time.perf_counter()
    batch = torch.utils.data.default_collate([patches[i] for i in range(arguments.batch)])
    batch = {name: values.to(arguments.device) for name, values in batch.items()}
    loading = time.perf_counter() - start
    net, objective = MSGNet(SCALE, "dsr"), DepthObjective("lap1", 0.1)
    net = net.to(arguments.device)
    slow = plain(net)
    fast = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    ways = {
        "plain float32 loop": lambda: step(slow, objective, batch, mixed=False),
        "float32": lambda: step(fast, objective, batch, mixed=False),
        "bfloat16": lambda: step(fast, objective, batch, mixed=True),
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(arguments.steps + 1):
        for name, way in ways.items():
            seconds[name].append(way())
    medians = {name: statistics.median(each[1:]) + loading for name, each in seconds.items()}
    for name, each in medians.items():
        print(f"{name:<20} {each:.3f} s a step   {medians['plain float32 loop'] / each:.2f} times as fast")


if __name__ == "__main__":
    main()
