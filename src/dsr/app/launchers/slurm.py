"""Sweeps as job arrays of Slurm, through submitit."""

from __future__ import annotations

import contextlib
import io
import logging
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hydra.core.utils import JobReturn

from dsr.app.launchers.jobs import Ended, Job, JobsLauncher
from dsr.utils.builder import ConfigError
from dsr.utils.console import one_line

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
class _Resumable:
    """A job that submitit may requeue: it finds what it has done in its run directory."""

    job: Job

    def __call__(self) -> JobReturn:
        return self.job()

    def checkpoint(self) -> Any:
        """Return what is run instead when the job is requeued: the same."""
        from submitit.helpers import DelayedSubmission  # noqa: PLC0415 - plugins have to be importable without

        return DelayedSubmission(self)


class SlurmLauncher(JobsLauncher):
    """Submits the jobs of a sweep as an array, waits for them, and takes them back if it is interrupted."""

    def __init__(self, **values: Any) -> None:
        super().__init__(SlurmSettings, values)

    def _run(self, jobs: Sequence[Job], settings: SlurmSettings, folder: Path) -> Ended:
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
            handles = executor.submit_array([_Resumable(job) for job in jobs])
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
    """Asks Slurm what its jobs do, seldom, as it serves many; ``sacct``, which submitit asks, is not on every cluster.

    Args:
        cluster: Slurm or local.

    """

    def __init__(self, cluster: str) -> None:
        self._cluster = cluster
        self._begun = self._asked = time.monotonic()
        self._without_result: dict[str, int] = {}
        self._told: set[str] = set()

    def states(self, handles: Sequence[Any]) -> Mapping[str, str]:
        """Return the states of jobs that have certainly ended without a result, by their numbers."""
        now = time.monotonic()
        fewest, most = _ASK
        if now - self._asked < min(most, max(fewest, (now - self._begun) / 2)):
            return {}
        self._asked = now
        if self._cluster == "slurm":
            answer = _slurm_states([handle.job_id for handle in handles])
            self._tell([reason for state, reason in answer.values() if state == "PENDING"])
            states = {name: state for name, (state, _) in answer.items()}
        else:
            states = {handle.job_id: handle.state for handle in handles if handle.done()}
        ended = {name: state for name, state in states.items() if state in _ENDED or self._cluster != "slurm"}
        self._without_result = {name: self._without_result.get(name, 0) + 1 for name in ended}
        return {name: state for name, state in ended.items() if self._without_result[name] >= _CONFIRMATIONS}

    def _tell(self, reasons: Sequence[str]) -> None:
        """Tell why jobs are pending, once for each reason; some, such as ``PartitionConfig``, do not pass."""
        for reason in dict.fromkeys(reasons):
            if reason not in self._told | _NO_REASONS:
                self._told.add(reason)
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
    """Return the result of a job; None if it has none yet.

    Args:
        job: the job.
        handle: submitit's.
        state: the scheduler's word for what has become of it, if it has ended.

    """
    if handle.paths.result_pickle.exists():
        try:
            result: JobReturn = handle.result()
        except Exception as error:
            return job.ended(f"{one_line(error)}; see {handle.paths.stderr}")
        return result
    if state is None:
        return None
    return job.ended(f"ended without a result ({state}); what it finished is kept; see {handle.paths.stderr}")
