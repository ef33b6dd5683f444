"""A multirun is refused before its first job begins if one of its jobs cannot be run, with a line for each of these."""

from __future__ import annotations

import copy
import sys
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from dsr.app.entry import explain, fail, module_of
from dsr.app.schema import Identity, Plan
from dsr.utils.configuration import ConfigError
from dsr.utils.console import USAGE_ERROR, one_line, open_console, print_error, show


class CheckJobs(Callback):
    """Hydra's callback that plans each job of a multirun of Hydra's own sweeper, and prints how much there is to do."""

    def on_multirun_start(self, config: DictConfig, config_name: str | None = None, **_: Any) -> None:
        """Exit with 2 if a job cannot be run."""
        if not str(config.hydra.sweeper._target_).endswith(".BasicSweeper"):
            return  # its jobs are not known beforehand
        plans: list[Plan] = []
        problems: list[str] = []
        owners: dict[Path, Identity] = {}
        before = HydraConfig.instance().cfg
        try:
            jobs = _jobs(config)
        except HydraException as error:
            fail(explain(error))
        for overrides, job in jobs:
            HydraConfig.instance().set_config(job)
            composed = copy.deepcopy(job)
            with read_write(composed), open_dict(composed):
                del composed["hydra"]
            try:
                for plan in module_of(str(config_name), composed).plan(composed):
                    plans.append(plan)
                    if owners.setdefault(plan.folder.resolve(), plan.identity) != plan.identity:
                        raise ConfigError(
                            f"output_dir: expected a directory for each job, got {plan.folder} for several"
                        )
            except (ConfigError, OSError, OmegaConfBaseException) as error:
                problems.append(f"{' '.join(overrides)}: {one_line(error)}")
        HydraConfig.instance().cfg = before
        if problems:
            print_error(f"{len(problems)} of the jobs cannot be run, so none is begun")
            for problem in problems:
                print_error(problem)
            sys.exit(USAGE_ERROR)
        left, done = sum(plan.left for plan in plans), sum(plan.done for plan in plans)
        more = f" ({done} more are complete)" if done else ""
        for unit in {plan.unit for plan in plans}:
            show(open_console(), f"{len(plans)} runs, {unit}s to do: {left}{more}")


def _jobs(config: DictConfig) -> list[tuple[list[str], DictConfig]]:
    """Return the overrides and the configuration of each job, all of which are composed before the first is planned."""
    loader: Any = GlobalHydra.instance().config_loader()
    given = [f"{key}={value}" for key, value in (config.hydra.sweeper.params or {}).items()]
    given += OmegaConf.to_container(config.hydra.overrides.task)  # type: ignore[arg-type]
    overrides = OverridesParser.create(loader).parse_overrides(given)
    jobs = BasicSweeper.split_arguments(overrides, None)[0]
    return [(job, loader.load_sweep_config(config, job)) for job in jobs]
