"""The three formats of a table: what stands in them, that LaTeX takes it, and that no name in it is run as code."""

import dataclasses
import io
import re

import pandas as pd
import pytest
from small_runs import hostile_run, made_up_run

from dsr.evaluation.results import Results
from dsr.evaluation.run_files import load_results
from dsr.report.table_layouts import MISSING, escaped, latex_text, to_csv, to_latex, to_markdown
from dsr.report.tables import build_tables


def run(label, values, *, method="other", seed=0):
    """Return a run on a folder of scenes whose RMSE_d is the value in mm, and whose DSSIM_v, too, in thousandths."""
    scores = {scene: {"RMSE_d": value / 1e3, "DSSIM_v[max]": value / 1e3} for scene, value in values.items()}
    settings = {"dataset": {"_target_": "dsr.data.folder.Folder"}}
    return made_up_run(label, scores, dataset="mine", method=method, seed=seed, settings=settings)


def results():
    """Return three seeds of one method, one seed of others, and a scene that one of them lacks."""
    seeds = [run("DIP", {"lucy": 20.0 + 2 * seed, "b": 50.0}, seed=seed) for seed in range(3)]
    whole = run("MSG-V", {"lucy": 23.6, "b": 40.0}, method="msg_v")
    return Results((run("Bicubic", {"lucy": 70.4}, method="bicubic"), *seeds, whole))


def the_table(given=None, study=None):
    return build_tables(given or results(), study)[1]


def lines_of(text, start):
    """Return the cells of the table that follows a heading."""
    lines = text[text.index(start) :].splitlines()
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if line.startswith("|")]


def test_markdown_has_means_spreads_ranks_missing_values_and_scene_counts():
    head, _, *rows = lines_of(to_markdown(the_table()).split("###")[0], "##")
    assert head == ["scene", "method", "seeds", "RMSE_d (mm)", "DSSIM_v (1/1000)"]
    assert rows == [
        ["lucy", "Bicubic", "1", "70.4", "70"],
        ["", "DIP", "3", "**22.0** ± 2.0", "**22** ± 2"],
        ["", "MSG-V", "1", "<ins>23.6</ins>", "<ins>24</ins>"],
        ["b", "Bicubic", "1", MISSING, MISSING],
        ["", "DIP", "3", "<ins>50.0</ins> ± 0.0", "<ins>50</ins> ± 0"],
        ["", "MSG-V", "1", "**40.0**", "**40**"],
        ["mine, average of 2 scenes", "Bicubic", "1", "70.4 (1 of 2)", "70 (1 of 2)"],
        ["", "DIP", "3", "**22.0** ± 2.0 (1 of 2)", "**22** ± 2 (1 of 2)"],
        ["", "MSG-V", "1", "<ins>23.6</ins> (1 of 2)", "<ins>24</ins> (1 of 2)"],
    ]


def test_markdown_has_the_papers_values_the_difference_and_the_ratio():
    text = to_markdown(the_table())
    head, _, *rows = lines_of(text, "### ")
    assert head == ["scene", "method", "", "RMSE_d (mm)", "DSSIM_v (1/1000)"]
    assert rows[:4] == [
        ["lucy", "Bicubic", "ours", "70.4", "70"],
        ["", "", "paper", "72", "355"],
        ["", "", "difference", "-1.6", "-285"],
        ["", "", "ratio", "0.98", "0.20"],
    ]
    assert ["", "PDN", "paper"] in [row[:3] for row in rows]
    assert "nan" not in text.casefold()


def test_csv_has_full_precision_the_papers_units_and_no_empty_column():
    frame = pd.read_csv(io.StringIO(to_csv(the_table())))
    row = frame[(frame["scene"] == "lucy") & (frame["method"] == "DIP")].iloc[0]
    assert row["RMSE_d [mm]"] == 22
    assert row["RMSE_d spread [mm]"] == 2
    assert row["seeds"] == 3
    average = frame[(frame["kind"] == "average") & (frame["method"] == "Bicubic")].iloc[0]
    assert (average["RMSE_d scenes"], average["RMSE_d [mm]"]) == (1, pytest.approx(70.4, abs=1e-12))
    ours = frame[(frame["scene"] == "lucy") & (frame["method"] == "MSG-V")].iloc[0]
    assert ours["RMSE_d paper [mm]"] == 74
    assert ours["RMSE_d difference [mm]"] == pytest.approx(23.6 - 74)
    assert ours["RMSE_d ratio"] == pytest.approx(23.6 / 74)
    other = frame[frame["method"] == "PDN (paper)"].iloc[0]
    assert pd.isna(other["RMSE_d [mm]"])
    assert other["RMSE_d paper [mm]"] > 0
    assert "DSSIM_v [1/1000]" in frame
    assert not [name for name in frame if "low" in name or frame[name].isna().all()]
    alone = pd.read_csv(io.StringIO(to_csv(the_table(Results((run("A", {"x": 1.25}),))))))
    assert not [name for name in alone if "spread" in name or "paper" in name]


