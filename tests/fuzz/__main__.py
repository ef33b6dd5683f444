"""Run cases of the fuzzer in two processes, and count how they end: ``make fuzz ARGS="--cases 10000 --seed 0"``."""

import argparse
import multiprocessing
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from multiprocessing.pool import ThreadPool
from pathlib import Path

from fuzz.cases import READERS, Case, begin, reader_of, run
from fuzz.judging import Outcome

_HANGS = 100.0  # Seconds after which a worker is replaced that did not end its case
_EVERY = 20.0  # Seconds between lines about the progress


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases; return 1 if one did not end as it must."""
    parser = argparse.ArgumentParser("fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000, metavar="N", help="number of cases (10000)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="decides about all cases (0)")
    parser.add_argument("--reader", metavar="NAME", choices=[each.name for each in READERS], help="only cases of this")
    parser.add_argument("--case", type=int, metavar="N", help="run this case alone")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the files of unclean cases, or of --case, there")
    options = parser.parse_args(arguments)
    numbers = [n for n in range(options.cases) if options.reader in (None, reader_of(n).name)]
    if options.case is not None:
        numbers = [options.case]
    keep = None if options.keep is None else options.keep.absolute()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    work = Path(tempfile.mkdtemp(prefix="dsr-fuzz-"))
    done: list[Case] = []
    began = said = time.monotonic()
    try:
        with ThreadPool(2) as threads:
            worker = _Worker(options.seed, work, keep)
            for case in threads.imap_unordered(worker.run, numbers):
                done.append(case)
                if case.outcome.kind == "unclean" or options.case is not None:
                    print(f"{case.outcome.kind}: {case}", flush=True)
                elif keep is not None:
                    shutil.rmtree(keep / f"{case.number}", ignore_errors=True)
                if time.monotonic() - said >= _EVERY:
                    said = time.monotonic()
                    print(f"{len(done)} of {len(numbers)} after {said - began:.0f} s", flush=True)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    unclean = _show(done)
    return int(unclean > 0 or len(done) < len(numbers))


def _show(done: Sequence[Case]) -> int:
    """Show how cases ended, by reader, and return how many were unclean."""
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for case in done:
        for name in (case.reader, f"all {len(done)}"):
            counts[name].update({case.outcome.kind: 1, "seconds": round(1000 * case.outcome.seconds)})
    print(f"{'reader':<24}{'values':>10}{'refusals':>10}{'unclean':>10}{'seconds':>10}")
    for name in [*(each.name for each in READERS), f"all {len(done)}"]:
        if name in counts:
            row = "".join(f"{counts[name][kind]:>10}" for kind in ("value", "refusal", "unclean"))
            print(f"{name:<24}{row}{counts[name]['seconds'] / 1000:>10.1f}")
    if done:
        longest = max(done, key=lambda case: case.outcome.seconds)
        largest = max(done, key=lambda case: case.outcome.megabytes)
        print(f"longest {longest.outcome.seconds:.1f} s (case {longest.number}), "
              f"most memory {largest.outcome.megabytes:.0f} MB (case {largest.number})")  # fmt: skip
    return sum(case.outcome.kind == "unclean" for case in done)


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
            outcome = Outcome("unclean", "hangs, takes all memory or ends the process", _HANGS, 0.0)
            return Case(self._seed, number, reader_of(number).name, (), outcome)


if __name__ == "__main__":
    sys.exit(main())
