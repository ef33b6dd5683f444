"""Sweeps as job arrays of Slurm, through submitit; ``conf/hydra/launcher/slurm.yaml`` has the settings.

Unlike hydra-submitit-launcher this waits for every job, also when one is killed or its node is lost, and each job has a
device of its own.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import shutil
import subprocess
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from dsr.app.multirun import JobResult
from dsr.utils import interruption
from dsr.utils.configuration import ConfigError, check_types
from dsr.utils.console import ConsoleProgress, one_line, open_console

_log = logging.getLogger(__name__)
_NAME = "slurm"
_LOOK = 0.5
"""Seconds between two looks for results."""
_ASK = (2.0, 60.0)
"""The fewest and most seconds between two questions to Slurm."""
_STOP = 3.0
"""The most seconds to wait for processes that are stopped."""
_CONFIRMATIONS = 3
"""Answers in a row without a result after which a job has ended: network file systems show files late."""
_ENDED = {
    "COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "OUT_OF_MEMORY", "NODE_FAIL", "BOOT_FAIL", "DEADLINE", "PREEMPTED",
    "REVOKED",
}  # fmt: skip
"""Slurm's states of jobs that do not run any more; those that are requeued leave them at once."""
_NO_REASONS = {"None", "BeginTime", "JobArrayTaskLimit"}
"""Slurm's words for jobs that it has not looked at yet, that are requeued, and that array_parallelism keeps waiting."""


@dataclass(frozen=True)
class SlurmSettings:
    """See ``conf/hydra/launcher/slurm.yaml``."""

    cluster: Literal["slurm", "local"]
    partition: str | None
    account: str | None
    qos: str | None
    constraint: str | None
    gpus_per_node: int | None
    tasks_per_node: int
    cpus_per_task: int | None
    mem_gb: float | None
    timeout_min: int
    signal_delay_s: int
    max_num_timeout: int
    array_parallelism: int
    setup: list[str] | None = None
    additional_parameters: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        for name in (
            "gpus_per_node", "tasks_per_node", "cpus_per_task", "mem_gb", "timeout_min", "array_parallelism"
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ConfigError(f"hydra.launcher.{name}: expected a positive number, got {value}")
        for name in ("signal_delay_s", "max_num_timeout"):
            if getattr(self, name) < 0:
                raise ConfigError(f"hydra.launcher.{name}: expected 0 or more, got {getattr(self, name)}")
        if self.cluster == "local" and self.tasks_per_node > 1:
            raise ConfigError(f"hydra.launcher.tasks_per_node: expected 1 without Slurm, got {self.tasks_per_node}")


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

    def checkpoint(self) -> Any:
        """Return what submitit runs instead when the job is requeued: the same, which finds what it has done."""
        from submitit.helpers import DelayedSubmission  # noqa: PLC0415 - plugins have to be importable without

        return DelayedSubmission(self)

    def ended(self, problem: str) -> JobReturn:
        """Return how a job ended that left no result, and why."""
        return JobReturn(overrides=self.overrides, status=JobStatus.COMPLETED, _return_value=JobResult.failed(problem))


class SlurmLauncher(Launcher):
    """Submits the jobs of a sweep as an array, waits for them, and takes them back if it is interrupted.

    Args:
        **values: of :class:`SlurmSettings`, as configured.

    """

    def __init__(self, **values: Any) -> None:
        self._values: dict[str, Any] = {
            key: OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            for key, value in values.items()
        }
        self._set_up: tuple[HydraContext, TaskFunction, DictConfig] | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Store the settings for the jobs."""
        self._set_up = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run jobs, and wait for all of them.

        Raises:
            ConfigError: they cannot be run with these settings, or there is no Slurm.
            KeyboardInterrupt: a signal came; jobs that are under way are stopped.

        """
        assert self._set_up is not None  # noqa: S101 - Hydra calls setup
        context, function, config = self._set_up
        setup_globals()
        configure_log(config.hydra.hydra_logging, config.hydra.verbose)
        check_types(SlurmSettings, self._values, "hydra.launcher.")
        settings = SlurmSettings(**self._values)
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
            contextlib.closing(_run(jobs, settings, folder.resolve())) as ended,
        ):
            for number, result in ended:
                results[number] = result
                show(len(results))
        return [results[job.number] for job in jobs]


def _run(jobs: Sequence[Job], settings: SlurmSettings, folder: Path) -> Generator[tuple[int, JobReturn], None, None]:
    """Run jobs, and yield the number and the result of each, in any order; closed, stop those under way."""
    submitted = dict(zip((job.number for job in jobs), _submit(jobs, settings, folder), strict=True))
    _log.info(f"Output of the jobs: {folder / '.submitit'}")
    waiting, by_number = _Waiting(settings.cluster), {job.number: job for job in jobs}
    try:
        while submitted:
            states = waiting.states(list(submitted.values()))
            for number, handle in list(submitted.items()):
                result = _result(by_number[number], handle, states.get(handle.job_id))
                if result is not None:
                    del submitted[number]
                    yield number, result
            time.sleep(_LOOK if submitted else 0)
    finally:
        _stop(list(submitted.values()), settings.cluster)


