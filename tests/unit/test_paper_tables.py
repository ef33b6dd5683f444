"""The paper's tables: which scenes an average is over, seeds, ranks, and the paper's values beside ours."""

import math
import statistics
from dataclasses import replace

import pandas as pd
import pytest
from small_runs import made_up_run

from dsr.evaluation.results import Results, Run
from dsr.metrics.formats import MetricFormat
from dsr.report.paper import PAPER_SCENES, Place, published, sets_of_dataset, sets_of_summary
from dsr.report.study.percentages import read_study
from dsr.report.table_layouts import to_markdown
from dsr.report.tables import build_tables

SIMGEO = (*PAPER_SCENES["simgeo"][:5], "statue")


ABOUT = ("dataset", "seed", "scale", "downsampling", "method", "share")


def run(label, values, *, range_type=None, **given):
    """Return a run whose RMSE_d is the scenes' value in mm, and whose DSSIM_v, in thousandths, is ten times that."""
    scores = {
        scene: {"RMSE_d": value / 1e3, "DSSIM_v[e1]": value / 200, "DSSIM_v[max]": value / 1e2, "DSSIM_v[avg]": 0.1}
        for scene, value in values.items()
    }
    about = {name: given.pop(name) for name in ABOUT if name in given}
    settings = {"dataset": given, "downsampling": {"name": "box", "range_type": range_type}}
    return made_up_run(label, scores, settings=settings, **about)


def tables(*runs, study=None):
    return {table.name: table for table in build_tables(Results(runs), study)}


def group_of(table, start):
    [group] = [group for group in table.groups if group.about.title.startswith(start)]
    return group


def cell_of(table, start, label, key="RMSE_d"):
    [row] = [row for row in group_of(table, start).rows if row.label == label]
    return row.cells.get(key)


def all_of(names, value=10.0):
    return {name: value + number for number, name in enumerate(names)}


def test_tables_are_a_summary_and_one_per_dataset_for_each_scale_and_degradation():
    found = tables(
        run("Bicubic", {"lucy": 1.0}),
        run("Bicubic", {"sofa": 1.0}, dataset="icl"),
        run("Bicubic", {"lucy": 1.0}, scale=8),
        run("Bicubic", {"lucy": 1.0}, downsampling="box+noise 0.01/blobs"),
    )
    assert list(found) == [
        "summary_x4_box", "simgeo_x4_box", "icl_x4_box", "summary_x8_box", "simgeo_x8_box",
        "summary_x4_box_noise_0.01_blobs", "simgeo_x4_box_noise_0.01_blobs",
    ]  # fmt: skip


def test_aligned_scores_are_noted_and_not_beside_the_papers():
    plain = run("Bicubic", {"lucy": 1.0})
    aligned = replace(plain, settings={**plain.settings, "alignment": "affine_disparity"})
    for each, beside in ((plain, True), (aligned, False)):
        found = tables(each)["simgeo_x4_box"]
        assert found.has_published is beside
        assert any("affine_disparity" in note for note in found.notes) is not beside
        assert any(note.startswith("Not computed: BadPix_d_5cm") for note in found.notes)


def test_seeds_are_averaged_first_and_their_averages_give_the_spread():
    values = {0: {"a": 10.0, "b": 40.0}, 1: {"a": 12.0, "b": 50.0}, 2: {"a": 17.0, "b": 30.0}}
    table = tables(*(run("DIP", each, seed=seed, dataset="mine") for seed, each in values.items()))["mine_x4_box"]
    single = cell_of(table, "a", "DIP")
    assert (single.mean, single.seeds) == (pytest.approx(13), 3)
    assert single.spread == pytest.approx(math.sqrt((9 + 1 + 16) / 2))
    average = cell_of(table, "mine", "DIP")
    assert average.mean == pytest.approx((13 + 40) / 2)
    assert average.spread == pytest.approx(statistics.stdev([25, 31, 23.5]))


def test_scenes_of_uneven_seeds_weigh_the_same_and_only_complete_seeds_spread():
    runs = [run("DIP", {"a": 10.0, "b": 40.0}, dataset="m"), run("DIP", {"a": 20.0, "b": 60.0}, dataset="m", seed=1)]
    average = cell_of(tables(*runs, run("DIP", {"a": 90.0}, dataset="m", seed=2))["m_x4_box"], "m,", "DIP")
    assert average.mean == pytest.approx((40 + 50) / 2)
    assert (average.seeds, average.spread) == (2, pytest.approx(statistics.stdev([25, 40])))


