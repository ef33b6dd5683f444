"""Evaluate a depth super-resolution method: ``python eval.py --help``."""

from dsr.utils.interruption import start

if __name__ == "__main__":
    start("dsr.app.entry", "run_eval")
