"""Compose a configuration, outside of a Hydra command or within one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from dsr.app.experiments import register_resolvers
from dsr.app.schema import register


def compose(
    name: str, overrides: Sequence[str], directories: Sequence[Path], *, with_hydra: bool = False
) -> DictConfig:
    """Compose a configuration.

    Args:
        name: without ``.yaml``.
        overrides: as on the command line.
        directories: those of :func:`dsr.utils.configuration.config_directories`.
        with_hydra: whether Hydra's own settings are there, too.

    """
    register()
    register_resolvers()
    places = ",".join(f'"file://{directory.resolve()}"' for directory in directories[1:])
    more = [f"hydra.searchpath=[{places}]"] if places else []
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(directories[0]), version_base="1.3"):
            return hydra.compose(name, [*overrides, *more], return_hydra_config=with_hydra)
    finally:
        if running is not None:
            GlobalHydra.instance().initialize(running)
