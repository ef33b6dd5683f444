"""Runs scenarios in one folder, so that paths in their results are the same, and compares with undisturbed ones."""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from chaos.results import damaged, differences
from chaos.scenarios import ALL

REPOSITORY = Path(__file__).resolve().parents[2]
CODES = {signal.SIGKILL: (-9,), signal.SIGINT: (130, -2), signal.SIGTERM: (143, 130, -2)}  # Python may end by SIGINT
COMPLETE = "is trained already"  # The one command that refuses what is done
KEPT = ("cache/**/*.npz", "**/predictions/*.npz", "out/*/info.json")  # Files that are never made again
LIMIT = 300.0  # Seconds that an undisturbed command may take


class Ended(NamedTuple):
    """How a command ended: its exit code, None if it had to be killed, its output, and the seconds that it took."""

    code: int | None
    out: str
    err: str
    seconds: float
    left: int = 0  # Processes of its session that were alive after the limit


class Strike(NamedTuple):
    """A signal at a fraction of the undisturbed command's time; to its process, or as from a terminal to the group."""

    number: signal.Signals
    moment: float
    group: bool


class Command:
    """A command in a session of its own."""

    def __init__(self, arguments: tuple[str, ...], folder: Path) -> None:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("DSR_", "HYDRA_", "PL_"))}
        path = os.pathsep.join(filter(None, (str(REPOSITORY / "src"), kept.get("PYTHONPATH"))))
        program, *rest = arguments
        if program == "dsr":
            rest = ["-m", "dsr", *rest]
        elif program in ("eval.py", "train.py"):
            rest = [str(REPOSITORY / program), *rest]
        self.started = time.monotonic()
        self.process = subprocess.Popen(
            [sys.executable, *rest], cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, start_new_session=True,
            env={**kept, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "DSR_CACHE": "cache", "GIT_OPTIONAL_LOCKS": "0"},
        )  # fmt: skip

    def strike(self, strike: Strike, seconds: float) -> bool:
        """Send a signal at its moment, once the command catches SIGTERM; return whether it lived then."""
        status = Path(f"/proc/{self.process.pid}/status")
        while self.process.poll() is None:
            caught = next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("SigCgt"))
            ready = strike.number == signal.SIGKILL or int(caught, 16) >> (signal.SIGTERM - 1) & 1
            if ready and time.monotonic() - self.started >= strike.moment * seconds:
                (os.killpg if strike.group else os.kill)(self.process.pid, strike.number)
                return True
            time.sleep(0.01)
        return False

    def end(self, limit: float) -> Ended:
        """Wait for the end of all its processes; after the limit in seconds kill what is left."""
        asked = time.monotonic()
        while ((left := self._alive()) or self.process.poll() is None) and time.monotonic() - asked < limit:
            time.sleep(0.02)
        code, seconds = self.process.poll(), time.monotonic() - self.started
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        out, err = self.process.communicate()
        return Ended(code, out, err, seconds, len(left))

    def _alive(self) -> list[int]:
        """Return the processes of the session that live."""
        found = []
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):  # ended meanwhile
                state, _, _, session = stat.read_text().rpartition(")")[2].split()[:4]
                if int(session) == self.process.pid and state not in "ZX":
                    found.append(int(stat.parent.name))
        return found


