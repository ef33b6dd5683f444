"""Aggregate answers into the paper's columns "User 1st", "User 2nd" and "Top 2", with confidence intervals.

User 1st is the fraction of participants who chose a method's rendering as most similar to that of the ground truth,
User 2nd as second most similar, Top 2 as either (Voynov et al., "Perceptual Deep Depth Super-Resolution", ICCV 2019).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from dsr.report.significance import agreement, average_fraction, bootstrap_of_average, wilson
from dsr.report.study.answers import Answer, Answers
from dsr.report.study.key import Candidate, Key, Trial
from dsr.report.study.study_table import ALL, AVERAGE, COLUMNS, PERCENTAGES, PLACE
from dsr.utils.ratios import as_ratio


@dataclass(frozen=True)
class _Votes:
    """Votes for one method.

    Args:
        candidate: the method.
        asked: (people, scenes) 1 where the participant saw the method.
        chosen: (people, scenes) for each column in ``PERCENTAGES``, 1 where the participant chose the method.

    """

    candidate: Candidate
    asked: np.ndarray
    chosen: tuple[np.ndarray, ...]


def collect(answers: Sequence[Answers], key: Key) -> pd.DataFrame:
    """Return the table of a study: rows per scene and method, and averages over each data set and over all scenes.

    Percentages of single scenes have Wilson intervals. Intervals of averages come from resampling participants, since
    the answers of one participant are not independent. In an average each scene that showed the method has the same
    weight. Scenes without answers have no rows.

    Args:
        answers: accepted answers, at least one.
        key: key of the study.

    """
    groups: dict[tuple[float, str], dict[str, list[str]]] = {}
    for name in _seen(answers, key):
        trial = key.trials[name]
        groups.setdefault((trial.scale, trial.downsampling), {}).setdefault(trial.dataset, []).append(name)
    rows = []
    for datasets in groups.values():
        for dataset, scenes in datasets.items():
            for scene in scenes:
                rows += _rows(answers, key, [scene], dataset)
            rows += _rows(answers, key, scenes, dataset, AVERAGE)
        rows += _rows(answers, key, [scene for scenes in datasets.values() for scene in scenes], ALL, AVERAGE)
    return pd.DataFrame(rows, columns=list(COLUMNS))


def remarks(answers: Sequence[Answers], key: Key) -> list[str]:
    """Summarize the answers, one line each: number, duration, agreement and consistency of participants."""
    times = [sum(answer.seconds for answer in each.given) / 60 for each in answers]
    people = len(answers)
    lines = [f"{people} {'person' if people == 1 else 'people'}, {median(times):.1f} minutes each (median)"]
    counts, labels = _first_choices(answers, key)
    same, kappa = agreement(counts)
    if math.isfinite(same):
        chance = float(np.mean([1 / len(key.trials[name].candidates) for name in _seen(answers, key)]))
        text = f"two people choose the same picture first in {100 * same:.0f} % of the cases ({100 * chance:.0f} % by "
        text += "guessing)"
        lines.append(text + (f"; Fleiss' kappa {kappa:.2f}" if math.isfinite(kappa) and len(labels) > 1 else ""))
    return [*lines, *_consistency(answers)]


def _seen(answers: Iterable[Answers], key: Key) -> list[str]:
    """Return the scenes with answers, in the order of the key."""
    asked = {answer.scene for each in answers for answer in each.given}
    return [name for name in key.trials if name in asked]


def _rows(
    answers: Sequence[Answers], key: Key, scenes: Sequence[str], dataset: str, name: str | None = None
) -> list[dict[str, Any]]:
    """Return the rows of all methods for one scene, or for a named average over several."""
    trials = [key.trials[scene] for scene in scenes]
    place = (dataset, name or trials[0].scene, trials[0].scale, trials[0].downsampling)
    rows = []
    for label in dict.fromkeys(candidate.label for trial in trials for candidate in trial.candidates.values()):
        votes = _votes(answers, scenes, trials, label)
        people = int(votes.asked.any(axis=1).sum())
        method = (votes.candidate.method, label)
        row: dict[str, Any] = {**dict(zip(PLACE, (*place, *method), strict=True)), "n": people}
        for column, chosen in zip(PERCENTAGES, votes.chosen, strict=True):
            fraction = float(average_fraction(chosen.sum(0), votes.asked.sum(0)))
            bounds = bootstrap_of_average(chosen, votes.asked) if name else wilson(chosen.sum(), people)
            row |= {column: 100 * fraction, f"{column}_low": 100 * bounds[0], f"{column}_high": 100 * bounds[1]}
        rows.append(row)
    return rows


def _votes(answers: Sequence[Answers], scenes: Sequence[str], trials: Sequence[Trial], label: str) -> _Votes:
    """Count the votes for one method in some scenes; participants who saw none of them are left out."""
    first, second, asked = (np.zeros((len(answers), len(scenes)), int) for _ in range(3))
    candidate = None
    for column, (scene, trial) in enumerate(zip(scenes, trials, strict=True)):
        for picture, each in trial.candidates.items():
            if each.label == label:
                candidate = each
                for row, answer in _answers_to(answers, scene):
                    asked[row, column] = 1
                    first[row, column] = answer.first == picture
                    second[row, column] = answer.second == picture
    if candidate is None:
        raise ValueError(f"{label}: expected a method of the scenes {', '.join(scenes)}")
    present = asked.any(axis=1)
    return _Votes(candidate, asked[present], (first[present], second[present], (first + second)[present]))


def _answers_to(answers: Sequence[Answers], scene: str) -> list[tuple[int, Answer]]:
    """Return the index of each participant who saw a scene, and the first answer."""
    return [
        (number, answer)
        for number, each in enumerate(answers)
        for answer in each.given
        if answer.scene == scene and not answer.again
    ]


def _first_choices(answers: Sequence[Answers], key: Key) -> tuple[np.ndarray, list[str]]:
    """Count the first choices of each method, (scenes, methods); return the counts and the methods."""
    scenes = _seen(answers, key)
    labels = sorted({candidate.label for name in scenes for candidate in key.trials[name].candidates.values()})
    counts = np.zeros((len(scenes), len(labels)), int)
    for row, name in enumerate(scenes):
        for _, answer in _answers_to(answers, name):
            counts[row, labels.index(key.trials[name].candidates[answer.first].label)] += 1
    return counts, labels


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
    """Yield a table per data set, scale and degradation, and one over all data sets if there are several.

    Args:
        collected: see :func:`collect`.

    """
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
