"""Sweeps on a Ray cluster, or on this machine through Ray."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn

from dsr.app.launchers.jobs import Ended, Job, JobsLauncher
from dsr.utils import interruption
from dsr.utils.builder import ConfigError
from dsr.utils.console import one_line

_NAME = "ray"
_VARIABLE = "RAY_ADDRESS"
_ADDRESS = re.compile(r"(?:ray://)?\[?(?P<host>[^/\[\]]+)\]?:(?P<port>[0-9]{1,5})")
"""Address of a cluster that is not found by Ray itself, as ``auto`` is."""
_PATIENCE = 10.0
"""Seconds after which a cluster that does not answer is not there; Ray itself waits for minutes."""
_LOOK = 1.0
"""Seconds after which waiting looks for signals."""


@dataclass(frozen=True)
class RaySettings:
    """See ``conf/hydra/launcher/ray.yaml``."""

    address: str | None
    num_cpus: float
    num_gpus: float | None
    memory_gb: float | None
    max_retries: int

    def __post_init__(self) -> None:
        for name in ("num_cpus", "num_gpus", "memory_gb"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise ConfigError(f"hydra.launcher.{name}: expected 0 or more, got {value}")
        if self.max_retries < -1:
            raise ConfigError(f"hydra.launcher.max_retries: expected -1 or more, got {self.max_retries}")


class RayLauncher(JobsLauncher):
    """Runs each job of a sweep as a task of Ray, again if its process or its node is lost."""

    def __init__(self, **values: Any) -> None:
        super().__init__(RaySettings, values)

    def _run(self, jobs: Sequence[Job], settings: RaySettings, folder: Path) -> Ended:
        import ray  # noqa: PLC0415 - plugins have to be importable without

        ours = not ray.is_initialized()
        if ours:
            _connect(ray, settings)
        try:
            options = _options(ray, settings)
            submitted = {
                ray.remote(_call).options(**options, name=f"job {job.number}").remote(job): job for job in jobs
            }
            while submitted:
                ready, _ = ray.wait(list(submitted), timeout=_LOOK)
                for reference in ready:
                    job = submitted.pop(reference)
                    yield job.number, _result(ray, reference, job)
        finally:
            if ours:
                ray.shutdown()  # ends the tasks that are left, too


def _call(job: Job) -> JobReturn:
    """Run a job in a process of Ray."""
    return job()


def _connect(ray: Any, settings: RaySettings) -> None:
    """Connect to the cluster, or start Ray on this machine."""
    given, variable = settings.address, os.environ.get(_VARIABLE)
    key, address = ("hydra.launcher.address", given) if given or not variable else (f"${_VARIABLE}", variable)
    try:
        if address is not None and (named := _ADDRESS.fullmatch(address)):
            socket.create_connection((named["host"], int(named["port"])), _PATIENCE).close()
        ray.init(address=given, include_dashboard=False, logging_level="warning")
    except (OSError, OverflowError, ValueError, RuntimeError) as error:
        raise ConfigError(f"{key}: no Ray cluster at {address}: {one_line(error)}") from error
    finally:
        interruption.reinstall()  # Ray takes SIGTERM


def _options(ray: Any, settings: RaySettings) -> dict[str, Any]:
    """Return what each task needs, on a cluster with GPUs one of them unless something else is asked for."""
    gpus = settings.num_gpus
    if gpus is None:
        gpus = 1 if ray.cluster_resources().get("GPU", 0) else 0
    memory = {} if settings.memory_gb is None else {"memory": settings.memory_gb * 1e9}
    needed = {"CPU": settings.num_cpus, "GPU": gpus, **memory}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(name, 0) >= amount for name, amount in needed.items()) for node in nodes):
        most = {name: max(node.get(name, 0) for node in nodes) for name in needed}
        raise ConfigError(
            f"hydra/launcher={_NAME}: no node has {_amounts(needed)}, which each job needs; there are up to "
            f"{_amounts(most)}"
        )
    return {"num_cpus": settings.num_cpus, "num_gpus": gpus, "max_retries": settings.max_retries, **memory}


def _amounts(resources: dict[str, float]) -> str:
    """Return amounts of resources for a reader."""
    return ", ".join(f"{amount:g} {name}" for name, amount in resources.items())


def _result(ray: Any, reference: Any, job: Job) -> JobReturn:
    """Return the result of a job that has ended."""
    try:
        result: JobReturn = ray.get(reference)
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None) or error
        return job.ended(f"{type(cause).__name__}: {one_line(cause)}; what it finished is kept")
    return result
