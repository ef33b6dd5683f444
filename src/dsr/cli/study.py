"""``dsr study``: ask people which rendering looks most like the ground truth, and collect their answers."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from dsr.utils.console import ConsoleProgress, show
from dsr.utils.ratios import as_ratio

if TYPE_CHECKING:
    import pandas as pd

_EXAMPLES = """\
examples:
  dsr study build outputs/eval --scale 4 -o study     make study/index.html, to hand out, and study/key.json, to keep
  dsr study collect study answers/*.json              percentages with confidence intervals, and study/study.csv
"""
_BUILD_EXAMPLES = """\
examples:
  dsr study build outputs/eval -o study
  dsr study build outputs/eval --scale 4 --methods bicubic msg_v facets --repeat 2 -o study
  dsr study build outputs/eval --scenes-per-person 10 --send-to "Mail the file to study@example.org." -o study

Give people only index.html: key.json says which method made which picture.
"""
_COLLECT_NOTES = """\
Files that are damaged, incomplete or of another study are named and left out. If one person sent several files, only
the one finished first counts. The exit code is 2 if no file is left.

Join the table to a report: dsr report RUNS --study study/study.csv
"""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    raw = argparse.RawDescriptionHelpFormatter
    about = "ask people which rendering looks most like the ground truth"
    parser = commands.add_parser("study", help=about, description=about, epilog=_EXAMPLES, formatter_class=raw)
    steps = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    about = "make a page that needs no network, from runs of eval.py"
    build = steps.add_parser("build", help=about, description=about, epilog=_BUILD_EXAMPLES, formatter_class=raw)
    build.add_argument("runs", nargs="+", type=Path, metavar="RUNS", help="runs, or directories with runs below")
    build.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="where to")
    build.add_argument("--light", default="e4", help="of the renderings: e1, e2, e3 or e4, the default")
    build.add_argument("--scale", type=float, nargs="+", default=[], metavar="N", help="these alone")
    build.add_argument("--downsampling", nargs="+", default=[], metavar="NAME", help="these alone")
    build.add_argument("--methods", nargs="+", default=[], metavar="NAME", help="these alone")
    build.add_argument("--scenes", nargs="+", default=[], metavar="NAME", help="these alone")
    build.add_argument("--scenes-per-person", type=int, metavar="N", help="for each person, drawn at random")
    build.add_argument(
        "--repeat",
        type=int,
        default=0,
        metavar="N",
        help="N of them are shown twice, to measure how consistent people are",
    )
    build.add_argument("--title", metavar="TEXT", help="of the page")
    build.add_argument(
        "--send-to", metavar="TEXT", help="instructions on the last page for sending the file of answers"
    )
    build.add_argument(
        "--overwrite", action="store_true", help="replace another study, whose answers can then no longer be collected"
    )
    build.set_defaults(run=_build)
    about = "turn the files that people saved into a table"
    collect = steps.add_parser("collect", help=about, description=about, epilog=_COLLECT_NOTES, formatter_class=raw)
    collect.add_argument("study", type=Path, metavar="DIR", help="the study's directory, with key.json")
    collect.add_argument("answers", nargs="+", type=Path, metavar="ANSWERS", help="files, or directories of them")
    collect.add_argument("-o", "--output", type=Path, metavar="FILE", help="the table; DIR/study.csv by default")
    collect.set_defaults(run=_collect)


def _build(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Make the page and its key."""
    from dsr.evaluation.run_files import load_results  # noqa: PLC0415 - torch and pandas take seconds to import
    from dsr.user_study.build import Choice, build_study  # noqa: PLC0415

    words = {name: text for name, text in (("title", options.title), ("send_to", options.send_to)) if text is not None}
    choice = Choice(
        light=options.light,
        scales=[as_ratio(scale) for scale in options.scale],
        downsamplings=options.downsampling,
        methods=options.methods,
        scenes=options.scenes,
        scenes_per_person=options.scenes_per_person,
        repeat=options.repeat,
        **words,
    )

    progress = ConsoleProgress(console)
    built = build_study(load_results(options.runs), options.output, choice, progress, overwrite=options.overwrite)
    for note in built.notes:
        show(console, note)
    key = built.key
    labels = dict.fromkeys(each.label for trial in key.trials.values() for each in trial.candidates.values())
    count, size = len(key.trials), built.page.stat().st_size / 1e6
    show(console, f"study {key.study}: {count} scenes under {key.light}; {', '.join(labels)}")
    questions = key.scenes_per_person + key.repeat
    show(console, f"{built.page}  {size:.1f} MB, {questions} questions for each person; give people only this file")
    show(console, f"{options.output / 'key.json'}  which method made which picture; keep it to yourself")
    return []


def _collect(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Read answers, print and write the table."""
    from dsr.user_study.answers import files_of, read_all  # noqa: PLC0415
    from dsr.user_study.collect import collect, remarks  # noqa: PLC0415
    from dsr.user_study.key import KEY_NAME, read_key  # noqa: PLC0415
    from dsr.utils.files import write_text  # noqa: PLC0415 - pandas takes a second to import

    key = read_key(options.study / KEY_NAME)
    files = files_of(options.answers)
    answers, left_out = read_all(files, key)
    errors = Console(stderr=True)
    for line in left_out:
        show(errors, f"left out: {line}")
    if not answers:
        raise ValueError(f"{options.study}: expected answers that count, got none in {len(files)} files")
    table = collect(answers, key)
    _print(console, table)
    for line in remarks(answers, key):
        show(console, line)
    path = options.output or options.study / "study.csv"
    write_text(path, table.to_csv(index=False, float_format="%.6g"))
    show(console, f"{path}  {len(answers)} of {len(files)} files count{', see above' if left_out else ''}")
    return []


def _print(console: Console, table: pd.DataFrame) -> None:
    """Print one table for each data set, scale and degradation."""
    from dsr.user_study.summary import tables_of  # noqa: PLC0415

    for each in tables_of(table):
        console.print(each)
