"""The parser of ``dsr`` and of its commands, whose errors suggest the right spelling."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from dsr.utils.console import printable
from dsr.utils.guards import did_you_mean


class Parser(argparse.ArgumentParser):
    """A parser, and those of its commands, that refuses an empty text as a path: it would be the current directory."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.register("type", Path, _path)

    def error(self, message: str) -> NoReturn:
        """Exit with the usage and the error, which repeats arguments, without an address's password."""
        super().error(printable(message))

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an unknown option is reported before what is missing, which it may stand for."""
        for unknown in self._unknown(sys.argv[1:] if args is None else args):
            self.error(f"unknown option {unknown}{did_you_mean(unknown, self.options)}")
        return super().parse_known_args(args, namespace)

    @property
    def commands(self) -> dict[str, Parser]:
        """The commands' parsers by their names; empty for a parser without."""
        found = (each for each in self._actions if isinstance(each, argparse._SubParsersAction))
        return next((dict(each.choices) for each in found), {})

    @property
    def options(self) -> dict[str, argparse.Action]:
        """The options by their flags."""
        return dict(self._option_string_actions)

    @property
    def arguments(self) -> list[argparse.Action]:
        """The arguments by place."""
        return [each for each in self._actions if not each.option_strings]

    def _unknown(self, arguments: Sequence[str]) -> Iterator[str]:
        """Yield the long options of a command line that this parser does not have, up to the name of a command."""
        for each in arguments if "-" in self.prefix_chars else ():
            if each == "--" or (self.commands and not each.startswith("-")):
                return
            name = each.partition("=")[0]
            if name.startswith("--") and " " not in name and not any(flag.startswith(name) for flag in self.options):
                yield name

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is not one of an action's choices."""
        if action.choices is not None and value not in action.choices:
            choices = [str(each) for each in action.choices]
            meant = did_you_mean(value, choices)
            raise argparse.ArgumentError(action, f"expected one of {', '.join(choices)}, got {value!r}{meant}")


def _path(text: str) -> Path:
    """Return the path that an argument names."""
    if not text.strip():
        raise argparse.ArgumentTypeError("expected a path, got an empty text")
    return Path(text)
