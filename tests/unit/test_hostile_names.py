"""Names that are commands or code come out of every file as the texts that they are."""

import dataclasses
import io
import re

import pandas as pd
import pytest
from small_runs import hostile_run

from dsr.evaluation.run_files import load_results
from dsr.report.correlations import save_scatter_matrix
from dsr.report.study.percentages import PERCENTAGES, read_study
from dsr.report.table_layouts import escaped, latex_text, to_csv, to_latex, to_markdown
from dsr.report.tables import build_tables

NAMES = (
    "=cmd|' /C calc'!A0", "+1", "-0.5", "@SUM(A1)", "\tx", "\rx", "x\r=y", "\nx", "'=x", "''-x", "'", "'x", "plain",
    "", "é=", "<script>alert(1)</script>", "\\input{/etc/passwd}", "`id`", "a|b", "$\\frac$", "[2pt]",
)  # fmt: skip
HOSTILE = "=cmd|' \\input{/etc/passwd} `id` <script>alert(1)</script> $\\frac$"


@pytest.fixture
def results(make_run, tmp_path):
    """A run whose method, data set, scene and a metric have a hostile name."""
    results = load_results([hostile_run(make_run, tmp_path / "run", HOSTILE)])
    assert set(results.runs[0].scores["method"]) == {HOSTILE}
    return results


def test_tables_of_a_report_have_no_command_or_tag(results):
    for table in build_tables(results, None):
        assert HOSTILE in pd.read_csv(io.StringIO(to_csv(table)), dtype=str)["method"].tolist()
        markdown = to_markdown(table)
        assert "\\<script\\>" in markdown
        assert not re.search(r"(?<!\\)[<`|](?=script|id|/script|\s*\\\\input)", markdown)
        latex = to_latex(table)
        assert "\\textbackslash{}input\\{/etc/passwd\\}" in latex
        assert not re.search(r"\\input\b|\\frac\b|(?<!\\)\$\\textb", latex)
        assert "/" not in table.name


def test_markdown_rows_have_as_many_cells_as_the_head(results):
    for table in build_tables(results, None):
        for part in to_markdown(table).split("\n\n"):
            lines = [line for line in part.splitlines() if line.startswith("|")]
            assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) <= 1


def test_latex_rows_do_not_begin_with_an_option(results):
    [run] = results.runs
    scene = run.scenes[0]
    scores = run.scores.assign(scene="[2pt]")
    odd = dataclasses.replace(run, scenes=("[2pt]",), scores=scores, seconds={"[2pt]": run.seconds[scene]})
    tables = build_tables(dataclasses.replace(results, runs=(odd,)), None)
    assert any("\n{}[2pt] & " in to_latex(table) for table in tables)
    assert not any(re.search(r"(\\\\|rule)\s*[\[*]", to_latex(table)) for table in tables)


@pytest.mark.parametrize("name", NAMES)
def test_no_name_is_a_command_of_latex_or_markdown(name):
    assert not re.search(r"\\(?!textbackslash|textasci|textless|textgreater|textbar|[{}$&#%_])[a-z]", latex_text(name))
    assert not re.search(r"(?<!\\)[`<>|]", escaped(name))


def test_figures_show_names_that_look_like_formulas_of_tex(results, tmp_path):
    more = dataclasses.replace(results.runs[0], label="$\\frac$ $x", folder=results.runs[0].folder)
    both = dataclasses.replace(results, runs=(results.runs[0], more))
    assert all(path.stat().st_size > 1000 for path in save_scatter_matrix(both, tmp_path / "figures"))


def test_study_is_read_with_its_names(tmp_path):
    shares = dict.fromkeys(PERCENTAGES, 50.0)
    about = {"dataset": "-1", "scene": "@x", "scale": 4, "downsampling": "box", "label": HOSTILE}
    (tmp_path / "study.csv").write_text(pd.DataFrame([{**about, **shares}]).to_csv(index=False))
    assert read_study(tmp_path / "study.csv").iloc[0][[*about]].to_dict() == about
