"""Train a depth super-resolution network: ``python train.py --help``."""

from pathlib import Path

from dsr.app.entry import run_command
from dsr.app.train import train

if __name__ == "__main__":
    run_command(Path(__file__).parent / "conf", "train", train)
