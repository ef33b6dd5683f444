"""The ``dsr`` command."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

from rich.console import Console

from dsr.cli import data, doctor, hydra_commands, report, study, upsample
from dsr.data.download.catalogue import CATALOGUE, Collection
from dsr.utils.console import INTERRUPTED, USAGE_ERROR, one_line, open_console, print_error, show

_EXAMPLES = """\
examples:
  dsr upsample --rgb photo.jpg --depth depth.png -o out    finer depth, mesh and pictures from your own camera
  dsr eval method=facets dataset=simgeo scale=8            evaluate a method; more with dsr eval --help
  dsr train model=facets trainer=smoke                     train a network; more with dsr train --help
  dsr report outputs/eval -o report                        tables, figures and a page of all evaluations
  dsr study build outputs/eval --scale 4 -o study          a page that asks people which result looks best
  dsr study collect study answers/*.json                   what they answered, with intervals
  dsr data list                                            which data sets there are, and what of them is here
  dsr data get middlebury                                  fetch the seven scenes of the paper's tables
  dsr doctor my_scenes                                     check a directory of your own scenes

In a checkout of the project, `python eval.py` and `python train.py` are the same as `dsr eval` and `dsr train`.
"""
_COMMANDS = (upsample, hydra_commands, report, study, data, doctor)


def main(arguments: Sequence[str] | None = None, catalogue: Mapping[str, Collection] | None = None) -> int:
    """Run the command, and return its exit code: 0, 2 where something is wrong, 130 when interrupted.

    Args:
        arguments: of the command line; those of the process where None.
        catalogue: the data sets to offer; :data:`dsr.data.download.catalogue.CATALOGUE` where None.

    """
    options = _parser().parse_args(arguments)
    console = open_console()
    try:
        problems = options.run(options, console, CATALOGUE if catalogue is None else catalogue)
    except KeyboardInterrupt:
        show(Console(stderr=True), "interrupted; what was finished is kept, run the same command again to go on")
        return INTERRUPTED
    except (ValueError, OSError) as error:
        problems = [one_line(error)]
    if isinstance(problems, int):
        return problems
    for problem in problems:
        print_error(problem)
    return USAGE_ERROR if problems else 0


def _parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        "dsr",
        description="Guided depth super-resolution.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in _COMMANDS:
        command.add(commands)
    return parser
