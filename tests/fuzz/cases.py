"""Cases: a number and a seed are a reader, its files with something changed, and how reading them ends."""

import os
import shutil
import signal
import tempfile
from dataclasses import dataclass
from pathlib import Path
from random import Random

import torch

from fuzz.commands import COMMANDS
from fuzz.judging import Outcome, Place, judge
from fuzz.mutations import mutate
from fuzz.readers import OF_CAPTURES, OF_FILES, OF_SETS, Reader

READERS = (*OF_CAPTURES, *OF_SETS, *OF_FILES, *COMMANDS)
# The readers of consecutive cases.
ROUND = tuple(reader for turn in range(6) for reader in READERS if reader.weight > turn)


@dataclass(frozen=True)
class Case:
    """What happened in a case: the changes of its files, and how reading them ended."""

    seed: int
    number: int
    changes: tuple[str, ...]
    outcome: Outcome

    @property
    def reader(self) -> Reader:
        """The reader of the case."""
        return ROUND[self.number % len(ROUND)]

    def __str__(self) -> str:
        return (
            f"{self.reader.name}: {self.outcome.text}\n    of {', '.join(self.changes) or 'valid files'}\n"
            f'    again: make fuzz ARGS="--seed {self.seed} --case {self.number} --keep DIR"'
        )


class Cases:
    """Makes and runs cases in a folder of its own, below ``above`` or among temporary files."""

    def __init__(self, seed: int, above: Path | None = None) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="dsr-fuzz-", dir=above))
        self._seed = seed
        self.of_valid_files: dict[str, Outcome] = {}  # by reader
        os.environ["DSR_CACHE"] = str(self.folder / "cache")
        (self.folder / "etc").mkdir()
        (self.folder / "etc" / "passwd").touch()  # ../../etc/passwd from the folder of a case's files

    def run(self, number: int, keep: Path | None = None) -> Case:
        """Run a case in the working directory, which should be an empty one; ``keep`` is a new folder for its files."""
        reader, random = ROUND[number % len(ROUND)], Random(f"{self._seed}-{number}")
        place = self._place(f"case{number}", self._seeds(reader))
        changes = mutate(random, place, lambda: self._other(random))
        if keep is not None:  # named pipes are left out
            copy = lambda source, target: shutil.copy2(source, target) if Path(source).is_file() else target  # noqa: E731
            shutil.copytree(place.input, keep, symlinks=True, copy_function=copy)
        try:
            outcome = judge(reader.read, place)
        finally:
            for folder in (place.root, place.canary):
                shutil.rmtree(folder, ignore_errors=True)
        return Case(self._seed, number, tuple(changes), outcome)

    def _place(self, name: str, seeds: Path) -> Place:
        place = Place(self.folder / name)
        shutil.copytree(seeds, place.input)
        place.out.mkdir()
        return place

    def _seeds(self, reader: Reader) -> Path:
        """Return the folder of a reader's valid files, which is made and read once: readers import when they read."""
        folder = self.folder / "seeds" / f"{READERS.index(reader)}"
        if not folder.is_dir():
            folder.mkdir(parents=True)
            reader.make(folder)
            place = self._place("first", folder)
            self.of_valid_files[reader.name] = judge(reader.read, place)
            shutil.rmtree(place.root)
        return folder

    def _other(self, random: Random) -> bytes:
        """Return the content of a file of any reader that is cheap to make."""
        folder = self._seeds(random.choice([each for each in READERS if each.weight > 1]))
        return random.choice(sorted(path for path in folder.rglob("*") if path.is_file())).read_bytes()


def begin(seed: int, work: Path) -> None:
    """Prepare a worker process."""
    global _cases  # noqa: PLW0603 - of this process
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)
    _cases = Cases(seed, work)
    os.chdir(_cases.folder)


def run(number: int, keep: Path | None) -> Case:
    """Run a case in a worker process that has begun."""
    return _cases.run(number, keep)


_cases: Cases
