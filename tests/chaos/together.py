"""Two commands at once on the same files."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass

from chaos.campaign import Campaign, undisturbed_problems
from chaos.processes import Ended
from chaos.scenarios import AT_ONCE, Scenario
from chaos.trees import damaged

_LIMIT = 300.0


@dataclass(frozen=True)
class PairCase:
    """Two commands of which the second starts some seconds of the first one's computing time later."""

    name: str
    scenario: Scenario
    delay: float


def pair_cases(seed: int, repetitions: int = 1) -> list[PairCase]:
    """Return all cases; the seed determines the delays as fractions of the first command's computing time."""
    draw = random.Random(f"{seed} together")
    pairs = [scenario for _ in range(repetitions) for scenario in AT_ONCE.values()]
    delays = [draw.choice((0.0, draw.uniform(0, 0.9))) for _ in pairs]
    return [PairCase(f"pair-{number}", *each) for number, each in enumerate(zip(pairs, delays, strict=True))]


def run_case(campaign: Campaign, case: PairCase) -> list[str]:
    """Run a case; return what is wrong."""
    known = campaign.undisturbed(case.scenario)
    campaign.begin(case.scenario)
    first = campaign.start(case.scenario, 0)
    first.wait_for(case.delay * known.computed[0])
    second = campaign.start(case.scenario, 1)
    while first.is_alive() and second.is_alive():
        time.sleep(0.05)
    problems = [line for each in (first, second) for line in end_problems(case.scenario, each.end(_LIMIT))]
    problems += damaged(campaign.work)
    problems += campaign.finish(case.scenario)[0]
    return problems + campaign.compare(case.scenario)


def end_problems(scenario: Scenario, end: Ended) -> list[str]:
    """Return what is wrong with the end of one of two commands: 0, or 2 and one line."""
    refused = end.code == 2 and len(end.err.splitlines()) == 1 and end.err.startswith("error: ")
    return [] if refused and not end.left else undisturbed_problems(scenario, end)
