"""Evaluate a depth super-resolution method: ``python eval.py --help``."""

from pathlib import Path

from dsr.app.entry import run_command
from dsr.app.evaluate import evaluate

if __name__ == "__main__":
    run_command(Path(__file__).parent / "conf", "eval", evaluate)
