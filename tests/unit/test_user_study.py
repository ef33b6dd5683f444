"""The perceptual study: its page, what is taken of the answers, and the percentages."""

import base64
import copy
import io
import json
import math
import re
import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image
from scipy.stats import binomtest

from dsr.cli import main
from dsr.evaluation.run_files import load_results
from dsr.geometry.camera import Camera
from dsr.pictures.depth_views import rendering
from dsr.report.significance import agreement, bootstrap_of_average, wilson
from dsr.report.study import Choice
from dsr.report.study.files import Candidate, Key, Trial, files_of, read_all, read_answers, read_key, write_key
from dsr.report.study.percentages import ALL, AVERAGE, COLUMNS, collect, remarks
from dsr.report.study.questionnaire import build_study, grey_png

CANDIDATES = {
    "aa": Candidate("MSG-V", "msg_v", "runs/1"),
    "bb": Candidate("Bicubic", "bicubic", "runs/2"),
    "cc": Candidate("DIP", "dip", "runs/3"),
}
METHODS = {"V": "aa", "B": "bb", "D": "cc"}
SCENES = {"s1": "cube", "s2": "statue"}
TRIALS = {name: Trial("simgeo", scene, 4, "box", CANDIDATES) for name, scene in SCENES.items()}
KEY = Key("0123456789ab", "e4", 2, 0, TRIALS)


def answers(person, *choices, minute=0, **changes):
    """Return a file's content; a choice such as "VB" is MSG-V first and Bicubic second, one for each scene."""
    more = 100 * sum(person.encode())  # people differ in how long they take
    trials = []
    for scene, (a, b) in zip(SCENES, choices, strict=True):
        chosen = {"order": ["cc", "aa", "bb"], "first": METHODS[a], "second": METHODS[b]}
        trials.append({"scene": scene, "again": False, "ms": 5e3 + more, **chosen})
    finished = f"2024-05-01T12:{minute:02}:00.000Z"
    return {"study": KEY.study, "page": 1, "participant": person, "finished": finished, "trials": trials} | changes


def written(folder, *contents):
    files = [folder / f"{number}.json" for number in range(len(contents))]
    for file, content in zip(files, contents, strict=True):
        file.write_text(content if isinstance(content, str) else json.dumps(content))
    return files


def collected(folder, *contents, key=KEY):
    given, left_out = read_all(written(folder, *contents), key)
    assert left_out == []
    return collect(given, key)


def row(table, dataset, scene, label):
    here = (table["dataset"] == dataset) & (table["scene"] == scene) & (table["label"] == label)
    [found] = table[here].to_dict("records")
    return found


GIVEN = {"p1": ("VB", "VD"), "p2": ("VB", "BV"), "p3": ("VD", "BV"), "p4": ("BV", "VB")}
FOUR = tuple(answers(person, *choices) for person, choices in GIVEN.items())


@pytest.mark.parametrize(("count", "n"), [(0, 1), (1, 1), (0, 136), (3, 136), (5, 10), (136, 136)])
def test_wilson_interval_equals_scipy(count, n):
    theirs = binomtest(count, n).proportion_ci(0.95, method="wilson")
    assert wilson(count, n) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_interval_of_an_average_is_wilsons_with_one_answer_a_person_where_all_agree():
    ones = np.ones((12, 5), int)
    assert bootstrap_of_average(ones, ones) == pytest.approx(wilson(12, 12))
    assert bootstrap_of_average(0 * ones, ones) == pytest.approx(wilson(0, 12))
    low, high = bootstrap_of_average(np.tile([1, 0], (5, 1)), np.ones((5, 2), int))  # one scene of two
    assert low + high == pytest.approx(1)


def test_agreement_equals_fleiss_own_example():
    """Ten subjects, fourteen raters, five categories: 0.378 and kappa 0.210."""
    counts = [
        [0, 0, 0, 0, 14], [0, 2, 6, 4, 2], [0, 0, 3, 5, 6], [0, 3, 9, 2, 0], [2, 2, 8, 1, 1],
        [7, 7, 0, 0, 0], [3, 2, 6, 3, 0], [2, 5, 3, 2, 2], [6, 5, 2, 1, 0], [0, 2, 2, 3, 7],
    ]  # fmt: skip
    assert agreement(np.array(counts)) == pytest.approx((0.378, 0.210), abs=5e-4)


