"""Choose how an evaluation runs its method: itself, or at another scale than it is made for."""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

import torch

from dsr.app.schema import EvalConfig, user_directories
from dsr.inference.adapter import AnyScale, takes_scale
from dsr.methods.networks.weight_files import files_of_weights
from dsr.methods.registry import find_weights, has_weights
from dsr.utils.builder import ConfigError, takes
from dsr.utils.console import note_once
from dsr.utils.hashing import file_hash


def adapt_method(settings: EvalConfig, device: torch.device) -> AnyScale | None:
    """Return the method as ``dsr upsample`` runs it, None for one that takes the scale itself.

    Raises:
        ConfigError: the method rejects a setting, or has no weights.

    """
    node, given = settings.method, _given_weights(settings)
    lacks = settings.measured and given is None and node.get("weights_packaged") is not None
    if takes_scale(node, settings.scale) and not (lacks and not has_weights(node, settings.scale)):
        return None
    try:
        return AnyScale(node, user_directories(), device, given)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from error


def weights_of(settings: EvalConfig) -> Path | None:
    """Return the file of weights for the method; None for a method without weights."""
    given = _given_weights(settings)
    if takes("method", settings.method, "weights"):
        return find_weights(settings.method, settings.scale, given)
    if given is not None and not given.is_dir():  # a directory serves all methods of a multirun
        name = settings.method["name"]
        note_once(f"method={name} has no weights; weights={given} is not used")
    return None


def hash_weights(files: list[Path]) -> str | None:
    """Return the SHA-256 of a file of weights, or of those of several and of those that they need; None without any.

    Raises:
        ConfigError: one is missing or damaged.

    """
    try:
        hashes = [_hash(each, each.stat()) for file in files for each in files_of_weights(file)]
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from error
    if len(hashes) < 2:
        return next(iter(hashes), None)
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


@functools.cache
def _hash(path: Path, _: os.stat_result) -> str:
    """Return the SHA-256 of a file, which jobs of a multirun share, as long as it is the same one."""
    return file_hash(path)


def _given_weights(settings: EvalConfig) -> Path | None:
    """Return the file or directory of weights that the configuration names."""
    return None if settings.weights is None else Path(settings.weights).expanduser()
