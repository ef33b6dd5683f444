"""Where a case of the fuzzer happens: the folder of its files, and what must not be touched."""

from dataclasses import dataclass
from pathlib import Path

MARK = "dsr_fuzz_canary"  # A word in everything that a file could execute


@dataclass(frozen=True)
class Place:
    """The folders of a case.

    Args:
        root: the folder of the case alone.

    """

    root: Path

    @property
    def input(self) -> Path:
        """The folder of the files that are read."""
        return self.root / "input"

    @property
    def out(self) -> Path:
        """The folder that a command may write to."""
        return self.root / "out"

    @property
    def canary(self) -> Path:
        """A folder that only code from a file makes, in the working directory.

        It is relative, so that files that name it are the same wherever a case runs.
        """
        return Path(MARK)

    def strangers(self) -> list[str]:
        """Return the names of what lies in the folder without being input or output, and of the canary."""
        found = sorted(path.name for path in self.root.iterdir() if path.name not in ("input", "out"))
        return [*found, MARK] if self.canary.exists() else found
