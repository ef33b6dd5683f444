"""What became of the jobs of a multirun, whichever launcher ran them and in whichever process."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode

from dsr.utils.builder import ConfigError, expect_library
from dsr.utils.console import one_line

LAUNCHERS = {
    "basic": "hydra",
    "gpus": "hydra_plugins.hydra_joblib_launcher",
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "ray": "ray",
    "slurm": "submitit",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
}
"""The launchers that ``pip install dsr[cluster]`` brings, and what each needs."""
_MADE_BY = "instantiate_launcher"
"""The method of Hydra's plugins with which sweepers make their launcher."""


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


@contextlib.contextmanager
def collected_jobs() -> Iterator[list[JobReturn]]:
    """Yield a list to which the jobs of multiruns within the context are added as they come back from the launcher.

    A launcher that breaks, because a process of it was killed, say, raises ConfigError.
    """
    jobs: list[JobReturn] = []
    instantiate = getattr(Plugins, _MADE_BY)

    def instantiate_collecting(self: Plugins, *args: Any, **named: Any) -> Any:
        launcher = instantiate(self, *args, **named)
        launch = launcher.launch

        def launch_collecting(job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
            try:
                results = launch(job_overrides, initial_job_idx)
            except ConfigError:
                raise
            except Exception as error:
                kind = type(launcher).__name__
                raise ConfigError(
                    f"hydra/launcher: {kind} ended before its jobs did ({type(error).__name__}: {one_line(error)}); "
                    "what is finished is kept, the same command goes on from there"
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


def failure_summary(jobs: Sequence[JobReturn]) -> list[str]:
    """Return lines on the jobs of a multirun that failed, each named by the overrides that not all jobs share."""
    problems = [_problem(job) for job in jobs]
    if not any(problems):
        return []
    shared = set.intersection(*(set(job.overrides or ()) for job in jobs)) if len(jobs) > 1 else set()
    lines = [f"{sum(map(bool, problems))} of {len(jobs)} jobs failed"]
    for job, problem in zip(jobs, problems, strict=True):
        if problem:
            name = " ".join(each for each in job.overrides or () if each not in shared)
            lines.append(f"{name}: {problem}" if name else problem)
    return lines


def _problem(job: JobReturn) -> str:
    """Return why a job failed, one line; empty if it did not."""
    if job.status == JobStatus.FAILED:
        error = job._return_value
        return f"{type(error).__name__}: {one_line(error)}"
    return getattr(job.return_value, "problem", "")
