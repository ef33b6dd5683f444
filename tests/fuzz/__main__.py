"""Run cases of the fuzzer in two processes, and count how they end: ``make fuzz ARGS="--cases 10000 --seed 0"``."""

import argparse
import multiprocessing
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from multiprocessing.pool import ThreadPool
from pathlib import Path

from fuzz.cases import READERS, ROUND, Case, begin, run
from fuzz.judging import Outcome

_HANGS = 100.0  # Seconds after which a worker is replaced that did not end its case
_EVERY = 20.0  # Seconds between lines about the progress


def main() -> int:
    """Run the cases; return 1 if one did not end as it must."""
    parser = argparse.ArgumentParser("fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000, metavar="N", help="number of cases (10000)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="decides about all cases (0)")
    parser.add_argument("--reader", metavar="NAME", choices=[each.name for each in READERS], help="only cases of this")
    parser.add_argument("--case", type=int, metavar="N", help="run this case alone")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the files of unclean cases, or of --case, there")
    options = parser.parse_args()
    numbers = [n for n in range(options.cases) if options.reader in (None, ROUND[n % len(ROUND)].name)]
    if options.case is not None:
        numbers = [options.case]
    keep = None if options.keep is None else options.keep.absolute()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    work = Path(tempfile.mkdtemp(prefix="dsr-fuzz-"))
    counts: dict[str, Counter[str]] = {each.name: Counter() for each in READERS}
    done, slowest = 0, ""
    began = said = time.monotonic()
    try:
        with ThreadPool(2) as threads:
            for case in threads.imap_unordered(_Worker(options.seed, work, keep).run, numbers):
                done += 1
                counts[case.reader.name][case.outcome.kind] += 1
                if case.outcome.kind == "unclean" or options.case is not None:
                    print(f"{case.outcome.kind}: {case}", flush=True)
                elif keep is not None:
                    shutil.rmtree(keep / f"{case.number}", ignore_errors=True)
                slowest = max(slowest, f"{case.outcome.seconds:6.1f} s (case {case.number})")
                if time.monotonic() - said >= _EVERY:
                    said = time.monotonic()
                    print(f"{done} of {len(numbers)} after {said - began:.0f} s", flush=True)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    total = sum(counts.values(), Counter())
    for name, count in (("reader", None), *counts.items(), (f"all {done}", total)):
        kinds = ("value", "refusal", "unclean")
        if count != Counter():
            print(f"{name:<24}" + "".join(f"{kind if count is None else count[kind]:>10}" for kind in kinds))
    print(f"longest {slowest.strip()}")
    return int(total["unclean"] > 0 or done < len(numbers))


class _Worker:
    """Runs cases in a process for each thread that asks, which is replaced when it hangs or dies."""

    def __init__(self, seed: int, work: Path, keep: Path | None) -> None:
        self._seed, self._work, self._keep = seed, work, keep
        self._own = threading.local()

    def run(self, number: int) -> Case:
        """Run a case."""
        if not hasattr(self._own, "pool"):
            spawn = multiprocessing.get_context("spawn")
            self._own.pool = spawn.Pool(1, begin, (self._seed, self._work))
        keep = None if self._keep is None else self._keep / f"{number}"
        try:
            return self._own.pool.apply_async(run, (number, keep)).get(_HANGS)
        except multiprocessing.TimeoutError:
            self._own.pool.terminate()
            del self._own.pool
            return Case(self._seed, number, (), Outcome("unclean", "hangs, or ends the process", _HANGS))


if __name__ == "__main__":
    sys.exit(main())
