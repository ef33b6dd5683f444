"""Worker processes that run cases; the one that starts them notices those that hang or die."""

import contextlib
import multiprocessing
import os
import resource
import shutil
import signal
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

_HANGS = 100.0  # Seconds after which a worker is killed whose case did not end by itself
_CHUNK = 50
_ADDRESSES = 6 << 30
"""Bytes of addresses that a case may take beyond those of an idle worker, so that the machine is left alone."""


class Pool:
    """Workers that get cases in chunks; one that hangs or dies is replaced, and its case counts as unclean."""

    def __init__(self, work: Path, seed: int, count: int, keep: Path | None = None) -> None:
        self._work, self._seed, self._keep = work, seed, keep
        self._context = multiprocessing.get_context("spawn")
        self._workers = [self._start() for _ in range(count)]

    def _start(self) -> dict[str, Any]:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs, self._work, self._seed, self._keep))
        process.start()
        theirs.close()
        return {"pipe": ours, "process": process, "todo": [], "case": None, "since": time.monotonic()}

    def run(self, numbers: Sequence[int]) -> Any:
        """Yield the results of cases."""
        left = [list(numbers[at : at + _CHUNK]) for at in range(0, len(numbers), _CHUNK)][::-1]
        while left or any(worker["todo"] for worker in self._workers):
            for worker in self._workers:
                if not worker["todo"] and left:
                    worker["todo"] = left.pop()
                    worker["pipe"].send(worker["todo"])
            for pipe in wait([worker["pipe"] for worker in self._workers], timeout=1):
                worker = next(each for each in self._workers if each["pipe"] is pipe)
                yield from self._receive(worker)
            for worker in self._workers:
                if worker["case"] is not None and time.monotonic() - worker["since"] > _HANGS:
                    worker["process"].kill()

    def _receive(self, worker: dict[str, Any]) -> Any:
        try:
            kind, content = worker["pipe"].recv()
        except (EOFError, OSError):
            worker["process"].join()
            number, code = worker["case"], worker["process"].exitcode
            if number is None:
                raise RuntimeError(f"a worker ended by itself, with exit code {code}") from None
            from fuzz.readers import reader_of  # noqa: PLC0415

            name = reader_of(number).name
            how = "hangs, or takes all memory" if code == -signal.SIGKILL else f"ends the process with {code}"
            text = f'{name}: {how}\n    again: make fuzz ARGS="--seed {self._seed} --case {number}"'
            yield name, "unclean", text, 0.0, 0.0, number
            rest = worker["todo"][worker["todo"].index(number) + 1 :]
            self._workers[self._workers.index(worker)] = fresh = self._start()
            fresh["todo"] = rest
            if rest:
                fresh["pipe"].send(rest)
            return
        worker["since"] = time.monotonic()
        if kind == "begin":
            worker["case"] = content
            return
        worker["case"] = None
        number = content[-1]
        if number == worker["todo"][-1]:
            worker["todo"] = []
        yield content

    def close(self) -> None:
        """End the workers."""
        for worker in self._workers:
            worker["process"].kill()
            worker["process"].join()


def _serve(pipe: Connection, work: Path, seed: int, keep: Path | None) -> None:
    """Run the cases that come through a pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the workers
    import torch  # noqa: PLC0415

    torch.set_num_threads(1)
    from fuzz.cases import Cases  # noqa: PLC0415

    with contextlib.suppress(ValueError, OSError), open("/proc/self/statm") as file:  # noqa: PTH123 - Linux's
        most = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE") + _ADDRESSES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    cases = Cases(seed, work)
    os.chdir(cases.folder)
    with contextlib.suppress(EOFError, OSError):
        while True:
            for number in pipe.recv():
                pipe.send(("begin", number))
                kept = None if keep is None else keep / str(number)
                case = cases.run(number, kept)
                end = case.outcome
                if kept is not None and end.kind != "unclean":
                    shutil.rmtree(kept, ignore_errors=True)
                text = str(case) if end.kind == "unclean" else ""
                pipe.send(("end", (case.reader, end.kind, text, end.seconds, end.megabytes, number)))
