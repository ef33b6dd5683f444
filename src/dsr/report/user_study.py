"""What the participants of a study said, as columns of tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

USER_COLUMNS = {"user_first": "User 1st", "user_second": "User 2nd", "user_top2": "User Top 2"}
"""The paper's columns: which share of the answers named a method the most similar, the second most, or either."""
_TEXTS = ("dataset", "scene", "downsampling", "label")
_KEYS = (*_TEXTS, "scale")
_AVERAGE, _ALL = "average", "all"
"""A study's own averages are rows of this scene; the one over all data sets is of this data set."""


class Answer(NamedTuple):
    """A share of the answers in percent.

    Args:
        mean: over scenes.
        scenes: how many it is about.
        interval: its 95 % confidence interval, where the study gives one.

    """

    mean: float
    scenes: int
    interval: tuple[float, float] | None


def read_study(path: Path) -> pd.DataFrame:
    """Read what ``dsr study collect`` wrote.

    Raises:
        ValueError: the file is no such table.

    """
    try:
        study = pd.read_csv(path, dtype=dict.fromkeys(_TEXTS, str), keep_default_na=False, na_values=[""])
    except (OSError, ValueError) as error:  # what pandas raises of damaged files is a ValueError, too
        raise ValueError(f"{path}: expected the table of dsr study collect, got {type(error).__name__}") from error
    check_study(study, str(path))
    return study


def check_study(study: pd.DataFrame, name: str = "study") -> None:
    """Refuse a table that is not one of a study.

    Raises:
        ValueError: a column is missing, or holds no numbers.

    """
    missing = [column for column in (*_KEYS, *USER_COLUMNS) if column not in study]
    if missing:
        raise ValueError(f"{name}: expected the table of dsr study collect, got one without {', '.join(missing)}")
    numbers = [column for column in study if column == "scale" or str(column).startswith("user_")]
    wrong = [str(column) for column in numbers if not pd.api.types.is_numeric_dtype(study[column])]
    if wrong:
        raise ValueError(f"{name}: expected numbers in {', '.join(wrong)}, got text")


def user_cells(
    study: pd.DataFrame | None, places: Sequence[tuple[str, str]], scale: int, downsampling: str, label: str
) -> dict[str, Answer]:
    """Return the share of the answers in percent that named a method, by column of :data:`USER_COLUMNS`.

    An average over scenes is the mean of the scenes' shares, as in the paper, or the study's own row about these very
    scenes; only that one has an interval, since the study alone knows who answered what.

    Args:
        study: its table; see :func:`dsr.report.paper_tables.build_tables`.
        places: data sets and scenes.
        scale: of the rows that count.
        downsampling: of those, too.
        label: and the method's.

    """
    if study is None:
        return {}
    fits = (study["scale"] == scale) & (study["downsampling"] == downsampling) & (study["label"] == label)
    rows = study[fits].drop_duplicates(list(_KEYS), keep="last").set_index(["dataset", "scene"])
    here = [place for place in places if place in rows.index]
    found = {}
    for key in USER_COLUMNS:
        values = rows.loc[here, key].dropna()
        if len(values):
            whole = _own_average(rows, places) if len(values) == len(places) else None
            mean, interval = (values.mean(), None) if whole is None else (whole[key], _interval(whole, key))
            found[key] = Answer(float(mean), len(values), interval)
    return found


def _own_average(rows: pd.DataFrame, places: Sequence[tuple[str, str]]) -> pd.Series | None:
    """Return the study's row about exactly these scenes."""
    if len(places) == 1:
        return rows.loc[places[0]]
    datasets = {dataset for dataset, _ in places}
    asked = [place for place in rows.index if place[1] != _AVERAGE]
    if set(asked) == set(places):
        name = (_ALL, _AVERAGE)
        own = name if name in rows.index else (next(iter(datasets)), _AVERAGE)
    elif len(datasets) == 1 and {place for place in asked if place[0] in datasets} == set(places):
        own = (next(iter(datasets)), _AVERAGE)
    else:
        return None
    return rows.loc[own] if own in rows.index else None


def _interval(row: pd.Series, key: str) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of a share."""
    low, high = row.get(f"{key}_low"), row.get(f"{key}_high")
    return None if pd.isna(low) or pd.isna(high) else (float(low), float(high))