def test_percentages_of_a_scene_equal_a_count_by_hand(tmp_path):
    table = collected(tmp_path, *FOUR)
    assert tuple(table.columns) == COLUMNS
    found = row(table, "simgeo", "cube", "MSG-V")
    assert (found["user_first"], found["user_second"], found["user_top2"], found["n"]) == (75, 25, 100, 4)
    found = row(table, "simgeo", "cube", "Bicubic")
    assert (found["user_first"], found["user_second"], found["user_top2"]) == (25, 50, 75)
    found = row(table, "simgeo", "statue", "DIP")
    assert (found["user_first"], found["user_second"], found["user_top2"]) == (0, 25, 25)
    assert (found["method"], found["scale"], found["downsampling"]) == ("dip", 4, "box")
    bounds = binomtest(1, 4).proportion_ci(0.95, method="wilson")
    assert (found["user_top2_low"], found["user_top2_high"]) == pytest.approx((100 * bounds.low, 100 * bounds.high))


def test_averages_are_means_over_scenes_with_an_interval_around_them(tmp_path):
    table = collected(tmp_path, *FOUR)
    found = row(table, "simgeo", AVERAGE, "MSG-V")
    assert (found["user_first"], found["user_second"], found["user_top2"], found["n"]) == (62.5, 37.5, 100, 4)
    assert found["user_first_low"] < 62.5 < found["user_first_high"]
    assert row(table, ALL, AVERAGE, "MSG-V") | {"dataset": "simgeo"} == found


def test_scene_counts_only_those_who_saw_it(tmp_path):
    key = Key(KEY.study, "e4", 1, 0, KEY.trials)
    parts = copy.deepcopy(FOUR)
    for number, part in enumerate(parts):
        part["trials"] = part["trials"][:1] if number else part["trials"][1:]
    table = collected(tmp_path, *parts, key=key)
    assert [row(table, "simgeo", scene, "MSG-V")["n"] for scene in ("cube", "statue", AVERAGE)] == [3, 1, 4]
    shares = [row(table, "simgeo", scene, "MSG-V")["user_first"] for scene in ("cube", "statue", AVERAGE)]
    assert shares == pytest.approx([200 / 3, 100, 250 / 3])


def test_repeated_scenes_measure_consistency_and_do_not_count_twice(tmp_path):
    key = Key(KEY.study, "e4", 2, 2, KEY.trials)
    asked_again = copy.deepcopy(FOUR)
    for number, content in enumerate(asked_again):
        more = [{**trial, "again": True} for trial in content["trials"]]
        content["trials"] += [trial | ({"first": "cc", "second": "aa"} if number == 3 else {}) for trial in more]
    given, _ = read_all(written(tmp_path, *asked_again), key)
    pd.testing.assert_frame_equal(collect(given, key), collected(tmp_path, *FOUR))
    lines = remarks(given, key)
    assert "asked again, people chose the same picture first 6 of 8 times" in lines
    assert any(line.startswith(f"{tmp_path / '3.json'}: another first choice") for line in lines)


def test_agreement_is_counted_over_pairs(tmp_path):
    given, _ = read_all(written(tmp_path, *FOUR), KEY)
    [line] = [line for line in remarks(given, KEY) if "two people" in line]
    assert "in 42 % of the cases (33 % by guessing)" in line  # cube: 3 of 6 pairs, statue: 2 of 6
    expected = (5 / 8) ** 2 + (3 / 8) ** 2
    assert f"kappa {(5 / 12 - expected) / (1 - expected):.2f}" in line


def changed(trial=None, **changes):
    """Return answers with other values in them, or in their first trial."""
    content = answers("p9", "VB", "VD")
    content["trials"][0] |= trial or {}
    return content | changes


DAMAGE = {
    "got damaged JSON: EOF": '{"study": "0123',
    "got damaged JSON: recursion": "[" * 100_000,
    "expected an object, got []": "[]",
    "study: expected '0123456789ab', got 'ffff'": changed(study="ffff"),
    "study: it is missing": "{}",
    "page: expected 1, got 7": changed({"ms": -1}, page=7),
    "participant: expected at least 1 character, got ''": changed(participant=""),
    "incomplete, it was saved before": changed(finished=None),
    "finished: expected a time such as": changed(finished="yesterday"),
    "finished: expected a time": changed(finished="2024-05-01T12:00:00"),
    "trials: expected a valid array, got {}": changed(trials={}),
    "expected 2 scenes, got 1": changed(trials=answers("p9", "VB", "VD")["trials"][:1]),
    "trials.0.scene: expected one of the study's, got 's7'": changed({"scene": "s7"}),
    "different scenes, got one of them twice": changed({"scene": "s2"}),
    "order: expected each picture of the scene once": changed({"order": ["aa", "bb"]}),
    "second: expected a picture that was shown, got 'zz'": changed({"second": "zz"}),
    "incomplete, no second choice": changed({"second": None}),
    "the same as first and second": changed({"second": "aa"}),
    "ms: expected greater than or equal to 0, got -1": changed({"ms": -1}),
    "ms: expected a finite number, got nan": changed({"ms": math.nan}),
    "ms: expected a finite number, got 1000": changed({"ms": 10**400}),
    "ms: expected a valid number, got True": changed({"ms": True}),
    "again: expected a valid boolean, got 0": changed({"again": 0}),
}


