"""Run cases of the fuzzer in worker processes, and count how they end: ``make fuzz ARGS="--cases 10000 --seed 0"``."""

import argparse
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fuzz.pool import Pool

_EVERY = 20.0  # Seconds between lines about the progress


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases; return 1 if one did not end as it must."""
    parser = argparse.ArgumentParser("fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000, metavar="N", help="number of cases (10000)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="decides about all cases (0)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument("--case", type=int, metavar="N", help="run this case alone")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep its files there, or those of the unclean ones")
    parser.add_argument("--reader", metavar="NAME", help="only cases of this reader")
    options = parser.parse_args(arguments)
    options.keep = None if options.keep is None else options.keep.absolute()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    work = Path(tempfile.mkdtemp(prefix="dsr-fuzz-"))
    os.chdir(work)
    try:
        return _one(options, work) if options.case is not None else _many(options, work)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _one(options: argparse.Namespace, work: Path) -> int:
    """Run one case in this process, and show it."""
    from fuzz.cases import Cases  # noqa: PLC0415 - in this process only then

    cases = Cases(options.seed, work)
    os.chdir(cases.folder)
    case = cases.run(options.case, options.keep)
    outcome = case.outcome
    print(f"{outcome.kind} after {outcome.seconds:.1f} s and {outcome.megabytes:.0f} MB\n{case}")
    return int(outcome.kind == "unclean")


def _many(options: argparse.Namespace, work: Path) -> int:
    """Run the cases in workers, and print what they find as they do."""
    from fuzz.readers import READERS, reader_of  # noqa: PLC0415

    if options.reader is not None and options.reader not in [each.name for each in READERS]:
        sys.exit(f"--reader: expected one of {', '.join(each.name for each in READERS)}")
    numbers = [n for n in range(options.cases) if options.reader in (None, reader_of(n).name)]
    tally = _Tally(len(numbers))
    pool = Pool(work, options.seed, options.workers, options.keep)
    try:
        for result in pool.run(numbers):
            tally.add(*result)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    finally:
        pool.close()
    tally.show()
    return int(tally.unclean > 0 or tally.done < tally.total)


class _Tally:
    """Counts how cases end, by reader."""

    def __init__(self, total: int) -> None:
        self.total, self.done, self.unclean = total, 0, 0
        self._counts: dict[str, Counter[str]] = {}
        self._seconds: Counter[str] = Counter()
        self._longest, self._largest = (0.0, ""), (0.0, "")
        self._began = self._said = time.monotonic()

    def add(self, reader: str, kind: str, text: str, seconds: float, megabytes: float, number: int) -> None:
        """Count a case, and show it if it is unclean."""
        self.done += 1
        self._counts.setdefault(reader, Counter())[kind] += 1
        self._seconds[reader] += seconds
        self._longest = max(self._longest, (seconds, f"case {number}"))
        self._largest = max(self._largest, (megabytes, f"case {number}"))
        if kind == "unclean":
            self.unclean += 1
            print(f"unclean: {text}", flush=True)
        now = time.monotonic()
        if now - self._said >= _EVERY:
            self._said, passed = now, now - self._began
            left = passed / self.done * (self.total - self.done)
            print(f"{self.done} of {self.total}, {self.unclean} unclean, elapsed {passed:.0f} s, "
                  f"remaining {left:.0f} s", flush=True)  # fmt: skip

    def show(self) -> None:
        """Show the counts."""
        kinds = ("value", "refusal", "unclean")
        print(f"{'reader':<20}" + "".join(f"{kind + 's' if kind != 'unclean' else kind:>10}" for kind in kinds)
              + f"{'seconds':>10}")  # fmt: skip
        for reader, counts in self._counts.items():
            row = "".join(f"{counts[kind]:>10}" for kind in kinds)
            print(f"{reader:<20}{row}{self._seconds[reader]:>10.1f}")
        totals = sum(self._counts.values(), Counter())
        print(f"{'all ' + str(self.done):<20}" + "".join(f"{totals[kind]:>10}" for kind in kinds))
        print(f"longest {self._longest[0]:.1f} s ({self._longest[1]}), most memory {self._largest[0]:.0f} MB "
              f"({self._largest[1]}), elapsed {time.monotonic() - self._began:.0f} s")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
