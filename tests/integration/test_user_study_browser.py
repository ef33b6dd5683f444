"""The study as people do it: the page in a browser, by mouse, keys and fingers, and the command that collects."""

import json
import math
from collections import Counter

import pandas as pd
import pytest

from dsr.cli import main
from dsr.evaluation.run_files import load_results
from dsr.report.study import Choice
from dsr.report.study.files import read_key
from dsr.report.study.questionnaire import build_study

LABELS = {"msg_v": "MSG-V", "bicubic": "Bicubic", "dip": "DIP"}
SCENES = ("cube", "statue", "<img src=x onerror=alert(1)>")
QUESTIONS = len(SCENES) + 1
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True, "device_scale_factor": 2}


@pytest.fixture(scope="module")
def study(tmp_path_factory, make_run):
    """A study of three methods on three scenes, one of which comes twice."""
    folder = tmp_path_factory.mktemp("study")
    for method, label in LABELS.items():
        make_run(folder / "runs" / method, method=method, label=label, scenes=SCENES)
    build_study(load_results([folder / "runs"]), folder, Choice(repeat=1))
    return folder


@pytest.fixture
def visit(window, study):
    """Return what opens the page as somebody new."""

    def open_page(**options):
        somebody = window(**options)
        somebody.page.goto((study / "index.html").as_uri())
        return somebody

    return open_page


def begun(somebody):
    somebody.page.locator("#begin").click()
    return somebody


def tile(somebody, number):
    return somebody.page.locator(f".tile[data-number='{number}']")


def ranks(somebody):
    """Return the numbers of the pictures chosen first and second."""
    script = "names => names.map(name => document.querySelector(`.tile.${name}`)?.dataset.number ?? null)"
    return somebody.page.evaluate(script, ["first", "second"])


def answer_rest(somebody):
    while somebody.page.locator("#trial").is_visible():
        if somebody.page.locator("#next").is_disabled():
            somebody.press("1", "2")
        somebody.press("Enter")


def save(somebody, path):
    with somebody.page.expect_download() as download:
        somebody.page.locator("#save").click()
    download.value.save_as(path)
    return json.loads(path.read_text(encoding="utf-8"))


def label_of(key, trial, rank):
    return key.trials[trial["scene"]].candidates[trial[rank]].label


def test_study_runs_from_the_first_choice_to_the_table(visit, study, tmp_path, capsys):
    mouse = begun(visit())
    tile(mouse, 2).click()
    tile(mouse, 3).click()
    assert ranks(mouse) == ["2", "3"]
    mouse.page.locator("#next").click()
    mouse.page.reload()
    assert mouse.page.inner_text("#where") == f"Scene 2 of {QUESTIONS}"
    answer_rest(mouse)
    mouse.page.locator("#again").click()
    assert "not been saved" in mouse.dialogs.pop()
    first = save(mouse, tmp_path / "mouse.json")
    mouse.page.locator("#again").click()
    assert mouse.page.locator("#welcome").is_visible()

    finger = visit(**PHONE)
    finger.page.locator("#begin").tap()
    for _ in range(QUESTIONS):
        tile(finger, 3).tap()
        tile(finger, 1).tap()
        finger.page.locator("#next").tap()
    second = save(finger, tmp_path / "finger.json")
    (tmp_path / "pasted.json").write_text(finger.page.locator("#answers").input_value())

    assert [trial["first"] for trial in first["trials"]][:1] == [first["trials"][0]["order"][1]]
    assert all(trial["first"] == trial["order"][2] for trial in second["trials"])
    assert (first["touch"], second["touch"]) == (False, True)
    arguments = ("study", "collect", study, tmp_path, "-o", tmp_path / "table.csv")
    assert main([*map(str, arguments)]) == 0
    said = capsys.readouterr()
    assert "2 of 3 files count" in said.out
    assert "the same person" in said.err
    key = read_key(study / "key.json")
    chosen = Counter()
    for trial in [trial for content in (first, second) for trial in content["trials"] if not trial["again"]]:
        scene = key.trials[trial["scene"]].scene
        chosen[scene, label_of(key, trial, "first"), "user_first"] += 50
        chosen[scene, label_of(key, trial, "second"), "user_second"] += 50
    table = pd.read_csv(tmp_path / "table.csv").set_index(["dataset", "scene", "label"]).sort_index()
    for scene in SCENES:
        for label in LABELS.values():
            for column in ("user_first", "user_second"):
                assert table.loc[("simgeo", scene, label), column] == chosen[scene, label, column]
    assert set(table["n"]) == {2}


DAMAGES = ("'{'", "'null'", *(f"JSON.stringify({{...person, started: 'x', {part}}})" for part in (
    "trials: 3", "index: 99", "trials: person.trials.slice(1)", "trials: person.trials.map(() => ({scene: 'other'}))",
)))  # fmt: skip


def test_keys_choose_in_an_order_that_stays_and_damaged_storage_does_not_stop_the_page(visit):
    """One visit: storage that was damaged, keys to choose, undo, go on and back, and orders of other people."""
    somebody = visit()
    for damage in DAMAGES:
        somebody.page.evaluate(f"localStorage.setItem(STORE, {damage})")
        somebody.page.reload()
        assert somebody.page.locator("#welcome").is_visible(), damage
    begun(somebody)
    script = "() => [...document.querySelectorAll('#grid img')].map(each => each.src)"
    pictures = somebody.page.evaluate(script)
    for keys, chosen in (
        (["3", "1"], ["3", "1"]), (["2"], ["3", "1"]), (["Backspace"], ["3", None]), (["Enter"], ["3", None]),
        (["2", "Enter"], [None, None]), (["ArrowLeft"], ["3", "2"]), (["3"], [None, "2"]),
    ):  # fmt: skip
        somebody.press(*keys)
        assert ranks(somebody) == chosen, keys
    somebody.page.reload()
    assert somebody.page.evaluate(script) == pictures
    orders = somebody.page.evaluate("[...Array(4800).keys()].map(() => shuffled(['a', 'b', 'c', 'd']).join(''))")
    counts = Counter(orders)
    assert len(counts) == math.factorial(4)
    chi_square = sum((count - 200) ** 2 / 200 for count in counts.values())
    assert chi_square < 70  # 23 degrees of freedom: beyond it with a chance of 1e-6 if orders are fair
