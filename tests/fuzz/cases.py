"""Cases: a number and a seed are a reader, its files with something changed, and how reading them ends."""

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from random import Random

from fuzz.judging import Outcome, judge
from fuzz.mutations import mutate
from fuzz.place import Place
from fuzz.readers import READERS, Reader, reader_of


@dataclass(frozen=True)
class Case:
    """What happened in a case.

    Args:
        seed, number: what it is made from.
        reader: name of the reader.
        changes: what was changed in its files.
        outcome: how it ended.

    """

    seed: int
    number: int
    reader: str
    changes: tuple[str, ...]
    outcome: Outcome

    def __str__(self) -> str:
        what = ", ".join(self.changes)
        return (
            f"{self.reader}: {self.outcome.text}\n    of {what or 'valid files'}\n"
            f'    again: make fuzz ARGS="--seed {self.seed} --case {self.number} --keep DIR"'
        )


class Cases:
    """Makes and runs cases in a folder of its own.

    Args:
        seed: decides about all cases, together with their numbers.
        above: folder above its own; None for that of temporary files.

    """

    def __init__(self, seed: int, above: Path | None = None) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="dsr-fuzz-", dir=above))
        self._seed = seed
        os.environ["DSR_CACHE"] = str(self.folder / "cache")
        (self.folder / "etc").mkdir()
        (self.folder / "etc" / "passwd").touch()  # ../../etc/passwd from the folder of a case's files

    def run(self, number: int, keep: Path | None = None) -> Case:
        """Run a case, in the working directory, which should be an empty one.

        Args:
            number: its number.
            keep: a folder for its files; None to delete them.

        """
        reader, random = reader_of(number), Random(f"{self._seed}-{number}")
        place = Place(self.folder / f"case{number}")
        shutil.copytree(self._seeds(reader), place.input)
        place.out.mkdir()
        changes = mutate(random, place, lambda: self._other(random))
        if keep is not None:
            shutil.copytree(place.input, keep, symlinks=True, copy_function=_copy)
        cache = os.environ["DSR_CACHE"]
        try:
            outcome = judge(reader.read, place, reader.refusals)
        finally:
            os.environ["DSR_CACHE"] = cache
            for folder in (place.root, place.canary):
                shutil.rmtree(folder, ignore_errors=True)
        return Case(self._seed, number, reader.name, tuple(changes), outcome)

    def close(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _seeds(self, reader: Reader) -> Path:
        """Return the folder of a reader's valid files, which is made once."""
        folder = self.folder / "seeds" / f"{READERS.index(reader)}"
        if not folder.is_dir():
            folder.mkdir(parents=True)
            reader.make(folder)
            _warm_up(reader, Place(self.folder), folder)
        return folder

    def _other(self, random: Random) -> bytes:
        """Return the content of a file of any reader that is cheap to make."""
        folder = self._seeds(random.choice([each for each in READERS if each.weight > 1]))
        return random.choice(sorted(path for path in folder.rglob("*") if path.is_file())).read_bytes()


def _copy(source: str, target: str) -> str:
    """Copy a file that is one; named pipes are left out."""
    return shutil.copy2(source, target) if Path(source).is_file() else target


def _warm_up(reader: Reader, place: Place, folder: Path) -> None:
    """Import what a reader needs before anything is measured, by reading valid files once."""
    first = Place(Path(tempfile.mkdtemp(prefix="first-", dir=place.root)))
    shutil.copytree(folder, first.input)
    first.out.mkdir()
    judge(reader.read, first, reader.refusals)
    shutil.rmtree(first.root, ignore_errors=True)
