"""Statistics of reports: correlations of metrics, intervals of means over scenes, and paired tests between methods."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.stats import bootstrap, permutation_test
from small_runs import made_up_run

from dsr.evaluation.results import Results
from dsr.report.correlations import correlate, metric_matrix, with_reference, write_correlations
from dsr.report.paper import published
from dsr.report.significance import interval_of_mean, p_of_difference

VARIANTS = ("e1", "e2", "e3", "e4", "max", "avg")


def run(label, count=12, *, seed=0, scale=4, lpips=True):
    """Return a run on scenes whose metrics go with each other more or less."""
    rng = np.random.default_rng([seed, scale, *label.encode()])
    scores = {}
    for number in range(count):
        base = rng.random()
        of_scene = scores.setdefault(f"s{number}", {"RMSE_d": base**2})
        for metric in ("DSSIM_v", "LPIPS_v") if lpips else ("DSSIM_v",):
            of_scene |= {f"{metric}[{name}]": base + 0.2 * rng.random() for name in VARIANTS}
    return made_up_run(label, scores, seed=seed, scale=scale)


RESULTS = Results((run("Bicubic"), run("MSG"), run("MSG", seed=1), run("MSG", scale=8), run("Mine", 2)))


def test_metric_matrix_has_a_row_per_result_and_a_column_per_metric_variant():
    matrix = metric_matrix(RESULTS)
    assert len(matrix) == 4 * 12 + 2
    lights = [f"[{name}]" for name in VARIANTS if name != "max"]
    expected = {"RMSE_d", *(name + light for name in ("DSSIM_v", "LPIPS_v") for light in ["", *lights])}
    assert set(matrix.columns) == expected
    scores = RESULTS.runs[3].scores
    [value] = scores[(scores["scene"] == "s3") & (scores["metric"] == "DSSIM_v") & (scores["variant"] == "max")][
        "value"
    ]
    assert matrix.loc[("simgeo", "s3", 8, "box", "MSG", 0), "DSSIM_v"] == value


def test_rmse_d_is_clipped_at_half_a_metre():
    raw = np.concatenate([each.scores[each.scores["metric"] == "RMSE_d"]["value"] for each in RESULTS.runs])
    clipped = metric_matrix(RESULTS)["RMSE_d"]
    assert (raw > 0.5).any()
    assert clipped.max() == 0.5
    assert sorted(clipped) == pytest.approx(sorted(np.minimum(raw, 0.5)))


@pytest.mark.parametrize("kind", ["pearson", "spearman"])
@pytest.mark.parametrize("other", [[1.0, 2.0, math.nan, math.nan], [0.1, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, math.nan]])
def test_correlation_of_too_few_points_or_a_constant_is_unknown(kind, other):
    table = correlate(pd.DataFrame({"x": [1.0, 2.0, 4.0, 3.0], "y": other}), kind)
    assert math.isnan(table.loc["x", "y"])


def test_metrics_are_ordered_by_rank_correlation_with_lpips_without_its_own_variants():
    ranking = with_reference(metric_matrix(RESULTS))
    assert list(ranking["spearman"]) == sorted(ranking["spearman"], reverse=True)
    assert not ranking["metric"].str.startswith("LPIPS").any()
    assert set(ranking["n"]) == {50}
    matrix = metric_matrix(RESULTS)
    row = ranking[ranking["metric"] == "DSSIM_v[e2]"].iloc[0]
    assert row["pearson"] == pytest.approx(stats.pearsonr(matrix["DSSIM_v[e2]"], matrix["LPIPS_v"]).statistic)


def test_correlations_in_the_papers_tables_stand_beside_ours(tmp_path):
    ranking = pd.read_csv(write_correlations(tmp_path, RESULTS)[-2], index_col="metric")
    paper = published()[~published()["scene"].str.startswith("Average")]
    assert ranking.loc["DSSIM_v", "paper_n"] == len(paper) == 315
    expected = stats.spearmanr(paper["DSSIM_v"], paper["LPIPS_v"]).statistic
    assert ranking.loc["DSSIM_v", "paper_spearman"] == pytest.approx(expected)
    depth = stats.pearsonr(paper["RMSE_d"].clip(upper=500), paper["LPIPS_v"]).statistic
    assert ranking.loc["RMSE_d", "paper_pearson"] == pytest.approx(depth)
    assert math.isnan(ranking.loc["DSSIM_v[e2]", "paper_pearson"])


def test_interval_of_many_scenes_is_that_of_another_bootstrap():
    values = np.random.default_rng(1).gamma(2, size=200)
    theirs = bootstrap((values,), np.mean, n_resamples=10_000, method="percentile", rng=0).confidence_interval
    assert interval_of_mean(values.tolist()) == pytest.approx(theirs, rel=0.02)


def test_interval_of_few_scenes_holds_the_mean_about_as_often_as_it_says():
    random = np.random.default_rng(4)
    bounds = np.array([interval_of_mean(random.normal(0, 1, 6).tolist()) for _ in range(400)])
    assert ((bounds[:, 0] <= 0) & (bounds[:, 1] >= 0)).mean() > 0.92


def test_few_scenes_have_no_interval_and_no_significant_difference():
    assert interval_of_mean([1, 2, 3, 4]) is None
    assert p_of_difference([1, 2, 3, 4, 5], [5, 6, 7, 8, 9]) == 2 / 32


def test_exact_test_is_that_of_another_library():
    first, second = np.random.default_rng(5).normal([[0.8], [0]], 1, (2, 9))
    theirs = permutation_test((first, second), lambda a, b: np.mean(a - b), permutation_type="samples").pvalue
    assert p_of_difference(first.tolist(), second.tolist()) == pytest.approx(theirs)


def test_scenes_are_paired():
    random = np.random.default_rng(2)
    scenes = random.normal(0, 10, 12)
    better, worse = scenes, scenes + 1 + random.normal(0, 0.1, 12)
    assert p_of_difference(better, worse) < 0.001
    assert p_of_difference(better, random.permutation(worse)) > 0.05
    assert p_of_difference(better, worse) == p_of_difference(worse, better)
    assert p_of_difference(better, better) == 1
