"""Two commands at once on the same files."""

import random
import time
from dataclasses import dataclass

from chaos.campaign import Campaign, undisturbed_problems
from chaos.processes import Ended
from chaos.scenarios import AT_ONCE, Scenario
from chaos.trees import damaged, differences

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
    if case.scenario.rivals:
        return _run_rivals(campaign, case)
    first, second = _run_both(campaign, case, campaign.undisturbed(case.scenario).computed[0])
    problems = [line for end in (first, second) for line in end_problems(case.scenario, end)]
    problems += damaged(campaign.work)
    problems += campaign.finish(case.scenario)[0]
    return problems + campaign.compare(case.scenario)


def _run_rivals(campaign: Campaign, case: PairCase) -> list[str]:
    """Run two commands of different settings in one folder, which has to become that of one of them."""
    known = [campaign.undisturbed(each) for each in case.scenario.rivals]
    ends = _run_both(campaign, case, known[0].computed[0])
    problems = [line for end in ends for line in end_problems(case.scenario, end)] + damaged(campaign.work)
    codes = [end.code for end in ends]
    if sorted(codes) != [0, 2]:
        return [*problems, f"exit codes {codes}, expected that one is refused"]
    return problems + differences(known[codes.index(0)].folder, campaign.work)


def _run_both(campaign: Campaign, case: PairCase, computed: float) -> tuple[Ended, Ended]:
    """Run both commands, of which the first computes so many seconds; return how they ended."""
    campaign.begin(case.scenario)
    first = campaign.start(case.scenario, 0)
    first.wait_for(case.delay * computed)
    second = campaign.start(case.scenario, 1)
    while first.is_alive() and second.is_alive():
        time.sleep(0.05)
    return first.end(_LIMIT), second.end(_LIMIT)


def end_problems(scenario: Scenario, end: Ended) -> list[str]:
    """Return what is wrong with the end of one of two commands: 0, or 2 and one line."""
    refused = end.code == 2 and len(end.err.splitlines()) == 1 and end.err.startswith("error: ")
    return [] if refused and not end.left else undisturbed_problems(scenario, end)
