"""From answers to the paper's columns "User 1st", "2nd" and "Top 2", with confidence intervals.

User 1st is the share of the people who chose a method's rendering as the one most similar to the truth's, User 2nd as
the second most similar, Top 2 as either (Voynov et al., "Perceptual Deep Depth Super-Resolution", ICCV 2019).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
import pandas as pd

from dsr.user_study.answers import Answer, Answers
from dsr.user_study.intervals import agreement, average_share, bootstrap_of_average, wilson
from dsr.user_study.key import Candidate, Key, Trial

SHARES = ("user_first", "user_second", "user_top2")
PLACE = ("dataset", "scene", "scale", "downsampling", "method", "label")
COLUMNS = (*PLACE, *SHARES, "n", *(f"{share}_{bound}" for share in SHARES for bound in ("low", "high")))
"""Of the table: percent, and bounds of 95 % intervals."""
AVERAGE, ALL = "average", "all"
"""The scene's name in rows of averages, and the data set's in those over all data sets."""


@dataclass(frozen=True)
class _Votes:
    """What everybody chose of one method.

    Args:
        candidate: the method.
        asked: (people, scenes) 1 where somebody was asked about it.
        chosen: (people, scenes) for each of the columns in ``SHARES``, 1 where somebody chose it.

    """

    candidate: Candidate
    asked: np.ndarray
    chosen: tuple[np.ndarray, ...]


def collect(answers: Sequence[Answers], key: Key) -> pd.DataFrame:
    """Return the table: rows for each scene and method, for averages over a data set's scenes, and over all scenes.

    Percentages of scenes have Wilson's intervals; those of averages come from resampling people, for one person's
    answers to several scenes belong together. An average counts each scene that a method was shown in alike. Scenes
    that nobody was shown have no rows.

    Args:
        answers: those that count, at least one.
        key: of the study.

    """
    groups: dict[tuple[int, str], dict[str, list[str]]] = {}
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
    """Return what there is to say of the answers, one line each: how many, how long, how far people agree."""
    times = [sum(answer.seconds for answer in each.given) / 60 for each in answers]
    people = len(answers)
    said = [f"{people} {'person' if people == 1 else 'people'}, {median(times):.1f} minutes each (median)"]
    counts, labels = _first_choices(answers, key)
    same, kappa = agreement(counts)
    if math.isfinite(same):
        chance = float(np.mean([1 / len(key.trials[name].candidates) for name in _seen(answers, key)]))
        text = f"two people choose the same picture first in {100 * same:.0f} % of the cases ({100 * chance:.0f} % by "
        text += "guessing)"
        said.append(text + (f"; Fleiss' kappa {kappa:.2f}" if math.isfinite(kappa) and len(labels) > 1 else ""))
    return [*said, *_consistency(answers)]


def _seen(answers: Iterable[Answers], key: Key) -> list[str]:
    """Return the scenes that somebody was asked about, in the key's order."""
    asked = {answer.scene for each in answers for answer in each.given}
    return [name for name in key.trials if name in asked]


def _rows(
    answers: Sequence[Answers], key: Key, scenes: Sequence[str], dataset: str, name: str | None = None
) -> list[dict[str, Any]]:
    """Return the rows of all methods for one scene, or for the average over several, which then has a name."""
    trials = [key.trials[scene] for scene in scenes]
    place = (dataset, name or trials[0].scene, trials[0].scale, trials[0].downsampling)
    rows = []
    for label in dict.fromkeys(candidate.label for trial in trials for candidate in trial.candidates.values()):
        votes = _votes(answers, scenes, trials, label)
        people = int(votes.asked.any(axis=1).sum())
        method = (votes.candidate.method, label)
        row: dict[str, Any] = {**dict(zip(PLACE, (*place, *method), strict=True)), "n": people}
        for column, chosen in zip(SHARES, votes.chosen, strict=True):
            share = float(average_share(chosen.sum(0), votes.asked.sum(0)))
            bounds = bootstrap_of_average(chosen, votes.asked) if name else wilson(chosen.sum(), people)
            row |= {column: 100 * share, f"{column}_low": 100 * bounds[0], f"{column}_high": 100 * bounds[1]}
        rows.append(row)
    return rows


def _votes(answers: Sequence[Answers], scenes: Sequence[str], trials: Sequence[Trial], label: str) -> _Votes:
    """Return what everybody chose of one method in some scenes; people who were shown none of them are left out."""
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
    there = asked.any(axis=1)
    return _Votes(candidate, asked[there], (first[there], second[there], (first + second)[there]))


def _answers_to(answers: Sequence[Answers], scene: str) -> list[tuple[int, Answer]]:
    """Return the number of each person who was asked about a scene, and the answer, that of the first time."""
    return [
        (number, answer)
        for number, each in enumerate(answers)
        for answer in each.given
        if answer.scene == scene and not answer.again
    ]


def _first_choices(answers: Sequence[Answers], key: Key) -> tuple[np.ndarray, list[str]]:
    """Return how often each method was chosen first, (scenes, methods), and the methods."""
    scenes = _seen(answers, key)
    labels = sorted({candidate.label for name in scenes for candidate in key.trials[name].candidates.values()})
    counts = np.zeros((len(scenes), len(labels)), int)
    for row, name in enumerate(scenes):
        for _, answer in _answers_to(answers, name):
            counts[row, labels.index(key.trials[name].candidates[answer.first].label)] += 1
    return counts, labels


def _consistency(answers: Sequence[Answers]) -> list[str]:
    """Return how often people chose the same when they were asked again, overall and where one never did."""
    said = []
    same, asked = 0, 0
    for each in answers:
        before = {answer.scene: answer.first for answer in each.given if not answer.again}
        repeated = [answer.first == before[answer.scene] for answer in each.given if answer.again]
        same, asked = same + sum(repeated), asked + len(repeated)
        if len(repeated) > 1 and not any(repeated):
            said.append(f"{each.file}: another first choice each of the {len(repeated)} times a scene came again")
    return [f"asked again, people chose the same picture first {same} of {asked} times", *said] if asked else []
