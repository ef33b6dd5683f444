"""The standings: ranks within families and settings, over the scenes that all methods have."""

import pytest
from small_runs import made_up_run

from dsr.evaluation.results import Results
from dsr.metrics.formats import MetricFormat
from dsr.report.page import standings

FORMATS = {
    "RMSE_d": MetricFormat("RMSE_d", "mm", 1e3, 1, position=1),
    **{name: MetricFormat(name, digits=2, higher_is_better=True, family="sharp") for name in ("F1", "F2", "F3")},
}


def run(label, values, dataset="mine"):
    return made_up_run(label, values, dataset=dataset, formats=FORMATS)


def test_families_weigh_the_same_and_directions_are_heard():
    near = run("Near", {"hall": {"RMSE_d": 0.01, "F1": 0.1, "F2": 0.1, "F3": 0.1}})
    sharp = run("Sharp", {"hall": {"RMSE_d": 0.02, "F1": 0.9, "F2": 0.9, "F3": 0.9}})
    rows = standings(Results((near, sharp)))
    assert [row["rank"] for row in rows] == [1.5, 1.5]
    assert rows[0]["values"]["RMSE_d"] == [pytest.approx(10)]


def test_means_are_over_the_scenes_that_all_methods_have():
    one = run("One", {"hall": {"RMSE_d": 0.03}, "yard": {"RMSE_d": 0.001}})
    two = run("Two", {"hall": {"RMSE_d": 0.02}})
    rows = standings(Results((one, two)))
    assert [(row["method"], row["rank"]) for row in rows] == [("Two", 1), ("One", 2)]
    assert rows[1]["values"]["RMSE_d"] == [pytest.approx(30)]


def test_method_without_a_setting_stands_last_and_without_means():
    one, two = (run(name, {"hall": {"RMSE_d": value}}) for name, value in (("One", 0.03), ("Two", 0.02)))
    more = run("One", {"lake": {"RMSE_d": 0.05}}, dataset="other")
    rows = standings(Results((one, two, more)))
    assert [(row["method"], row["settings"]) for row in rows] == [("One", 2), ("Two", 1)]
    assert rows[0]["values"]["RMSE_d"] == [pytest.approx(40)]
    assert rows[1]["values"] == {}
