"""Write the generated pages of the documentation: commands, options, configuration, Python API and changes.

MkDocs calls :func:`on_files` at every build, so these pages always agree with the code and none of them is stored.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[2]
CONF = ROOT / "conf"
PACKAGES = (
    "inference",
    "sample",
    "geometry",
    "degradation",
    "metrics",
    "methods",
    "data",
    "training",
    "evaluation",
    "io",
)
"""Parts of dsr that have a page in the API reference."""

_KEY = re.compile(r"(?P<indent> *)(?P<key>[\w/@.+]+):(?P<value>(?: +[^#\s][^#]*)?)(?:\s*# ?(?P<comment>.*))?$")
_ITEM = re.compile(r" *- (?P<value>[^#]*?)(?:\s*#.*)?$")

_HEAD_COMMANDS = """\
# Command reference

This page is generated from the commands; `dsr COMMAND --help` prints the same text. The settings of `dsr eval`
(`python eval.py`) and `dsr train` (`python train.py`) are in the [configuration reference](configuration.md).
"""
_HEAD_OPTIONS = """\
# Options of dsr upsample

This page is generated from the command; `dsr upsample --help` prints the same, with examples. What is not given is read
from the files or [assumed](../upsample.md#what-is-assumed). The pages of [folders](../upsample.md#a-folder-of-frames),
[holes and noise](../holes.md) and [results](../results.md) explain what the options do.
"""
_HEAD_CONFIGURATION = """\
# Configuration reference

This page is generated from the files in `conf/`. `python eval.py --help` and `python train.py --help` print the
choices and the complete configuration.

- Choose a file of a group with `GROUP=NAME`, for example `method=tgv` or `dataset=icl`.
- Set a single value with `GROUP.KEY=VALUE`, for example `method.data_weight=30`.
- `defaults` lists the files that a file starts from.
- The value `???` has to be given. `null` means "not set"; the comment says what happens then.
- `${oc.env:NAME,VALUE}` reads an environment variable, with a default; `${KEY}` repeats another value.

Every key is checked before anything is computed: an unknown key or a value of the wrong type ends the command with one
line and exit code 2.
"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to those that MkDocs found."""
    from mkdocs.structure.files import File  # noqa: PLC0415 - the tests of the pages run without MkDocs

    for path, content in generated_pages().items():
        files.append(File.generated(config, path, content=content))
    return files


def generated_pages() -> dict[str, str]:
    """Return the Markdown of every generated page by its path in the site."""
    pages = {
        "reference/commands.md": command_reference(command_parser()),
        "reference/upsample.md": option_reference(command_parser(), "dsr upsample"),
        "reference/configuration.md": configuration_reference(CONF),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(),
        "security.md": (ROOT / "SECURITY.md").read_text(),
    }
    pages["api/dsr.md"] = names_of_package()
    return pages | {f"api/{package}.md": f"# dsr.{package}\n\n::: dsr.{package}\n" for package in PACKAGES}


def names_of_package() -> str:
    """Return the reference of the names of ``dsr`` itself, wherever they are."""
    import dsr  # noqa: PLC0415

    shown = "show_root_heading: true, show_root_toc_entry: true, skip_local_inventory: true"
    parts = [
        f"::: {home}.{name}\n    options: {{{shown}, heading: dsr.{name}, toc_label: {name}}}\n"
        for name, home in sorted(dsr._HOMES.items())
    ]
    return "\n".join(["# dsr\n", *parts])


def command_parser() -> argparse.ArgumentParser:
    """Return the parser of the ``dsr`` command."""
    from dsr import cli  # noqa: PLC0415

    return cli.make_parser()


def command_reference(parser: argparse.ArgumentParser) -> str:
    """Return the help of a command and all its subcommands as Markdown, whatever the width of the terminal."""
    sections = []
    for each in all_parsers(parser):
        each.formatter_class = partial(each.formatter_class, width=100)  # type: ignore[assignment]
        sections.append(f"## {each.prog}\n\n```text\n{each.format_help().rstrip()}\n```\n")
    return "\n".join([_HEAD_COMMANDS, *sections])


def option_reference(parser: argparse.ArgumentParser, command: str) -> str:
    """Return the options of a command as Markdown, a table for each group that has any."""
    parser = next(each for each in all_parsers(parser) if each.prog == command)
    shown = argparse.HelpFormatter(command)
    sections = []
    for group in parser._action_groups:
        rows = [
            f"| {_code(shown._format_action_invocation(action))} | {_linked(_escape(action.help or ''))} |"
            for action in group._group_actions
            if action.dest != "help"
        ]
        if rows:
            sections += [f"## {_title(group.title or '')}\n", "| option | what |", "| --- | --- |", *rows, ""]
    for each in parser._mutually_exclusive_groups:
        names = ", ".join(_code(action.option_strings[-1]) for action in each._group_actions)
        sections.append(f"At most one of {names} is given.\n")
    return "\n".join([_HEAD_OPTIONS, *sections])


def _linked(text: str) -> str:
    """Return a text of a command with links in place of the pages that it names."""
    return re.sub(r"docs/(\w+\.md)", r"[\1](../\1)", text)


def _title(text: str) -> str:
    """Return a group's title as a heading: its first letter large, without what is in brackets."""
    return re.sub(r" \(.*", "", text[:1].upper() + text[1:])


def all_parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser, then those of its subcommands, in the order of its help."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                yield from all_parsers(child)


def configuration_reference(conf: Path) -> str:
    """Return the files of a configuration directory as Markdown: the two commands first, then each group."""
    commands = [f"## {name}.py\n\n{_file_text(conf / f'{name}.yaml')}" for name in ("eval", "train")]
    folders = [folder for folder in sorted(conf.iterdir()) if folder.is_dir() and folder.name != "hydra"]
    groups = [_group_section(folder, folder.name) for folder in folders]
    return "\n".join([_HEAD_CONFIGURATION, *commands, *groups])


def _group_section(folder: Path, group: str) -> str:
    """Return a group: a table of its choices, then each file."""
    paths, anchor = sorted(folder.glob("*.yaml")), group.replace("/", "-")
    lines = [f"## {group}\n", "| choice | what |", "| --- | --- |"]
    lines += [f"| [`{path.stem}`](#{anchor}-{path.stem}) | {_escape(_summary(path))} |" for path in paths]
    lines.append("")
    for path in paths:
        lines.append(f"### {group}={path.stem} {{ #{anchor}-{path.stem} }}\n\n{_file_text(path)}")
    return "\n".join(lines)


def _file_text(path: Path) -> str:
    """Return a configuration file: its first comment and a table of its keys, or an experiment as it is."""
    if path.parent.name == "experiment":
        return f"```yaml\n{path.read_text().rstrip()}\n```\n"
    comment, body = _split_comment(path)
    about = "\n".join(comment)
    indented = any(line.startswith(" ") for line in comment)  # commands and tables
    about = f"```text\n{about}\n```" if indented else _escape(about)
    rows = [f"| `{key}` | {_code(value)} | {_escape(meaning)} |" for key, value, meaning in config_keys(body)]
    return "\n".join([about, "", "| key | default | meaning |", "| --- | --- | --- |", *rows, ""])


def config_keys(lines: list[str]) -> Iterator[tuple[str, str, str]]:
    """Yield the dotted keys of a configuration file's lines, with their values and comments; Hydra's own are left out.

    A list on lines of its own is joined into the value of its key, and so is a comment.
    """
    entries: list[tuple[str, str, str]] = []
    above: list[tuple[int, str]] = []
    for line in lines:
        found = _KEY.match(line)
        item = _ITEM.match(line)
        if found:
            indent = len(found["indent"])
            above = [(depth, key) for depth, key in above if depth < indent] + [(indent, found["key"])]
            entries.append((".".join(key for _, key in above), found["value"].strip(), found["comment"] or ""))
        elif item and entries:
            key, value, comment = entries[-1]
            entries[-1] = (key, f"{value}, {item['value']}".removeprefix(", "), comment)
    return (entry for entry in entries if entry[0].partition(".")[0] != "hydra")


def _split_comment(path: Path) -> tuple[list[str], list[str]]:
    """Return the lines of the comment that a file begins with, without the marks, and the lines after it."""
    lines = path.read_text().splitlines()
    count = next((number for number, line in enumerate(lines) if not line.startswith("#")), len(lines))
    comment = [line.removeprefix("#").removeprefix(" ") for line in lines[:count]]
    return [line for line in comment if not line.startswith("@package")], lines[count:]


def _summary(path: Path) -> str:
    """Return what the comment says that a configuration file begins with, up to an experiment's table."""
    comment, _ = _split_comment(path)
    return " ".join(" ".join(comment).partition("Table:")[0].split())


def _escape(text: str) -> str:
    """Return a text whose brackets and bars Markdown shows as they are, outside of code."""
    marks = {"[": "\\[", "<": "&lt;", "|": "\\|"}
    return re.sub(r"(`[^`]*`)|([\[<|])", lambda found: found[1] or marks[found[2]], text)


def _code(text: str) -> str:
    """Return a value as code, nothing for none."""
    return f"`{text}`" if text else ""
