"""``dsr eval`` and ``dsr train``: the same as ``eval.py`` and ``train.py`` of a checkout."""

from __future__ import annotations

import argparse
from typing import Any

_ABOUT = {
    "eval": "evaluate a method on a data set: predictions, scores, pictures",
    "train": "train a network: weights, checkpoints, a TensorBoard log",
}


def add(commands: Any) -> None:
    """Add the commands to the parser's commands."""
    for name, about in _ABOUT.items():
        # No argument begins with a space, so all of them, --help and -m too, are values, which Hydra parses.
        parser = commands.add_parser(name, help=about, add_help=False, prefix_chars=" ")
        parser.add_argument("arguments", nargs="*")
        parser.set_defaults(run=_run, name=name)


def _run(options: argparse.Namespace, *_: object) -> int:
    """Run the command, which exits the process after an error."""
    from dsr.app.entry import run_eval, run_train  # noqa: PLC0415 - Hydra is not needed for the other commands

    {"eval": run_eval, "train": run_train}[options.name](options.arguments)
    return 0
