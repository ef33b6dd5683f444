"""Processes to be struck by signals: their sessions, computing time, and what is left of them."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

_POLL = 0.02
_TICK = os.sysconf("SC_CLK_TCK")
_UNREADY = 0.6  # Seconds of computing after which a process counts as ready to be struck even if it catches no SIGTERM


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Args:
        code: its exit code, negative for a signal; None if it had to be killed after the limit.
        out, err: what it wrote.
        wall: seconds from its start.
        computed: seconds of computing of all its processes, to a few hundredths.
        left: processes of its session that were alive after the limit.

    """

    code: int | None
    out: str
    err: str
    wall: float
    computed: float
    left: tuple[int, ...]


class Command:
    """A command in a session of its own, with its output in files.

    Args:
        arguments: of the command.
        folder: its working directory.
        environment: its environment variables.
        logs: folder of the files ``out`` and ``err``.

    """

    def __init__(self, arguments: Sequence[str], folder: Path, environment: Mapping[str, str], logs: Path) -> None:
        self._logs, self._folder, self._computed = logs, folder, 0.0
        self._started, self._clock = time.monotonic(), time.time()
        logs.mkdir(parents=True, exist_ok=True)
        with (logs / "out").open("wb") as output, (logs / "err").open("wb") as errors:
            self._process = subprocess.Popen(
                arguments, cwd=folder, env=dict(environment), stdin=subprocess.DEVNULL, stdout=output, stderr=errors,
                start_new_session=True,
            )  # fmt: skip
        self._pid = self._process.pid

    @property
    def is_at_work(self) -> bool:
        """Whether it has written a line or a file."""
        if (self._logs / "out").stat().st_size:
            return True
        with contextlib.suppress(OSError):  # files come and go
            return any(path.stat().st_mtime > self._clock for path in self._folder.rglob("*"))
        return True

    def is_alive(self) -> bool:
        """Return whether the command's own process has not ended."""
        return self._process.poll() is None

    def wait_until_ready(self) -> float:
        """Wait until the command catches SIGTERM or has computed for a while; return the seconds that it computed."""
        while self.is_alive() and not _catches(self._pid, signal.SIGTERM) and self.computed() < _UNREADY:
            time.sleep(0.002)
        return self.computed()

    def wait_for(self, computed: float, limit: float = 300) -> bool:
        """Wait until the processes have computed for some seconds; return whether the command is alive then."""
        while self.is_alive() and self.computed() < computed:
            if time.monotonic() - self._started > limit:
                return True
            time.sleep(_POLL)
        return self.is_alive()

    def computed(self) -> float:
        """Return the seconds that the session has computed so far."""
        self._computed = max(self._computed, sum(ticks for _, ticks in _session(self._pid)) / _TICK)
        return self._computed

    def send(self, number: signal.Signals, *, group: bool) -> None:
        """Send a signal to the process, or as a terminal does to its group."""
        with contextlib.suppress(ProcessLookupError):
            (os.killpg if group else os.kill)(self._pid, number)

    def end(self, limit: float) -> Ended:
        """Wait for the end; after the limit in seconds kill what is left."""
        asked = time.monotonic()
        while self.is_alive() and time.monotonic() - asked < limit:
            self.computed()
            time.sleep(_POLL)
        code, wall = self._process.poll(), time.monotonic() - self._started
        left = _session(self._pid)
        while left and time.monotonic() - asked < limit:
            time.sleep(_POLL)
            left = _session(self._pid)
        for pid, _ in left:
            os.kill(pid, signal.SIGKILL)
        self._process.wait()
        out, err = ((self._logs / name).read_text(errors="replace") for name in ("out", "err"))
        return Ended(code, out, err, wall, self._computed, tuple(pid for pid, _ in left))


def _catches(pid: int, number: signal.Signals) -> bool:
    """Return whether a process has a handler for a signal."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    mask = next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(mask, 16) >> (number - 1) & 1)


def _session(leader: int) -> list[tuple[int, int]]:
    """Return the processes of a session that live, with the ticks that they and their waited-for children computed."""
    found = []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            fields = (folder / "stat").read_bytes().rpartition(b")")[2].split()
        except OSError:  # ended meanwhile
            continue
        if int(fields[3]) == leader and fields[0] not in (b"Z", b"X"):
            found.append((int(folder.name), sum(map(int, fields[11:15]))))
    return found
