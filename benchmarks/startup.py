"""Measure how much processor time a command takes to answer: user and system seconds, the least of several runs.

    python benchmarks/startup.py

Exits with 1 where a command that has nothing to compute takes longer than 1.0 s. Prints a Markdown table.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DSR = [sys.executable, "-m", "dsr.cli"]
COMMANDS = {
    "dsr --help": [*DSR, "--help"],
    "dsr upsample --mehtod x": [*DSR, "upsample", "--mehtod", "x"],
    "dsr eval --help": [*DSR, "eval", "--help"],
    "dsr eval method=nosuch": [*DSR, "eval", "method=nosuch"],
    "python eval.py method=nosuch": [sys.executable, str(ROOT / "eval.py"), "method=nosuch"],
    "python eval.py method.nosuch=1": [sys.executable, str(ROOT / "eval.py"), "method.nosuch=1"],
    "python train.py model=nosuch": [sys.executable, str(ROOT / "train.py"), "model=nosuch"],
}
RUNS = 3
MOST = 1.0
"""Seconds."""


def spent() -> float:
    """Return the processor time of all finished child processes, in seconds."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def measure(command: list[str]) -> float:
    """Return the least processor time of a command, in seconds."""
    seconds = []
    for _ in range(RUNS):
        before = spent()
        subprocess.run(command, capture_output=True, check=False)  # noqa: S603 - the commands above
        seconds.append(spent() - before)
    return min(seconds)


def main() -> int:
    """Measure each command, print the table, and return the exit code."""
    print("| command | CPU, s |\n| --- | ---: |")
    times = {name: measure(command) for name, command in COMMANDS.items()}
    for name, seconds in times.items():
        print(f"| `{name}` | {seconds:.2f} |")
    return int(max(times.values()) > MOST)


if __name__ == "__main__":
    sys.exit(main())
