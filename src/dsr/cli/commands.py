"""The commands of ``dsr``: the options of each and the function behind it, which is imported after the checks."""

from __future__ import annotations

import argparse
import importlib
from argparse import Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from dsr.app.requests import (
    BrowserRequest,
    DoctorRequest,
    ExportRequest,
    FormatsRequest,
    FuseRequest,
    LeaderboardRequest,
    ReportRequest,
    ViewRequest,
)
from dsr.app.upsample.request import UpsampleRequest
from dsr.utils.options import Options, add_options, build


class Command(NamedTuple):
    """A command.

    Args:
        name: its name.
        about: what it does, in a line.
        record: its options.
        run: answers a record, given the console and the data sets on offer: returns problems, or an exit code.
        epilog: text of its help after the options.
        description: text before them; ``about`` by default.

    """

    name: str
    about: str
    record: type[Options]
    run: Callable[[Any, Console, Any], list[str] | int]
    epilog: str | None = None
    description: str | None = None

    def add(self, commands: Any) -> None:
        """Add the command to those of a parser."""
        parser = _add_parser(commands, self)
        add_options(parser, self.record)

        def run(options: Namespace, *context: Any) -> list[str] | int:
            return self.run(build(self.record, options), *context)

        parser.set_defaults(run=run)


class CommandGroup(NamedTuple):
    """Commands under one name; the arguments are those of :class:`Command`."""

    name: str
    about: str
    commands: tuple[Command, ...]
    epilog: str | None = None
    description: str | None = None

    def add(self, commands: Any) -> None:
        """Add the commands to those of a parser."""
        steps = _add_parser(commands, self).add_subparsers(title="commands", metavar="COMMAND", required=True)
        for each in self.commands:
            each.add(steps)


def _add_parser(commands: Any, command: Command | CommandGroup) -> Any:
    """Return a parser of a command's own, whose texts keep their line breaks."""
    return commands.add_parser(
        command.name,
        help=command.about,
        description=command.description or command.about,
        epilog=command.epilog,
        formatter_class=RawDescriptionHelpFormatter,
    )


def _later(module: str, name: str) -> Callable[[Any, Console, object], list[str]]:
    """Return a function of a module that takes seconds to import: it is imported after the values are checked."""

    def run(request: Any, console: Console, _: object) -> list[str]:
        problems: list[str] = getattr(importlib.import_module(module), name)(request, console)
        return problems

    return run


def _examine(request: DoctorRequest, *_: object) -> int:
    """Examine a directory of scenes, or without one the machine."""
    if request.directory is None:
        from dsr.doctor.machine import examine_machine  # noqa: PLC0415 - it takes seconds to import

        return examine_machine()
    from dsr.doctor.examine import examine_directory  # noqa: PLC0415

    return examine_directory(request.directory, request.most)


def _show_formats(request: FormatsRequest, console: Console, _: object) -> list[str]:
    """Print the formats that are read."""
    from dsr.io.captures.registry import all_captures  # noqa: PLC0415 - it takes seconds to import

    words, known = [word.lower() for word in request.names], all_captures()
    found = [
        each for each in known
        if not words or any(word in text.lower() for word in words for text in each.rows().values())
    ]  # fmt: skip
    if not found:
        raise ValueError(f"{' '.join(words)}: expected a word of {', '.join(each.name for each in known)}")
    console.print("\n\n".join(map(str, found)), markup=False, highlight=False, soft_wrap=True)
    return []


UPSAMPLE = Command(
    "upsample",
    "upsample the depth of your own photos",
    UpsampleRequest,
    _later("dsr.app.upsample.run", "run"),
    description="""\
Upsample the depth maps of your own photos to the photos' resolution.

Give --rgb and --depth, or folders that hold both. The depth map has to be registered to the photo: the same view, the
same field of view, any size up to the photo's. What is not given is read from the files or assumed, and reported.""",
    epilog="""\
examples:
  dsr upsample --rgb photo.jpg --depth depth.png -o out
  dsr upsample --rgb photo.jpg --depth depth.png --camera camera.json -o out
  dsr upsample --rgb photo.jpg --depth depth.exr --fov 70 --format exr --only depth,mesh -o out
  dsr upsample --rgb a.jpg b.jpg --depth a.png b.png --intrinsics 615 615 319.5 239.5 -o out
  dsr upsample --rgb rgb/ --depth depth/ --depth-unit 1/5000 -o out
  dsr upsample rgbd_dataset_freiburg1_xyz -o out
  dsr upsample scan.r3d --min-confidence 0.5 -o out
  dsr upsample --rgb photo.jpg --depth depth.png --method tgv --set data_weight=30 -o out
  dsr upsample recordings --with nerfstudio,open3d -o out
  dsr upsample --rgb photo.jpg --depth depth.png --depth-camera ir.json --extrinsics ir_to_rgb.txt -o out
  dsr upsample recording --poses groundtruth.txt --neighbours 4 -o out
  dsr upsample recordings --shard 3/16 -o out    the third of 16 parts, for a task of an array
  dsr upsample recordings --dry-run -o out       what would be done, and what would be assumed

The results of a single pair are in OUT, those of several in OUT/NAME: depth.* as the input is stored,
depth_metres.tiff, renderings/, normals.png, mesh.glb, before_after.png, confidence.png, confidence.npz, filled.png,
input.npz, and info.json with all settings and assumptions. Look at them with `dsr view OUT`. Run the same command again
to continue after an interruption. More in docs/upsample.md.
""",
)

