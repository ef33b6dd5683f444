"""``dsr completion``: what a shell completes of the command, its options, and values whose names are known.

A shell's script asks ``dsr completion --line LINE`` for the words that may stand at the end of the line.
"""

import contextlib
import shlex
from collections.abc import Callable, Iterable

from rich.console import Console

from dsr.app.requests import SHELLS, CompletionRequest
from dsr.cli import Parser, make_parser
from dsr.data.download import CATALOGUE
from dsr.geometry.lights import LIGHT_NAMES
from dsr.utils.configuration import config_directories, list_choices

_SCRIPTS = {
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


def complete(request: CompletionRequest, console: Console) -> list[str]:
    """Print a shell's script, or the words that may stand at the end of a line, one a line."""
    found = [_SCRIPTS[request.shell]]
    if request.line is not None:
        last = _split(request.line)[-1]
        found = [each for each in words_at_end(make_parser(), request.line) if each.startswith(last)]
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
        directories = config_directories()
        key, equals, _ = last.partition("=")
        if equals:  # a choice of a group
            return [f"{key}={choice}" for choice in list_choices(key.lstrip("+"), directories)]
        groups = sorted(path.name for path in directories[0].iterdir() if path.is_dir())
        return [f"+{each}=" if each == "experiment" else f"{each}=" for each in groups] + [*_HYDRA_FLAGS]
    options = parser._option_string_actions
    action = options.get(before[-1] if before else "")
    if action is not None and action.nargs != 0:
        expected = [action]
    elif last.startswith("-") or parser.commands:
        return [*options] if last.startswith("-") else [*parser.commands]
    else:
        expected = [each for each in parser._actions if not each.option_strings]
    return [str(name) for each in expected for name in each.choices or _NAMES.get(each.dest, tuple)()]


def _split(line: str) -> list[str]:
    words = line.split()
    with contextlib.suppress(ValueError):  # a quote that is not closed yet
        words = shlex.split(line)
    return [*words, ""] if not words or line[-1:].isspace() else words
