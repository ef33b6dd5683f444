"""Run a Hydra command so that every error ends as one line on stderr and exit code 2.

torch and Lightning take seconds to import. A command's module is therefore imported only after its configuration has
been composed and checked, so that a mistyped argument is reported immediately.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from dsr.app.experiments import register_resolvers, with_keys_of_swept_groups, without_overridden_sweeps
from dsr.app.explain import explain, explain_arguments, explain_choice, explain_damage
from dsr.app.gpus import count_gpus, take_gpu
from dsr.app.multirun import Check, JobResult, Plan, collected_jobs, expect_launcher, failure_summary, job_name
from dsr.app.schema import SEVERAL, EvalConfig, TrainConfig, plain_config, register
from dsr.utils import interruption
from dsr.utils.configuration import ConfigError, config_directories, list_choices
from dsr.utils.console import USAGE_ERROR, one_line, print_error
from dsr.utils.files import FullDiskError, space_for
from dsr.utils.memory import OutOfMemoryError, refusing_excess

_LIST = re.compile(r"(^|,)\s*\[")
"""Where a list begins in the value of an argument, or in one of several that -m runs."""


def run_eval(arguments: Sequence[str] | None = None) -> None:
    """Run ``eval.py``, which is ``dsr eval``, with the given arguments or those of the process."""
    run_command("eval", _evaluate, arguments, _check_evaluation)


def run_train(arguments: Sequence[str] | None = None) -> None:
    """Run ``train.py``, which is ``dsr train``, with the given arguments or those of the process."""
    run_command("train", _train, arguments, _check_training)


def _evaluate(config: DictConfig) -> float:
    EvalConfig.of(plain_config(config))
    from dsr.app.evaluate import evaluate, objective  # noqa: PLC0415 - they import torch

    return objective(evaluate(config))


def _train(config: DictConfig) -> float:
    TrainConfig.of(plain_config(config))
    from dsr.app.train import train  # noqa: PLC0415 - it imports torch

    return train(config)


def _check_evaluation(config: DictConfig) -> list[Plan]:
    EvalConfig.of(plain_config(config))
    from dsr.app.evaluate import plan  # noqa: PLC0415 - it imports torch

    return plan(config)


def _check_training(config: DictConfig) -> list[Plan]:
    TrainConfig.of(plain_config(config))
    from dsr.app.train import plan  # noqa: PLC0415 - it imports torch

    return plan(config)


def run_command(
    name: str,
    command: Callable[[DictConfig], Any],
    arguments: Sequence[str] | None = None,
    check: Check | None = None,
) -> None:
    """Compose a configuration from the command line, and run the command on it.

    Exits with 2 and one line on stderr when the configuration cannot be run, with 130 or 143 when interrupted. A
    multirun is refused if one of its jobs cannot be run, with a line for each that cannot; if one fails later, the
    others go on, and lines at the end say which ones failed.

    Args:
        name: the configuration's name, without ``.yaml``.
        command: the function to run; a multirun calls it once per combination. If it returns a number, sweepers
            minimise it.
        arguments: command-line arguments, Hydra's options and overrides; None for those of the process.
        check: of each job of a multirun before the first one begins; None for no check.

    """
    register()
    register_resolvers()
    OmegaConf.register_new_resolver("gpus", count_gpus, replace=True)
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    arguments = ["trust=true" if argument == "--trust" else argument for argument in arguments]
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra then raises exceptions instead of printing them
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # Hydra would show when it caches fonts
    try:
        directories = config_directories(_config_dirs(arguments))
        expect_launcher(arguments)
    except ValueError as error:
        fail(str(error))
    _expect_choices(name, arguments, directories)
    arguments = with_keys_of_swept_groups(without_overridden_sweeps(arguments, directories), directories)
    process = sys.argv
    failed: list[str] = []  # of this process; those of a launcher's processes come back with their jobs
    begun: list[bool] = []
    job = _job(command, process, failed, begun)
    with collected_jobs(check) as jobs:
        try:
            with _argv([process[0], *arguments]), space_for(Path("outputs")):  # parsed by Hydra
                hydra.main(version_base="1.3", config_path=str(directories[0]), config_name=name)(job)()
        except KeyboardInterrupt as interrupted:
            sys.exit(interruption.stop(str(interrupted)))
        except (HydraException, OmegaConfBaseException) as error:
            fail(explain(error, name, arguments, directories) or explain_damage(error, directories))
        except (ConfigError, FullDiskError) as error:  # of a launcher
            fail(one_line(error))
        except (OSError, YAMLError, ValueError, RecursionError) as error:
            if begun and not isinstance(error, OSError):  # of the command
                raise
            named = begun or getattr(error, "filename", None) is not None
            fail(one_line(error) if named else explain_damage(error, directories))
        finally:
            summary = failure_summary(jobs)
            for line in summary:
                print_error(line)
    if failed or summary:
        sys.exit(USAGE_ERROR)


def _job(
    command: Callable[[DictConfig], Any], argv: list[str], failed: list[str], begun: list[bool]
) -> Callable[[DictConfig], JobResult]:
    """Return the function that Hydra calls for each job, perhaps in a process of a launcher."""
    pid = os.getpid()

    def job(config: DictConfig) -> JobResult:
        if os.getpid() != pid:
            register_resolvers()
            if os.getppid() == pid:  # of a launcher on this machine
                interruption.end_with(pid)
                take_gpu(Path(HydraConfig.get().sweep.dir))
        try:
            begun.append(True)
            with _argv(_argv_of_job(argv)), interruption.requeued(), interruption.working(), refusing_excess():
                value = command(config)
            return JobResult(value if isinstance(value, int | float) else 0.0)
        except (ConfigError, OSError, FullDiskError, OutOfMemoryError) as error:  # a multirun goes on with the others
            problem = one_line(error)
            failed.append(problem)
            print_error(": ".join(filter(None, (job_name(), problem))))
            return JobResult.failed(problem)

    return job


def _argv_of_job(argv: list[str]) -> list[str]:
    """Return the arguments that run the current job alone: those of the process, or of a multirun's job."""
    hydra_config = HydraConfig.get()
    if hydra_config.mode != RunMode.MULTIRUN:
        return argv
    own = [part for path in _config_dirs(argv[1:]) for part in ("--config-dir", str(path))]
    command = argv[1:2] if argv[1:2] in (["train"], ["eval"]) else []  # of dsr
    return [argv[0], *command, *own, *hydra_config.overrides.task]


