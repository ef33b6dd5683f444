"""Evaluate a depth super-resolution method: ``python eval.py --help``."""

from dsr.app.entry import run_eval

if __name__ == "__main__":
    run_eval()
