"""Explain errors of a configuration in one line, with the choices or keys that exist where a name is mistyped."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from dsr.app.composition import compose
from dsr.app.multirun import LAUNCHERS
from dsr.app.schema import SEVERAL
from dsr.utils.config_files import list_choices, list_groups
from dsr.utils.console import one_line


def explain_arguments(arguments: Sequence[str]) -> str | None:
    """Explain in one line which argument Hydra would not refuse in one, None if there is none.

    Args:
        arguments: command-line arguments, Hydra's options and overrides.

    """
    shows = any(re.fullmatch(r"--(cfg|help)(=.*)?|-[ch].*", argument) for argument in arguments)
    for argument in arguments:
        if argument == "--resolve" and not shows:
            return "--resolve: expected with --cfg job, which shows the configuration"
        if re.match(r"[+~]*[@=]", argument) or not argument.strip():
            return f"{argument!r}: expected KEY=VALUE"
    return None


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
        texts = [f"{key}: got several values; -m runs each of them"]
        single = key in list_groups(directories)
        texts += [] if single and key not in SEVERAL else [f"{key}=[{values}] is a list"]
        texts += [] if single else [f"'{key}=\"{values}\"' a text"]
        return ", ".join(texts)
    return _explain_value(error, text, name, arguments, directories)


def explain_damage(error: Exception, directories: Sequence[Path]) -> str:
    """Explain in one line which of the user's configuration files cannot be read.

    Args:
        error: what reading it raised.
        directories: directories of configuration files, the project's first.

    """
    for directory in directories[1:]:
        for path in sorted(directory.rglob("*.yaml")):
            try:
                OmegaConf.load(path)
            except Exception as damage:  # damaged YAML raises many types
                return f"{path}: expected a readable YAML file, got {type(damage).__name__}"
    return one_line(error)


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
    siblings = [
        f"{prefix}.{child!s}" if prefix else str(child) for child in node if child not in ("target", "_target_")
    ]
    return f"{key}: unknown key; expected {', '.join(siblings) or 'none'}"


def _explain_missing(file: str, name: str, directories: Sequence[Path]) -> str:
    """Explain which files exist instead of a missing configuration file."""
    group, _, choice = file.rpartition("/")
    if not group:
        return f"--config-name {choice}: unknown; expected {name}"
    choices = list_choices(group, directories)
    if group == "hydra/launcher":
        choices = sorted({*choices, *LAUNCHERS})
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


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _node_of(key: str, name: str, arguments: Sequence[str], directories: Sequence[Path]) -> DictConfig:
    """Return the node in which ``key`` was looked for, or the innermost one above it."""
    choice = re.compile(rf"({'|'.join(list_groups(directories))}|hydra/launcher)=[\w-]+")
    overrides = [argument for argument in arguments if choice.fullmatch(argument)]
    with_hydra = key.startswith("hydra.")
    try:
        node = compose(name, overrides, directories, with_hydra=with_hydra)
    except HydraException:  # one of these choices is invalid
        node = compose(name, [], directories, with_hydra=with_hydra)
    for part in key.split(".")[:-1]:
        child = OmegaConf.select(node, part)
        if not isinstance(child, DictConfig):
            break
        node = child
    return node
