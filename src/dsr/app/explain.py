"""Explain errors of a configuration in one line, with the choices or keys that exist where a name is mistyped."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from dsr.app.composition import compose
from dsr.app.multirun import LAUNCHERS
from dsr.app.schema import MOVED, NAMED, SET_BY_DSR, SEVERAL
from dsr.utils.configuration import ConfigError, list_choices, list_groups, load_target
from dsr.utils.console import one_line
from dsr.utils.spelling import did_you_mean

_ALIASES = {
    "learning_rate": ("lr",), "batch_size": ("batch",), "steps": ("max_steps",),
    "ckpt_path": ("resume", "run"), "resume_from_checkpoint": ("resume", "run"), "checkpoint": ("resume", "run"),
}  # fmt: skip
"""Names that others have for keys."""
_ALIKE = 0.8
"""How alike a mistyped key is to the one that is meant, of 1."""
_PLUGINS = {
    "hydra/sweeper": {"optuna": "optuna", "ax": "ax", "nevergrad": "nevergrad"},
    "hydra/launcher": {"ray": "ray", "ray_aws": "ray", "rq": "rq"},
}
"""Choices of Hydra that come with a package of their own, by the middle of its name."""
_OTHERS = {"eval": "train", "train": "eval"}
"""The other command of each."""


def explain_arguments(arguments: Sequence[str]) -> str | None:
    """Return an error of one line for an argument on which Hydra would fail with more, None if there is none.

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
    if headless := re.match(r"In '((optimizer|scheduler)/\S+)': .*Key '\2' not in", text):
        return f"{headless[1]}.yaml: expected the first line '# @package model.{headless[2]}'"
    several = re.match(r"Ambiguous value for argument '([^=]+)=(.*?)' 1\.", text)
    if several:
        key, values = several.groups()
        texts = [f"{key}: got several values; -m runs each of them"]
        single = key in list_groups(directories)
        texts += [f"metrics.protocols=[{values}] computes all of them"] if key == "metrics" else []
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


def explain_choice(group: str, choice: str, directories: Sequence[Path]) -> str:
    """Explain in one line which choices a group has instead of one that it does not have.

    Args:
        group: such as ``model``.
        choice: what is not there.
        directories: directories of configuration files.

    """
    if group == "model" and choice in list_choices("method", directories):
        return f"model={choice}: expected a network to train, {choice} is none; eval.py has method={choice}"
    choices = list_choices(group, directories)
    return f"{group}={choice}: unknown; expected one of {', '.join(choices)}{did_you_mean(choice, choices)}"


def _explain_key(key: str, name: str, arguments: Sequence[str], directories: Sequence[Path]) -> str:
    """Explain which keys exist instead of an unknown one: those that are meant, or those beside it."""
    if key == "experiment":
        return f"experiment: write +experiment=NAME, NAME one of {', '.join(list_choices(key, directories))}"
    values = (argument.partition("=") for argument in arguments)
    value = next((value for given, _, value in values if given.lstrip("+~") == key), "...")
    group = key.removesuffix(".name")
    if key == f"{group}.name" and group in NAMED:
        return f"{key}: unknown key; expected names.{group}={value}"
    if name == "train" and key in MOVED:
        return f"{key}: unknown key; expected {MOVED[key]}={value}"
    config = _composed_for(key, name, arguments, directories)
    prefix, node = _innermost(config, key)
    children = [str(child) for child in node if child not in ("_target_", "_partial_", "names")]
    last = key.removeprefix(prefix)
    alike = [f"{prefix}{each}={value}" for each in get_close_matches(key.rpartition(".")[2], children, 1, _ALIKE)]
    meant = _meant(key, value, name, config, directories)
    wanted = alike or meant if prefix else meant or alike  # a key of a group is one of this group first
    beside = [f"{prefix}{child}" for child in children]
    more = _arguments(prefix, node, last)
    if last in more and not alike and not (meant and last in config):
        return f"{key}: unknown key; expected +{key}={value}, as it adds an argument of {node['_target_']}"
    if prefix:
        known = {**{each: f"+{prefix}{each}" for each in more}, **dict(zip(children, beside, strict=True))}
        near = re.sub(r"mean (.*)\?", lambda found: f"mean {known[found[1]]}?", did_you_mean(last, known))
    else:
        near = did_you_mean(key, {*beside, *list_groups(directories)})
    return f"{key}: unknown key; expected {' or '.join(wanted) or (', '.join(beside) or 'none') + near}"


def _arguments(prefix: str, node: DictConfig, wanted: str) -> list[str]:
    """Return what a target outside of dsr, whose keys are all there, takes; the wanted one if it takes any name."""
    if str(node.get("_target_", "dsr.")).startswith("dsr."):
        return []
    try:
        taken = inspect.signature(load_target(prefix, dict(node))).parameters
    except (ConfigError, ValueError):  # a target that is missing, or has no signature
        return []
    names = [wanted if each.kind is each.VAR_KEYWORD else name for name, each in taken.items()]
    return [name for name in names if prefix != "trainer." or name not in SET_BY_DSR]


