"""Time of ``python eval.py``, as a user types it, against that of another checkout, and where it goes.

    git worktree add ../before COMMIT
    python benchmarks/eval_speed.py --before ../before [--rounds 3] [KEY=VALUE ...]

Both are run in turn, each in a new directory; the least seconds of each are printed, with the processor time, their
ratio, and the stages of the fastest run: the start until the run's directory is made, the predictions, metrics with
pictures, and the log with the table. Variables that set numbers of threads are taken out of the environment.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("start", "predictions", "metrics and pictures", "log and table")


class Measured(NamedTuple):
    """Seconds and processor seconds of a run, and the seconds of its stages."""

    seconds: float
    processor: float
    stages: tuple[float, ...]


def processor_seconds() -> float:
    """Return the processor time of all finished child processes, in seconds."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def measure(checkout: Path, overrides: list[str]) -> Measured:
    """Run a checkout's command once."""
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    environment["PYTHONPATH"] = str(checkout / "src")
    with tempfile.TemporaryDirectory() as place:
        run = Path(place) / "run"
        before, begun = processor_seconds(), time.time()
        subprocess.run(  # noqa: S603 - a checkout of this project
            [sys.executable, str(checkout / "eval.py"), f"output_dir={run}", *overrides],
            cwd=place,
            env=environment,
            check=True,
            stdout=subprocess.DEVNULL,
        )
        ended = time.time()
        predictions = max(path.stat().st_mtime for path in (run / "predictions").glob("*.npz"))
        ends = (begun, (run / "versions.json").stat().st_mtime, predictions, (run / "scores.csv").stat().st_mtime)
        stages = tuple(end - start for start, end in zip(ends, (*ends[1:], ended), strict=True))
        return Measured(ended - begun, processor_seconds() - before, stages)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, help="the other checkout")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("overrides", nargs="*", help="of both commands")
    options = parser.parse_args()
    checkouts = {"before": options.before.resolve(), "now": ROOT}
    found: dict[str, list[Measured]] = {name: [] for name in checkouts}
    for _ in range(options.rounds):
        for name, checkout in checkouts.items():
            found[name].append(measure(checkout, options.overrides))
            print(f"{name}: {found[name][-1].seconds:.1f} s", flush=True)
    best = {name: min(each) for name, each in found.items()}
    least = {name: min(run.processor for run in each) for name, each in found.items()}
    print(f"\n| | seconds | CPU seconds | {' | '.join(STAGES)} |\n|{' --- |' * (3 + len(STAGES))}")
    for name, each in best.items():
        stages = " | ".join(f"{seconds:.1f}" for seconds in each.stages)
        print(f"| {name} | {each.seconds:.1f} | {least[name]:.1f} | {stages} |")
    print(f"\nratio: {best['before'].seconds / best['now'].seconds:.2f}, of CPU seconds", end=" ")
    print(f"{least['before'] / least['now']:.2f}")


if __name__ == "__main__":
    main()
