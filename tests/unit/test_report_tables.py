"""Scores in the units of the paper's tables, beside what the paper says."""

import io
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console
from small_runs import made_up_run

from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import in_tables
from dsr.report.paper import Place, published, published_row
from dsr.report.table_layouts import score_tables
from dsr.report.tables import values_of

RAW = {
    "RMSE_d": 0.0704, "BadPix_d_5cm": 0.0670, "BadPix_v_5": 0.495, "DSSIM_v": 0.354, "LPIPS_v": 0.424,
    "Bumpiness_d": 1.39, "RMSE_v": 0.274,
}  # fmt: skip
"""Lucy x4 Bicubic as the protocol measures it, in raw units."""
UNITS = {
    "RMSE_d": 70.4, "BadPix_d_5cm": 6.70, "BadPix_v_5": 49.5, "DSSIM_v": 354, "LPIPS_v": 424, "Bumpiness_d": 1.39,
    "RMSE_v": 274,
}  # fmt: skip
PER_LIGHT = ("BadPix_v_5", "DSSIM_v", "LPIPS_v")


def bicubic(*scenes, name="simgeo", folder=Path("none"), range_type=None, **dataset):
    """Return a run of bicubic interpolation on Lucy, and on scenes whose scores grow by 0.1 from one to the next."""
    values = {}
    for number, scene in enumerate(scenes):
        scores = {"BadPix_d_1cm": 0.9, "RMSE_v1": 0.8}
        for metric, value in RAW.items():
            lights = {"[e1]": 7.0, "[max]": value, "[avg]": 3.0} if metric in PER_LIGHT else {"": value}
            scores |= {metric + light: own for light, own in lights.items()}
        values[scene] = {metric: value + 0.1 * number for metric, value in scores.items()}
    settings = {"dataset": dataset, "downsampling": {"range_type": range_type}}
    return made_up_run("Bicubic", values, dataset=name, folder=folder, settings=settings)


def text(run):
    console = Console(width=120, file=io.StringIO())
    console.print(*score_tables(run, KNOWN_FORMATS))
    return console.file.getvalue()


def row(printed, first, second):
    """Return the numbers of the printed row that starts with the two words."""
    [line] = [line for line in printed.splitlines() if line.split()[: len(first) + 1] == [*first, second]]
    return line.split()[len(first) + 1 :]


def test_raw_scores_become_millimetres_percents_and_thousandths():
    values = values_of([bicubic("lucy")], KNOWN_FORMATS)["Bicubic"][Place("simgeo", "lucy")]
    shown = {name: values[name][0] for name in in_tables(KNOWN_FORMATS)}
    assert shown == pytest.approx(UNITS)


@pytest.mark.parametrize(("scene", "method", "scale"), [("lucy", "Bicubic", 2), ("lucy", "Mine", 4), ("a", "MSG", 4)])
def test_scene_that_the_paper_lacks_is_not_found(scene, method, scale):
    assert published_row(scene, method, scale) is None


def test_published_values_equal_the_shared_transcription(shared):
    long = pd.read_csv(shared / "paper" / "tables.csv").set_index(["scene", "method", "scale", "metric"])["value"]
    ours = published().melt(["scene", "method", "scale"], list(in_tables(KNOWN_FORMATS)), "metric").dropna()
    assert len(ours) > 500
    theirs = long.loc[pd.MultiIndex.from_frame(ours[["scene", "method", "scale", "metric"]])]
    pd.testing.assert_series_equal(ours["value"], theirs, check_index=False)


def test_published_values_stand_below_ours_in_the_same_units():
    printed = text(bicubic("lucy"))
    assert row(printed, ["lucy"], "dsr") == ["70.4", "6.70", "49.5", "354", "424", "1.39", "274"]
    assert row(printed, [], "paper") == ["72.0", "6.80", "48.8", "355", "398", "1.37", "267"]
    assert "*" not in printed