def _meant(key: str, value: str, name: str, config: DictConfig, directories: Sequence[Path]) -> list[str]:
    """Return the arguments that may be meant by one with an unknown key, which is known elsewhere; perhaps none."""
    other = _OTHERS[name]
    pair = {"model": "method", "method": "model"}.get(key)
    if pair in config:
        wanted = f"{pair}={value}" if value in list_choices(str(pair), directories) else f"{key}={value} of {other}.py"
        return [wanted] if value in list_choices("method", directories) else []
    last = key.rpartition(".")[2]
    known = list(_places(OmegaConf.to_container(config)))
    ends = {place.rpartition(".")[2] for place in known}
    last = next((each for each in _ALIASES.get(last, ()) if each in ends), last)
    places = [place for place in known if place.rpartition(".")[2] == last]
    if places:
        return [f"{place}={value}" for place in places]
    choices: dict[str, list[str]] = {}
    for group in [str(each) for each in config if each in list_groups(directories)]:
        for choice in list_choices(group, directories):
            for place in _places_of(group, choice, directories):
                if place.rpartition(".")[2] == last:
                    choices.setdefault(f"{group}.{place}={value} with {group}", []).append(choice)
    if choices:
        return [f"{place}={', '.join(names)}" for place, names in choices.items()]
    there = key in _places(OmegaConf.to_container(compose(other, [], directories[1:])))
    return [f"{key}={value} of {other}.py"] if there else []


def _places(node: Any, above: str = "") -> Iterator[str]:
    """Yield the dotted keys of a configuration's plain values."""
    for child, value in node.items():
        yield f"{above}{child!s}"
        if isinstance(value, dict):
            yield from _places(value, f"{above}{child!s}.")


def _places_of(group: str, choice: str, directories: Sequence[Path]) -> set[str]:
    """Return the dotted keys of a choice of a group, with those of the choices that it is made from."""
    file = next((path for each in directories if (path := each / group / f"{choice}.yaml").is_file()), None)
    content = None if file is None else OmegaConf.load(file)
    if not isinstance(content, DictConfig):
        return set()
    bases = [each for each in content.get("defaults") or () if isinstance(each, str) and each != choice]
    content = content.get(group, content)  # of a choice that sets other keys, too
    return set(_places(OmegaConf.to_container(content))).union(*(_places_of(group, e, directories) for e in bases))


def _explain_missing(file: str, name: str, directories: Sequence[Path]) -> str:
    """Explain which files exist instead of a missing configuration file."""
    group, _, choice = file.rpartition("/")
    if not group:
        return f"--config-name {choice}: unknown; expected {name}"
    choices = list_choices(group, directories)
    if group in _PLUGINS:
        if choice in _PLUGINS[group]:
            package = f"hydra-{_PLUGINS[group][choice]}-{group.removeprefix('hydra/')}"
            return f"{group}={choice}: expected a plugin that is installed; pip install {package}"
        choices = sorted({*choices, *(LAUNCHERS if group == "hydra/launcher" else ()), "basic", *_PLUGINS[group]})
        return f"{group}={choice}: unknown; expected one of {', '.join(choices)}{did_you_mean(choice, choices)}"
    if choices:
        return explain_choice(group, choice, directories)
    groups = list_groups(directories)
    return f"{group}: no such group of choices; expected one of {', '.join(groups)}{did_you_mean(group, groups)}"


def _explain_syntax(override: str) -> str:
    """Explain how to write an argument that Hydra cannot parse."""
    key, equals, value = override.partition("=")
    if not equals:
        return f"{override}: expected KEY=VALUE"
    quoted = re.sub(r"[^\[\],{}:]+", r'"\g<0>"', value) if value.startswith("[") else f'"{value}"'
    return f"{key}: cannot read the value {value}; special characters need quotes within quotes: '{key}={quoted}'"


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _composed_for(key: str, name: str, arguments: Sequence[str], directories: Sequence[Path]) -> DictConfig:
    """Return the configuration in which ``key`` was looked for: with the choices that the arguments name."""
    choice = re.compile(rf"({'|'.join(list_groups(directories))}|hydra/launcher)=(\[.*\]|[\w-]+)")
    overrides = [argument for argument in arguments if choice.fullmatch(argument)]
    with_hydra = key.startswith("hydra.")
    try:
        return compose(name, overrides, directories[1:], with_hydra=with_hydra)
    except HydraException:  # one of these choices is invalid
        return compose(name, [], directories[1:], with_hydra=with_hydra)


def _innermost(config: DictConfig, key: str) -> tuple[str, DictConfig]:
    """Return the innermost node above ``key`` that is there, and what stands before the keys in it."""
    prefix, node = "", config
    for part in key.split(".")[:-1]:
        child = OmegaConf.select(node, part)
        if not isinstance(child, DictConfig):
            break
        prefix, node = f"{prefix}{part}.", child
    return prefix, node
