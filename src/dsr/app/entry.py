"""``train.py`` and ``eval.py`` as Hydra's commands: a mistake of the user is one line on stderr and exit code 2.

torch and Lightning take seconds to import. A command's module is therefore imported only after its configuration has
been composed and checked, so that a mistyped argument is reported immediately. A multirun is refused before its first
job begins if one of its jobs cannot be run, with a line for each of these.
"""

import copy
import functools
import importlib
import os
import re
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from dsr.app.schema import (
    EvalConfig,
    Identity,
    TrainConfig,
    explain_value,
    given_overrides,
    plain_config,
    register,
    user_directories,
)
from dsr.utils import interruption
from dsr.utils.configuration import ConfigError, config_directories
from dsr.utils.console import USAGE_ERROR, one_line, print_error
from dsr.utils.files import FullDiskError
from dsr.utils.guards import OutOfMemoryError, did_you_mean, refusing_excess


def module_of(name: str, config: DictConfig) -> Any:
    """Check the configuration of ``train`` or ``eval``, and return the module of the command, which imports torch."""
    kind, module = (TrainConfig, "train") if name == "train" else (EvalConfig, "evaluate")
    kind.of(plain_config(config))
    return importlib.import_module(f"dsr.app.{module}")


def run_command(name: str, command: Callable[[DictConfig], Any], arguments: Sequence[str] | None = None) -> None:
    """Compose a configuration from the command line, and run the command on it, in a multirun on each combination.

    Exits with 2 and one line on stderr if the configuration cannot be run, with 130 or 143 if interrupted. If a job of
    a multirun fails, the others of its batch go on. Sweepers minimise the number that the command returns.
    """
    register()
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra then raises exceptions instead of printing them
    begun: list[DictConfig] = []
    process = sys.argv
    sys.argv = process if arguments is None else [process[0], *arguments]  # parsed by Hydra
    try:
        place = str(config_directories()[0])
        hydra.main(version_base="1.3", config_path=place, config_name=name)(_job(command, process, begun))()
    except KeyboardInterrupt as interrupted:
        sys.exit(interruption.stop(str(interrupted)))
    except (HydraException, OmegaConfBaseException) as error:
        fail(_damaged_file() or explain(error))
    except (ConfigError, OSError, FullDiskError, YAMLError, BrokenExecutor) as error:
        fail(_damaged_file() or one_line(error))
    except (ValueError, RecursionError) as error:
        if begun:  # a defect of the command's
            raise
        fail(_damaged_file() or f"{' '.join(sys.argv[1:])}: {one_line(error)}")  # of Hydra's, which names no key
    finally:
        sys.argv = process


# ``eval.py``, which is ``dsr eval``, and ``train.py``, with the arguments that they get or those of the process
run_eval = functools.partial(run_command, "eval", lambda config: module_of("eval", config).evaluate(config))
run_train = functools.partial(run_command, "train", lambda config: module_of("train", config).train(config))


def _job(command: Callable[[DictConfig], Any], argv: list[str], begun: list[DictConfig]) -> Callable[[DictConfig], Any]:
    """Return the function that Hydra calls for each job, perhaps in a process of a launcher."""
    pid = os.getpid()

    def job(config: DictConfig) -> Any:
        if os.getpid() != pid:
            register()
            if os.getppid() == pid:  # of a launcher on this machine
                interruption.end_with(pid)
        begun.append(config)
        several, overrides = HydraConfig.get().mode == RunMode.MULTIRUN, given_overrides()
        sys.argv = argv  # what a training starts its further processes with
        if several:
            own = [f"--config-dir={place}" for place in user_directories()]
            sys.argv = [argv[0], *(each for each in argv[1:2] if each in ("train", "eval")), *own, *overrides]
        try:
            with refusing_excess():
                return command(config)
        except (ConfigError, OSError, FullDiskError, OutOfMemoryError) as error:
            problem = one_line(error)
            if not several:
                fail(problem)
            print_error(f"{' '.join(overrides)}: {problem}")
            raise ConfigError(f"a job failed, {' '.join(overrides)}: {problem}") from error

    return job