def test_invalid_answer_file_is_left_out_with_one_line_that_names_it(tmp_path):
    for message, damaged in DAMAGE.items():
        good, bad = written(tmp_path, FOUR[0], damaged)
        given, left_out = read_all([good, bad], KEY)
        assert [each.file for each in given] == [good]
        [line] = left_out
        assert line.startswith(f"{bad}: ")
        assert message in line
        assert "\n" not in line


def test_answers_with_a_byte_order_mark_are_read(tmp_path):
    file = tmp_path / "mailed.json"
    file.write_text(json.dumps(FOUR[0]) + "\r\n", encoding="utf-8-sig")
    assert read_answers(file, KEY).participant == "p1"


def test_first_finished_of_one_persons_files_counts(tmp_path):
    later, first, other = answers("p1", "VB", "VB", minute=9), answers("p1", "BV", "BV", minute=3), FOUR[1]
    files = written(tmp_path, later, first, other)
    given, left_out = read_all(files, KEY)
    assert [each.file for each in given] == files[1:]
    assert left_out == [f"{files[0]}: duplicate of {files[1]} (the same person), which was finished first"]


def test_directory_stands_for_its_json_files_and_a_file_named_twice_counts_once(tmp_path):
    (tmp_path / "deep").mkdir()
    files = [*written(tmp_path, FOUR[0]), *written(tmp_path / "deep", FOUR[1])]
    (tmp_path / "notes.txt").write_text("no answers")
    assert files_of([tmp_path, files[0]]) == files
    with pytest.raises(ValueError, match="found none"):
        files_of([])


def test_key_round_trips_and_a_damaged_one_is_refused(tmp_path):
    path = tmp_path / "key.json"
    write_key(path, KEY)
    assert read_key(path) == KEY
    path.write_text(path.read_text()[:-30])
    with pytest.raises(ValueError, match=r"key.json: expected the key of a study; got damaged JSON"):
        read_key(path)
    write_key(path, KEY)
    path.write_text(path.read_text().replace('"repeat": ', '"repeat": "no", "was": '))
    with pytest.raises(ValueError, match=r"key.json: expected the key of a study; repeat: expected a valid integer"):
        read_key(path)
    with pytest.raises(ValueError, match="there is none"):
        read_key(tmp_path / "none.json")


# The page


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return tmp_path_factory.mktemp("made")


@pytest.fixture
def runs(tmp_path, made, make_run):
    """Three methods on two scenes; the third has only one of them."""
    scenes = ("cube_no_texture", "<_script><b>statue")
    for method, label, count in (("bicubic", "Bicubic", 2), ("msg_v", "MSG-V", 2), ("dip", "DIP", 1)):
        if not (made / f"folder_of_{method}").exists():
            make_run(made / f"folder_of_{method}", method=method, label=label, scenes=scenes[:count])
    return shutil.copytree(made, tmp_path / "runs")


def content_of(page):
    text = page.read_text(encoding="utf-8")
    [data] = re.findall(r'<script type="application/json" id="study">(.*?)</script>', text, re.DOTALL)
    return json.loads(data), text.replace(data, re.sub(r"[A-Za-z0-9+/=]{100,}", "", data))


