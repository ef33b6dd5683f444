# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Train facets for days: stages in turn, each a training of about an hour, and after each a row of all yardsticks.

    python docs/measurements/scripts/long_training.py [PLAN] [-o DIR] [--shared DIR] [--stages N]

``PLAN`` is ``long_training.yaml`` beside this file: ``stages``, each with the name of its ``weights``, its ``steps``
and further ``overrides`` of ``train.py``, and the ``parts`` of ``real_sensors.py`` that are measured. Each stage starts
from the weights that its name had last, at first those that come with dsr, and its learning rate falls to 0 at its end.
Its ``share`` is that of its weights in the mean with those it started from, which keeps better what a stage sees less
of (Wortsman et al., *Robust fine-tuning of zero-shot models*, CVPR 2022). ``DIR`` (``outputs/long_training``) holds
the runs, ``weights/`` with the latest of each name, in half precision as they are packaged, and ``curve.csv``.

One thread, at the lowest priority. It may be killed at any time: the same command goes on from the last checkpoint.
Ctrl-C saves one first.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

import torch
import yaml
from real_sensors import measure, upsampled, with_weights

from dsr.methods.networks.trained import NETWORKS
from dsr.methods.networks.weight_files import LINKS, load_network, read_header, save_network
from dsr.utils.files import replacing, write_text

HERE = Path(__file__).resolve().parent
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(2**30),  # freed memory is kept: the system would clear every page of it anew
    "MALLOC_TRIM_THRESHOLD_": str(2**31 - 1),
}
PACKAGED = HERE.parent / "src" / "dsr" / "methods" / "weights"


def stages(plan: Mapping[str, Any], out: Path) -> Iterator[tuple[int, Mapping[str, Any], Path]]:
    """Yield the stages in turn, again and again: their number, what they are, and the folder of their run."""
    for number in count():
        stage = plan["stages"][number % len(plan["stages"])]
        yield number, stage, out / f"{number:03d}_{stage['weights']}"


def train(stage: Mapping[str, Any], number: int, run: Path, weights: Path) -> None:
    """Begin or go on with the training of a stage, unless it is complete."""
    if (run / "weights.safetensors").is_file():
        return
    links = read_header(weights)
    shared = [f"start.shared={weights.parent / links['shared']}"] if "shared" in links else []
    command = [sys.executable, str(HERE.parent / "train.py")]
    if (run / "checkpoints" / "last.ckpt").is_file():
        command += [f"resume={run}"]
    else:
        command += [
            *stage["overrides"], *shared, f"trainer.max_steps={stage['steps']}", "keep=last",
            f"start.weights={weights}", f"seed={number}", f"output_dir={run}",
        ]  # fmt: skip
    with subprocess.Popen(command, env={**os.environ, **ENVIRONMENT}) as child:  # noqa: S603
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the training, too, which saves itself
        code = child.wait()
    signal.signal(signal.SIGINT, before)
    if code:
        sys.exit(code)


def keep(run: Path, weights: Path, share: float) -> None:
    """Move the latest weights of a name by a share towards those of a run, once, and keep their links to others."""
    moved, trained = run / "moved.safetensors", run / "weights.safetensors"
    if not moved.exists():
        header = read_header(weights)
        net, before = (load_network(path, NETWORKS) for path in (trained, weights))
        state = net.state_dict()
        for name, old in before.state_dict().items():
            if old.is_floating_point():
                state[name].lerp_(old, 1 - share)
        links = {key: weights.parent / header[key] for key in LINKS if key in header}
        with replacing(moved) as temporary:
            save_network(temporary, net, header["model"], read_header(trained)["facts"], half=True, links=links)
    copy(moved, weights)


def copy(source: Path, target: Path) -> None:
    """Copy a file, the whole or nothing."""
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)


def scores(parts: list[str], weights: Path, shared: Path) -> dict[str, float]:
    """Return the scores of the latest weights in all parts, by part and name."""
    name = with_weights(weights)
    rows = {part: measure(part, lambda sample: upsampled(sample, name, "cpu", weights), shared, None) for part in parts}
    return {f"{part}/{name}": value for part, row in rows.items() for name, value in row.items()}


def note(curve: Path, row: Mapping[str, Any]) -> None:
    """Add a row to the curve."""
    rows = list(csv.DictReader(curve.read_text().splitlines())) if curve.is_file() else []
    names = dict.fromkeys((*(rows[0] if rows else ()), *row))
    lines = [",".join(names), *(",".join(str(each.get(name, "")) for name in names) for each in (*rows, row))]
    write_text(curve, "\n".join(lines) + "\n")
    print(
        "  ".join(
            f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in row.items()
        )
    )


def main() -> None:
    """Train and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", nargs="?", type=Path, default=HERE / "long_training.yaml")
    parser.add_argument("-o", "--output", type=Path, default=Path("outputs/long_training"))
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--stages", type=int, help="stop after so many stages in all; never is the default")
    options = parser.parse_args()
    os.nice(15)
    torch.set_num_threads(1)
    plan = yaml.safe_load(options.plan.read_text())
    folder, curve = options.output.resolve() / "weights", options.output.resolve() / "curve.csv"
    folder.mkdir(parents=True, exist_ok=True)
    for packaged in PACKAGED.glob("facets_x*.safetensors"):
        if not (folder / packaged.name).exists():
            copy(packaged, folder / packaged.name)
    done = len(curve.read_text().splitlines()) - 2 if curve.is_file() else -1  # beside the names and the first row
    if done < 0:
        note(curve, {"stage": "packaged", "steps": 0, "minutes": 0, **scores(plan["parts"], folder, options.shared)})
        done = 0
    for number, stage, run in stages(plan, options.output.resolve()):
        if options.stages is not None and number >= options.stages:
            break
        if number < done:
            continue
        started = time.monotonic()
        train(stage, number, run, folder / f"{stage['weights']}.safetensors")
        keep(run, folder / f"{stage['weights']}.safetensors", stage["share"])
        row = {"stage": run.name, "steps": stage["steps"], "minutes": round((time.monotonic() - started) / 60)}
        note(curve, {**row, **scores(plan["parts"], folder, options.shared)})


if __name__ == "__main__":
    main()
