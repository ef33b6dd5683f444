"""Ctrl-C and SIGTERM: a command ends with one line and exit code 130 or 143, and what is finished is kept.

Both raise KeyboardInterrupt, so that temporary files are removed and worker processes stopped; a second signal kills
the process. Within :func:`deferred` the first one is only noted: a training completes its step and saves it. All files
are replaced atomically, so that an interruption leaves nothing half-written.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from dsr.utils.guards import limit_memory

MESSAGE = "interrupted; what is finished is kept, the same command continues from there"
_BETWEEN_LOOKS = 0.5  # seconds between two looks of a worker after its parent
_came: list[int] = []  # the signals that this process was interrupted by


def start(module: str, function: str) -> NoReturn:
    """Import a function, call it, and exit with the code that it returns, or with that of an interruption."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:  # as in a shell's background job
            signal.signal(number, _interrupt)
    # No code is loaded from the working directory, which may hold a stranger's files, here or in worker processes.
    os.environ["PYTHONSAFEPATH"] = "1"  # of worker processes, which are started with -c
    os.environ["LD_LIBRARY_PATH"] = os.environ.get("LD_LIBRARY_PATH") or str(Path(__file__).parent)
    # OpenCV puts a colon before it, and the working directory would stand for an empty entry
    if getattr(sys.modules["__main__"], "__spec__", None) is not None and sys.path[:1] == [os.getcwd()]:  # noqa: PTH109
        del sys.path[0]  # where ``python -m`` puts it
    ignore_warnings_of_numbers()
    limit_memory()
    try:
        code = getattr(importlib.import_module(module), function)()
        sys.stdout.flush()
    except KeyboardInterrupt as interrupted:
        code = stop(str(interrupted))
    except BrokenPipeError:  # nobody reads the output any longer, as in | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    finally:
        for worker in multiprocessing.active_children():  # those of data loaders outlast SIGTERM
            with contextlib.suppress(AttributeError):  # joblib's have no kill, and end by themselves
                worker.kill()
    sys.exit(code)


def _interrupt(number: int, _: FrameType | None) -> None:
    _came.append(number)
    signal.signal(number, signal.SIG_DFL)
    raise KeyboardInterrupt


def stop(message: str = "") -> int:
    """Print the line of an interrupted command on stderr, and return its exit code."""
    print(message or MESSAGE, file=sys.stderr)  # noqa: T201
    return exit_code()


def exit_code() -> int:
    """Return the exit code of an interrupted command: 128 + the number of the signal that came, by default SIGINT."""
    return 128 + (_came[0] if _came else signal.SIGINT)


@contextlib.contextmanager
def deferred() -> Iterator[list[int]]:
    """Within this context the first signal is only noted, in the list that is yielded; a second one kills the process.

    SIGUSR2 is noted, too, if there is a handler for it: submitit's, which requeues the job. SIGTERM then has no effect,
    as under submitit. The caller passes the signal on to its handler with :func:`signal.raise_signal`.
    """
    noted: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        noted.append(number)
        signal.signal(number, signal.SIG_DFL)
        if number == signal.SIGINT:
            os.write(2, b"stopping after this step (Ctrl-C again stops at once)\n")

    preemption: Any = getattr(signal, "SIGUSR2", None)  # Windows has none
    requeues = preemption is not None and callable(signal.getsignal(preemption))
    handlers: dict[Any, Any] = {signal.SIGINT: note, signal.SIGTERM: signal.SIG_IGN if requeues else note}
    handlers |= {preemption: note} if requeues else {}
    before: dict[Any, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, handler) for number, handler in handlers.items()
                  if signal.getsignal(number) != signal.SIG_IGN}  # fmt: skip
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ignore_warnings_of_numbers() -> None:
    """Suppress NumPy's floating-point warnings, except in users' code: dsr checks the results instead."""
    warnings.filterwarnings("ignore", category=RuntimeWarning, module=r"(dsr|numpy)\b")


@contextlib.contextmanager
def starting_workers(*further: signal.Signals) -> Iterator[None]:
    """Within this context started processes do not get SIGINT, nor ``further`` signals, before :func:`end_with`."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *further})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with(parent: int) -> None:
    """Leave Ctrl-C to the parent of this process, a worker, and end this process once the parent is gone."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_BETWEEN_LOOKS)
        os._exit(exit_code())

    ignore_warnings_of_numbers()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()
