"""The parser of ``dsr`` and of its commands, whose errors suggest the right spelling, and what a shell completes of it.

A shell's script asks ``dsr completion --line LINE`` for the words that may stand at the end of the line.
"""

from __future__ import annotations

import argparse
import contextlib
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from rich.console import Console

from dsr.data.download.collections import CATALOGUE
from dsr.geometry.lights import LIGHT_NAMES
from dsr.utils.configuration import config_directories, list_choices, list_groups
from dsr.utils.console import printable
from dsr.utils.guards import did_you_mean
from dsr.utils.options import Options, one_of, option

SHELLS = {
    "bash": """\
_dsr() { mapfile -t COMPREPLY < <(dsr completion bash --line "${COMP_LINE:0:COMP_POINT}" 2>/dev/null)
[[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace; }
complete -o default -F _dsr dsr""",
    "zsh": """\
#compdef dsr
_dsr() { local -a found
found=(${(f)"$(dsr completion zsh --line "${(j: :)words[1,CURSOR-1]} $PREFIX" 2>/dev/null)"})
(( $#found )) || { _files; return }
compadd -S '' -- ${(M)found:#*=}
compadd -- ${found:#*=} }
compdef _dsr dsr""",
    "fish": """\
complete -c dsr -a '(dsr completion fish --line (commandline -cp | string collect) 2>/dev/null)'""",
}
"""What each shell runs at its start."""
_NAMES: dict[str, Callable[[], Iterable[str]]] = {
    "light": lambda: LIGHT_NAMES,
    "method": lambda: list_choices("method", config_directories()),
    "names": lambda: CATALOGUE,
    "shell": lambda: SHELLS,
}
"""Names that may stand for the value of an option or an argument, by where argparse keeps it."""
_HYDRA_FLAGS = ("--multirun", "--config-dir", "--cfg", "--help", "--info")


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
            self.error(f"unknown option {unknown}{did_you_mean(unknown, self._option_string_actions)}")
        return super().parse_known_args(args, namespace)

    @property
    def commands(self) -> dict[str, Parser]:
        """The commands' parsers by their names; empty for a parser without."""
        found = (each for each in self._actions if isinstance(each, argparse._SubParsersAction))
        return next((dict(each.choices) for each in found), {})

    def _unknown(self, arguments: Sequence[str]) -> Iterator[str]:
        """Yield the long options of a command line that this parser does not have, up to the name of a command."""
        for each in arguments if "-" in self.prefix_chars else ():
            if each == "--" or (self.commands and not each.startswith("-")):
                return
            name = each.partition("=")[0]
            if (
                name.startswith("--")
                and " " not in name
                and not any(flag.startswith(name) for flag in self._option_string_actions)
            ):
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


@dataclass(frozen=True, kw_only=True)
class CompletionRequest(Options):
    """For which shell."""

    shell: str = option(..., ", ".join(SHELLS), "SHELL", flags="shell", rule=one_of(SHELLS))
    line: str | None = option(None, "print what may stand at the end of a line, instead of the script", "LINE")


ABOUT = "what your shell completes after `dsr`"
EPILOG = """\
examples:
  eval "$(dsr completion bash)"         in ~/.bashrc
  source <(dsr completion zsh)          in ~/.zshrc, after compinit
  dsr completion fish | source          in ~/.config/fish/config.fish

It completes commands, options, methods, data sets, and for eval and train the choices of each group.
Hydra's own completion has all keys, in a checkout: eval "$(python train.py -sc install=bash)", then python train.py ...
"""


def complete(parser: Parser, request: CompletionRequest, console: Console) -> list[str]:
    """Print a shell's script, or the words that may stand at the end of a line, one a line."""
    found = [SHELLS[request.shell]]
    if request.line is not None:
        last = _split(request.line)[-1]
        found = [each for each in words_at_end(parser, request.line) if each.startswith(last)]
        if request.shell == "bash" and "=" in last:  # which begins a word of its own there
            found = [each.rpartition("=")[2] for each in found]
    for line in found:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    return []


def words_at_end(parser: Parser, line: str) -> list[str]:
    """Return the completions of a line's last word: commands, options, or values where their names are known."""
    *before, last = _split(line)[1:] or [""]
    for word in before:
        parser = parser.commands.get(word, parser)
    if "-" not in parser.prefix_chars:  # Hydra's
        return _overrides(last)
    options = parser._option_string_actions
    action = options.get(before[-1] if before else "")
    if action is not None and action.nargs != 0:
        return _names_of(action)
    if last.startswith("-"):
        return [*options]
    arguments = [each for each in parser._actions if not each.option_strings]
    return [*parser.commands] or [name for each in arguments for name in _names_of(each)]


def _names_of(action: argparse.Action) -> list[str]:
    """Return the known names that may stand for a value."""
    return [str(name) for name in action.choices or _NAMES.get(action.dest, tuple)()]


def _overrides(last: str) -> list[str]:
    """Return what an argument of Hydra's may become: a group, or a choice of the group that it begins with."""
    directories = config_directories()
    key, equals, _ = last.partition("=")
    if equals:
        return [f"{key}={choice}" for choice in list_choices(key.lstrip("+"), directories)]
    groups = [f"{group}=" for group in list_groups(directories)]
    return [f"+{each}" if each == "experiment=" else each for each in groups] + [*_HYDRA_FLAGS]


def _split(line: str) -> list[str]:
    """Return the words of a line, of which the last one may be empty."""
    words = line.split()
    with contextlib.suppress(ValueError):  # a quote that is not closed yet
        words = shlex.split(line)
    return [*words, ""] if not words or line[-1:].isspace() else words
