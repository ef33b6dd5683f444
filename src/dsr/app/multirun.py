"""The jobs of a multirun, with any launcher: all are checked before the first runs, and failures are summarised."""

from __future__ import annotations

import contextlib
import copy
import io
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from dsr.app.schema import Identity
from dsr.utils.configuration import ConfigError, expect_library
from dsr.utils.console import USAGE_ERROR, one_line, open_console, print_error, show
from dsr.utils.progress import duration

LAUNCHERS = {
    "basic": "hydra",
    "gpus": "hydra_plugins.hydra_joblib_launcher",
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "slurm": "submitit",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
}
"""The launchers that ``pip install -e '.[cluster]'`` brings, and what each needs."""
_MADE_BY = "instantiate_launcher"
"""The method of Hydra's plugins with which sweepers make their launcher."""


@dataclass(frozen=True)
class Plan:
    """The outline of a job, as far as it is known beforehand.

    Args:
        folder: the directory of its run.
        identity: what its results depend on, see :func:`dsr.app.run_directory.identity_of`.
        unit: what its work is counted in: scenes or steps.
        left: how many of them are left to do.
        done: how many are complete.
        seconds: measures how long what is left will take, NaN if that is not known; what it shares with other jobs does
            not count if the given set names it, and is added to it. None where nothing can be measured.

    """

    folder: Path
    identity: Identity
    unit: str
    left: int
    done: int = 0
    seconds: Callable[[set[str]], float] | None = None


Check = Callable[[DictConfig], Sequence[Plan]]
"""Checks a job's configuration before anything is computed or written, and returns what the job will do."""


class JobResult(float):
    """What a job returns: a number, which sweepers minimise, NaN if the job failed.

    Attributes:
        problem: why the job failed, one line; empty if it did not.

    """

    problem: str = ""

    @classmethod
    def failed(cls, problem: str) -> JobResult:
        """Return the result of a job that failed."""
        result = cls("nan")
        result.problem = problem
        return result


def expect_launcher(arguments: Sequence[str]) -> None:
    """Check that the launcher that a command line names, if dsr knows it, is installed.

    Args:
        arguments: of the command line.

    Raises:
        ConfigError: it is not.

    """
    for argument in arguments:
        group, _, choice = argument.partition("=")
        if group == "hydra/launcher" and choice in LAUNCHERS:
            expect_library(argument, LAUNCHERS[choice], "cluster")


def job_name() -> str:
    """Return the overrides of the job of a multirun that is under way; empty for a command that is none."""
    config = HydraConfig.get()
    return " ".join(config.overrides.task) if config.mode == RunMode.MULTIRUN else ""


def runs_here() -> bool:
    """Return whether the launcher of the multirun runs its jobs in this process, and so with its devices."""
    return HydraConfig.get().runtime.choices.get("hydra/launcher") == "basic"