def decoded(text):
    """Return (H, W, 2): grey and opacity."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("LA"))


def test_page_shows_what_the_key_says(tmp_path, runs):
    built = build_study(load_results([runs]), tmp_path / "study")
    content, _ = content_of(built.page)
    assert read_key(tmp_path / "study" / "key.json") == built.key
    assert content["study"] == built.key.study
    assert {scene["id"]: set(scene["images"]) for scene in content["scenes"]} == {
        name: set(trial.candidates) for name, trial in built.key.trials.items()
    }
    [cube] = [(name, trial) for name, trial in built.key.trials.items() if trial.scene == "cube_no_texture"]
    [shown] = [scene for scene in content["scenes"] if scene["id"] == cube[0]]
    for name, candidate in cube[1].candidates.items():
        [run] = [run for run in load_results([runs]).runs if run.label == candidate.label]
        scene = run.sample("cube_no_texture")
        expected = rendering(run.prediction("cube_no_texture"), scene.camera, "e4")
        image = decoded(shown["images"][name])
        assert np.abs((image[..., 0] - 1.0) / 254 - expected).max() <= 0.51 / 254


def test_page_reveals_no_method_scene_or_directory(tmp_path, runs):
    built = build_study(load_results([runs]), tmp_path / "study")
    _, words = content_of(built.page)
    for name in ("bicubic", "msg", "dip", "folder_of", "simgeo", "cube", "statue"):
        assert name not in words.casefold()
    assert str(tmp_path) not in words
    scenes = content_of(built.page)[0]["scenes"]
    assert len({decoded(png).shape for each in scenes for png in (each["truth"], *each["images"].values())}) == 1


def test_scene_of_one_method_alone_is_left_out_and_incomplete_ones_are_noted(tmp_path, runs, make_run):
    make_run(runs / "more", scenes=["alone"])
    built = build_study(load_results([runs]), tmp_path / "study")
    assert {trial.scene for trial in built.key.trials.values()} == {"cube_no_texture", "<_script><b>statue"}
    assert any("alone x4 box: only Bicubic has a prediction" in note for note in built.notes)
    assert any("without DIP" in note for note in built.notes)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"methods": ["Bicubic", "EG"]}, "method: expected one of .*, got 'EG'"),
        ({"scales": [16]}, "scale: expected one of 4, got 16"),
        ({"scenes": ["none"]}, "scene: expected one of"),
        ({"downsamplings": ["nearest"]}, "downsampling: expected one of box, got 'nearest'"),
        ({"methods": ["Bicubic"]}, "2 methods, found none; left out: "),
        ({"light": "e5"}, "light: expected one of e1, e2, e3, e4, got 'e5'"),
        ({"scenes_per_person": 3}, "scenes per person: expected 1 to 2, got 3"),
        ({"repeat": -1}, "repeat: expected 0 to 2, got -1"),
        ({"title": "Is bicubic best?"}, "title: expected words without the methods' names, got 'Bicubic'"),
    ],
)
def test_invalid_study_is_refused_and_leaves_nothing(tmp_path, runs, choice, message):
    with pytest.raises(ValueError, match=message):
        build_study(load_results([runs]), tmp_path / "study", Choice(**choice))
    assert not (tmp_path / "study").exists()


def test_key_of_another_study_is_not_overwritten_without_overwrite(tmp_path, runs):
    results = load_results([runs])
    first = build_study(results, tmp_path)
    assert build_study(results, tmp_path).key == first.key
    with pytest.raises(ValueError, match="expected no other study"):
        build_study(results, tmp_path, Choice(light="e1"))
    assert read_key(tmp_path / "key.json") == first.key
    assert build_study(results, tmp_path, Choice(light="e1"), overwrite=True).key == read_key(tmp_path / "key.json")


def test_texts_of_the_page_are_shown_unchanged(tmp_path, runs):
    title = "</title><script>alert(1)</script> {{ DATA }}"
    page = build_study(load_results([runs]), tmp_path / "study", Choice(title=title)).page.read_text()
    assert "alert(1)</script>" not in page
    assert page.count("&lt;/title&gt;&lt;script&gt;alert(1)&lt;/script&gt; {{ DATA }}") == 2


def test_missing_truth_is_hidden_in_every_picture_alike():
    camera = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
    depth = torch.full((1, 6, 8), 2.0)
    truth = depth.clone()
    truth[0, 2, 3] = math.nan
    known = np.isfinite(rendering(truth, camera, "e4"))
    picture = decoded(base64.b64encode(grey_png(rendering(depth, camera, "e4"), known)))
    assert picture.shape == (6, 8, 2)
    assert np.array_equal(picture[..., 1] == 0, ~known)
    assert np.argwhere(~known).tolist() == [[1, 3], [2, 2], [2, 3]]


def test_command_collects_valid_answers_and_reports_the_others(tmp_path, capsys):
    write_key(tmp_path / "key.json", KEY)
    folder = tmp_path / "answers"
    folder.mkdir()
    written(folder, *FOUR, "{")
    arguments = ("study", "collect", tmp_path, folder, "-o", tmp_path / "table.csv")
    assert main([*map(str, arguments)]) == 0
    said = capsys.readouterr()
    assert said.err.startswith(f"left out: {folder / '4.json'}: ")
    assert "4 of 5 files count, see above" in said.out
    table = pd.read_csv(tmp_path / "table.csv")
    assert tuple(table.columns) == COLUMNS
    assert row(table, "simgeo", "cube", "MSG-V")["user_first"] == 75
