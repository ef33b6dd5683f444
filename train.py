"""Train a depth super-resolution network: ``python train.py --help``."""

from dsr.utils.interruption import start

if __name__ == "__main__":
    start("dsr.app.entry", "run_train")
