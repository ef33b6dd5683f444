"""The commands behind ``dsr report``, ``dsr leaderboard`` and ``dsr study``."""

import json
import os
from pathlib import Path

import pandas as pd
from rich.console import Console

from dsr.app.requests import REPORT_PARTS, AnswersRequest, LeaderboardRequest, ReportRequest, StudyRequest
from dsr.evaluation.run_files import load_results
from dsr.notes import expect_no_warning
from dsr.report.correlations import save_scatter_matrix, write_correlations
from dsr.report.figures import Figures
from dsr.report.page import Pictures, save_page
from dsr.report.study.files import KEY_NAME, files_of, read_all, read_key
from dsr.report.study.percentages import collect, read_study, remarks, tables_of
from dsr.report.study.questionnaire import build_study
from dsr.report.table_layouts import write_tables
from dsr.report.worker_pool import WorkerPool
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.files import expect_target, replacing_folder, write_text
from dsr.utils.progress import Progress
from dsr.utils.ratios import as_ratio

_MARK = "report.json"  # a file that marks a directory as a report, which a new one may replace
_FEW = 24  # predictions below which the start of worker processes takes longer than they save
_MOST = 8  # workers unless more are requested; each needs about 0.5 GB
_MAIN = {
    "page": "index.html",
    "tables": "tables/all.md",
    "LaTeX": "tables/all.tex",
    "figures": "figures",
    "metrics": "metrics",
}


def make_report(request: ReportRequest, console: Console) -> list[str]:
    """Write the tables, figures, correlations and page of runs in place of an earlier report, whole or not at all."""
    output = request.output
    if output.exists() and not (output.is_dir() and ((output / _MARK).is_file() or not any(output.iterdir()))):
        raise ValueError(f"{output}: expected a new directory or an earlier report, it holds something else")
    results = load_results(request.runs)
    results = results.only(request.methods, request.datasets, tuple(map(as_ratio, request.scales)))
    if request.strict:
        expect_no_warning(", ".join(map(str, request.runs)), results.warnings)
    answers = None if request.study is None else read_study(request.study)
    predictions = sum(len(run.scenes) for run in results.runs)
    worth = 1 if predictions < _FEW else min(os.cpu_count() or 1, _MOST)
    workers = worth if request.workers is None else request.workers
    progress = ConsoleProgress(console)
    with replacing_folder(output) as temporary, WorkerPool(results, workers, progress.say) as pool:
        notes = _write(temporary, pool, answers, request, progress)
        about = {"runs": [str(run.folder) for run in results.runs], "warnings": [w.record() for w in results.warnings]}
        write_text(temporary / _MARK, json.dumps(about, indent=1) + "\n")
    for warning in results.warnings:
        show(console, str(warning))
    for note in (*results.notes, *notes):
        show(console, f"note: {note}")
    for what, file in _MAIN.items():
        if (output / file).exists():
            show(console, f"{what:<8} {output / file}")
    return []


def make_leaderboard(request: LeaderboardRequest, console: Console) -> list[str]:
    """Write a page of runs that begins with one row a method, with the tables beside it."""
    parts = ("tables", "page")
    return make_report(ReportRequest(**vars(request), leaderboard=True, intervals=True, parts=parts), console)


def _write(
    folder: Path, pool: WorkerPool, study: pd.DataFrame | None, request: ReportRequest, progress: Progress
) -> list[str]:
    """Write the parts, the tables while workers are at what takes longest; return notes for the reader."""
    results = pool.results
    notes: list[str] = []
    scored = any(not run.scores.empty for run in results.runs)
    scatter = pool.map(save_scatter_matrix, [folder / "metrics"] if "metrics" in request.parts and scored else [])
    drawn = Figures(folder / "figures", pool, request.light) if "figures" in request.parts else None
    pictures = Pictures(pool, request.page_px) if "page" in request.parts else None

    todo = [part for part in REPORT_PARTS if part in request.parts]
    if not scored:
        notes.append("no scene has a ground truth to score against, so there are no tables and no metric study")
        todo = [part for part in todo if part not in ("tables", "metrics")]
    for part in progress.track(todo, "report"):
        if part == "tables":
            write_tables(folder / "tables", results, study, intervals=request.intervals)
        elif part == "metrics":
            write_correlations(folder / "metrics", results)
            list(scatter)
        elif drawn is not None and part == "figures":
            with progress.task("figures") as task:
                drawn.save(task)
            notes.extend(drawn.notes)
        elif pictures is not None and part == "page":  # which is last, as it links to the other parts' files
            with progress.task("scenes") as task:
                notes += save_page(
                    folder / "index.html",
                    pictures,
                    title=request.title,
                    progress=task,
                    leaderboard=request.leaderboard,
                )
    return list(dict.fromkeys(notes))


def build_page(request: StudyRequest, console: Console) -> list[str]:
    """Make the page and its key."""
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


def collect_answers(request: AnswersRequest, console: Console) -> list[str]:
    """Read answers, print and write the table."""
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
