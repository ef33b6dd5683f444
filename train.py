"""Train a depth super-resolution network: ``python train.py --help``."""

from dsr.app.entry import run_train

if __name__ == "__main__":
    run_train()
