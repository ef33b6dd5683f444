"""Ctrl-C and SIGTERM: a command ends in one line, with exit code 128 + the signal's number.

It ends within five seconds, but that at Ctrl-C a training or an optimisation does the step that it is at to its end.

Python turns SIGINT into an exception wherever the program happens to be: in an import, in a callback of the garbage
collector, which drops it, or in a library that catches everything. SIGTERM ends it without a word. :func:`start`, which
runs the commands, therefore installs a handler before anything else is imported:

- While a command works (:func:`working`), the first signal raises KeyboardInterrupt, so that temporary files are
  removed and worker processes stopped. Within :func:`deferred` it is only noted, so that a training can save its step.
- If this has not ended the process after a few seconds, but not while a step that Ctrl-C has met is being done, at a
  second signal, and at any other time, such as during imports, the process ends at once. Files are replaced atomically,
  so only temporary ones are left, which a later run removes.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import importlib
import io
import os
import select
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, NoReturn

from dsr.utils import surroundings

MESSAGE = "interrupted; what is finished is kept, the same command continues from there"
"""The line of an interrupted command that has nothing more precise to say."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PREEMPTION: signal.Signals | None = getattr(signal, "SIGUSR2", None)
"""The signal with which submitit ends a job that is preempted or out of time; Windows has none."""
_GRACE = 4.0
"""Seconds that an interrupted command has to end by itself."""
_BETWEEN_LOOKS = 0.5
"""Seconds between two looks of a worker after its parent, and of a process that is to end after its work."""
_SILENCE = 1.0
"""Seconds after Ctrl-C from which on a step that is still being done is reported."""
_SHOW_CURSOR = b"\x1b[?25h"
"""The control sequence of terminals that undoes what a progress display hides."""


class Deferred:
    """Records a signal instead of acting on it at once; ``requested`` is set once one has come.

    Args:
        message: returns the line that the process ends with if the signal is not acted upon in time.

    """

    def __init__(self, message: Callable[[], str]) -> None:
        self.message, self.requested = message, False

    def note(self, number: int, _: FrameType | None) -> None:
        """Note the first signal; the default handler applies to the second one."""
        self.requested = True
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


class _Output(io.FileIO):
    """A standard stream that nobody reads any longer, as of ``| head``, takes what is written and drops it.

    Args:
        descriptor: that of the stream.
        dropped: numbers of the errors at which it does so.

    """

    def __init__(self, descriptor: int, dropped: tuple[int, ...]) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self._dropped = dropped

    def write(self, data: Any, /) -> int:
        """Write bytes, or from an error on drop them."""
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in self._dropped:
                raise
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return len(data)


class _State:
    """What the handler knows of the process.

    Attributes:
        installed: whether the handler is that of the process.
        numbers: the signals that are acted upon: not SIGINT in a shell's background job, which is started to ignore it.
        working: whether a command is at work.
        number: the signal that came; 0 for none.
        handled: whether the handler has acted upon a signal.
        deferred: what notes a signal; None if signals raise.
        requeues: whether a scheduler requeues the job of this process, see :func:`requeued`.
        silent: whether the process ends without a line, as another one of the same command says it.
        starting: whether a process is being started, see :func:`starting_workers`.
        late: whether a signal has come meanwhile.
        terminated: whether this process is a worker that its parent ends by SIGTERM.
        pools: how many groups of worker processes are at work, see :func:`with_workers`.
        ending: held by the thread that ends the process.

    """

    installed = False
    numbers: tuple[int, ...] = ()
    working = False
    number = 0
    handled = False
    deferred: Deferred | None = None
    requeues = False
    silent = False
    starting = False
    late = False
    terminated = False
    pools = 0
    ending = threading.Lock()


def start(module: str, function: str) -> NoReturn:
    """Import a function, call it, and end the process with its exit code, or with that of an interruption.

    The working directory has no say in what is imported, see :mod:`dsr.utils.surroundings`.

    Args:
        function: name of its function; it takes no arguments, and returns an exit code, or None for 0.

    """
    install()
    surroundings.close()
    sys.stdout = _without(sys.stdout, errno.EPIPE)
    sys.stderr = _without(sys.stderr, errno.EPIPE, errno.ENOSPC)  # what cannot be printed must not change the exit code
    code: object = 0
    try:
        code = getattr(importlib.import_module(module), function)()
    except SystemExit as ending:
        code = ending.code
    except KeyboardInterrupt:
        end(MESSAGE)
    _State.working = False
    if isinstance(code, str):
        print(code, file=sys.stderr)  # noqa: T201 - as sys.exit does
    _finish(code if isinstance(code, int) else int(code is not None))