VIEW = Command(
    "view",
    "look at results of `dsr upsample` in the browser",
    ViewRequest,
    _later("dsr.app.view", "view"),
    description="""\
Make one page of the results of `dsr upsample` and open it: the surface to turn, a light to drag, before and after, the
photo and the expected errors as its colours. The page is a single file that needs no network and can be sent as it is.
""",
    epilog="""\
examples:
  dsr view out                             a result, or a folder of results; writes out/view.html
  dsr view out --no-open -o page.html
  dsr view recordings --most 40 --vertices 100000
""",
)

APP = Command(
    "app",
    "upsample in the browser: drop files, see the surfaces under one light",
    BrowserRequest,
    _later("dsr.app.browser.server", "browse"),
    description="""\
Serve a page of this machine alone, and open it: drop a photo and a depth map, or a capture, and look at photo, input
and result side by side. The libraries are an extra: pip install -e '.[app]' in a checkout. More in
docs/view.md.""",
    epilog="""\
examples:
  dsr app
  dsr app --no-open --port 9000
  dsr app --max-upload 2000 --max-seconds 900     for large captures
""",
)

FUSE = Command(
    "fuse",
    "one mesh of the results of a sequence",
    FuseRequest,
    _later("dsr.app.fuse", "fuse"),
    description="""\
Fuse the depth that `dsr upsample` made of a sequence with poses into one mesh, weighted by the expected errors.
""",
    epilog="""\
examples:
  dsr upsample recording --poses groundtruth.txt --neighbours 4 --only depth,confidence -o out
  dsr fuse out -o mesh.ply
  dsr fuse out -o mesh.ply --voxel 0.01
""",
)

REPORT = Command(
    "report",
    "tables, figures and a page from runs of eval.py",
    ReportRequest,
    _later("dsr.app.report", "make_report"),
    description="""\
Make tables, figures, the metric study and a page from runs of eval.py. All runs in and below the directories are read;
no other files are needed.
""",
    epilog="""\
examples:
  dsr report outputs/eval -o report
  dsr report outputs/eval -o report --methods Bicubic MSG-V --scale 4
  dsr report outputs/eval -o report --study study.csv     with the columns of a user study, see `dsr study`
  dsr report outputs/eval -o report --only tables

Open report/index.html in a browser. It needs no network and can be sent as it is.
""",
)

LEADERBOARD = Command(
    "leaderboard",
    "a page with one row a method, from runs of eval.py",
    LeaderboardRequest,
    _later("dsr.app.report", "make_leaderboard"),
    description="""\
Make a static page that ranks the methods of all runs in and below the directories over all data sets, scales and
metrics, with their surfaces under any light. A click on a method shows it beside another.
""",
    epilog="""\
examples:
  python eval.py -m +experiment=reference
  python eval.py -m method=external method.path=mine,yours metrics=suite
  dsr leaderboard outputs/eval -o site

Open site/index.html in a browser, or publish the folder as it is.
""",
)

EXPORT = Command(
    "export",
    "a network as a file for programs without PyTorch",
    ExportRequest,
    _later("dsr.app.export", "export_onnx"),
    description="""\
Write a method's network as an ONNX file, which takes a photo and a depth map of any size, and check it with
onnxruntime. The libraries are an extra: pip install -e '.[onnx]' in a checkout.""",
    epilog="""\
examples:
  dsr export --onnx facets_x4.onnx
  dsr export --onnx facets_x1.onnx --scale 1               for depth maps of the photo's own size
  dsr export --onnx msg_v_x8.onnx --method msg_v --scale 8
  dsr export --onnx mine.onnx --method pdn --weights outputs/train/mine/weights.safetensors

Inputs: photo (1, 3, H, W) in 0..1, inverse_depth (1, 1, h, w) in 1 / metres, valid (1, 1, h, w) bool, with H = N h and
W = N w. Output: inverse_depth_hr (1, 1, H, W); of facets also relative_error, that of the depth, and angle_error in
degrees. docs/python.md has a program that runs such a file.
""",
)

