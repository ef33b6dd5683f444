"""The study as people do it: the page in a browser, by mouse, keys and fingers, and the command that collects."""

import json
import math
from collections import Counter

import pandas as pd
import pytest

from dsr.cli import main
from dsr.evaluation.run_files import load_results
from dsr.report.study import Choice
from dsr.report.study.key import read_key
from dsr.report.study.questionnaire import build_study

LABELS = {"msg_v": "MSG-V", "bicubic": "Bicubic", "dip": "DIP"}
SCENES = ("cube", "statue", "<img src=x onerror=alert(1)>")
QUESTIONS = len(SCENES) + 1
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True, "device_scale_factor": 2}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("study")


@pytest.fixture
def study(folder, make_run):
    """A study of three methods on three scenes, one of which comes twice."""
    if not (folder / "index.html").exists():
        for method, label in LABELS.items():
            make_run(folder / "runs" / method, method=method, label=label, scenes=SCENES)
        build_study(load_results([folder / "runs"]), folder, Choice(repeat=1))
    return folder


@pytest.fixture
def visit(browser, study):
    """Return what opens the page as somebody new; in the end nothing may have gone wrong on any page."""
    visits = []

    def open_page(**options):
        visits.append(Visit(browser, study, options))
        return visits[-1]

    yield open_page
    for each in visits:
        each.context.close()
        assert each.wrong == []
        assert {url for url in each.asked if not url.startswith(("data:", "blob:"))} == {each.url}


class Visit:
    """Somebody's visit of the page, with what went wrong there and what it asked for."""

    def __init__(self, browser, folder, options):
        self.context = browser.new_context(**({"viewport": {"width": 1280, "height": 900}} | options))
        self.page = self.context.new_page()
        self.wrong, self.asked = [], []
        self.page.on("console", lambda message: self.wrong.append(message.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.url = (folder / "index.html").as_uri()
        self.page.goto(self.url)

    def begin(self):
        self.page.locator("#begin").click()
        return self

    def tile(self, number):
        return self.page.locator(f".tile[data-number='{number}']")

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)

    def ranks(self):
        """Return the numbers of the pictures chosen first and second."""
        script = "names => names.map(name => document.querySelector(`.tile.${name}`)?.dataset.number ?? null)"
        return self.page.evaluate(script, ["first", "second"])

    def text(self, where):
        return self.page.locator(where).inner_text()

    def pictures(self):
        script = "() => [...document.querySelectorAll('#grid img')].map(each => each.src)"
        return self.page.evaluate(script)

    def answer_rest(self):
        while self.page.locator("#trial").is_visible():
            if self.page.locator("#next").is_disabled():
                self.press("1", "2")
            self.press("Enter")

    def save(self, path):
        with self.page.expect_download() as download:
            self.page.locator("#save").click()
        download.value.save_as(path)
        return json.loads(path.read_text(encoding="utf-8"))


def label_of(key, trial, rank):
    return key.trials[trial["scene"]].candidates[trial[rank]].label


def test_study_runs_from_the_first_choice_to_the_table(visit, study, tmp_path, capsys):
    mouse = visit().begin()
    mouse.tile(2).click()
    mouse.tile(3).click()
    assert mouse.ranks() == ["2", "3"]
    mouse.page.locator("#next").click()
    mouse.page.reload()
    assert mouse.text("#where") == f"Scene 2 of {QUESTIONS}"
    mouse.answer_rest()
    first = mouse.save(tmp_path / "mouse.json")

    finger = visit(**PHONE)
    finger.page.locator("#begin").tap()
    for _ in range(QUESTIONS):
        finger.tile(3).tap()
        finger.tile(1).tap()
        finger.page.locator("#next").tap()
    second = finger.save(tmp_path / "finger.json")
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


def test_keys_choose_undo_and_go_on_and_back(visit):
    somebody = visit().begin()
    somebody.press("3", "1")
    assert somebody.ranks() == ["3", "1"]
    somebody.press("2")
    assert somebody.ranks() == ["3", "1"]
    assert "Two are chosen" in somebody.text("#hint")
    somebody.press("Backspace")
    assert somebody.ranks() == ["3", None]
    somebody.press("Enter")
    assert somebody.text("#where") == f"Scene 1 of {QUESTIONS}"
    somebody.press("2", "Enter")
    assert somebody.text("#where") == f"Scene 2 of {QUESTIONS}"
    assert somebody.ranks() == [None, None]
    somebody.press("ArrowLeft")
    assert somebody.ranks() == ["3", "2"]
    somebody.press("3")
    assert somebody.ranks() == [None, "2"]


DAMAGES = ("'{'", "'null'", *(f"JSON.stringify({{...person, started: 'x', {part}}})" for part in (
    "trials: 3", "index: 99", "trials: person.trials.slice(1)", "trials: person.trials.map(() => ({scene: 'other'}))",
)))  # fmt: skip


def test_damaged_storage_does_not_stop_the_page(visit):
    somebody = visit()
    for damage in DAMAGES:
        somebody.page.evaluate(f"localStorage.setItem(STORE, {damage})")
        somebody.page.reload()
        assert somebody.page.locator("#welcome").is_visible(), damage


def test_next_person_starts_anew_and_answers_are_not_dropped_unasked(visit, tmp_path):
    somebody = visit().begin()
    somebody.answer_rest()
    said = []
    somebody.page.once("dialog", lambda dialog: (said.append(dialog.message), dialog.dismiss()))
    somebody.page.locator("#again").click()
    assert "not been saved" in said[0]
    first = somebody.save(tmp_path / "first.json")
    somebody.page.locator("#again").click()
    assert somebody.page.locator("#welcome").is_visible()
    somebody.begin().answer_rest()
    second = somebody.save(tmp_path / "second.json")
    assert first["participant"] != second["participant"]
    assert first["study"] == second["study"]


def test_order_stays_for_a_person_and_is_uniform_over_many(visit):
    somebody = visit().begin()
    pictures = somebody.pictures()
    somebody.page.reload()
    assert somebody.pictures() == pictures
    orders = somebody.page.evaluate("[...Array(4800).keys()].map(() => shuffled(['a', 'b', 'c', 'd']).join(''))")
    counts = Counter(orders)
    assert len(counts) == math.factorial(4)
    chi_square = sum((count - 200) ** 2 / 200 for count in counts.values())
    assert chi_square < 70  # 23 degrees of freedom: beyond it with a chance of 1e-6 if orders are fair