def test_best_and_second_best_are_marked_and_ties_share():
    runs = [run(label, {"a": value}) for label, value in (("A", 10.01), ("B", 9.99), ("C", 12.0), ("D", 13.0))]
    table = tables(*runs)["simgeo_x4_box"]
    assert [row.cells["RMSE_d"].rank for row in table.groups[0].rows] == [1, 1, 2, 0]  # both read 10.0
    texts = [table.columns["RMSE_d"].text(row.cells["RMSE_d"].mean) for row in table.groups[0].rows]
    assert texts == ["10.0", "10.0", "12.0", "13.0"]


def test_average_is_over_the_scenes_in_common_and_labelled():
    runs = [run("A", {"a": 1.0, "b": 9.0}, dataset="m"), run("B", {"a": 2.0, "b": 1.0}, dataset="m")]
    table = tables(*runs, run("C", {"a": 0.5}, dataset="m"))["m_x4_box"]
    cells = [cell_of(table, "m,", label) for label in "ABC"]
    assert [cell.mean for cell in cells] == pytest.approx([1.0, 2.0, 0.5])
    assert [(cell.scenes, cell.of, cell.rank) for cell in cells] == [(1, 2, 2), (1, 2, 0), (1, 2, 1)]
    assert any(note.startswith("(k of n)") for note in table.notes)


def test_summary_has_the_papers_six_averages_with_its_values_over_its_own_scenes():
    runs = [run("MSG-V", all_of(names), dataset=name) for name, names in PAPER_SCENES.items()]
    table = tables(*runs)["summary_x4_box"]
    assert [len(group.about.places) for group in table.groups] == [6, 6, 7, 13, 6, 19]
    without = cell_of(table, "Without", "MSG-V")
    assert without.mean == pytest.approx(sum([*range(10, 16), *range(10, 16), 10]) / 13)
    assert cell_of(table, "With missing", "MSG-V").mean == pytest.approx(sum(range(11, 17)) / 6)
    assert [group.rows[0].published.get("RMSE_d") for group in table.groups] == [None, None, 96, None, 107, None]


RECREATED = {
    "cube_high_freq": "Cube, high-frequency texture",
    "cube_no_texture": "Cube, no texture",
    "sphere_cylinder_high_freq": "Sphere and cylinder, high-frequency texture",
    "sphere_cylinder_low_freq": "Sphere and cylinder, low-frequency texture",
    "sphere_cylinder_no_texture": "Sphere and cylinder, no texture",
}  # The embedded SimGeo scenes, and those of the paper that they are like


def test_published_averages_are_over_the_same_scenes_as_ours():
    places = [Place(name, scene) for name, scenes in PAPER_SCENES.items() for scene in scenes]
    rows = published()[published()["method"] == "Bicubic"].set_index(["scene", "scale"])["BadPix_v_5"]
    known = {name.casefold(): name for name, _ in rows.index}
    averages = sets_of_summary(places, lambda _: True)
    theirs = [name for name in published()["scene"].unique() if name.startswith("Average")]
    for each, name in zip(averages, theirs, strict=True):
        titles = [RECREATED.get(place.scene, place.scene.replace("_", " ")) for place in each.places]
        own = [rows[known[title.casefold()], 4] for title in titles]
        assert statistics.mean(own) == pytest.approx(rows[name, 4], abs=0.051)
        assert each.published in ("", name)


def test_average_with_missing_scenes_is_labelled_and_has_no_published_value():
    table = tables(run("MSG-V", all_of(SIMGEO[:2])))["summary_x4_box"]
    assert [group.about.title for group in table.groups] == ["SimGeo, average of 2 of the paper's 6 scenes"]
    assert not table.has_published


def test_additional_scenes_do_not_enter_the_papers_averages():
    scenes = [*PAPER_SCENES["middlebury"], "adirondack"]
    table = tables(run("MSG-V", all_of(scenes), dataset="middlebury"))["middlebury_x4_box"]
    assert cell_of(table, "Middlebury, average of 7", "MSG-V").mean == pytest.approx(13)
    assert cell_of(table, "Middlebury, average of 8", "MSG-V").mean == pytest.approx(13.5)
    assert group_of(table, "Middlebury, average of 7").rows[0].published["RMSE_d"] == 96
    assert not group_of(table, "Middlebury, average of 8").rows[0].published


