"""The table of a user study: its columns, how it is read, and what tables of scores show of it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from dsr.utils.guards import MOST_TABLE, read_limited

PERCENTAGES = {"user_first": "User 1st", "user_second": "User 2nd", "user_top2": "User Top 2"}
"""The paper's columns: percentage of answers with a method as most similar, second most similar, or either."""
PLACE = ("dataset", "scene", "scale", "downsampling", "method", "label")
COLUMNS = (*PLACE, *PERCENTAGES, "n", *(f"{column}_{bound}" for column in PERCENTAGES for bound in ("low", "high")))
"""Columns of the table: percentages, and bounds of their 95 % intervals."""
AVERAGE, ALL = "average", "all"
"""Scene name of rows of averages, and data set name of averages over all data sets."""
_TEXTS = ("dataset", "scene", "downsampling", "label")
_KEYS = (*_TEXTS, "scale")


class Share(NamedTuple):
    """A percentage of the answers."""

    mean: float  # over scenes
    scenes: int  # number of scenes
    interval: tuple[float, float] | None  # 95 % confidence interval, if the study gives one


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
) -> dict[str, Share]:
    """Return the percentages of answers that chose a method, by column of :data:`PERCENTAGES`.

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
            found[key] = Share(float(mean), len(values), interval)
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
