"""Running a Hydra command so that whatever is wrong ends as one line on stderr and exit code 2."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.app.schema import register
from dsr.utils.builder import ConfigError
from dsr.utils.console import INTERRUPTED, USAGE_ERROR, print_error


def run_command(conf: Path, name: str, command: Callable[[DictConfig], Any]) -> None:
    """Compose the configuration ``name`` of the directory ``conf`` from the command line, and run the command on it.

    Exits with 2 and one line on stderr when the configuration cannot be run, with 130 when interrupted.

    Args:
        conf: Hydra's configuration directory.
        name: without ``.yaml``.
        command: what to run; a multirun calls it once per combination.

    """
    register()
    if not conf.is_dir():
        fail(f"{conf}: expected the directory of the configuration files; run the command in a checkout of the project")
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # exceptions arrive here instead of being printed by Hydra
    failures: list[str] = []
    _expect_choices(conf)

    def job(config: DictConfig) -> None:
        try:
            command(config)
        except ConfigError as error:  # a multirun goes on with its other jobs
            failures.append(str(error))
            print_error(str(error))

    try:
        hydra.main(version_base="1.3", config_path=str(conf.resolve()), config_name=name)(job)()
    except KeyboardInterrupt as interruption:
        message = str(interruption) or "interrupted; what is finished is kept, the same command goes on from there"
        print(message, file=sys.stderr)  # noqa: T201
        sys.exit(INTERRUPTED)
    except (HydraException, OmegaConfBaseException) as error:
        fail(explain(error, conf, name))
    if failures:
        sys.exit(USAGE_ERROR)


def fail(message: str) -> None:
    """Print one line on stderr and exit with 2."""
    print_error(message)
    sys.exit(USAGE_ERROR)


def explain(error: Exception, conf: Path, name: str, arguments: Sequence[str] | None = None) -> str:
    """Return what is wrong with a configuration, on one line, with the choices where a name is mistyped.

    Args:
        error: Hydra's or OmegaConf's.
        conf: Hydra's configuration directory.
        name: of the configuration.
        arguments: that it was composed from; None for the command line's.

    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None:
        return _explain_missing(str(error.missing_cfg_file), conf, name)
    if isinstance(error, OverrideParseException):
        return _explain_syntax(error.override)
    text = " ".join(str(error).split())
    several = re.match(r"Ambiguous value for argument '([^=]+)=(.*?)' 1\.", text)
    if several:
        key, values = several.groups()
        return (
            f"{key}: got several values; -m runs each of them, {key}=[{values}] is a list, '{key}=\"{values}\"' a text"
        )
    return _explain_value(error, text, conf, name, sys.argv[1:] if arguments is None else arguments)


def _explain_value(error: Exception, text: str, conf: Path, name: str, arguments: Sequence[str]) -> str:
    """Return which key of an override is unknown, or does not take its value."""
    cause = error.__cause__
    key = re.search(r"Could not override '([^']+)'", text)
    if key:
        if cause is not None and "not in struct" not in str(cause) and "not in '" not in str(cause):
            return f"{key[1]}: {_first_line(cause)}"
        return f"{key[1]}: unknown key; expected {', '.join(_siblings(key[1], conf, name, arguments))}"
    value = re.match(r"Error merging override (\S+?)=", text)
    return f"{value[1]}: {_first_line(cause)}" if value and cause is not None else text


def _explain_missing(file: str, conf: Path, name: str) -> str:
    """Return what there is instead of a configuration file that is not there."""
    group, _, choice = file.rpartition("/")
    if not group:
        return f"--config-name {choice}: unknown; expected {name}"
    files = sorted(path.stem for path in (conf / group).glob("*.yaml"))
    if files:
        return f"{group}={choice}: unknown; expected one of {', '.join(files)}"
    return f"{group}: no such group of choices; expected one of {', '.join(sorted(_groups(conf)))}"


def _explain_syntax(override: str) -> str:
    """Return how to write an argument that Hydra cannot read."""
    key, equals, value = override.partition("=")
    if not equals:
        return f"{override}: expected KEY=VALUE"
    quoted = re.sub(r"[^\[\],{}:]+", r'"\g<0>"', value) if value.startswith("[") else f'"{value}"'
    return f"{key}: cannot read the value {value}; special characters need quotes within quotes: '{key}={quoted}'"


def _expect_choices(conf: Path) -> None:
    """Exit where the command line takes away a choice that must be made."""
    for argument in sys.argv[1:]:
        group, equals, choice = argument.partition("=")
        if equals and choice in ("", "null") and group in _groups(conf):
            choices = ", ".join(sorted(path.stem for path in (conf / group).glob("*.yaml")))
            fail(f"{argument}: expected one of {choices}")


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _siblings(key: str, conf: Path, name: str, arguments: Sequence[str]) -> Sequence[str]:
    """Return the keys that stand where ``key`` was looked for."""
    overrides = [argument for argument in arguments if re.match(rf"({'|'.join(_groups(conf))})=[\w-]+$", argument)]
    with hydra.initialize_config_dir(str(conf.resolve()), version_base="1.3"):
        node: Any = hydra.compose(name, overrides)
    for part in key.split(".")[:-1]:
        child = OmegaConf.select(node, part)
        if not isinstance(child, DictConfig):
            break
        node = child
    prefix = key.rpartition(".")[0]
    return [f"{prefix}.{child}" if prefix else str(child) for child in node if child != "target"]


def _groups(conf: Path) -> list[str]:
    return [path.name for path in conf.iterdir() if path.is_dir()]
