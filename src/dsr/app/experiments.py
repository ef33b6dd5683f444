"""Support for experiments (``conf/experiment``) that Hydra lacks.

Sweeps over the data sets that are on this machine, and sweeps that the command line overrides.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from dsr.data.download.collections import CATALOGUE
from dsr.utils.console import note_once
from dsr.utils.files import data_root

_KEY_OF_GROUP = re.compile(r"(\w+)\.[\w.]+=")
"""An argument that sets a key of a group, such as ``method.range_type=orthogonal``."""


def register_resolvers() -> None:
    """Let configuration files use ``${present:NAME,NAME}``: those of the named data sets that are on this machine."""
    OmegaConf.register_new_resolver("present", _present, replace=True)


def without_overridden_sweeps(arguments: Sequence[str], directories: Sequence[Path]) -> list[str]:
    """Return a command's arguments, with overrides that remove the keys that they set from their experiment's sweep.

    Otherwise the sweep of the experiment would run in addition to the value of the command line.
    """
    swept = _swept_keys(arguments, directories)
    given = {argument.partition("=")[0] for argument in arguments}
    return [*arguments, *(f"~hydra.sweeper.params.{key}" for key in sorted(swept & given))]


def with_keys_of_swept_groups(arguments: Sequence[str], directories: Sequence[Path]) -> list[str]:
    """Return a command's arguments, with keys of groups that it sweeps over as overrides that may add them.

    Before Hydra composes the jobs, it checks overrides that are not swept against the defaults: with
    ``method=pgsr,svlrm method.range_type=orthogonal``, against the default method, which has no such key.
    """
    if not {"-m", "--multirun"} & set(arguments):
        return list(arguments)
    swept = _swept_keys(arguments, directories) | {
        key for key, _, value in (argument.partition("=") for argument in arguments) if "," in value
    }
    return [
        f"++{argument}" if (match := _KEY_OF_GROUP.match(argument)) and match[1] in swept else argument
        for argument in arguments
    ]


def _swept_keys(arguments: Sequence[str], directories: Sequence[Path]) -> set[str]:
    """Return the keys that the experiment of a command sweeps over; none without an experiment."""
    names = (re.fullmatch(r"\+experiment=([\w-]+)", argument) for argument in arguments)
    files = (directory / "experiment" / f"{name[1]}.yaml" for name in names if name for directory in directories)
    file = next((each for each in files if each.is_file()), None)
    params = None if file is None else OmegaConf.select(OmegaConf.load(file), "hydra.sweeper.params")
    return set(map(str, params or ()))


def _present(*names: str) -> str:
    """Return the data sets that are on this machine or embedded, separated by commas; print a note on the others."""
    absent = []
    for name in names:
        folders = CATALOGUE[name].folders if name in CATALOGUE else ()
        if not all((data_root() / folder).is_dir() for folder in folders):
            absent.append(name)
    if absent:
        note_once(f"left out, as not in {data_root()}: {', '.join(absent)}; `dsr data get NAME` gets one")
    return ",".join(name for name in names if name not in absent)
