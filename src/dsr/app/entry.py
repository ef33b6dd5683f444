"""Run a Hydra command so that every error ends as one line on stderr and exit code 2.

torch and Lightning take seconds to import. A command's module is therefore imported only after its configuration has
been composed and checked, so that a mistyped argument is reported immediately.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.app.experiments import register_resolvers, with_keys_of_swept_groups, without_overridden_sweeps
from dsr.app.schema import EvalConfig, TrainConfig, plain_config, register
from dsr.utils.builder import ConfigError
from dsr.utils.config_files import config_directories, list_choices, list_groups
from dsr.utils.console import INTERRUPTED, USAGE_ERROR, print_error


def run_eval(arguments: Sequence[str] | None = None) -> None:
    """Run ``eval.py``, which is ``dsr eval``, with the given arguments or those of the process."""
    run_command("eval", _evaluate, arguments)


def run_train(arguments: Sequence[str] | None = None) -> None:
    """Run ``train.py``, which is ``dsr train``, with the given arguments or those of the process."""
    run_command("train", _train, arguments)


def _evaluate(config: DictConfig) -> None:
    EvalConfig.of(plain_config(config))
    from dsr.app.evaluate import evaluate  # noqa: PLC0415 - it imports torch

    evaluate(config)


def _train(config: DictConfig) -> None:
    TrainConfig.of(plain_config(config))
    from dsr.app.train import train  # noqa: PLC0415 - it imports torch

    train(config)


def run_command(name: str, command: Callable[[DictConfig], Any], arguments: Sequence[str] | None = None) -> None:
    """Compose a configuration from the command line, and run the command on it.

    Exits with 2 and one line on stderr when the configuration cannot be run, with 130 when interrupted.

    Args:
        name: the configuration's name, without ``.yaml``.
        command: the function to run; a multirun calls it once per combination.
        arguments: command-line arguments, Hydra's options and overrides; None for those of the process.

    """
    register()
    register_resolvers()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra then raises exceptions instead of printing them
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # Hydra would show when it caches fonts
    failures: list[str] = []
    try:
        directories = config_directories(_config_dirs(arguments))
    except ValueError as error:
        fail(str(error))
    _expect_choices(name, arguments, directories)
    arguments = with_keys_of_swept_groups(without_overridden_sweeps(arguments, directories), directories)
    process = sys.argv

    def job(config: DictConfig) -> None:
        try:
            with _argv(process):  # Lightning starts the processes of further devices from it
                command(config)
        except ConfigError as error:  # a multirun continues with its other jobs
            failures.append(str(error))
            print_error(str(error))

    try:
        with _argv([process[0], *arguments]):  # parsed by Hydra
            hydra.main(version_base="1.3", config_path=str(directories[0]), config_name=name)(job)()
    except KeyboardInterrupt as interruption:
        message = str(interruption) or "interrupted; what is finished is kept, the same command goes on from there"
        print(message, file=sys.stderr)  # noqa: T201
        sys.exit(INTERRUPTED)
    except (HydraException, OmegaConfBaseException) as error:
        fail(explain(error, name, arguments, directories))
    if failures:
        sys.exit(USAGE_ERROR)


def compose(name: str, overrides: Sequence[str], directories: Sequence[Path]) -> DictConfig:
    """Compose a configuration outside of a command.

    Args:
        name: without ``.yaml``.
        overrides: as on the command line.
        directories: those of :func:`dsr.utils.config_files.config_directories`.

    """
    register()
    register_resolvers()
    places = ",".join(f'"file://{directory.resolve()}"' for directory in directories[1:])
    more = [f"hydra.searchpath=[{places}]"] if places else []
    with hydra.initialize_config_dir(str(directories[0]), version_base="1.3"):
        return hydra.compose(name, [*overrides, *more])


def fail(message: str) -> NoReturn:
    """Print one line on stderr and exit with 2."""
    print_error(message)
    sys.exit(USAGE_ERROR)


def explain(error: Exception, name: str, arguments: Sequence[str], directories: Sequence[Path]) -> str:
    """Explain an error of a configuration in one line, with the choices if a name is mistyped.

    Args:
        error: the exception of Hydra or OmegaConf.
        name: the configuration's name.
        arguments: the arguments that it was composed from.
        directories: directories of configuration files.

    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None:
        return _explain_missing(str(error.missing_cfg_file), name, directories)
    if isinstance(error, OverrideParseException):
        return _explain_syntax(error.override)
    text = " ".join(str(error).split())
    several = re.match(r"Ambiguous value for argument '([^=]+)=(.*?)' 1\.", text)
    if several:
        key, values = several.groups()
        return (
            f"{key}: got several values; -m runs each of them, {key}=[{values}] is a list, '{key}=\"{values}\"' a text"
        )
    return _explain_value(error, text, name, arguments, directories)