def test_latex_has_rules_units_marks_and_dashes():
    text = to_latex(the_table())
    lines = [line.rstrip("\\ ").split(" & ") for line in text.splitlines() if " & " in line]
    assert lines[0] == ["Scene", "Method", "Seeds", "RMSE$_{d}$", "DSSIM$_{v}$"]
    assert lines[1] == ["", "", "", "mm", "1/1000"]
    assert ["", "DIP", "3", "\\textbf{22.0} $\\pm$ 2.0", "\\textbf{22} $\\pm$ 2"] in lines
    assert ["b", "Bicubic", "1", "--", "--"] in lines
    assert ["", "Bicubic", "1", "70.4 (1 of 2)", "70 (1 of 2)"] in lines
    assert "\\underline{23.6}" in text
    assert [text.count(f"\\{rule}rule") for rule in ("top", "mid", "bottom")] == [1, 3, 1]


def test_second_latex_table_has_the_papers_values_in_parentheses():
    mine = run("Mine", {"lucy": 2.0})
    text = to_latex(the_table(Results((*results().runs, mine))), published=True)
    lines = [line.rstrip("\\ ").split(" & ") for line in text.splitlines() if " & " in line]
    assert ["lucy", "Bicubic", "70.4 (72)", "70 (355)"] in lines
    assert ["", "Mine", "\\textbf{2.0} (--)", "\\textbf{2} (--)"] in lines
    assert ["", "PDN (paper)"] in [line[:2] for line in lines]
    assert not [line for line in lines if line[1] == "MSG (paper)" and "--" in line]
    assert "b &" not in text  # the paper has no such scene


def test_long_latex_table_is_split_to_fit_on_pages():
    scenes = {f"scene{number:02}": 1.0 for number in range(50)}
    text = to_latex(the_table(Results((run("A", scenes), run("B", scenes)))))
    parts = text.split("\\end{table}")[:-1]
    assert len(parts) == 4
    assert max(part.count("\\\\\n") for part in parts) == 2 + 26  # of the heading, and rows
    assert all(text.count(f"{name} &") == 1 for name in scenes)


@pytest.mark.parametrize(("text", "shown"), [("50%_&", "50\\%\\_\\&"), ("é", "é"), ("日本", "[U+65E5][U+672C]")])
def test_latex_text_is_escaped_or_named(text, shown):
    assert latex_text(text) == shown


# Names that are commands or code


NAMES = (
    "=cmd|' /C calc'!A0", "+1", "-0.5", "@SUM(A1)", "\tx", "\rx", "x\r=y", "\nx", "'=x", "''-x", "'", "'x", "plain",
    "", "é=", "<script>alert(1)</script>", "\\input{/etc/passwd}", "`id`", "a|b", "$\\frac$", "[2pt]",
)  # fmt: skip
HOSTILE = "=cmd|' \\input{/etc/passwd} `id` <script>alert(1)</script> $\\frac$"


@pytest.fixture
def hostile(make_run, tmp_path):
    """A run whose method, data set, scene and a metric have a hostile name."""
    results = load_results([hostile_run(make_run, tmp_path / "run", HOSTILE)])
    assert set(results.runs[0].scores["method"]) == {HOSTILE}
    return results


def test_tables_of_a_report_have_no_command_or_tag(hostile):
    for table in build_tables(hostile, None):
        assert HOSTILE in pd.read_csv(io.StringIO(to_csv(table)), dtype=str)["method"].tolist()
        markdown = to_markdown(table)
        assert "\\<script\\>" in markdown
        assert not re.search(r"(?<!\\)[<`|](?=script|id|/script|\s*\\\\input)", markdown)
        latex = to_latex(table)
        assert "\\textbackslash{}input\\{/etc/passwd\\}" in latex
        assert not re.search(r"\\input\b|\\frac\b|(?<!\\)\$\\textb", latex)
        assert "/" not in table.name
        for part in markdown.split("\n\n"):  # rows have as many cells as the head
            lines = [line for line in part.splitlines() if line.startswith("|")]
            assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) <= 1


def test_latex_rows_do_not_begin_with_an_option(hostile):
    [run] = hostile.runs
    scene = run.scenes[0]
    named = {"scenes": ("[2pt]",), "scores": run.scores.assign(scene="[2pt]"), "seconds": {"[2pt]": run.seconds[scene]}}
    odd = dataclasses.replace(run, **named)
    tables = build_tables(dataclasses.replace(hostile, runs=(odd,)), None)
    assert any("\n{}[2pt] & " in to_latex(table) for table in tables)
    assert not any(re.search(r"(\\\\|rule)\s*[\[*]", to_latex(table)) for table in tables)


@pytest.mark.parametrize("name", NAMES)
def test_no_name_is_a_command_of_latex_or_markdown(name):
    assert not re.search(r"\\(?!textbackslash|textasci|textless|textgreater|textbar|[{}$&#%_])[a-z]", latex_text(name))
    assert not re.search(r"(?<!\\)[`<>|]", escaped(name))
