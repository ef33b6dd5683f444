"""A few quick cases of ``make chaos``, and that it finds commands that do not end as they should."""

import json
import signal
import sys

import numpy as np
import pytest

from chaos import scenarios
from chaos.campaign import Campaign, Command, Strike, end_problems
from chaos.results import damaged, differences
from chaos.scenarios import Scenario, make_answers

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


def make_study(folder):
    """Write the key of a study of two scenes, and answers beside."""
    folder.mkdir()
    candidates = {name: {"label": name.upper(), "method": name, "run": f"runs/{name}"} for name in ("aa", "bb", "cc")}
    trial = {"dataset": "set", "scale": 4, "downsampling": "box", "candidates": candidates}
    trials = {name: {**trial, "scene": name} for name in ("hall", "room")}
    key = {"page": 1, "study": "s", "light": "e1", "scenes_per_person": 2, "repeat": 0, "trials": trials}
    (folder / "key.json").write_text(json.dumps(key))
    make_answers(folder.parent / "answers")


@pytest.fixture
def campaign(tmp_path, monkeypatch):
    collect = ("dsr", "study", "collect", "study", "answers")
    monkeypatch.setitem(scenarios.ALL, "collect", Scenario((collect, collect), {"study": make_study}))
    return Campaign(tmp_path, grace=60)


def test_signals_end_a_command_in_one_line_and_it_goes_on(campaign):
    strikes = [Strike(signal.SIGTERM, 0.0, group=True), Strike(signal.SIGINT, 0.5, group=False)]
    assert campaign.kill("collect", strikes) == (2, [])


def test_two_commands_at_once_do_not_disturb_each_other(campaign):
    assert campaign.pair("collect", 0.0) == []


def test_sigterm_while_torch_is_imported_ends_an_evaluation_in_one_line(campaign):
    campaign.begin("eval")
    command, strike = Command(scenarios.STRUCK["eval"].commands[0], campaign.work), Strike(signal.SIGTERM, 1.0, False)
    assert command.strike(strike, 0.7)
    assert end_problems(command.end(60), strike) == []
    assert list(campaign.work.iterdir()) == []


def test_results_that_differ_in_more_than_their_times_are_found(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for folder, seconds in ((one, 1.0), (two, 2.0)):
        folder.mkdir()
        np.savez(folder / "depth.npz", depth=np.zeros(3), seconds=seconds)
        (folder / "info.json").write_text(json.dumps({"unit": "m", "seconds": seconds}))
        (folder / "scores.csv").write_text("scene,value\nhall,1\n")
    (two / ".half.npz").write_bytes(b"PK")
    assert differences(one, two) == []
    np.savez(two / "depth.npz", depth=np.ones(3), seconds=2.0)
    (two / "info.json").write_text(json.dumps({"unit": "mm", "seconds": 2.0}))
    (two / "scores.csv").unlink()
    (two / "mine.txt").write_text("")
    assert differences(one, two) == [
        "depth.npz: differs", "info.json: differs", "mine.txt: not in the reference", "scores.csv: missing",
    ]  # fmt: skip
    (two / "depth.npz").write_bytes(b"PK")
    assert [line.partition(":")[0] for line in damaged(two)] == ["depth.npz"]


HANDLED = "import signal, time\nfor n in (2, 15): signal.signal(n, lambda *_: {})\n"
LONG = "time.sleep(60)\n"


@pytest.mark.parametrize(
    ("script", "number", "problem"),
    [
        (HANDLED.format("exit(3)") + LONG, signal.SIGINT, "exit code 3"),
        (HANDLED.format("exit(143)") + LONG, signal.SIGTERM, "0 lines on stderr"),
        (HANDLED.format("1 / 0") + LONG, signal.SIGINT, "a traceback"),
        (HANDLED.format("None") + LONG, signal.SIGTERM, "1 processes alive after the limit"),
        ("import subprocess, time\nsubprocess.Popen(['sleep', '60'])\n" + LONG, signal.SIGKILL, "1 processes alive"),
    ],
)
def test_commands_that_do_not_end_cleanly_are_found(tmp_path, script, number, problem):
    strike = Strike(number, 1.0, group=False)
    command = Command(("python", "-c", script), tmp_path)
    assert command.strike(strike, 0.3)
    problems = end_problems(command.end(1), strike)
    assert any(problem in line for line in problems), problems
