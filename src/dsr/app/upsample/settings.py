"""Parse arguments of methods from the command line, ``KEY=VALUE``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.utils.options import OptionError


def parse_settings(arguments: Sequence[str]) -> dict[str, Any]:
    """Parse arguments, with their values read as YAML.

    Args:
        arguments: ``KEY=VALUE`` each.

    Raises:
        OptionError: an argument is not of that form, or its value cannot be read.

    """
    settings: dict[str, Any] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not key.isidentifier():
            raise OptionError(argument, "expected KEY=VALUE")
        try:
            settings |= OmegaConf.to_container(OmegaConf.from_dotlist([f"{key}={value}"]), resolve=True)  # type: ignore[arg-type]
        except (yaml.YAMLError, OmegaConfBaseException) as error:
            raise OptionError(key, f"expected a value as in a YAML file, got {value!r}") from error
    return settings
