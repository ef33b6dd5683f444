"""The ``dsr`` command."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from dsr.cli.commands import (
    APP,
    DOCTOR,
    EXPORT,
    FORMATS_COMMAND,
    FUSE,
    LEADERBOARD,
    REPORT,
    UPSAMPLE,
    VIEW,
    add_data_command,
    add_hydra_commands,
)
from dsr.cli.study import STUDY
from dsr.data.download.collections import CATALOGUE, Collection
from dsr.utils import interruption
from dsr.utils.console import USAGE_ERROR, one_line, open_console, print_error, printable
from dsr.utils.files import FullDiskError
from dsr.utils.memory import refusing_excess

_EXAMPLES = """\
examples:
  dsr upsample --rgb photo.jpg --depth depth.png -o out    high-resolution depth, mesh and pictures
  dsr view out                                             its surfaces, before and after, in the browser
  dsr app                                                  the same in the browser: drop files, look, download
  dsr fuse out -o mesh.ply                                 one mesh of the results of a sequence with poses
  dsr eval method=facets dataset=simgeo scale=8            evaluate a method; more with dsr eval --help
  dsr train model=facets trainer=smoke                     train a network; more with dsr train --help
  dsr report outputs/eval -o report                        tables, figures and a page of all evaluations
  dsr study build outputs/eval --scale 4 -o study          a page that asks people which result looks best
  dsr study collect study answers/*.json                   their answers, with confidence intervals
  dsr data list                                            all data sets, and which of them are on this machine
  dsr data get middlebury                                  download the seven scenes of the paper's tables
  dsr doctor my_scenes                                     check a directory of your own scenes
  dsr export --onnx facets_x4.onnx                         a network for programs without PyTorch

In a checkout of the project, `python eval.py` and `python train.py` are the same as `dsr eval` and `dsr train`.
"""
_COMMANDS = (
    *(command.add for command in (UPSAMPLE, VIEW, APP, FUSE)),
    add_hydra_commands,
    *(command.add for command in (REPORT, LEADERBOARD, STUDY)),
    add_data_command,
    *(command.add for command in (FORMATS_COMMAND, DOCTOR, EXPORT)),
)


def main(arguments: Sequence[str] | None = None, catalogue: Mapping[str, Collection] | None = None) -> int:
    """Run the command, and return its exit code: 0, 2 after an error, 130 or 143 when interrupted.

    Args:
        catalogue: the data sets to offer; None for :data:`dsr.data.download.collections.CATALOGUE`.

    """
    options = _parser().parse_args(arguments)
    console = open_console()
    try:
        with interruption.working(), refusing_excess():
            problems = options.run(options, console, CATALOGUE if catalogue is None else catalogue)
    except KeyboardInterrupt as interrupted:
        return interruption.stop(str(interrupted))
    except (ValueError, OSError, FullDiskError) as error:
        problems = [one_line(error)]
    if isinstance(problems, int):
        return problems
    for problem in problems:
        print_error(problem)
    return USAGE_ERROR if problems else 0


class _Parser(argparse.ArgumentParser):
    """A parser, and those of its commands, that refuses an empty text as a path: it would be the current directory."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.register("type", Path, _path)

    def error(self, message: str) -> NoReturn:
        """End with the usage and what is wrong, which repeats arguments, without an address's password."""
        super().error(printable(message))


def _path(text: str) -> Path:
    """Return the path that an argument names."""
    if not text.strip():
        raise argparse.ArgumentTypeError("expected a path, got an empty text")
    return Path(text)


def _parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = _Parser(
        "dsr",
        description="Guided depth super-resolution.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in _COMMANDS:
        add(commands)
    return parser