def _without(stream: Any, *dropped: int) -> Any:
    """Return a standard stream that drops what is written from these errors on; None for none."""
    if not isinstance(stream, io.TextIOWrapper):
        return stream
    try:
        raw = _Output(stream.fileno(), dropped)
    except OSError:  # it is closed
        return stream
    stream.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(raw) if isinstance(stream.buffer, io.BufferedWriter) else raw,
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def install() -> None:
    """Make the handler that of this process; only from its main thread."""
    _State.installed = True
    _State.silent = os.environ.get("LOCAL_RANK", "0") != "0"  # a further process of a training on several devices
    _State.numbers = tuple(number for number in _SIGNALS if signal.getsignal(number) != signal.SIG_IGN)
    sys.unraisablehook = _unraisable
    sys.warnoptions.append("ignore:resource_tracker")  # it warns on stderr of what it cleans up after a sudden end
    ignore_warnings_of_numbers()
    os.register_at_fork(after_in_child=_forget)
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reading,), name="interruption", daemon=True).start()
    reinstall()


def ignore_warnings_of_numbers() -> None:
    """Suppress NumPy's floating-point warnings, except in users' code: dsr checks the results instead."""
    warnings.filterwarnings("ignore", category=RuntimeWarning, module=r"(dsr|numpy)\b")


def silence() -> None:
    """End this process silently at a signal: another process of the same command prints the line."""
    _State.silent = True


def reinstall() -> None:
    """Install the handler again after a library has replaced it; without :func:`install` nothing happens."""
    if _State.installed and threading.current_thread() is threading.main_thread():
        for number in _State.numbers:
            signal.signal(number, _handle)


@contextlib.contextmanager
def working() -> Iterator[None]:
    """Within this context a signal raises KeyboardInterrupt, rather than ending the process at once."""
    before, _State.working = _State.working, True
    try:
        yield
    finally:
        _State.working = before


@contextlib.contextmanager
def deferred(message: Callable[[], str]) -> Iterator[Deferred]:
    """Within this context the first signal is only noted; the code in it looks for it and ends by itself.

    At Ctrl-C it has the time that it needs, at SIGTERM, which batch systems let SIGKILL follow, a few seconds.
    Where the handler is not that of the process, as in a notebook, the process is never ended.

    Args:
        message: returns the line that the process ends with if the signal is not acted upon in time.

    """
    noted, before = Deferred(message), {}
    if _State.installed or _State.requeues:
        _State.deferred = noted
        reinstall()
    if _State.requeues:
        before = {signal.SIGTERM: signal.signal(signal.SIGTERM, signal.SIG_IGN)}  # Lightning ends a training at it
    elif not _State.installed and threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, noted.note) for number in _SIGNALS}
    try:
        yield noted
    finally:
        _State.deferred = None
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def requeued() -> Iterator[None]:
    """Within this context a job that its scheduler wants to stop is stopped as by Ctrl-C, and only then requeued.

    submitit, in whose processes the jobs of sweeps run, requeues a job and ends its process at once when SIGUSR2 says
    that its time is up or that it is preempted. Here the signal first raises KeyboardInterrupt, or is noted within
    :func:`deferred`, so that a training saves its step. SIGTERM, which some clusters send before, stays without effect,
    as submitit has it. In other processes nothing changes.
    """
    requeue = signal.getsignal(_PREEMPTION) if _PREEMPTION is not None else None
    if _PREEMPTION is None or not callable(requeue) or _State.installed:
        yield
        return
    came: list[FrameType | None] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(frame)
        if _in_import(frame):
            requeue(number, frame)
        elif _State.deferred is not None:
            _State.deferred.requested = True
        elif len(came) == 1:  # a second one would disturb what the first one has begun
            raise KeyboardInterrupt

    signal.signal(_PREEMPTION, note)
    _State.requeues = True
    try:
        yield
    except KeyboardInterrupt:
        if came:
            requeue(_PREEMPTION, came[0])
        raise
    finally:
        _State.requeues = False
        signal.signal(_PREEMPTION, requeue)


def await_requeue() -> None:
    """Leave the first process of a job the time to ask for its requeue: the end of a process may end the whole job."""
    if _State.requeues:
        time.sleep(_GRACE)


@contextlib.contextmanager
def starting_workers(*further: signal.Signals) -> Iterator[None]:
    """Within this context started processes do not get SIGINT, which would meet them before :func:`end_with`.

    A signal that comes to this process meanwhile is acted upon at the end: a process that is half started complains.

    Args:
        further: other signals that they do not get either.

    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *further})
    _State.starting = True
    try:
        yield
    finally:
        _State.starting = False
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if _State.late:
            _State.late = _State.handled = False
            _handle(_State.number, None)


def end_with(parent: int, *, terminated: bool = False) -> None:
    """End this process, a worker, once its parent is gone, and leave it to the parent to end it at Ctrl-C.

    Args:
        parent: number of the parent's process.
        terminated: whether the parent ends it by SIGTERM: at once, but for :func:`leaving`.

    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_BETWEEN_LOOKS)
        os._exit(exit_code())

    ignore_warnings_of_numbers()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if terminated:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a fork has its parent's handler
        _State.terminated = True
    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def leaving() -> Iterator[None]:
    """Within this context, in which a temporary file exists, SIGTERM ends a worker by an exception that removes it."""
    main = threading.current_thread() is threading.main_thread()
    if not (_State.terminated and main and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL):
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def outlast_group() -> None:
    """End this process, a worker, only some seconds after SIGTERM, in which its parent, if it got it too, ends both.

    The parent may need the worker to complete its step, or take its sudden end for an error.
    """

    def wait(number: int, _: FrameType | None) -> None:
        timer = threading.Timer(_GRACE, os._exit, (128 + number,))
        timer.daemon = True
        timer.start()

    signal.signal(signal.SIGTERM, wait)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


