"""Compose a configuration, outside of a Hydra command or within one, with the resolver ``${present:...}``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf, open_dict

from dsr.app.schema import NAMED, register
from dsr.utils.configuration import config_directories
from dsr.utils.console import note_once
from dsr.utils.files import data_root


def compose(name: str, overrides: Sequence[str] = (), directories: Sequence[Path] = ()) -> DictConfig:
    """Compose the configuration of a command, as in ``compose("train", ["model=msg_v", "scale=8"])``.

    Args:
        name: ``train`` or ``eval``.
        overrides: as on the command line.
        directories: of configuration files of your own.

    Example:
        >>> import dsr
        >>> config = dsr.compose("eval", ["method=tgv", "scale=4"])
        >>> config.method.iterations, config.scale
        (1000, 4)

    """
    register()
    register_resolvers()
    project, *others = config_directories(directories)
    places = ",".join(f'"file://{directory.resolve()}"' for directory in others)
    more = [f"hydra.searchpath=[{places}]"] if places else []
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(project), version_base="1.3"):
            config = hydra.compose(name, [*overrides, *more], return_hydra_config=True)
    finally:
        if running is not None:
            GlobalHydra.instance().initialize(running)
    with open_dict(config):
        choices = config.hydra.runtime.choices
        given = {group: name for group, name in config.names.items() if name is not None}
        config.names = {each: choices[each] for each in NAMED if each in choices} | given
        del config["hydra"]
    return config


def register_resolvers() -> None:
    """Let configuration files use ``${present:NAME,NAME}``: those of the named data sets that are on this machine."""
    OmegaConf.register_new_resolver("present", _present, replace=True)


def _present(*names: str) -> str:
    """Return the data sets that are on this machine or embedded, separated by commas; print a note on the others."""
    from dsr.data.download.collections import CATALOGUE  # noqa: PLC0415 - only a few experiments ask for it

    folders = {name: CATALOGUE[name].folders if name in CATALOGUE else () for name in names}
    absent = [name for name in names if not all((data_root() / folder).is_dir() for folder in folders[name])]
    if absent:
        note_once(f"left out, as not in {data_root()}: {', '.join(absent)}; `dsr data get NAME` gets one")
    return ",".join(name for name in names if name not in absent)
