"""Aggregate answers into the paper's columns "User 1st", "User 2nd" and "Top 2", with confidence intervals.

User 1st is the fraction of participants who chose a method's rendering as most similar to that of the ground truth,
User 2nd as second most similar, Top 2 as either (Voynov et al., "Perceptual Deep Depth Super-Resolution", ICCV 2019).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from dsr.report.significance import agreement, average_fraction, bootstrap_of_average, wilson
from dsr.report.study.answers import Answers
from dsr.report.study.key import Key
from dsr.report.study.study_table import ALL, AVERAGE, COLUMNS, PERCENTAGES, PLACE
from dsr.utils.ratios import as_ratio


def collect(answers: Sequence[Answers], key: Key) -> pd.DataFrame:
    """Return the table of a study: rows per scene and method, and averages over each data set and over all scenes.

    Percentages of single scenes have Wilson intervals. Intervals of averages come from resampling participants, since
    the answers of one participant are not independent. In an average each scene that showed the method has the same
    weight. Scenes without answers have no rows.
    """
    rows = []
    for (scale, downsampling), of_setting in _ballots(answers, key).groupby(["scale", "downsampling"], sort=False):
        for dataset, of_dataset in of_setting.groupby("dataset", sort=False):
            for _, of_scene in of_dataset.groupby("id", observed=True):
                rows += _rows(of_scene, (dataset, of_scene["scene"].iloc[0], scale, downsampling))
            rows += _rows(of_dataset, (dataset, AVERAGE, scale, downsampling))
        rows += _rows(of_setting, (ALL, AVERAGE, scale, downsampling))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def remarks(answers: Sequence[Answers], key: Key) -> list[str]:
    """Summarize the answers, one line each: number, duration, agreement and consistency of participants."""
    times = [sum(answer.seconds for answer in each.given) / 60 for each in answers]
    people = len(answers)
    lines = [f"{people} {'person' if people == 1 else 'people'}, {median(times):.1f} minutes each (median)"]
    ballots = _ballots(answers, key)
    counts = ballots.pivot_table("user_first", "id", "label", "sum", fill_value=0, observed=True).to_numpy()
    same, kappa = agreement(counts)
    if math.isfinite(same):
        chance = float(np.mean([1 / len(key.trials[name].candidates) for name in ballots["id"].unique()]))
        text = f"two people choose the same picture first in {100 * same:.0f} % of the cases ({100 * chance:.0f} % by "
        text += "guessing)"
        lines.append(text + (f"; Fleiss' kappa {kappa:.2f}" if math.isfinite(kappa) and counts.shape[1] > 1 else ""))
    return [*lines, *_consistency(answers)]


def _ballots(answers: Sequence[Answers], key: Key) -> pd.DataFrame:
    """Return a row per participant, scene and method shown, in the key's order: whether it was chosen; no repetitions.

    Columns: ``id`` of the scene, ``person``, those that say which scene and method it is, and the percentages' own.
    """
    rows = []
    for person, given in enumerate(answers):
        for answer in given.given:
            trial = key.trials[answer.scene]
            for picture, method in trial.candidates.items() if not answer.again else ():
                about = (trial.dataset, trial.scene, trial.scale, trial.downsampling, method.method, method.label)
                first, second = int(answer.first == picture), int(answer.second == picture)
                rows.append((answer.scene, person, *about, first, second, first + second))
    ballots = pd.DataFrame(rows, columns=["id", "person", *PLACE, *PERCENTAGES])
    ballots["id"] = pd.Categorical(ballots["id"], list(key.trials))
    return ballots.sort_values(["id", "person"], kind="stable", ignore_index=True)


def _rows(ballots: pd.DataFrame, place: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Return the rows of all methods for one scene, or for an average over several."""
    rows = []
    for label, votes in ballots.groupby("label", sort=False):
        table = votes.pivot(index="person", columns="id", values=list(PERCENTAGES))
        asked = table["user_first"].notna().to_numpy(int)
        people = len(asked)
        values = (*place, votes["method"].iloc[-1], label)
        row: dict[str, Any] = {**dict(zip(PLACE, values, strict=True)), "n": people}
        for column in PERCENTAGES:
            chosen = table[column].fillna(0).to_numpy(int)
            fraction = float(average_fraction(chosen.sum(0), asked.sum(0)))
            bounds = bootstrap_of_average(chosen, asked) if place[1] == AVERAGE else wilson(chosen.sum(), people)
            row |= {column: 100 * fraction, f"{column}_low": 100 * bounds[0], f"{column}_high": 100 * bounds[1]}
        rows.append(row)
    return rows


def _consistency(answers: Sequence[Answers]) -> list[str]:
    """Report how often participants repeated their first choice, overall, and who never did."""
    lines = []
    same, asked = 0, 0
    for each in answers:
        before = {answer.scene: answer.first for answer in each.given if not answer.again}
        repeated = [answer.first == before[answer.scene] for answer in each.given if answer.again]
        same, asked = same + sum(repeated), asked + len(repeated)
        if len(repeated) > 1 and not any(repeated):
            lines.append(f"{each.file}: another first choice each of the {len(repeated)} times a scene came again")
    return [f"asked again, people chose the same picture first {same} of {asked} times", *lines] if asked else []


def tables_of(collected: pd.DataFrame) -> Iterator[Table]:
    """Yield a table per data set, scale and degradation, and one over all data sets if there are several."""
    for place, rows in collected.groupby(["dataset", "scale", "downsampling"], sort=False):
        dataset, scale, downsampling = place
        others = collected[(collected["scale"] == scale) & (collected["downsampling"] == downsampling)]
        if dataset != ALL or others["dataset"].nunique() > 2:
            yield _terminal_table(rows, f"{dataset}, x{as_ratio(scale)}, {downsampling} downsampling")


def _terminal_table(rows: pd.DataFrame, where: str) -> Table:
    """Return one table; the largest percentage of each scene is bold."""
    table = Table(title=f"{escape(where)}: who chose what, %, with 95 % intervals", title_justify="left")
    table.box, table.padding = box.SIMPLE_HEAD, (0, 1, 0, 0)
    table.add_column("scene", overflow="fold")
    table.add_column("method", overflow="fold")
    for heading in PERCENTAGES.values():
        table.add_column(heading.replace("User Top", "Top"), justify="right", no_wrap=True)
    table.add_column("people", justify="right")
    for scene, of_scene in rows.groupby("scene", sort=False):
        table.add_section()
        for number, (_, row) in enumerate(of_scene.iterrows()):
            cells = []
            for column in PERCENTAGES:
                value, low, high = row[column], row[f"{column}_low"], row[f"{column}_high"]
                shown = f"[bold]{value:.1f}[/]" if value == of_scene[column].max() > 0 else f"{value:.1f}"
                cells.append(f"{shown} [dim]({low:.0f}-{high:.0f})[/]")
            name = escape(str(scene)) if number == 0 else ""
            heading = f"[bold]{name}[/]" if name and scene == AVERAGE else name
            table.add_row(heading, escape(row["label"]), *cells, str(row["n"]))
    return table
