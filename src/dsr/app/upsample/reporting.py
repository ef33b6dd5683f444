"""Report the notes and problems of ``dsr upsample``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from rich.console import Console

from dsr.notes import Assumption
from dsr.utils.console import show

_SHOWN = 5
"""Number of names that a line lists; further ones are only counted."""


class Record:
    """Keeps lines and notes for a :class:`Reporter` in another process."""

    def __init__(self) -> None:
        self._said: list[str | Sequence[Assumption]] = []

    def say(self, line: str) -> None:
        """Keep a line."""
        self._said.append(line)

    def facts(self, facts: Sequence[Assumption]) -> None:
        """Keep notes."""
        self._said.append(tuple(facts))

    def replay(self, reporter: Messages) -> None:
        """Report the kept lines, in their order."""
        for each in self._said:
            if isinstance(each, str):
                reporter.say(each)
            else:
                reporter.facts(each)


class Reporter:
    """Shows every note once, and counts the pictures that it applies to."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._counts: Counter[str] = Counter()
        self._warned: dict[str, Assumption] = {}

    def say(self, line: str) -> None:
        """Show a line."""
        show(self._console, line)

    def facts(self, facts: Sequence[Assumption]) -> None:
        """Show the notes that no earlier picture had."""
        for fact in facts:
            if not self._counts[fact.statement]:
                self.say(f"  {fact}")
            self._counts[fact.statement] += 1
            if fact.code:
                self._warned.setdefault(fact.statement, fact)

    @property
    def warnings(self) -> list[dict[str, Any]]:
        """The warnings as values for JSON, each once, as of the first of so many ``pictures``."""
        return [{**fact.record(), "pictures": self._counts[text]} for text, fact in self._warned.items()]

    def summary(self, pictures: int) -> None:
        """Show the notes that apply to some of the pictures only."""
        for text, count in self._counts.items():
            if count < pictures:
                self.say(f"  {count} of {pictures} pictures: {text}")


Messages = Reporter | Record  # takes lines and notes


def listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