def fail(message: str) -> NoReturn:
    """Print one line on stderr and exit with 2."""
    print_error(message)
    sys.exit(USAGE_ERROR)


def _expect_choices(name: str, arguments: Sequence[str], directories: Sequence[Path]) -> None:
    """Exit if the command line names a choice that does not exist, or removes a required one."""
    problem = explain_arguments(arguments)
    if problem is not None:
        fail(problem)
    defaults = OmegaConf.load(directories[0] / f"{name}.yaml").defaults
    groups = {str(key) for entry in defaults if isinstance(entry, DictConfig) for key in entry} | {"experiment"}
    elsewhere = any(argument.startswith("hydra.searchpath=") for argument in arguments)  # there may be further choices
    for argument in arguments:
        key, equals, choice = argument.partition("=")
        group, at, _ = key.lstrip("+").partition("@")
        if _LIST.search(choice) and group in {*groups, "hydra/launcher", "hydra/sweeper"} - {*SEVERAL}:
            each = f"; -m {key}=A,B runs each of several" if group in groups else ""
            each += f", metrics.protocols={choice} computes all of them" if group == "metrics" else ""
            fail(f"{argument}: expected one choice, got a list{each}")
        if equals and not at and not elsewhere and group in groups and key != "experiment":
            _expect_choice(argument, group, choice, directories)


def _expect_choice(argument: str, group: str, choice: str, directories: Sequence[Path]) -> None:
    """Exit if ``choice``, or one of several separated by commas or in lists, is not a file of the group."""
    choices = list_choices(group, directories)
    if choice in ("", "null"):
        fail(f"{argument}: expected one of {', '.join(choices)}")
    for each in re.split(r"[\[\],\s]+", choice.strip("[] ")):
        if re.fullmatch(r"[\w.+-]+", each) and each not in choices:
            fail(explain_choice(group, each, directories))


def _config_dirs(arguments: Sequence[str]) -> list[Path]:
    """Return the user's directory of configuration files, which Hydra's option names."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--config-dir", "-cd", type=Path, nargs="?")
    given = parser.parse_known_args(arguments)[0].config_dir
    return [] if given is None else [given]


@contextlib.contextmanager
def _argv(arguments: list[str]) -> Iterator[None]:
    """Replace ``sys.argv`` within the context."""
    before, sys.argv = sys.argv, arguments
    try:
        yield
    finally:
        sys.argv = before
