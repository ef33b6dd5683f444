"""Cases: a seed, a reader and a number are files with something changed, and how reading them ends."""

import os
import shutil
from pathlib import Path
from random import Random

from fuzz.commands import COMMANDS
from fuzz.judging import Outcome, Place, judge
from fuzz.mutations import mutate
from fuzz.readers import OF_CAPTURES, OF_FILES, OF_SETS, Reader

READERS = (*OF_CAPTURES, *OF_SETS, *OF_FILES, *COMMANDS)


class Cases:
    """Makes and runs cases in a folder of its own, which should be the working directory and a new one."""

    def __init__(self, seed: int, folder: Path) -> None:
        self._seed, self._folder = seed, folder
        self.of_valid_files: dict[str, Outcome] = {}  # by reader
        os.environ["DSR_CACHE"] = str(folder / "cache")
        (folder / "etc").mkdir()
        (folder / "etc" / "passwd").touch()  # ../../etc/passwd from the folder of a case's files

    def run(self, reader: Reader, number: int, keep: Path | None = None) -> str:
        """Return what is unclean in a case, empty if nothing; ``keep`` is a new folder for its files then."""
        random = Random(f"{self._seed}-{reader.name}-{number}")
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
        if outcome.kind == "unclean":
            return f"case {number} of {reader.name}, {', '.join(changes) or 'valid files'}: {outcome.text}"
        if keep is not None:
            shutil.rmtree(keep)
        return ""

    def _place(self, name: str, seeds: Path) -> Place:
        place = Place(self._folder / name)
        shutil.copytree(seeds, place.input)
        place.out.mkdir()
        return place

    def _seeds(self, reader: Reader) -> Path:
        """Return the folder of a reader's valid files, which is made and read once: readers import when they read."""
        folder = self._folder / "seeds" / f"{READERS.index(reader)}"
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
