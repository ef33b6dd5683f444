"""A command of ``dsr``: what it is asked, and what answers; that imports what is slow once the options are checked."""

from __future__ import annotations

from argparse import Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable
from typing import Any, NamedTuple

from rich.console import Console

from dsr.utils.options import Options, add_options, build


class Command(NamedTuple):
    """A command.

    Args:
        name: its name.
        about: what it does, in a line.
        record: its options.
        run: answers a record, given the console and the data sets on offer: returns problems, or an exit code.
        epilog: text of its help after the options.
        description: text before them; ``about`` by default.

    """

    name: str
    about: str
    record: type[Options]
    run: Callable[[Any, Console, Any], list[str] | int]
    epilog: str | None = None
    description: str | None = None

    def add(self, commands: Any) -> None:
        """Add the command to those of a parser."""
        parser = _add_parser(commands, self)
        add_options(parser, self.record)

        def run(options: Namespace, *context: Any) -> list[str] | int:
            return self.run(build(self.record, options), *context)

        parser.set_defaults(run=run)


class CommandGroup(NamedTuple):
    """Commands under one name; the arguments are those of :class:`Command`."""

    name: str
    about: str
    commands: tuple[Command, ...]
    epilog: str | None = None
    description: str | None = None

    def add(self, commands: Any) -> None:
        """Add the commands to those of a parser."""
        steps = _add_parser(commands, self).add_subparsers(title="commands", metavar="COMMAND", required=True)
        for each in self.commands:
            each.add(steps)


def _add_parser(commands: Any, command: Command | CommandGroup) -> Any:
    """Return a parser of a command's own, whose texts keep their line breaks."""
    return commands.add_parser(
        command.name,
        help=command.about,
        description=command.description or command.about,
        epilog=command.epilog,
        formatter_class=RawDescriptionHelpFormatter,
    )