@dataclass
class Campaign:
    """Runs scenarios below a folder; a struck command has ``grace`` seconds to end."""

    root: Path
    grace: float = 5.0
    _seconds: dict[str, float] = field(default_factory=dict)

    @property
    def work(self) -> Path:
        """The folder in which all commands run."""
        return self.root / "work"

    def begin(self, name: str) -> None:
        """Empty the folder of work, and put there what a scenario starts from."""
        shutil.rmtree(self.work, ignore_errors=True)
        self.work.mkdir(parents=True)
        for path, origin in ALL[name].needs.items():
            (self.work / path).parent.mkdir(parents=True, exist_ok=True)
            if callable(origin):
                origin(self.work / path)
            else:
                shutil.copytree(self.root / "undisturbed" / origin[0] / origin[1], self.work / path)

    def undisturbed(self, name: str) -> float:
        """Run a scenario without disturbance, the first time; return the seconds of its first command."""
        if name not in self._seconds:
            for origin in ALL[name].needs.values():
                if not callable(origin):
                    self.undisturbed(origin[0])
            self.begin(name)
            ends = [Command(each, self.work).end(LIMIT) for each in ALL[name].commands]
            if problems := [line for end in ends for line in end_problems(end)]:
                raise RuntimeError(f"{name}: undisturbed: {'; '.join(problems)}")
            shutil.copytree(self.work, self.root / "undisturbed" / name)
            self._seconds[name] = ends[0].seconds
        return self._seconds[name]

    def kill(self, name: str, strikes: list[Strike]) -> tuple[int, list[str]]:
        """Strike a command, again when it goes on, and at last let it end; return the hits, and what was wrong."""
        seconds, hits = self.undisturbed(name), 0
        self.begin(name)
        stamps: dict[Path, tuple[int, int]] = {}
        for strike in strikes:
            command = Command(ALL[name].commands[0], self.work)
            hit = command.strike(strike, seconds)
            problems = end_problems(command.end(self.grace), strike if hit else None) + damaged(self.work)
            if problems:
                return hits + hit, [f"{strike}: {line}" for line in problems]
            hits += hit
            stamps |= _stamps(self.work)
        return hits, self._finish(name, stamps)

    def pair(self, name: str, delay: float) -> list[str]:
        """Run two commands at once, the second after a fraction of the first one's time; return what is wrong."""
        rivals = ALL[name].rivals
        seconds = [self.undisturbed(each) for each in rivals or (name,)]
        commands = [ALL[each].commands[0] for each in rivals] or ALL[name].commands
        self.begin(name)
        first = Command(commands[0], self.work)
        time.sleep(delay * seconds[0])
        running = [first, Command(commands[1], self.work)]
        ends = [command.end(LIMIT) for command in running]
        problems = [line for end in ends if not _refused(end) for line in end_problems(end)] + damaged(self.work)
        if not rivals:
            return problems + self._finish(name, {})
        codes = [end.code for end in ends]
        if sorted(codes, key=str) != [0, 2]:
            return [*problems, f"exit codes {codes}, expected that one is refused"]
        return problems + differences(self.root / "undisturbed" / rivals[codes.index(0)], self.work)

    def _finish(self, name: str, stamps: dict[Path, tuple[int, int]]) -> list[str]:
        """Run the commands to their ends; return what differs from undisturbed results, and what was made again."""
        ends = [Command(each, self.work).end(LIMIT) for each in ALL[name].commands]
        after = _stamps(self.work)
        return [
            *(line for end in ends for line in end_problems(end)),
            *(f"{path.name}: was complete, and was made again" for path in stamps if after.get(path) != stamps[path]),
            *damaged(self.work),
            *differences(self.root / "undisturbed" / name, self.work),
        ]


def draw_strikes(draw: random.Random) -> list[Strike]:
    """Return one to three strikes at random moments; a fifth come early, while modules are imported."""
    return [
        Strike(
            draw.choice(list(CODES)),
            draw.uniform(0, 0.35) if draw.random() < 1 / 5 else draw.random(),
            draw.random() < 1 / 2,
        )
        for _ in range(draw.choice((1, 2, 2, 3)))
    ]


def end_problems(end: Ended, strike: Strike | None = None) -> list[str]:
    """Return what is wrong with the end of a command, struck or not."""
    lines = end.err.splitlines()
    problems = ["a traceback"] if "Traceback" in end.err + end.out else []
    problems += [f"{end.left} processes alive after the limit"] if end.left else []
    done = end.code == 2 and len(lines) == 1 and COMPLETE in end.err
    if done or (end.code == 0 and not lines):
        return problems
    if strike is None or end.code not in CODES[strike.number]:
        return [*problems, f"exit code {end.code}: {' | '.join(lines[-4:])}"]
    if strike.number != signal.SIGKILL and len(lines) != 1:
        problems.append(f"{len(lines)} lines on stderr, expected one: {' | '.join(lines[-4:])}")
    return problems


def _refused(end: Ended) -> bool:
    """Return whether a command was refused in one line, as another one is at work or has other settings."""
    return end.code == 2 and len(end.err.splitlines()) == 1 and end.err.startswith("error: ") and not end.left


def _stamps(work: Path) -> dict[Path, tuple[int, int]]:
    """Return the files that are never made again, ``info.json`` once it is complete, with their numbers and times."""
    paths = {path for pattern in KEPT for path in work.glob(pattern) if not path.name.startswith(".")}
    whole = [path for path in paths if path.suffix != ".json" or json.loads(path.read_text()).get("complete")]
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in whole}
