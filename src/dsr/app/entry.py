"""Running a Hydra command so that whatever is wrong ends as one line on stderr and exit code 2."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.app.schema import ConfigError, register

USAGE_ERROR = 2
INTERRUPTED = 130


def run_command(conf: Path, name: str, command: Callable[[DictConfig], Any]) -> None:
    """Compose the configuration ``name`` of the directory ``conf`` from the command line, and run the command on it.

    Exits with 2 and one line on stderr when the configuration cannot be run, with 130 when interrupted.

    Args:
        conf: Hydra's configuration directory.
        name: without ``.yaml``.
        command: what to run; a multirun calls it once per combination.

    """
    register()
    if not conf.is_dir():
        fail(f"{conf}: expected the directory of the configuration files; run the command in a checkout of the project")
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # exceptions arrive here instead of being printed by Hydra
    failures: list[str] = []

    def job(config: DictConfig) -> None:
        try:
            command(config)
        except ConfigError as error:  # a multirun goes on with its other jobs
            failures.append(str(error))
            print_error(str(error))

    try:
        hydra.main(version_base="1.3", config_path=str(conf.resolve()), config_name=name)(job)()
    except KeyboardInterrupt:
        print("interrupted; what is finished is kept, the same command goes on from there", file=sys.stderr)  # noqa: T201
        sys.exit(INTERRUPTED)
    except (HydraException, OmegaConfBaseException) as error:
        fail(explain(error, conf, name))
    if failures:
        sys.exit(USAGE_ERROR)


def print_error(message: str) -> None:
    """Print one line on stderr."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr, flush=True)  # noqa: T201


def fail(message: str) -> None:
    """Print one line on stderr and exit with 2."""
    print_error(message)
    sys.exit(USAGE_ERROR)


def explain(error: Exception, conf: Path, name: str) -> str:
    """Return what is wrong with a configuration, on one line, with the choices where a name is mistyped."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None:
        group, _, choice = str(error.missing_cfg_file).rpartition("/")
        files = sorted(path.stem for path in (conf / group).glob("*.yaml")) if group else []
        if files:
            return f"{group}={choice}: unknown; expected one of {', '.join(files)}"
        groups = ", ".join(sorted(path.name for path in conf.iterdir() if path.is_dir()))
        return f"{group or choice}: no such group of choices; expected one of {groups}"
    text = " ".join(str(error).split())
    cause = error.__cause__
    key = re.search(r"Could not override '([^']+)'", text)
    if key:
        if cause is not None and "not in struct" not in str(cause) and "not in '" not in str(cause):
            return f"{key[1]}: {_first_line(cause)}"
        return f"{key[1]}: unknown key; expected {', '.join(_siblings(key[1], conf, name))}"
    value = re.match(r"Error merging override (\S+?)=", text)
    if value and cause is not None:
        return f"{value[1]}: {_first_line(cause)}"
    return text


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _siblings(key: str, conf: Path, name: str) -> Sequence[str]:
    """Return the keys that stand where ``key`` was looked for."""
    overrides = [argument for argument in sys.argv[1:] if re.match(rf"({'|'.join(_groups(conf))})=[\w-]+$", argument)]
    with hydra.initialize_config_dir(str(conf.resolve()), version_base="1.3"):
        node: Any = hydra.compose(name, overrides)
    for part in key.split(".")[:-1]:
        child = OmegaConf.select(node, part)
        if not isinstance(child, DictConfig):
            break
        node = child
    prefix = key.rpartition(".")[0]
    return [f"{prefix}.{child}" if prefix else str(child) for child in node if child != "target"]


def _groups(conf: Path) -> list[str]:
    return [path.name for path in conf.iterdir() if path.is_dir()]
