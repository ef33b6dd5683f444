"""The paper's columns "User 1st", "User 2nd" and "Top 2": from answers, with confidence intervals, and for tables.

User 1st is the fraction of participants who chose a method's rendering as most similar to that of the ground truth,
User 2nd as second most similar, Top 2 as either (Voynov et al., "Perceptual Deep Depth Super-Resolution", ICCV 2019).
"""

import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from dsr.report.significance import agreement, average_fraction, bootstrap_of_average, wilson
from dsr.report.study.files import Answers, Key
from dsr.utils.guards import MOST_TABLE, read_limited
from dsr.utils.ratios import as_ratio

# The paper's columns: percentage of answers with a method as most similar, second most similar, or either
PERCENTAGES = {"user_first": "User 1st", "user_second": "User 2nd", "user_top2": "User Top 2"}
PLACE = ("dataset", "scene", "scale", "downsampling", "method", "label")
# Columns of the table: percentages, and bounds of their 95 % intervals
COLUMNS = (*PLACE, *PERCENTAGES, "n", *(f"{column}_{bound}" for column in PERCENTAGES for bound in ("low", "high")))
AVERAGE, ALL = "average", "all"  # scene name of rows of averages, and data set name of averages over all data sets
_TEXTS = ("dataset", "scene", "downsampling", "label")
_KEYS = (*_TEXTS, "scale")


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
    times = [sum(answer.ms for answer in each.trials) / 60e3 for each in answers]
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
    consistent, asked = 0, 0
    others = []
    for each in answers:
        before = {answer.scene: answer.first for answer in each.trials if not answer.again}
        repeated = [answer.first == before[answer.scene] for answer in each.trials if answer.again]
        consistent, asked = consistent + sum(repeated), asked + len(repeated)
        if len(repeated) > 1 and not any(repeated):
            others.append(f"{each.file}: another first choice each of the {len(repeated)} times a scene came again")
    if asked:
        lines.append(f"asked again, people chose the same picture first {consistent} of {asked} times")
    return lines + others


def _ballots(answers: Sequence[Answers], key: Key) -> pd.DataFrame:
    """Return a row per participant, scene and method shown, in the key's order: whether it was chosen; no repetitions.

    Columns: ``id`` of the scene, ``person``, those that say which scene and method it is, and the percentages' own.
    """
    rows = []
    for person, given in enumerate(answers):
        for answer in given.trials:
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


def tables_of(collected: pd.DataFrame) -> Iterator[Table]:
    """Yield a table per data set, scale and degradation, and one over several data sets; the largest is bold."""
    for (dataset, scale, downsampling), rows in collected.groupby(["dataset", "scale", "downsampling"], sort=False):
        others = collected[(collected["scale"] == scale) & (collected["downsampling"] == downsampling)]
        if dataset == ALL and others["dataset"].nunique() <= 2:
            continue
        where = escape(f"{dataset}, x{as_ratio(scale)}, {downsampling} downsampling")
        table = Table(title=f"{where}: who chose what, %, with 95 % intervals", title_justify="left")
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
        yield table


def read_study(path: Path) -> pd.DataFrame:
    """Read a table written by ``dsr study collect``."""
    try:
        study = pd.read_csv(
            io.BytesIO(read_limited(path, MOST_TABLE)),
            dtype=dict.fromkeys(_TEXTS, str),
            keep_default_na=False,
            na_values=[""],
            usecols=lambda name: name in COLUMNS and name not in ("method", "n"),
        )
    except (OSError, ValueError) as error:  # pandas raises subclasses of ValueError for damaged files
        raise ValueError(f"{path}: expected the table of dsr study collect, got {type(error).__name__}") from error
    check_study(study, str(path))
    return study


def check_study(study: pd.DataFrame, name: str = "study") -> None:
    """Check that a table is that of a study."""
    missing = [column for column in (*_KEYS, *PERCENTAGES) if column not in study]
    if missing:
        raise ValueError(f"{name}: expected the table of dsr study collect, got one without {', '.join(missing)}")
    numbers = [column for column in study if column == "scale" or str(column).startswith("user_")]
    wrong = [str(column) for column in numbers if not pd.api.types.is_numeric_dtype(study[column])]
    if wrong:
        raise ValueError(f"{name}: expected numbers in {', '.join(wrong)}, got text")


def study_cells(
    study: pd.DataFrame | None, places: Sequence[tuple[str, str]], scale: float, downsampling: str, label: str
) -> dict[str, tuple[float, int, tuple[float, float] | None]]:
    """Return the percentages of answers that chose a method, by column: mean, number of scenes, and 95 % interval.

    An average over scenes is the study's own row for exactly these scenes if there is one, otherwise the mean over the
    scenes, as in the paper. Only the study's own row has a confidence interval, which needs the individual answers.
    """
    if study is None:
        return {}
    matches = (study["scale"] == scale) & (study["downsampling"] == downsampling) & (study["label"] == label)
    rows = study[matches].drop_duplicates(list(_KEYS), keep="last").set_index(["dataset", "scene"])
    here = [place for place in places if place in rows.index]
    found = {}
    for key in PERCENTAGES:
        values = rows.loc[here, key].dropna()
        if len(values):
            mean, interval = values.mean(), None
            own_average = _own_average(rows, places) if len(values) == len(places) else None
            if own_average is not None:
                mean, low, high = own_average[key], own_average.get(f"{key}_low"), own_average.get(f"{key}_high")
                interval = None if pd.isna(low) or pd.isna(high) else (float(low), float(high))
            found[key] = float(mean), len(values), interval
    return found


def _own_average(rows: pd.DataFrame, places: Sequence[tuple[str, str]]) -> pd.Series | None:
    """Return the study's row for exactly these scenes, None without one."""
    if len(places) == 1:
        return rows.loc[places[0]]
    datasets = {dataset for dataset, _ in places}
    asked = [place for place in rows.index if place[1] != AVERAGE]
    if set(asked) == set(places):
        name = (ALL, AVERAGE)
        own = name if name in rows.index else (next(iter(datasets)), AVERAGE)
    elif len(datasets) == 1 and {place for place in asked if place[0] in datasets} == set(places):
        own = (next(iter(datasets)), AVERAGE)
    else:
        return None
    return rows.loc[own] if own in rows.index else None