def _submit(jobs: Sequence[Job], settings: SlurmSettings, folder: Path) -> Sequence[Any]:
    """Submit jobs, and return submitit's handles of them."""
    import submitit  # noqa: PLC0415 - plugins have to be importable without

    place = folder / ".submitit"
    try:
        executor = submitit.AutoExecutor(
            place / "%j",
            cluster=settings.cluster,
            **{f"{settings.cluster}_max_num_timeout": settings.max_num_timeout},
        )
        executor.update_parameters(
            name="dsr",
            timeout_min=settings.timeout_min,
            gpus_per_node=settings.gpus_per_node,
            tasks_per_node=settings.tasks_per_node,
            cpus_per_task=settings.cpus_per_task,
            mem_gb=settings.mem_gb,
            slurm_partition=settings.partition,
            slurm_account=settings.account,
            slurm_qos=settings.qos,
            slurm_constraint=settings.constraint,
            slurm_signal_delay_s=settings.signal_delay_s,
            slurm_array_parallelism=settings.array_parallelism,
            slurm_setup=settings.setup,
            slurm_additional_parameters=settings.additional_parameters,
        )
        with contextlib.redirect_stderr(io.StringIO()):  # sbatch's words come with its error
            handles = executor.submit_array(list(jobs))
            first = [handle.task(0) for handle in handles]  # of several processes of a job it has the result
    except (RuntimeError, OSError, subprocess.SubprocessError) as error:  # no Slurm, or sbatch refuses
        shutil.rmtree(place, ignore_errors=True)
        raise ConfigError(f"hydra/launcher={_NAME}: {_refusal(error)}") from error
    return first


def _refusal(error: Exception) -> str:
    """Return why jobs could not be submitted, one line: what sbatch says."""
    said = [line for line in str(error).splitlines() if "error:" in line]
    return said[-1].strip() if said else one_line(error)


def _stop(handles: Sequence[Any], cluster: str) -> None:
    """Stop jobs; processes on this machine are waited for."""
    for handle in handles:
        handle.cancel(check=False)
    deadline = time.monotonic() + _STOP
    while cluster == "local" and time.monotonic() < deadline and not all(handle.done() for handle in handles):
        time.sleep(0.05)


class _Waiting:
    """Asks Slurm what its jobs do, seldom; ``sacct``, which submitit asks, is not on every cluster."""

    def __init__(self, cluster: str) -> None:
        self._cluster = cluster
        self._begun = self._asked = time.monotonic()
        self._without_result: dict[str, int] = {}
        self._logged: set[str] = set()

    def states(self, handles: Sequence[Any]) -> Mapping[str, str]:
        """Return the states of jobs that have certainly ended without a result, by their numbers."""
        now = time.monotonic()
        fewest, most = _ASK
        if now - self._asked < min(most, max(fewest, (now - self._begun) / 2)):
            return {}
        self._asked = now
        if self._cluster == "slurm":
            answer = _slurm_states([handle.job_id for handle in handles])
            self._log_reasons([reason for state, reason in answer.values() if state == "PENDING"])
            states = {name: state for name, (state, _) in answer.items()}
        else:
            states = {handle.job_id: handle.state for handle in handles if handle.done()}
        ended = {name: state for name, state in states.items() if state in _ENDED or self._cluster != "slurm"}
        self._without_result = {name: self._without_result.get(name, 0) + 1 for name in ended}
        return {name: state for name, state in ended.items() if self._without_result[name] >= _CONFIRMATIONS}

    def _log_reasons(self, reasons: Sequence[str]) -> None:
        """Log why jobs are pending, once for each reason; some, such as ``PartitionConfig``, do not pass."""
        for reason in dict.fromkeys(reasons):
            if reason not in self._logged | _NO_REASONS:
                self._logged.add(reason)
                _log.info(f"Jobs pending in Slurm: {reasons.count(reason)} ({reason})")


def _slurm_states(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the states of jobs, and Slurm's reason, by their numbers; nothing if Slurm does not answer now."""
    arrays = ",".join(sorted({name.partition("_")[0] for name in names}))
    command = ["squeue", "--noheader", "--array", "--states=all", "--format=%F %K %T %r", f"--jobs={arrays}"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired):
        return {}
    if answer.returncode and "Invalid job id" not in answer.stderr:
        return {}
    rows = [line.split(maxsplit=3) for line in answer.stdout.splitlines()]
    states = {
        f"{array}_{task}" if task.isdecimal() else array: (state, "".join(reason))
        for array, task, state, *reason in rows
    }
    return {name: states.get(name, ("COMPLETED", "")) for name in names}  # Slurm forgets them minutes after their end


def _result(job: Job, handle: Any, state: str | None) -> JobReturn | None:
    """Return the result of a job; None if it has none yet."""
    if handle.paths.result_pickle.exists():
        try:
            result: JobReturn = handle.result()
        except Exception as error:
            return job.ended(f"{one_line(error)}; see {handle.paths.stderr}")
        return result
    if state is None:
        return None
    return job.ended(f"ended without a result ({state}); what it finished is kept; see {handle.paths.stderr}")
