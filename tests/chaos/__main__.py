"""Strike commands and run them at once, and compare with undisturbed results.

``make chaos ARGS="--kills 100 --seed 0"``, on Linux. Files and output of cases that are not clean are kept.
"""

import argparse
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from chaos import kills, together
from chaos.campaign import Campaign
from chaos.scenarios import ALL

PARTS = ("kills", "pairs")
_COLUMNS = ("SIGKILL", "SIGTERM", "SIGINT", "twice", "before the first output", "at work", "pair", "unclean")


@dataclass
class Tally:
    """What has been counted so far.

    Args:
        counts: by scenario, by kind.
        unclean: problems by case.
        ready: seconds of computing until a command caught signals, the most.

    """

    counts: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    unclean: dict[str, list[str]] = field(default_factory=dict)
    ready: float = 0.0

    @property
    def kills(self) -> int:
        """How many strikes met a living command."""
        return sum(counts["kills"] for counts in self.counts.values())

    def summary(self, seconds: float) -> str:
        """Return the counts as a table."""
        rows = [f"{'scenario':<28}{'kills':>6}" + "".join(f"{name:>{len(name) + 2}}" for name in _COLUMNS)]
        total: Counter[str] = sum(self.counts.values(), Counter())
        for name, counts in [*sorted(self.counts.items()), ("all", total)]:
            cells = "".join(f"{counts[column]:>{len(column) + 2}}" for column in _COLUMNS)
            rows.append(f"{name:<28}{counts['kills']:>6}{cells}")
        rows.append(f"signals are caught after {self.ready:.2f} s of computing at most")
        rows.append(
            f"{total['kills']} kills, {total['pair']} pairs in {seconds / 60:.1f} minutes: {len(self.unclean)} unclean"
        )
        return "\n".join(rows)


class Session:
    """Runs the cases, and tells and counts what became of them."""

    def __init__(self, campaign: Campaign, options: argparse.Namespace) -> None:
        self.campaign, self.options, self.tally = campaign, options, Tally()
        self._started = time.monotonic()

    @property
    def seconds(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self._started

    def kill(self, case: kills.KillCase) -> None:
        """Run a case of kills."""
        hits, problems = kills.run_case(self.campaign, case)
        counts = self.tally.counts[case.scenario.name]
        for hit in hits:
            twice = [] if hit.strike.again is None else ["twice"]
            counts.update(["kills", hit.strike.number.name, hit.place, *twice])
            self.tally.ready = max(self.tally.ready, hit.ready)
            problems = [*(f"{hit.strike}, {hit.place}: {line}" for line in hit.problems), *problems]
        reported = "; ".join(f"{hit.strike} {hit.place}" for hit in hits) or "no strike met it"
        self._conclude(case.name, case.scenario.name, reported, problems)

    def pair(self, case: together.PairCase) -> None:
        """Run two commands at once."""
        problems = together.run_case(self.campaign, case)
        self.tally.counts[case.scenario.name].update(["pair"])
        self._conclude(case.name, case.scenario.name, f"the second after {case.delay:.2f}", problems)

    def _conclude(self, name: str, scenario: str, reported: str, problems: list[str]) -> None:
        """Print a line, and keep what is not clean."""
        left = ""
        if name.startswith("kill") and self.tally.kills:
            left = f", about {self.seconds * (self.options.kills / self.tally.kills - 1) / 60:.0f} min of kills left"
        verdict = "UNCLEAN" if problems else "clean"
        print(f"[{self.seconds / 60:5.1f} min{left}] {name} {scenario}: {reported}: {verdict}", flush=True)
        for line in problems:
            print(f"    {line}", flush=True)
        if problems:
            self.tally.counts[scenario]["unclean"] += 1
            self.tally.unclean[name] = problems
            self.campaign.keep(name, problems)


def main() -> int:
    """Run the campaign, and return the exit code."""
    options = _parser().parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # children of a background job would ignore it
    root = (options.folder or Path(tempfile.mkdtemp(prefix="dsr-chaos-"))).resolve()
    session = Session(Campaign(root, options.grace), options)
    if options.case:
        _repeat(session, options.case, options.seed)
    else:
        _run_all(session, options)
    print(session.tally.summary(session.seconds))
    if session.tally.unclean:
        print(f"unclean: {' '.join(session.tally.unclean)}; their files are in {root / 'unclean'}")
        return 1
    if options.folder is None:
        shutil.rmtree(root)
    return 0


def _run_all(session: Session, options: argparse.Namespace) -> None:
    """Run the chosen parts of the campaign."""
    chosen = tuple(options.only or ALL)
    if "kills" in options.parts:
        cases = kills.kill_cases(options.seed, chosen)
        while session.tally.kills < options.kills:
            session.kill(next(cases))
    if "pairs" in options.parts:
        for pair in together.pair_cases(options.seed):
            if pair.scenario.name in chosen:
                session.pair(pair)


def _repeat(session: Session, name: str, seed: int) -> None:
    """Run one case again."""
    kind, _, number = name.partition("-")
    cases: dict[str, Iterator] = {
        "kill": kills.kill_cases(seed),
        "pair": iter(together.pair_cases(seed)),
    }
    run = {"kill": session.kill, "pair": session.pair}[kind]
    run(next(case for _, case in zip(range(int(number) + 1), cases[kind], strict=False) if case.name == name))


def _parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        "chaos", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--kills", type=int, default=100, metavar="N", help="strikes that meet a living command; 100")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of scenarios, signals and moments; 0")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="these alone")
    parser.add_argument("--only", nargs="+", choices=sorted(ALL), metavar="NAME", help=f"of {', '.join(sorted(ALL))}")
    parser.add_argument("--case", metavar="NAME", help="one case again, such as kill-17 or pair-0; same seed")
    parser.add_argument("--grace", type=float, default=5.0, metavar="S", help="seconds for the end after a signal; 5")
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where to work; a temporary folder by default")
    return parser


if __name__ == "__main__":
    sys.exit(main())