@contextlib.contextmanager
def with_workers() -> Iterator[None]:
    """Within this context, Ctrl-C waits for steps that worker processes are at, however long it takes to reach them."""
    _State.pools += 1
    try:
        yield
    finally:
        _State.pools -= 1


def is_ctrl_c() -> bool:
    """Return whether the signal that came first is that of Ctrl-C."""
    return _State.number == signal.SIGINT


def exit_code() -> int:
    """Return the exit code of an interrupted command: 128 + the number of the signal that came, by default SIGINT."""
    return 128 + (_State.number or signal.SIGINT)


def stop(message: str) -> int:
    """End an interrupted command that has cleaned up, with a line on stderr; in other processes return the exit code.

    Args:
        message: the line; empty for :data:`MESSAGE`.

    """
    if _State.installed:
        end(message or MESSAGE)
    print(message or MESSAGE, file=sys.stderr)  # noqa: T201
    return exit_code()


def end(message: str) -> NoReturn:
    """End the process at once, and its worker processes, with a line on stderr."""
    if not _State.ending.acquire(blocking=False):
        threading.Event().wait()  # another thread is ending the process
    with contextlib.suppress(BaseException):
        if sys.stdout.isatty():
            os.write(1, _SHOW_CURSOR)
        if not _State.silent:
            os.write(2, f"{message}\n".encode())
        _end_children()
    os._exit(exit_code())


def _message() -> str:
    """Return the line of a process that has to end at once."""
    return MESSAGE if _State.deferred is None else _State.deferred.message()


def _handle(number: int, frame: FrameType | None) -> None:
    """Act upon a signal, in the main thread."""
    again, _State.handled = _State.handled, True
    _State.number = _State.number or number
    if _State.starting and not again:  # it came to another thread, which does not block it
        _State.late = True
        return
    if again or not _State.working or _in_import(frame):
        end(_message())
    if _State.deferred is None:
        raise KeyboardInterrupt
    _State.deferred.requested = True


def _watch(pipe: int) -> None:
    """End the process some seconds after a signal, or at a second one, whatever the main thread is busy with.

    A step that Ctrl-C has met is waited for however long it takes.
    """
    grace = 2 * _GRACE if _State.silent else _GRACE  # another process may need this one to complete its step
    came, deadline, announced = 0.0, 0.0, _State.silent
    while True:
        left = max(min(deadline - time.monotonic(), _BETWEEN_LOOKS), 0) if came else None
        if select.select([pipe], [], [], left)[0]:
            number = os.read(pipe, 1)[0]
            if number not in _SIGNALS:
                continue
            _State.number = _State.number or number
            if came:
                end(_message())
            came, deadline = time.monotonic(), time.monotonic() + grace
        elif (_State.deferred is not None or _State.pools) and is_ctrl_c() and not _State.silent:
            deadline = time.monotonic() + grace
            if not announced and time.monotonic() - came >= _SILENCE:
                announced = True
                with contextlib.suppress(OSError):
                    os.write(2, b"stopping after this step (Ctrl-C again stops at once)\n")
        elif time.monotonic() >= deadline:
            end(_message())


def _unraisable(problem: Any) -> None:
    """End the process if an interruption came where exceptions are dropped; else report as Python does."""
    if issubclass(problem.exc_type, KeyboardInterrupt) and _State.number:
        end(_message())
    sys.__unraisablehook__(problem)


def _in_import(frame: FrameType | None) -> bool:
    """Return whether a module is being imported, which takes no exception."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _end_children() -> None:
    """End the worker processes."""
    processes = sys.modules.get("multiprocessing.process")
    for child in [] if processes is None else processes.active_children():
        with contextlib.suppress(OSError):
            os.kill(child.pid, signal.SIGKILL)


def _forget() -> None:
    """Leave signals to the parent process, in a process that was forked from it; SIGTERM ends it."""
    _State.installed = False
    signal.set_wakeup_fd(-1)
    sys.unraisablehook = sys.__unraisablehook__
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _finish(code: int) -> NoReturn:
    """End the process as the interpreter does, but without taking it down, when no signal could be answered."""
    shut_down_threads: Callable[[], None] = vars(threading)["_shutdown"]
    try:
        shut_down_threads()
        atexit._run_exitfuncs()
        sys.stdout.flush()
    except OSError as error:
        if not code:  # it may be for the same reason that there was an error before
            print(f"error: standard output: {error.strerror}", file=sys.stderr)  # noqa: T201
            code = 2
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    os._exit(code)