def test_statue_replaces_lucy_only_where_lucy_is_missing():
    both = sets_of_dataset([Place("simgeo", name) for name in (*SIMGEO, "lucy")])
    assert Place("simgeo", "statue") not in both[-2].places
    assert Place("simgeo", "lucy") in both[-2].places
    [average] = [each for each in sets_of_dataset([Place("simgeo", name) for name in SIMGEO]) if each.average]
    assert [place.scene for place in average.places][-1] == "statue"
    assert not average.published


@pytest.mark.parametrize(("shares", "title"), [((0.9, 1.0), "without"), ((0.9, 0.95), "with")])
def test_scenes_of_other_datasets_are_grouped_by_holes_in_their_truth(shares, title):
    holes = ["b"] if title == "with" else []
    runs = [run(label, {"b": 1.0}, dataset="m", share=share) for label, share in zip("AB", shares, strict=True)]
    others = [run(label, {"a": 1.0, "c": 1.0}, dataset="m") for label in "AB"]
    found = tables(*runs, *others)["summary_x4_box"].groups
    sets = {group.about.title.split(",")[0]: [place.scene for place in group.about.places] for group in found}
    assert sets.get("Other scenes with missing measurements", []) == holes
    assert sets.get("Other scenes without missing measurements", ["a", "b", "c"]) == sorted({"a", "b", "c"} - {*holes})


def test_holes_of_the_truth_are_distinguished_from_those_of_a_prediction(make_run, tmp_path):
    folder = make_run(tmp_path, dataset="m", scenes=("a", "b"))
    runs = [run("A", {"a": 1.0, "b": 2.0}, dataset="m", share=0.9)]
    runs = [Run(**{**vars(each), "folder": folder}) for each in runs]
    [group] = tables(*runs)["summary_x4_box"].groups
    assert len(group.about.places) == 2
    titles = [each.title for each in sets_of_summary(group.about.places, lambda _: False)]
    assert titles == ["m, average of 2 scenes"]  # the same scenes are not averaged twice


def test_papers_values_of_methods_that_were_not_run_stand_only_beside_its_own_scenes():
    folder = "dsr.data.folder.Folder"
    table = tables(run("MSG-V", {"lucy": 23.6}, dataset="mine", _target_=folder))["mine_x4_box"]
    [group] = table.groups
    assert group.rows[0].published["RMSE_d"] == 74
    others = {row.label: row.published for row in group.paper_only}
    assert others["PDN"]["RMSE_d"] == published_value("Lucy", "PDN")
    assert "MSG-V" not in others
    recreated = tables(run("MSG-V", {"cube_no_texture": 9.0}))["simgeo_x4_box"].groups[0]
    assert not recreated.rows[0].published
    assert not recreated.paper_only


def published_value(scene, method, scale=4, key="RMSE_d"):
    table = published()
    return table[(table["scene"] == scene) & (table["method"] == method) & (table["scale"] == scale)][key].item()


@pytest.mark.parametrize(
    "settings",
    [
        {"downsampling": "nearest"}, {"range_type": "orthogonal"}, {"dataset": "sunrgbd"}, {"size": 64}, {"crop": 0.0},
        {"scale": 2}, {"method": "mine"}, {"dataset": "icl", "scene": "plant"}, {"scene": "cube_no_texture"},
        {"scene": "cube_no_texture", "dataset": "mine", "_target_": "dsr.data.folder.Folder"},
        {"scene": "vintage", "dataset": "middlebury", "without_offset": []},
        {"scene": "vintage", "dataset": "mine", "_target_": "dsr.data.folder.Folder", "without_offset": []},
    ],
    ids=str,
)  # fmt: skip
def test_other_data_degradations_sizes_scales_and_methods_have_no_published_value(settings):
    scene = settings.get("scene", "lucy")
    given = {"method": "msg_v", **{key: value for key, value in settings.items() if key != "scene"}}
    found = tables(run("Mine", {scene: 1.0}, **given)).values()
    assert not any(table.has_published for table in found)
    assert "method" in settings or not any(group.paper_only for table in found for group in table.groups)


def study_of(*rows):
    columns = ("dataset", "scene", "label", "user_first", "user_first_low", "user_first_high")
    frame = pd.DataFrame([dict(zip(columns, row, strict=True)) for row in rows])
    return frame.assign(scale=4, downsampling="box", user_second=5.0, user_top2=frame["user_first"] + 5)


