"""The commands of ``dsr``: the options of each and the function behind it, which is imported after the checks."""

from __future__ import annotations

import argparse
import importlib
from argparse import Namespace, RawDescriptionHelpFormatter
from inspect import cleandoc
from typing import NamedTuple

from rich.console import Console

from dsr.app import requests
from dsr.app.upsample.request import UpsampleRequest
from dsr.utils.options import Options, add_options, build


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


def add_commands(parser: argparse.ArgumentParser) -> None:
    """Add the commands, and the groups of some, to the parser of ``dsr``."""
    style = RawDescriptionHelpFormatter
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


def show_formats(request: requests.FormatsRequest, console: Console) -> list[str]:
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
  dsr fuse out -o mesh.ply --voxel 0.01
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
    Command("study build", requests.StudyRequest, "dsr.cli.tasks:build_page", """\
examples:
  dsr study build outputs/eval -o study
  dsr study build outputs/eval --scale 4 --methods bicubic msg_v facets --repeat 2 -o study
  dsr study build outputs/eval --scenes-per-person 10 --send-to "Mail the file to study@example.org." -o study

Give people only index.html: key.json says which method made which picture.
"""),
    Command("study collect", requests.AnswersRequest, "dsr.cli.tasks:collect_answers", """\
Join the table to a report: dsr report RUNS --study study/study.csv
"""),
    Command("data list", requests.DataListRequest, "dsr.cli.data_tasks:list_data_sets"),
    Command("data where", requests.DataWhereRequest, "dsr.cli.data_tasks:show_folders"),
    Command("data get", requests.DataGetRequest, "dsr.cli.data_tasks:get_data_sets", """\
A file has to have the SHA-256 that dsr knows. Where it knows none, that of the first download is written into
checksums.json, and later ones have to match it; `dsr data list` shows which.

A mirror has every file under the same path as below the directory of the data sets, and every archive in the folder
of its data set:
  URL/middlebury2014/Vintage-perfect/im0.png
  URL/sunrgbd/SUNRGBD.zip
  URL/icl_nuim/office_room_traj0_frei_png.tar.gz
An archive that you put there by hand is used instead of being downloaded, and kept.
"""),
    Command("data verify", requests.DataVerifyRequest, "dsr.cli.data_tasks:verify_data_sets"),
    Command("data prepare", requests.DataPrepareRequest, "dsr.app.evaluate:prepare_dataset"),
    Command("formats", requests.FormatsRequest, "dsr.cli.commands:show_formats"),
    Command("doctor", requests.DoctorRequest, "dsr.cli.commands:examine", """\
examples:
  dsr doctor                     whether everything is here that dsr needs: exit code 0, or 2
  dsr doctor my_scenes           units, cameras, holes: exit code 0, or 1 where something is probably wrong
"""),
    Command("export", requests.ExportRequest, "dsr.cli.tasks:export_onnx", """\
examples:
  dsr export --onnx facets_x4.onnx
  dsr export --onnx facets_x1.onnx --scale 1               for depth maps of the photo's own size
  dsr export --onnx msg_v_x8.onnx --method msg_v --scale 8
  dsr export --onnx mine.onnx --method pdn --weights outputs/train/mine/weights.safetensors

Inputs: photo (1, 3, H, W) in 0..1, inverse_depth (1, 1, h, w) in 1 / metres, valid (1, 1, h, w) bool, with H = N h and
W = N w. Output: inverse_depth_hr (1, 1, H, W); of facets also relative_error, that of the depth, and angle_error in
degrees. docs/python.md has a program that runs such a file.
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
