"""The ``dsr`` command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from dsr.cli.commands import add_commands
from dsr.doctor import version_lines
from dsr.utils import interruption
from dsr.utils.console import USAGE_ERROR, one_line, open_console, print_error, printable, show
from dsr.utils.files import FullDiskError
from dsr.utils.guards import did_you_mean, refusing_excess

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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command, and return its exit code: 0, 2 after an error, 130 or 143 when interrupted."""
    options = make_parser().parse_args(arguments)
    console = open_console()
    try:
        with refusing_excess():
            problems = options.run(options, console)
    except KeyboardInterrupt as interrupted:
        return interruption.stop(str(interrupted))
    except (ValueError, OSError, FullDiskError) as error:
        problems = [one_line(error)]
    if isinstance(problems, int):
        return problems
    for problem in problems:
        print_error(problem)
    return USAGE_ERROR if problems else 0


class Parser(argparse.ArgumentParser):
    """A parser, and those of its commands, that refuses an empty text as a path: it would be the current directory."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.register("type", Path, _path)

    def error(self, message: str) -> NoReturn:
        """Exit with the usage and the error, which repeats arguments, without an address's password."""
        super().error(printable(message))

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an unknown option is reported before what is missing, which it may stand for."""
        for each in sys.argv[1:] if args is None else args:
            if each == "--" or "-" not in self.prefix_chars or (self.commands and not each.startswith("-")):
                break  # what follows are values, or the command's own options
            name = each.partition("=")[0]
            known = self._option_string_actions
            if name.startswith("--") and " " not in name and not any(flag.startswith(name) for flag in known):
                self.error(f"unknown option {name}{did_you_mean(name, known)}")
        return super().parse_known_args(args, namespace)

    @property
    def commands(self) -> dict[str, Parser]:
        """The commands' parsers by their names; empty for a parser without."""
        found = (each for each in self._actions if isinstance(each, argparse._SubParsersAction))
        return next((dict(each.choices) for each in found), {})

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is not one of an action's choices."""
        if action.choices is not None and value not in action.choices:
            choices = [str(each) for each in action.choices]
            meant = did_you_mean(value, choices)
            raise argparse.ArgumentError(action, f"expected one of {', '.join(choices)}, got {value!r}{meant}")


def _path(text: str) -> Path:
    """Return the path that an argument names."""
    if not text.strip():
        raise argparse.ArgumentTypeError("expected a path, got an empty text")
    return Path(text)


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
    add_commands(parser)
    return parser