@contextlib.contextmanager
def collected_jobs(check: Check | None = None) -> Iterator[list[JobReturn]]:
    """Yield a list to which the jobs of multiruns within the context are added as they come back from the launcher.

    A launcher that breaks, because a process of it was killed, say, raises ConfigError.

    Args:
        check: of each job, before the first one of those that are launched together begins; if one cannot be run, the
            process exits with 2 and a line for each of these. None for no check.

    """
    jobs: list[JobReturn] = []
    instantiate = getattr(Plugins, _MADE_BY)

    def instantiate_collecting(
        self: Plugins, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> Any:
        launcher = instantiate(self, hydra_context=hydra_context, task_function=task_function, config=config)
        launch = launcher.launch

        def launch_collecting(job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
            if check is not None:
                configs = _composed(hydra_context.config_loader, config, job_overrides, initial_job_idx)
                try:
                    _announce(_plans(configs, check))
                except BaseException:
                    if initial_job_idx == 0:
                        _remove_record(Path(config.hydra.sweep.dir))
                    raise
            try:
                results = launch(job_overrides, initial_job_idx)
            except ConfigError:
                raise
            except Exception as error:
                kind = type(launcher).__name__
                raise ConfigError(
                    f"hydra/launcher: {kind} ended before its jobs did ({type(error).__name__}: {one_line(error)}); "
                    "what is finished is kept, the same command continues from there"
                ) from error
            jobs.extend(results)
            return results

        launcher.launch = launch_collecting
        return launcher

    setattr(Plugins, _MADE_BY, instantiate_collecting)
    try:
        yield jobs
    finally:
        setattr(Plugins, _MADE_BY, instantiate)


def _composed(
    loader: ConfigLoader, config: DictConfig, jobs: Sequence[Sequence[str]], first: int
) -> Iterator[DictConfig]:
    """Yield the configuration of each job, the first of which has a number, while it is Hydra's current one."""
    before = HydraConfig.instance().cfg
    try:
        for number, overrides in enumerate(jobs, start=first):
            composed = loader.load_sweep_config(config, list(overrides))
            with read_write(composed), open_dict(composed):
                composed.hydra.job.num, composed.hydra.job.id = number, str(number)
                HydraConfig.instance().set_config(copy.deepcopy(composed))
                del composed["hydra"]
            yield composed
    finally:
        HydraConfig.instance().cfg = before


def _plans(configs: Iterator[DictConfig], check: Check) -> list[list[Plan]]:
    """Return what each job will do; exit with a line for each that cannot be run."""
    plans: list[list[Plan]] = []
    results: list[JobReturn] = []
    owners: dict[Path, Mapping[str, Any]] = {}
    for config in configs:
        overrides = OmegaConf.to_container(HydraConfig.get().overrides.task)
        job = JobReturn(overrides, status=JobStatus.COMPLETED)  # type: ignore[arg-type]
        job.return_value = JobResult()
        results.append(job)
        try:
            plans.append(list(check(config)))
            for plan in plans[-1] if config.output_dir is not None else ():
                if owners.setdefault(plan.folder.resolve(), plan.identity) != plan.identity:
                    raise ConfigError(
                        f"output_dir: expected a directory for each job, got {plan.folder} for several; without "
                        "output_dir each has its own"
                    )
        except (ConfigError, OSError, OmegaConfBaseException) as error:
            job.return_value = JobResult.failed(one_line(error))
    summary = failure_summary(results, "cannot be run, so none is begun")
    for line in summary:
        print_error(line)
    if summary:
        sys.exit(USAGE_ERROR)
    return plans


def _announce(plans: Sequence[Sequence[Plan]]) -> None:
    """Say what all jobs together will do, and how long that takes as far as it can be measured."""
    every = [plan for job in plans for plan in job]
    if not every:
        return
    unit, left, done = every[0].unit, sum(plan.left for plan in every), sum(plan.done for plan in every)
    line = f"{len(plans)} job{'s' * (len(plans) > 1)}, {left} {unit}{'s' * (left != 1)}"
    line += f" ({done} more are complete)" if done else ""
    shared: set[str] = set()
    measured = [(plan.left, plan.seconds(shared)) for plan in every if plan.left and plan.seconds is not None]
    known = [(count, seconds) for count, seconds in measured if not math.isnan(seconds)]
    if known:
        some = sum(count for count, _ in known)
        line += ": about " if some == left else f"; {some} of them take about "
        line += duration(sum(seconds for _, seconds in known))
    show(open_console(), line)


def _remove_record(folder: Path) -> None:
    """Remove what Hydra has written of a multirun that is refused, and directories that are empty then."""
    with contextlib.suppress(OSError):
        (folder / "multirun.yaml").unlink()
        os.removedirs(folder)


def failure_summary(jobs: Sequence[JobReturn], what: str = "failed") -> list[str]:
    """Return lines on the jobs of a multirun that failed, each named by the overrides that not all jobs share.

    Args:
        jobs: all of them.
        what: is the matter with those that have a problem.

    """
    problems = [_problem(job) for job in jobs]
    if not any(problems):
        return []
    shared = set.intersection(*(set(job.overrides or ()) for job in jobs)) if len(jobs) > 1 else set()
    lines = [f"{sum(map(bool, problems))} of {len(jobs)} jobs {what}"]
    for job, problem in zip(jobs, problems, strict=True):
        if problem:
            name = " ".join(each for each in job.overrides or () if each not in shared)
            lines.append(problem if not name or problem.startswith(f"{name}:") else f"{name}: {problem}")
    return lines


def _problem(job: JobReturn) -> str:
    """Return why a job failed, one line; empty if it did not."""
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # Hydra's own line, which repeats the overrides
            return getattr(job.return_value, "problem", "")
    except Exception as error:  # of the job
        return f"{type(error).__name__}: {one_line(error)}"
