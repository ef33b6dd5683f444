"""Commands struck by signals at random moments."""

import json
import random
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from chaos.campaign import Campaign, undisturbed_problems
from chaos.processes import Command, Ended
from chaos.scenarios import STRUCK, Scenario
from chaos.trees import damaged

_CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGINT: 130, signal.SIGTERM: 143}
_AT_THE_END = 1.0  # Seconds of computing that a command may take to its end by itself when a signal comes too late


@dataclass(frozen=True)
class Strike:
    """One kill.

    Args:
        number: the signal.
        moment: when, as a fraction of the computing time of the undisturbed command.
        group: whether all processes of the group get it, as from a terminal.
        again: seconds after which the same signal comes a second time; None for once.

    """

    number: signal.Signals
    moment: float
    group: bool
    again: float | None = None

    def __str__(self) -> str:
        """Return the strike for people."""
        twice = "" if self.again is None else f", again after {self.again:.2f} s"
        return f"{self.number.name} at {self.moment:.3f}{' to the group' if self.group else ''}{twice}"


@dataclass(frozen=True)
class KillCase:
    """A scenario that is struck, perhaps again when it goes on, and at last runs to its end."""

    name: str
    scenario: Scenario
    strikes: tuple[Strike, ...]


@dataclass(frozen=True)
class Hit:
    """A strike that met a living command.

    Args:
        strike: the strike.
        place: what the command was doing.
        ready: seconds of computing until the command caught signals.
        problems: what was wrong afterwards.

    """

    strike: Strike
    place: str
    ready: float
    problems: tuple[str, ...]


def kill_cases(seed: int, only: tuple[str, ...] = ()) -> Iterator[KillCase]:
    """Yield cases without end: those of ``only``, or of all scenarios, in turn in an order that the seed determines."""
    number = 0
    while True:
        for name in random.Random(f"{seed} order {number}").sample(list(STRUCK), len(STRUCK)):
            if not only or name in only:
                yield kill_case(seed, number, name)
            number += 1


def kill_case(seed: int, number: int, name: str) -> KillCase:
    """Return a case with one to three strikes."""
    draw = random.Random(f"{seed} {number} {name}")
    return KillCase(f"kill-{number}", STRUCK[name], tuple(_strike(draw) for _ in range(draw.choice((1, 2, 2, 3)))))


def _strike(draw: random.Random) -> Strike:
    """Return a random strike; a fifth of them come early for sure, while modules are imported."""
    kind = draw.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
    moment = draw.uniform(0, 0.35) if draw.random() < 1 / 5 else draw.random()
    again = draw.uniform(0.1, 1) if kind != signal.SIGKILL and draw.random() < 1 / 3 else None
    return Strike(kind, moment, draw.random() < 1 / 2, again)


def run_case(campaign: Campaign, case: KillCase) -> tuple[list[Hit], list[str]]:
    """Run a case; return its hits, and what was wrong at its end."""
    computed = campaign.undisturbed(case.scenario).computed[0]
    campaign.begin(case.scenario)
    hits: list[Hit] = []
    kept: dict[Path, tuple[int, int]] = {}
    for strike in case.strikes:
        command = campaign.start(case.scenario)
        ready = command.wait_until_ready()
        if not command.wait_for(strike.moment * computed):
            command.end(campaign.grace)
            continue
        place = "at work" if command.is_at_work else "before the first output"
        before = command.computed()
        end = carry_out(command, strike, campaign.grace)
        problems = [] if _was_complete(case.scenario, end) else end_problems(strike, end, end.computed - before)
        problems += damaged(campaign.work)
        hits.append(Hit(strike, place, ready, tuple(problems)))
        kept |= _stamps(campaign.work, case.scenario)
        if problems:
            return hits, []
    problems, _ = campaign.finish(case.scenario)
    after = _stamps(campaign.work, case.scenario)
    again = [path for path, stamp in kept.items() if after.get(path) != stamp]
    problems += [f"{path.relative_to(campaign.work)}: was complete, and was made again" for path in again]
    return hits, problems + damaged(campaign.work) + campaign.compare(case.scenario)


def _was_complete(scenario: Scenario, end: Ended) -> bool:
    """Return whether a command ended by itself, as it had nothing left to do."""
    return end.code == 2 and bool(scenario.complete) and not undisturbed_problems(scenario, end)


def carry_out(command: Command, strike: Strike, grace: float) -> Ended:
    """Strike a command, and wait for its end."""
    started = time.monotonic()
    command.send(strike.number, group=strike.group)
    while strike.again is not None and command.is_alive() and time.monotonic() - started < strike.again:
        time.sleep(0.01)
    if strike.again is not None and command.is_alive():
        command.send(strike.number, group=strike.group)
    return command.end(grace - (time.monotonic() - started))


def end_problems(strike: Strike, end: Ended, computed: float) -> list[str]:
    """Return what is wrong with the end of a command that was struck.

    Args:
        strike: the strike.
        end: how the command ended.
        computed: seconds that it computed after the strike.

    """
    problems = []
    lines = end.err.splitlines()
    if end.code is None:
        problems.append("alive after the limit")
    elif end.code == 0 and strike.number != signal.SIGKILL:
        if computed > _AT_THE_END:
            problems.append(f"went on for {computed:.1f} s, and ended with exit code 0")
        if lines:
            problems.append(f"exit code 0, but on stderr: {lines[-1]}")
    elif end.code not in (0, _CODES[strike.number]):
        problems.append(f"exit code {end.code}, expected {_CODES[strike.number]}")
    if strike.number != signal.SIGKILL and end.code not in (0, None) and len(lines) != 1:
        problems.append(f"{len(lines)} lines on stderr, expected one: {' | '.join(lines[-4:])}")
    if "Traceback" in end.err or "Traceback" in end.out:
        problems.append("a traceback")
    if end.left:
        problems.append(f"{len(end.left)} processes alive after the limit")
    return problems


def _stamps(work: Path, scenario: Scenario) -> dict[Path, tuple[int, int]]:
    """Return the files that are never made again, with their numbers and times."""
    paths = {path for pattern in scenario.kept for path in work.glob(pattern) if not path.name.startswith(".")}
    whole = [path for path in paths if path.suffix != ".json" or json.loads(path.read_text()).get("complete")]
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in whole}
