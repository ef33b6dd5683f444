"""The ``dsr`` command."""

from __future__ import annotations

import argparse
import importlib
import sys
from argparse import Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from inspect import cleandoc
from typing import Any, NamedTuple, NoReturn

from rich.console import Console

from dsr.app import requests
from dsr.app.upsample.request import UpsampleRequest
from dsr.doctor import version_lines
from dsr.utils import interruption
from dsr.utils.console import USAGE_ERROR, one_line, open_console, print_error, printable, show
from dsr.utils.files import FullDiskError
from dsr.utils.guards import did_you_mean, refusing_excess
from dsr.utils.options import Options, add_options, build

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
    """A parser, and those of its commands, which says what may be meant."""

    def error(self, message: str) -> NoReturn:
        """Exit with the usage and the error, which repeats arguments: names of files may control a terminal."""
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
        if action.choices is not None and value not in action.choices:
            choices = [str(each) for each in action.choices]
            meant = did_you_mean(value, choices)
            raise argparse.ArgumentError(action, f"expected one of {', '.join(choices)}, got {value!r}{meant}")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        for line in version_lines():
            show(open_console(), line)
        parser.exit()


class Command(NamedTuple):
    """A command."""

    name: str  # of two words within a group of commands
    record: type[Options] | None  # its options, whose docstring is its help; None for a command of Hydra
    run: str  # module:function, of a record and the console, returns problems or an exit code
    epilog: str | None = None  # text of its help after the options; what a command of Hydra does, in a line

    def answer(self, options: Namespace, console: Console) -> list[str] | int:
        """Run the command; one of Hydra exits the process after an error."""
        given = (options.arguments,) if self.record is None else (build(self.record, options), console)
        place, _, function = self.run.partition(":")
        problems: list[str] | int | None = getattr(importlib.import_module(place), function)(*given)
        return problems or 0


def make_parser() -> Parser:
    """Return the command line, with the commands and the groups of some."""
    style = RawDescriptionHelpFormatter
    parser = Parser("dsr", description="Guided depth super-resolution.", epilog=_EXAMPLES, formatter_class=style)
    parser.add_argument("--version", action=_Version, nargs=0, help="of dsr, Python, torch and the packaged weights")
    commands = {"": parser.add_subparsers(title="commands", metavar="COMMAND", required=True)}
    for command in COMMANDS:
        group, _, name = command.name.rpartition(" ")
        if group not in commands:
            about, epilog = GROUPS[group]
            parent = commands[""].add_parser(group, help=about, description=about, epilog=epilog, formatter_class=style)
            commands[group] = parent.add_subparsers(title="commands", metavar="COMMAND", required=True)
        if command.record is None:
            # No argument begins with a space, so all of them, --help and -m too, are values, which Hydra parses.
            own = commands[group].add_parser(name, help=command.epilog, add_help=False, prefix_chars=" ")
            own.add_argument("arguments", nargs="*")
        else:
            text = cleandoc(command.record.__doc__ or "")
            about = text.partition("\n")[0]
            own = commands[group].add_parser(
                name, help=about, description=text, epilog=command.epilog, formatter_class=style
            )
            add_options(own, command.record)
        own.set_defaults(run=command.answer)
    return parser


def show_formats(request: requests.FormatsRequest, console: Console) -> list[str]:
    """Print the formats that are read."""
    from dsr.io.captures import all_captures  # noqa: PLC0415 - it takes seconds to import

    words, known = [word.lower() for word in request.names], all_captures()
    found = [
        each for each in known
        if not words or any(word in text.lower() for word in words for text in each.rows().values())
    ]  # fmt: skip
    if not found:
        raise ValueError(f"{' '.join(words)}: expected a word of {', '.join(each.name for each in known)}")
    console.print("\n\n".join(map(str, found)), markup=False, highlight=False, soft_wrap=True)
    return []


def examine(request: requests.DoctorRequest, _: Console) -> int:
    """Examine a directory of scenes, or without one the machine."""
    if request.directory is None:
        from dsr.doctor.machine import examine_machine  # noqa: PLC0415 - it takes seconds to import

        return examine_machine()
    from dsr.doctor.scenes import examine_directory  # noqa: PLC0415

    return examine_directory(request.directory, request.most)


