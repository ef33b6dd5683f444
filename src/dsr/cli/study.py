"""``dsr study``: ask people which rendering looks most like the ground truth, and collect their answers."""

from __future__ import annotations

from rich.console import Console

from dsr.app.requests import AnswersRequest, StudyRequest
from dsr.cli.commands import Command, CommandGroup
from dsr.notes import expect_no_warning
from dsr.utils.console import ConsoleProgress, show

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


def _build(request: StudyRequest, console: Console, _: object) -> list[str]:
    """Make the page and its key."""
    from dsr.evaluation.run_files import load_results  # noqa: PLC0415 - torch and pandas take seconds to import
    from dsr.report.study.questionnaire import build_study  # noqa: PLC0415

    progress, results = ConsoleProgress(console), load_results(request.runs)
    if request.strict:
        expect_no_warning(", ".join(map(str, request.runs)), results.warnings)
    built = build_study(results, request.output, request.choice, progress, overwrite=request.overwrite)
    for warning in results.warnings:
        show(console, str(warning))
    for note in built.notes:
        show(console, note)
    key = built.key
    labels = dict.fromkeys(each.label for trial in key.trials.values() for each in trial.candidates.values())
    count, size = len(key.trials), built.page.stat().st_size / 1e6
    show(console, f"study {key.study}: {count} scenes under {key.light}; {', '.join(labels)}")
    questions = key.scenes_per_person + key.repeat
    show(console, f"{built.page}  {size:.1f} MB, {questions} questions for each person; give people only this file")
    show(console, f"{request.output / 'key.json'}  which method made which picture; keep it to yourself")
    return []


def _collect(request: AnswersRequest, console: Console, _: object) -> list[str]:
    """Read answers, print and write the table."""
    from dsr.report.study.answers import files_of, read_all  # noqa: PLC0415
    from dsr.report.study.key import KEY_NAME, read_key  # noqa: PLC0415
    from dsr.report.study.percentages import collect, remarks, tables_of  # noqa: PLC0415
    from dsr.utils.files import expect_target, write_text  # noqa: PLC0415 - pandas takes a second to import

    path = request.output or request.study / "study.csv"
    expect_target(path)
    key = read_key(request.study / KEY_NAME)
    files = files_of(request.answers)
    answers, left_out = read_all(files, key)
    errors = Console(stderr=True)
    for line in left_out:
        show(errors, f"left out: {line}")
    if not answers:
        raise ValueError(f"{request.study}: expected answers that count, got none in {len(files)} files")
    table = collect(answers, key)
    for each in tables_of(table):
        console.print(each)
    for line in remarks(answers, key):
        show(console, line)
    write_text(path, table.to_csv(index=False, float_format="%.6g"))
    show(console, f"{path}  {len(answers)} of {len(files)} files count{', see above' if left_out else ''}")
    return []


STUDY = CommandGroup(
    "study",
    "ask people which rendering looks most like the ground truth",
    (
        Command(
            "build",
            "make a page that needs no network, from runs of eval.py",
            StudyRequest,
            _build,
            _BUILD_EXAMPLES,
        ),
        Command("collect", "turn the files that people saved into a table", AnswersRequest, _collect, _COLLECT_NOTES),
    ),
    _EXAMPLES,
)