FORMATS_COMMAND = Command("formats", "what is read of which device or program", FormatsRequest, _show_formats)
DOCTOR = Command(
    "doctor",
    "check what is installed, or a directory of your own scenes",
    DoctorRequest,
    _examine,
    epilog="""\
examples:
  dsr doctor                     whether everything is here that dsr needs: exit code 0, or 2
  dsr doctor my_scenes           units, cameras, holes: exit code 0, or 1 where something is probably wrong
""",
)


_HYDRA_COMMANDS = {
    "eval": "evaluate a method on a data set: predictions, scores, pictures",
    "train": "train a network: weights, checkpoints, a TensorBoard log",
}


def add_hydra_commands(commands: Any) -> None:
    """Add ``eval`` and ``train``, the same as ``eval.py`` and ``train.py`` of a checkout, to the parser's commands."""
    for name, about in _HYDRA_COMMANDS.items():
        # No argument begins with a space, so all of them, --help and -m too, are values, which Hydra parses.
        parser = commands.add_parser(name, help=about, add_help=False, prefix_chars=" ")
        parser.add_argument("arguments", nargs="*")
        parser.set_defaults(run=_run_hydra, name=name)


def _run_hydra(options: argparse.Namespace, *_: object) -> int:
    """Run the command, which exits the process after an error."""
    from dsr.app.entry import run_eval, run_train  # noqa: PLC0415 - Hydra is not needed for the other commands

    {"eval": run_eval, "train": run_train}[options.name](options.arguments)
    return 0


_DATA_EXAMPLES = """\
examples:
  dsr data list
  dsr data get middlebury middlebury2003 --yes
  dsr data get sunrgbd --mirror https://server.example/data
  dsr data verify tofmark
  dsr data prepare middlebury dataset.scenes=found
  DSR_DATA=/large/disk dsr data where icl

All data sets are below one directory: $DSR_DATA, or ./data.
"""
_GET_NOTES = """\
Run the same command again to continue an interrupted download.

A file has to have the SHA-256 that dsr knows. Where it knows none, that of the first download is written into
checksums.json, and later ones have to match it; `dsr data list` shows which.

A mirror has every file under the same path as below the directory of the data sets, and every archive in the folder
of its data set:
  URL/middlebury2014/Vintage-perfect/im0.png
  URL/sunrgbd/SUNRGBD.zip
  URL/icl_nuim/office_room_traj0_frei_png.tar.gz
An archive that you put there by hand is used instead of being downloaded, and kept.
"""


def add_data_command(commands: Any) -> None:
    """Add ``dsr data``, which lists, fetches, checks and prepares data sets, to the parser's commands."""
    style = argparse.RawDescriptionHelpFormatter
    data = commands.add_parser(
        "data",
        help="list, fetch and check data sets",
        description="Data sets.",
        epilog=_DATA_EXAMPLES,
        formatter_class=style,
    )
    tasks = data.add_subparsers(title="commands", metavar="COMMAND", required=True)
    tasks.add_parser("list", help="all data sets, and which of them are on this machine").set_defaults(
        run=_run_data_task, task="list"
    )

    where = tasks.add_parser("where", help="the directory of the data sets, or the folders of some")
    where.add_argument("names", nargs="*", metavar="NAME", help="a data set, as in `dsr data list`")
    where.set_defaults(run=_run_data_task, task="where")

    fetch = tasks.add_parser("get", help="fetch what is missing", epilog=_GET_NOTES, formatter_class=style)
    fetch.add_argument("names", nargs="+", metavar="NAME", help="a data set, as in `dsr data list`")
    fetch.add_argument("--mirror", metavar="URL", help="a server to try first, see below")
    fetch.add_argument("--yes", "-y", action="store_true", help="do not ask")
    fetch.add_argument("--keep-archives", action="store_true", help="keep archives after unpacking")
    fetch.set_defaults(run=_run_data_task, task="get")

    check = tasks.add_parser("verify", help="check every file against its recorded size and checksum")
    check.add_argument("names", nargs="+", metavar="NAME", help="a data set, as in `dsr data list`")
    check.set_defaults(run=_run_data_task, task="verify")
    ready = tasks.add_parser("prepare", help="resize and keep the scenes of a data set, and draw a contact sheet")
    ready.add_argument("name", metavar="NAME", help="a data set, as in `eval.py dataset=NAME`")
    ready.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="as for eval.py, such as dataset.size=256")
    ready.add_argument("--config-dir", type=Path, metavar="DIR", help="a directory of your own with dataset/NAME.yaml")
    ready.set_defaults(run=_run_data_task, task="prepare")
    for task in (fetch, check):
        task.add_argument(
            "--accept-changed", action="store_true", help="take files whose checksum differs from the recorded one"
        )


def _run_data_task(options: argparse.Namespace, console: Console, catalogue: Any) -> list[str]:
    """Run a task on the data sets of a catalogue, None for all that are known."""
    from dsr.cli.data_tasks import TASKS, downloads  # noqa: PLC0415 - it imports what downloads need

    return TASKS[options.task](options, console, downloads() if catalogue is None else catalogue)