def test_study_columns_join_with_their_intervals_and_higher_is_better():
    study = study_of(
        ("m", "a", "A", 80.0, 70, 90), ("m", "b", "A", 60.0, 50, 70), ("m", "average", "A", 70.0, 65, 75),
        ("m", "a", "B", 20.0, 10, 30), ("m", "b", "B", 40.0, 30, 50),
    )  # fmt: skip
    values = {"a": 1.0, "b": 2.0}
    table = tables(run("A", values, dataset="m"), run("B", values, dataset="m"), study=study)["m_x4_box"]
    single = cell_of(table, "a", "A", "user_first")
    assert (single.mean, single.interval, single.rank) == (80, (70, 90), 1)
    assert cell_of(table, "m,", "A", "user_first").interval == (65, 75)
    other = cell_of(table, "m,", "B", "user_first")
    assert (other.mean, other.interval, other.rank) == (30, None, 2)


def test_study_file_round_trips(tmp_path):
    study = study_of(("-1", "01", "None", 80.0, 70, 90), ("m", "@x", "=cmd|'A'!A0", 20.0, math.nan, math.nan))
    study.to_csv(tmp_path / "study.csv", index=False)
    pd.testing.assert_frame_equal(read_study(tmp_path / "study.csv"), study, check_dtype=False)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b'"a\nb,c\n1,2,3', b"dataset,scene\nm,a\n", None])
def test_file_that_is_no_study_is_refused_in_one_line(tmp_path, content):
    if content is not None:
        (tmp_path / "study.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"study.csv: expected the table of dsr study collect, got [^\n]+$"):
        read_study(tmp_path / "study.csv")


def test_averages_have_intervals_and_a_better_best_is_marked_when_asked():
    names = [f"scene{number}" for number in range(8)]
    near, far = ({name: base + number for number, name in enumerate(names)} for base in (10.0, 14.0))
    alike = {name: near[name] + (0.1 if number % 2 else -0.099) for number, name in enumerate(names)}
    for other, marked in ((far, True), (alike, False)):
        runs = Results((run("Near", near, dataset="mine"), run("Other", other, dataset="mine")))
        [_, table] = build_tables(runs, intervals=True)
        [group] = [each for each in table.groups if each.about.average]
        cell = next(row for row in group.rows if row.label == "Near").cells["RMSE_d"]
        assert cell.interval[0] < cell.mean < cell.interval[1]
        assert cell.significant == marked
        assert ("**\\*" in to_markdown(table)) == marked
        assert all(row.cells["RMSE_d"].interval is None for each in table.groups[:1] for row in each.rows)
    assert all(row.cells["RMSE_d"].interval is None for row in build_tables(runs)[1].rows)


def test_families_of_metrics_have_tables_of_their_own():
    one = run("Near", all_of(["hall", "yard"]), dataset="mine")
    more = one.scores[one.scores["metric"] == "RMSE_d"].assign(metric="SAWA")
    family = MetricFormat("SAWA", "", digits=2, family="evalmde")
    both = replace(one, scores=pd.concat([one.scores, more]), formats={"SAWA": family})
    found = tables(both)
    assert [name for name in found if "evalmde" in name] == ["summary_evalmde_x4_box", "mine_evalmde_x4_box"]
    assert list(found["mine_evalmde_x4_box"].columns) == ["SAWA"]
    assert list(found["mine_x4_box"].columns) == ["RMSE_d", "DSSIM_v"]


def test_a_table_says_what_its_runs_say_of_their_maps():
    maps, shared = "predictions come as whole numbers of 0.001 m", "its depth is not metric"
    files = replace(run("mine", {"a": 1.0, "b": 1.0}, dataset="m"), notes={"a": [maps, shared], "b": [maps]})
    other = replace(run("A", {"a": 1.0, "b": 1.0}, dataset="m"), notes={"a": [shared]})
    elsewhere = replace(run("A", {"c": 1.0}, dataset="n"), notes={"c": ["of another data set"]})
    notes = tables(files, other, elsewhere)["m_x4_box"].notes
    assert f"mine: {maps}." in notes
    assert f"a: {shared}." in notes
    assert not any("another" in note for note in notes)
    assert "- mine: predictions come as whole numbers" in to_markdown(tables(files, other)["m_x4_box"])
