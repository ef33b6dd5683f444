"""``dsr study`` and ``dsr export``: ask people which rendering looks best, and write a network as an ONNX file."""

from rich.console import Console

import dsr
from dsr.app.requests import AnswersRequest, ExportRequest, StudyRequest
from dsr.evaluation.run_files import load_results
from dsr.methods.networks.network_file import OnnxGraph, write_onnx
from dsr.methods.recipe import read_recipe
from dsr.notes import expect_no_warning
from dsr.report.study.files import KEY_NAME, files_of, read_all, read_key
from dsr.report.study.percentages import collect, remarks, tables_of
from dsr.report.study.questionnaire import build_study
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.files import expect_target, write_text
from dsr.utils.progress import megabytes


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


def export_onnx(request: ExportRequest, console: Console) -> list[str]:
    """Write the file, check it, and show its inputs and outputs."""
    net = read_recipe(request.method, None, request.directories).with_weights(request.weights).network(request.scale)
    graph = OnnxGraph(net, request.scale)
    facts = {"dsr": dsr.__version__, "method": request.method, "scale": request.scale, "network": type(net).__name__}
    difference = write_onnx(request.path, graph, facts)
    size = megabytes(request.path.stat().st_size)
    lines = (
        f"{request.method} x{request.scale} -> {request.path}, {size}",
        f"  inputs: photo (1, 3, H, W), inverse_depth and valid (1, 1, H / {request.scale}, W / {request.scale})",
        f"  outputs: {', '.join(graph.outputs)} (1, 1, H, W)",
        f"  onnxruntime differs from PyTorch by at most {difference:.1g} of the range",
    )
    for line in lines:
        show(console, line)
    return []
