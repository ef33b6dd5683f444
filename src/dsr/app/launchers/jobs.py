"""What the launchers have in common: the jobs of a sweep, and waiting for them."""

from __future__ import annotations

import contextlib
import logging
import os
from abc import abstractmethod
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from dsr.app.multirun import JobResult
from dsr.utils import interruption
from dsr.utils.builder import check_types
from dsr.utils.console import ConsoleProgress, open_console

Ended = Generator[tuple[int, JobReturn], None, None]
"""Yields the number of each job with its result when it has ended, in any order."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """A job of a sweep, which is called in a process of its own, perhaps on another machine, perhaps more than once.

    Args:
        context: Hydra's.
        config: of the sweep.
        function: to call with the job's configuration.
        overrides: the job's.
        number: the job's, from 0.
        singletons: Hydra's state.
        folder: the directory that relative paths start from, there as here.
        environment: the user's variables that configurations may use.

    """

    context: HydraContext
    config: DictConfig
    function: TaskFunction
    overrides: tuple[str, ...]
    number: int
    singletons: Mapping[Any, Any]
    folder: str
    environment: Mapping[str, str]

    @property
    def name(self) -> str:
        """Its overrides."""
        return " ".join(filter_overrides(self.overrides))

    def __call__(self) -> JobReturn:
        """Run the job; what it raises is returned, too."""
        os.chdir(self.folder)
        os.environ.update(self.environment)
        Singleton.set_state(dict(self.singletons))
        setup_globals()
        config = self.context.config_loader.load_sweep_config(self.config, list(self.overrides))
        with open_dict(config):
            config.hydra.job.num, config.hydra.job.id = self.number, f"{config.hydra.job.name}_{self.number}"
        HydraConfig.instance().set_config(config)
        return run_job(
            hydra_context=self.context,
            task_function=self.function,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )

    def ended(self, problem: str) -> JobReturn:
        """Return what becomes of a job that ended without a result, and why."""
        return JobReturn(overrides=self.overrides, status=JobStatus.COMPLETED, _return_value=JobResult.failed(problem))


class JobsLauncher(Launcher):
    """Runs the jobs of a sweep beside each other.

    Args:
        settings: of the launcher, a dataclass.
        values: its values, as configured.

    """

    def __init__(self, settings: type, values: Mapping[str, Any]) -> None:
        self._settings = settings
        self._values = {
            key: OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            for key, value in values.items()
        }
        self._set_up: tuple[HydraContext, TaskFunction, DictConfig] | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keep what the jobs need."""
        self._set_up = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run jobs, and wait for all of them.

        Raises:
            ConfigError: they cannot be run with these settings, or nowhere.
            KeyboardInterrupt: a signal came; jobs that are under way are stopped.

        """
        assert self._set_up is not None  # noqa: S101 - Hydra calls setup
        context, function, config = self._set_up
        setup_globals()
        configure_log(config.hydra.hydra_logging, config.hydra.verbose)
        check_types(self._settings, self._values, "hydra.launcher.")
        settings = self._settings(**self._values)
        folder = Path(str(config.hydra.sweep.dir))
        folder.mkdir(parents=True, exist_ok=True)
        environment = {name: value for name, value in os.environ.items() if name.startswith("DSR_")}
        jobs = [
            Job(context, config, function, tuple(overrides), number, Singleton.get_state(), os.getcwd(), environment)  # noqa: PTH109
            for number, overrides in enumerate(job_overrides, initial_job_idx)
        ]
        for job in jobs:
            _log.info(f"\t#{job.number} : {job.name}")
        results: dict[int, JobReturn] = {}
        progress = ConsoleProgress(open_console())
        with (
            interruption.working(),
            progress.task("jobs", len(jobs)) as show,
            contextlib.closing(self._run(jobs, settings, folder.resolve())) as ended,
        ):
            for number, result in ended:
                results[number] = result
                show(len(results))
        return [results[job.number] for job in jobs]

    @abstractmethod
    def _run(self, jobs: Sequence[Job], settings: Any, folder: Path) -> Ended:
        """Run jobs, and yield their results; closed, it stops those that are under way.

        Args:
            jobs: to run.
            settings: of the launcher.
            folder: of the sweep.

        """
