"""Compose a configuration, outside of a Hydra command or within one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, open_dict

from dsr.app.schema import NAMED, register
from dsr.utils.configuration import config_directories


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