def fail(message: str) -> NoReturn:
    """Print one line on stderr and exit with 2."""
    print_error(message)
    sys.exit(USAGE_ERROR)


def _damaged_file() -> str:
    """Return why the user's configuration files cannot be read, one line; empty if they can."""
    folder = get_args_parser().parse_known_args(sys.argv[1:])[0].config_dir
    if folder is None:
        return ""
    if not Path(folder).is_dir():
        return f"--config-dir: expected a directory, got {folder}"
    for path in sorted(Path(folder).glob("*/*.yaml")):
        try:
            OmegaConf.load(path)
        except Exception as error:  # damaged YAML raises many types
            return f"{path}: expected a readable YAML file, got {type(error).__name__}"
    return ""


def explain(error: Exception) -> str:
    """Return the first sentence of an error of Hydra's or OmegaConf's, with the keys or choices that there are."""
    if isinstance(error, MissingConfigException) and error.options:
        group, _, choice = str(error.missing_cfg_file).rpartition("/")
        meant = did_you_mean(choice, error.options)
        if group in ("hydra/sweeper", "hydra/launcher"):
            meant += f"; others are plugins, such as pip install hydra-{choice}-{group.partition('/')[2]}"
        return f"{group}={choice}: unknown; expected one of {', '.join(error.options)}{meant}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: expected KEY=VALUE; special characters need quotes within quotes, 'KEY=\"VALUE\"'"
    cause: Any = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    override = re.search(r"(?:override|argument) '?([^\s=']+\w)", str(error))
    key = override[1] if override else str(getattr(cause, "full_key", None) or "")
    if str(error).startswith("Ambiguous value"):
        together = "metrics.protocols=[...] computes all of them" if key == "metrics" else f"{key}=[...] is a list"
        return f"{key}: expected one value, got several; -m runs each of them, {together}"
    if "No match in the defaults list" in str(error):
        return f"{key}: expected a choice that the command has; +{key}=... adds one"
    return explain_value(cause, key) if isinstance(cause, OmegaConfBaseException) else one_line(error)


class CheckJobs(Callback):
    """Hydra's callback that checks each job of a multirun of Hydra's own sweeper before the first one begins."""

    def on_multirun_start(self, config: DictConfig, config_name: str | None = None, **_: Any) -> None:
        """Exit with 2 if a job cannot be run."""
        if not str(config.hydra.sweeper._target_).endswith(".BasicSweeper"):
            return  # its jobs are not known beforehand
        loader: Any = GlobalHydra.instance().config_loader()
        given = [f"{key}={value}" for key, value in (config.hydra.sweeper.params or {}).items()]
        given += OmegaConf.to_container(config.hydra.overrides.task)  # type: ignore[arg-type]
        try:
            overrides = OverridesParser.create(loader).parse_overrides(given)
            [jobs] = BasicSweeper.split_arguments(overrides, None)
            composed = [(job, loader.load_sweep_config(config, job)) for job in jobs]
        except HydraException as error:
            fail(explain(error))
        problems: list[str] = []
        owners: dict[Path, Identity] = {}
        for job, whole in composed:
            HydraConfig.instance().set_config(whole)
            own = copy.deepcopy(whole)
            with read_write(own), open_dict(own):
                del own["hydra"]
            try:
                for folder, identity in module_of(str(config_name), own).check(own):
                    if owners.setdefault(folder.resolve(), identity) != identity:
                        raise ConfigError(f"output_dir: expected a directory for each job, got {folder} for several")
            except (ConfigError, OSError, OmegaConfBaseException) as error:
                problems.append(f"{' '.join(job)}: {one_line(error)}")
        if problems:
            print_error(f"{len(problems)} of the jobs cannot be run, so none is begun")
            for problem in problems:
                print_error(problem)
            sys.exit(USAGE_ERROR)
