"""A few quick cases of ``make chaos``, and that it finds commands that do not end as they should."""

import json
import signal
import sys

import numpy as np
import pytest

from chaos import kills, together
from chaos.campaign import Campaign
from chaos.kills import KillCase, Strike
from chaos.scenarios import STRUCK, Scenario, make_answers
from chaos.together import PairCase
from chaos.trees import differences

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


COLLECT = Scenario("collect", (("dsr", "study", "collect", "study", "answers"),) * 2, {"study": make_study})


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return Campaign(tmp_path_factory.mktemp("chaos"))


def run(campaign, scenario, *strikes):
    """Return the problems of strikes, and at the end."""
    hits, problems = kills.run_case(campaign, KillCase("kill", scenario, strikes))
    return [line for hit in hits for line in hit.problems], problems, len(hits)


def test_signals_while_importing_end_a_command_in_one_line_and_leave_nothing(campaign):
    strikes = (Strike(signal.SIGTERM, 0.0, group=True), Strike(signal.SIGINT, 0.5, group=False, again=0.2))
    assert run(campaign, COLLECT, *strikes) == ([], [], 2)


def test_sigterm_while_torch_is_imported_ends_an_evaluation_in_one_line(campaign):
    scenario = STRUCK["eval"]
    campaign.begin(scenario)
    command = campaign.start(scenario)
    command.wait_until_ready()
    assert command.wait_for(0.5)
    strike = Strike(signal.SIGTERM, 0.0, group=False)
    assert kills.end_problems(strike, kills.carry_out(command, strike, 5), 0) == []
    assert list(campaign.work.iterdir()) == []


def test_two_commands_at_once_do_not_disturb_each_other(campaign):
    assert together.run_case(campaign, PairCase("pair", COLLECT, 0.0)) == []


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
        "depth.npz: /depth.npy differs",
        "info.json: /unit: expected 'm', got 'mm'",
        "mine.txt: not in the reference",
        "scores.csv: missing",
    ]


STUBBORN = "import signal, time\nfor n in (2, 15): signal.signal(n, lambda *_: None)\n"
WAIT = "while time.process_time() < {}: pass\n"


@pytest.mark.parametrize(
    ("script", "number", "grace", "problem"),
    [
        (STUBBORN + WAIT.format(1.5), signal.SIGINT, 20, "s, and ended with exit code 0"),
        ("import time\n" + WAIT.format(60), signal.SIGTERM, 20, "exit code -15, expected 143"),
        ("import time\n" + WAIT.format(60), signal.SIGINT, 20, "a traceback"),
        (STUBBORN + WAIT.format(60), signal.SIGTERM, 1, "alive after the limit"),
        (
            "import subprocess, time\nsubprocess.Popen(['sleep', '60'])\n" + WAIT.format(60),
            signal.SIGKILL, 1, "1 processes alive after the limit",
        ),
        ("import time\nopen('a.npz', 'wb').write(b'PK')\n" + WAIT.format(60), signal.SIGKILL, 20, "a.npz: damaged"),
    ],
)  # fmt: skip
def test_commands_that_do_not_end_cleanly_are_found(tmp_path, script, number, grace, problem):
    campaign = Campaign(tmp_path, grace)
    scenario = Scenario("script", (("python", "-c", script),))
    campaign.begin(scenario)
    command = campaign.start(scenario)
    command.wait_until_ready()
    before = command.computed()
    strike = Strike(number, 0.5, group=False)
    end = kills.carry_out(command, strike, campaign.grace)
    problems = kills.end_problems(strike, end, end.computed - before) + kills.damaged(campaign.work)
    assert any(problem in line for line in problems), problems
