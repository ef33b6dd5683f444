"""One case: a reader on its files, and whether it ended as it must."""

import contextlib
import io
import os
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bombs import limited_memory

from dsr.utils.console import one_line, printable
from dsr.utils.guards import refusing_excess
from fuzz.guard import MARK, watching

SECONDS, MEMORY = 20.0, 2 << 30  # Limits of a case: seconds of computing, and bytes, as commands limit their memory
_WAITING = 60.0  # Seconds that a case may take on a machine that does much else
_SHORTEST_NAME = 3  # Names of fewer letters are found in any message
REFUSALS = (ValueError, OSError)  # What the commands turn into a line
_SILENT = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)  # Python shows users none


class RefusedError(Exception):
    """A command that ended with exit code 2 and these lines on stderr."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__(" | ".join(lines))
        self.lines = list(lines)


class EscapedError(Exception):
    """An exception that a command did not turn into a line, which would show a traceback; it is the cause."""


class _TooLongError(BaseException):
    """A case that did not end in time; no ``except Exception`` catches it."""


class Place:
    """The folder of a case, with the files that are read in ``input``; commands write to ``out``."""

    def __init__(self, root: Path) -> None:
        self.root, self.input, self.out = root, root / "input", root / "out"
        self.canary = Path(MARK)
        """A folder that only code from a file makes; relative, so that the files are the same wherever a case runs."""


@dataclass(frozen=True)
class Outcome:
    """How a case ended: with a value, with a refusal of a line for each problem, or neither."""

    kind: Literal["value", "refusal", "unclean"]
    text: str
    seconds: float


def judge(read: Callable[[Place], Any], place: Place) -> Outcome:
    """Run a reader on the files of a place."""
    names, started = _names(place), time.process_time()
    problems, lines = list[str](), list[str]()
    with (
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
        watching(place.input, place.out) as watch,
        warnings.catch_warnings(record=True) as reported,
    ):
        warnings.simplefilter("default")
        try:
            with _limited(), limited_memory(MEMORY), refusing_excess():
                read(place)
        except RefusedError as refusal:
            lines = refusal.lines
            problems += [] if lines else ["ends with exit code 2 without a line"]
        except REFUSALS as error:
            lines = [one_line(error)]
        except _TooLongError as error:
            problems.append(f"takes longer than {SECONDS:g} s, or waits: {_where(error)}")
        except BaseException as error:
            cause = error.__cause__ or error if isinstance(error, EscapedError) else error
            problems.append(f"{type(cause).__name__}: {cause!s:.300} {_where(cause)}")
    left = sorted(path.name for path in place.root.iterdir() if path.name not in ("input", "out"))
    left += [MARK] if place.canary.exists() else []
    problems += [f"does what a reader must not: {each}" for each in watch.seen[:3]]
    problems += [f"leaves {name!r} beside its folders" for name in left]
    problems += [f"warns: {each.message!s:.200}" for each in reported if not issubclass(each.category, _SILENT)][:2]
    for line in lines:
        if "not enough memory" not in line and not any(name in line for name in names):
            problems.append(f"names no file: {line[:300]}")
        if line != printable(line) or "\n" in line:
            problems.append(f"has characters that do not print: {line[:300]!r}")
    kind: Literal["value", "refusal", "unclean"] = "unclean" if problems else "refusal" if lines else "value"
    return Outcome(kind, "; ".join(problems) or " | ".join(lines), time.process_time() - started)


def _names(place: Place) -> list[str]:
    """Return the names of the files and folders of a case, one of which a refusal must have."""
    found = {place.input.name + "/", str(place.input), str(place.out)}
    for folder, folders, files in os.walk(place.input):
        found.update((folder, *folders, *files, *(Path(name).stem for name in files)))
    return [name for name in found if len(name) >= _SHORTEST_NAME]


def _where(error: BaseException) -> str:
    """Return the last places of a traceback that are in dsr, and the last of all."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [each for each in frames if "/dsr/" in each.filename][-2:]
    shown = [f"{Path(each.filename).name}:{each.lineno} {each.name}" for each in (*ours, *frames[-1:])]
    return f"({', '.join(dict.fromkeys(shown))})"


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    """Raise in the block when it takes too long."""
    limits = ((signal.SIGPROF, signal.ITIMER_PROF, SECONDS), (signal.SIGALRM, signal.ITIMER_REAL, _WAITING))

    def late(*_: Any) -> None:
        raise _TooLongError

    before = [signal.signal(number, late) for number, _, _ in limits]
    for _, timer, seconds in limits:
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for (number, timer, _), handler in zip(limits, before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)