def _explain_value(
    error: Exception, text: str, name: str, arguments: Sequence[str], directories: Sequence[Path]
) -> str:
    """Explain which key of an override is unknown or has an invalid value."""
    cause = error.__cause__
    key = re.search(r"Could not override '([^']+)'", text)
    if key:
        if cause is not None and "not in struct" not in str(cause) and "not in '" not in str(cause):
            return f"{key[1]}: {_first_line(cause)}"
        return _explain_key(key[1], name, arguments, directories)
    value = re.match(r"Error merging override (\S+?)=", text)
    return f"{value[1]}: {_first_line(cause)}" if value and cause is not None else text


def _explain_key(key: str, name: str, arguments: Sequence[str], directories: Sequence[Path]) -> str:
    """Explain which keys exist instead of an unknown one."""
    if key == "experiment":
        return f"experiment: write +experiment=NAME, NAME one of {', '.join(list_choices(key, directories))}"
    prefix = key.rpartition(".")[0]
    node = _node_of(key, name, arguments, directories)
    siblings = [f"{prefix}.{child!s}" if prefix else str(child) for child in node if child != "target"]
    return f"{key}: unknown key; expected {', '.join(siblings)}"


def _explain_missing(file: str, name: str, directories: Sequence[Path]) -> str:
    """Explain which files exist instead of a missing configuration file."""
    group, _, choice = file.rpartition("/")
    if not group:
        return f"--config-name {choice}: unknown; expected {name}"
    choices = list_choices(group, directories)
    if choices:
        return f"{group}={choice}: unknown; expected one of {', '.join(choices)}"
    return f"{group}: no such group of choices; expected one of {', '.join(list_groups(directories))}"


def _explain_syntax(override: str) -> str:
    """Explain how to write an argument that Hydra cannot parse."""
    key, equals, value = override.partition("=")
    if not equals:
        return f"{override}: expected KEY=VALUE"
    quoted = re.sub(r"[^\[\],{}:]+", r'"\g<0>"', value) if value.startswith("[") else f'"{value}"'
    return f"{key}: cannot read the value {value}; special characters need quotes within quotes: '{key}={quoted}'"


def _expect_choices(name: str, arguments: Sequence[str], directories: Sequence[Path]) -> None:
    """Exit if the command line names a choice that does not exist, or removes a required one."""
    if any(argument.startswith("hydra.searchpath=") for argument in arguments):
        return  # other directories may have further choices
    defaults = OmegaConf.load(directories[0] / f"{name}.yaml").defaults
    groups = {str(key) for entry in defaults if isinstance(entry, DictConfig) for key in entry} | {"+experiment"}
    for argument in arguments:
        group, equals, choice = argument.partition("=")
        if equals and group in groups:
            _expect_choice(argument, group.lstrip("+"), choice, directories)


def _expect_choice(argument: str, group: str, choice: str, directories: Sequence[Path]) -> None:
    """Exit if ``choice``, or one of several separated by commas, is not a file of the group."""
    choices = list_choices(group, directories)
    if choice in ("", "null"):
        fail(f"{argument}: expected one of {', '.join(choices)}")
    for each in choice.split(","):
        if re.fullmatch(r"[\w-]+", each) and each not in choices:
            fail(f"{group}={each}: unknown; expected one of {', '.join(choices)}")


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _node_of(key: str, name: str, arguments: Sequence[str], directories: Sequence[Path]) -> DictConfig:
    """Return the node in which ``key`` was looked for, or the innermost one above it."""
    choice = re.compile(rf"({'|'.join(list_groups(directories))})=[\w-]+")
    overrides = [argument for argument in arguments if choice.fullmatch(argument)]
    try:
        node = compose(name, overrides, directories)
    except HydraException:  # one of these choices is invalid
        node = compose(name, [], directories)
    for part in key.split(".")[:-1]:
        child = OmegaConf.select(node, part)
        if not isinstance(child, DictConfig):
            break
        node = child
    return node


def _config_dirs(arguments: Sequence[str]) -> list[Path]:
    """Return the user's directory of configuration files, which Hydra's option names."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--config-dir", "-cd", type=Path, nargs="?")
    given = parser.parse_known_args(arguments)[0].config_dir
    return [] if given is None else [given]


@contextlib.contextmanager
def _argv(arguments: list[str]) -> Iterator[None]:
    """Replace ``sys.argv`` within the context."""
    before, sys.argv = sys.argv, arguments
    try:
        yield
    finally:
        sys.argv = before
