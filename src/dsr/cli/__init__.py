"""The ``dsr`` command."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import NoReturn

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
    Command,
    add_data_command,
    add_hydra_commands,
)
from dsr.cli.parser import ABOUT, EPILOG, CompletionRequest, Parser, complete
from dsr.cli.study import STUDY
from dsr.data.download.collections import Collection
from dsr.doctor.about import version_lines
from dsr.utils import interruption
from dsr.utils.console import USAGE_ERROR, one_line, open_console, print_error, show
from dsr.utils.files import FullDiskError
from dsr.utils.guards import refusing_excess

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
  dsr doctor                                               whether everything is here that dsr needs
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
        catalogue: the data sets to offer; None for :func:`dsr.cli.data_tasks.downloads`.

    """
    options = make_parser().parse_args(arguments)
    console = open_console()
    try:
        with refusing_excess():
            problems = options.run(options, console, catalogue)
    except KeyboardInterrupt as interrupted:
        return interruption.stop(str(interrupted))
    except (ValueError, OSError, FullDiskError) as error:
        problems = [one_line(error)]
    if isinstance(problems, int):
        return problems
    for problem in problems:
        print_error(problem)
    return USAGE_ERROR if problems else 0


class _Version(argparse.Action):
    """Prints what is installed, and ends the process."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Print it."""
        for line in version_lines():
            show(open_console(), line)
        parser.exit()


def make_parser() -> Parser:
    """Return the command line."""
    parser = Parser(
        "dsr",
        description="Guided depth super-resolution.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="of dsr, Python, torch and the packaged weights")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in _COMMANDS:
        add(commands)
    Command(
        "completion", ABOUT, CompletionRequest, lambda request, console, _: complete(parser, request, console), EPILOG
    ).add(commands)
    return parser
