"""What experiments (``conf/experiment``) need beyond Hydra.

Sweeps over the data sets that are on this machine, and sweeps that the command line overrides.
"""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from dsr.data.download.catalogue import CATALOGUE
from dsr.data.download.location import data_root


def register_resolvers() -> None:
    """Let configuration files use ``${present:NAME,NAME}``: those of the named data sets that are on this machine."""
    OmegaConf.register_new_resolver("present", _present, replace=True)


def without_overridden_sweeps(arguments: Sequence[str], directories: Sequence[Path]) -> list[str]:
    """Return a command's arguments, with overrides that remove the keys that they set from their experiment's sweep.

    Otherwise the sweep of the experiment would run in addition to the value of the command line.
    """
    swept = {key for argument in arguments for key in _swept_keys(argument, directories)}
    given = {argument.partition("=")[0] for argument in arguments}
    return [*arguments, *(f"~hydra.sweeper.params.{key}" for key in sorted(swept & given))]


def with_keys_of_swept_groups(arguments: Sequence[str], directories: Sequence[Path]) -> list[str]:
    """Return a command's arguments, with keys of groups that it sweeps over as overrides that may add them.

    Before Hydra composes the jobs, it checks overrides that are not swept against the defaults: with
    ``method=pgsr,svlrm method.range_type=orthogonal``, against the default method, which has no such key.
    """
    if not {"-m", "--multirun"} & set(arguments):
        return list(arguments)
    swept = {key for argument in arguments for key in _swept_keys(argument, directories)}
    swept |= {key for key, _, value in (argument.partition("=") for argument in arguments) if "," in value}
    return [f"++{each}" if re.match(r"(\w+)\.[\w.]+=", each) and each.partition(".")[0] in swept else each
            for each in arguments]  # fmt: skip


def _swept_keys(argument: str, directories: Sequence[Path]) -> list[str]:
    """Return the keys that the experiment of an argument sweeps over."""
    name = re.fullmatch(r"\+experiment=([\w-]+)", argument)
    files = [directory / "experiment" / f"{name[1]}.yaml" for directory in directories] if name else []
    for file in files:
        if file.is_file():
            return [str(key) for key in OmegaConf.select(OmegaConf.load(file), "hydra.sweeper.params") or ()]
    return []


def _present(*names: str) -> str:
    """Return the data sets that are on this machine or embedded, separated by commas; print a note on the others."""
    absent = []
    for name in names:
        folders = CATALOGUE[name].folders if name in CATALOGUE else ()
        if not all((data_root() / folder).is_dir() for folder in folders):
            absent.append(name)
    if absent:
        _note_once(f"left out, as not in {data_root()}: {', '.join(absent)}; `dsr data get NAME` gets one")
    return ",".join(name for name in names if name not in absent)


@functools.cache
def _note_once(note: str) -> None:
    """Print a note on stderr, once in a process, however often a value is resolved."""
    print(f"note: {note}", file=sys.stderr)  # noqa: T201