GROUPS = {
    "study": ("Ask people which rendering looks most like the ground truth.", """\
examples:
  dsr study build outputs/eval --scale 4 -o study     make study/index.html, to hand out, and study/key.json, to keep
  dsr study collect study answers/*.json              percentages with confidence intervals, and study/study.csv
"""),
    "data": ("List, fetch and check data sets.", """\
examples:
  dsr data list
  dsr data get middlebury middlebury2003 --yes
  dsr data get sunrgbd --mirror https://server.example/data
  dsr data verify tofmark
  dsr data prepare middlebury dataset.scenes=found
  DSR_DATA=/large/disk dsr data where icl

All data sets are below one directory: $DSR_DATA, or ./data.
"""),
}  # fmt: skip
"""The groups of commands: what each does, and the text of its help after its commands."""
COMMANDS = (
    Command("upsample", UpsampleRequest, "dsr.app.upsample.run:run", """\
examples:
  dsr upsample --rgb photo.jpg --depth depth.png -o out
  dsr upsample --rgb photo.jpg --depth depth.exr --fov 70 --format exr --only depth,mesh -o out
  dsr upsample --rgb rgb/ --depth depth/ --depth-unit 1/5000 -o out
  dsr upsample scan.r3d --min-confidence 0.5 -o out
  dsr upsample --rgb photo.jpg --depth depth.png --method tgv --set data_weight=30 -o out
  dsr upsample recordings --with nerfstudio,open3d -o out
  dsr upsample recording --poses groundtruth.txt --neighbours 4 -o out
  dsr upsample recordings --shard 3/16 -o out    the third of 16 parts, for a task of an array
  dsr upsample recordings --dry-run -o out       what would be done, and what would be assumed

The results of a single pair are in OUT, those of several in OUT/NAME: depth.* as the input is stored,
depth_metres.tiff, renderings/, normals.png, mesh.glb, before_after.png, confidence.png, confidence.npz, filled.png,
input.npz, and info.json with all settings and assumptions. Look at them with `dsr view OUT`. Run the same command again
to continue after an interruption. More in docs/upsample.md.
"""),
    Command("view", requests.ViewRequest, "dsr.app.results:view", """\
examples:
  dsr view out                             a result, or a folder of results; writes out/view.html
  dsr view out --no-open -o page.html
  dsr view recordings --most 40 --vertices 100000
"""),
    Command("app", requests.BrowserRequest, "dsr.app.browser:browse", """\
examples:
  dsr app
  dsr app --no-open --port 9000
  dsr app --max-upload 2000 --max-seconds 900     for large captures
"""),
    Command("fuse", requests.FuseRequest, "dsr.app.results:fuse", """\
examples:
  dsr upsample recording --poses groundtruth.txt --neighbours 4 --only depth,confidence -o out
  dsr fuse out -o mesh.ply
  dsr fuse out -o mesh.glb --voxel 0.01
"""),
    Command("eval", None, "dsr.app.entry:run_eval",
            "Evaluate a method on a data set: predictions, scores, pictures."),
    Command("train", None, "dsr.app.entry:run_train", "Train a network: weights, checkpoints, a TensorBoard log."),
    Command("report", requests.ReportRequest, "dsr.app.report:make_report", """\
examples:
  dsr report outputs/eval -o report
  dsr report outputs/eval -o report --methods Bicubic MSG-V --scale 4
  dsr report outputs/eval -o report --study study.csv     with the columns of a user study, see `dsr study`
  dsr report outputs/eval -o report --only tables

Open report/index.html in a browser. It needs no network and can be sent as it is.
"""),
    Command("leaderboard", requests.LeaderboardRequest, "dsr.app.report:make_leaderboard", """\
examples:
  python eval.py -m +experiment=reference
  python eval.py -m method=external method.path=mine,yours metrics=suite
  dsr leaderboard outputs/eval -o site

Open site/index.html in a browser, or publish the folder as it is.
"""),
    Command("study build", requests.StudyRequest, "dsr.app.report:build_page", """\
examples:
  dsr study build outputs/eval -o study
  dsr study build outputs/eval --scale 4 --methods bicubic msg_v facets --repeat 2 -o study
  dsr study build outputs/eval --scenes-per-person 10 --send-to "Mail the file to study@example.org." -o study

Give people only index.html: key.json says which method made which picture.
"""),
    Command("study collect", requests.AnswersRequest, "dsr.app.report:collect_answers", """\
Join the table to a report: dsr report RUNS --study study/study.csv
"""),
    Command("data list", requests.DataListRequest, "dsr.cli.data_tasks:list_data_sets"),
    Command("data where", requests.DataWhereRequest, "dsr.cli.data_tasks:show_folders"),
    Command("data get", requests.DataGetRequest, "dsr.cli.data_tasks:get_data_sets", """\
What a mirror has to hold, and which checksums are known, is in docs/data.md.
"""),
    Command("data verify", requests.DataVerifyRequest, "dsr.cli.data_tasks:verify_data_sets"),
    Command("data prepare", requests.DataPrepareRequest, "dsr.app.evaluate:prepare_dataset"),
    Command("formats", requests.FormatsRequest, "dsr.cli:show_formats"),
    Command("doctor", requests.DoctorRequest, "dsr.cli:examine", """\
examples:
  dsr doctor                     whether everything is here that dsr needs: exit code 0, or 2
  dsr doctor my_scenes           units, cameras, holes: exit code 0, or 1 where something is probably wrong
"""),
    Command("export", requests.ExportRequest, "dsr.cli.export:export_onnx", """\
examples:
  dsr export --onnx facets_x4.onnx
  dsr export --onnx facets_x1.onnx --scale 1               for depth maps of the photo's own size
  dsr export --onnx msg_v_x8.onnx --method msg_v --scale 8
  dsr export --onnx mine.onnx --method pdn --weights outputs/train/mine/weights.safetensors

docs/python.md has its inputs and outputs, and a program that runs such a file.
"""),
    Command("completion", requests.CompletionRequest, "dsr.cli.completion:complete", """\
examples:
  eval "$(dsr completion bash)"         in ~/.bashrc
  source <(dsr completion zsh)          in ~/.zshrc, after compinit
  dsr completion fish | source          in ~/.config/fish/config.fish

It completes commands, options, methods, data sets, and for eval and train the choices of each group.
Hydra's own completion has all keys, in a checkout: eval "$(python train.py -sc install=bash)", then python train.py ...
"""),
)  # fmt: skip
"""In the order of ``dsr --help``."""
