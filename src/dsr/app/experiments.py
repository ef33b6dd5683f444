"""The resolver ``${present:...}`` of ``conf/experiment``: sweeps over the data sets that are here."""

from __future__ import annotations

from omegaconf import OmegaConf

from dsr.data.download.collections import CATALOGUE
from dsr.utils.console import note_once
from dsr.utils.files import data_root


def register_resolvers() -> None:
    """Let configuration files use ``${present:NAME,NAME}``: those of the named data sets that are on this machine."""
    OmegaConf.register_new_resolver("present", _present, replace=True)


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
