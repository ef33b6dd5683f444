"""The directory of a run: named by its configuration, and never overwritten unless the user asks for it.

A name consists of the method or model, the scale, in evaluations the data set, the choices that are not the default,
the settings that the command line overrides, and the seed: ``msg_v_x8_w0.72_seed0``.
"""

import contextlib
import hashlib
import json
import os
import re
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from dsr.app.schema import NAMED, Config, Identity, user_directories
from dsr.utils import processes
from dsr.utils.configuration import ConfigError, config_directories
from dsr.utils.files import TargetError, expect_own, expect_target, write_text
from dsr.utils.guards import parse_json, read_limited
from dsr.utils.ratios import round_ratio
from dsr.utils.versions import RESULTS, SCENES, hash_outside_code, versions

IMPORTED = ("_target_", "network")  # keys whose value is imported
_RECORD = "versions.json"
# Arguments of a trainer that change no result.
_NO_BITS = ("log_every_n_steps", "profiler", "detect_anomaly", "enable_progress_bar", "enable_model_summary")
# Keys of a configuration that are not in a run's identity, which has the weights by their content.
_NOT_IDENTITY = ("output_dir", "overwrite", "metrics", "weights", "resume", "run", "trust", "workers", "threads",
                 "logger")  # fmt: skip
# Overrides that a name does not list: what is in it anyway, and what changes no result.
_IN_NAME = (*NAMED, "names.dataset", "scale", "seed")
_NOT_NAMED = {*_NOT_IDENTITY, "device"} - {"run"}
_LONGEST, _LONGEST_VALUE = 100, 60


def identity_of(
    config: Config, weights_hash: str | None, device: torch.device, targets: Iterable[str] = ()
) -> dict[str, Any]:
    """Return everything that a run's results depend on, as plain values: settings, weights, kind of device, code.

    Of the metrics it has how predictions are aligned before they are scored, where they are; the rest may change. The
    code counts by its numbers in :mod:`dsr.utils.versions`, the user's own classes, ``targets`` among them, by a hash.
    """
    kept = {key: value for key, value in config.items() if key not in _NOT_IDENTITY}
    if isinstance(kept.get("trainer"), Mapping):
        kept["trainer"] = {key: value for key, value in kept["trainer"].items() if key not in _NO_BITS}
    outside = hash_outside_code([*(target for _, target in imported(kept)), *targets])
    code = {"results_version": RESULTS, "scenes_version": SCENES}
    more = {} if outside is None else {"outside_code": outside}
    if (alignment := config.get("metrics", {}).get("alignment", "none")) != "none":
        more["alignment"] = alignment
    return {**kept, "device": device.type, "weights_sha256": weights_hash, **code, **more}


def imported(config: Config) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the key and the value of all entries that are imported, those of ``metrics.extra`` included."""
    for key, value in entries_of(config):
        metric = key[:2] == ("metrics", "extra") and not isinstance(value, list)
        if value is not None and (key[-1] in IMPORTED or metric):
            yield key, str(value)


def entries_of(node: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the key and the value of all entries of a configuration."""
    entries = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
    for name, value in entries:
        key = (*above, str(name))
        yield key, value
        yield from entries_of(value, key)


def directory_of(kind: str, config: Config, identity: Identity, overrides: Sequence[str] = ()) -> Path:
    """Return ``output_dir``, or outputs/KIND/NAME for a run with these overrides of the command line.

    The first eight digits of the identity's hash follow where an override is too long to be shown, or where the
    directory of that name holds a run of another identity. Weights that were given are named by their hash.
    """
    if config["output_dir"]:
        return Path(config["output_dir"]).expanduser()
    head = "method" if kind == "eval" else "model"
    listed: Any = OmegaConf.load(config_directories()[0] / f"{kind}.yaml")
    usual = {group: name for each in listed["defaults"] if not isinstance(each, str) for group, name in each.items()}
    parts = [config["names"][head], f"x{round_ratio(config['scale'])}"]
    for group, name in config["names"].items():
        if group in usual and group != head and (name != usual[group] or (kind, group) == ("eval", "dataset")):
            parts.append(name)
    if config.get("weights") is not None and config.get("run") is None and identity["weights_sha256"] is not None:
        parts.append(f"weights-{str(identity['weights_sha256'])[:8]}")
    complete = True
    for key, _, value in sorted(each.lstrip("+").partition("=") for each in overrides):
        named = key == "metrics.alignment" or key.partition(".")[0] not in _NOT_NAMED
        if named and key not in _IN_NAME and not (key == "experiment" and _only_sweeps(value)):
            setting, whole = _setting(key, value)
            parts.append(setting)
            complete = complete and whole
    name = "_".join(map(str, parts))
    plain = Path("outputs", kind, f"{name[:_LONGEST]}_seed{config['seed']}")
    marked = plain.with_name(f"{plain.name}-{_hash_of(identity)[:8]}")
    free = not marked.is_dir() and _changes_in(plain, identity) == []
    return plain if complete and len(name) <= _LONGEST and free else marked


def _only_sweeps(experiment: str) -> bool:
    """Return whether an experiment has only ``hydra`` and ``defaults``, whose choices are in runs' names anyway."""
    files = (place / "experiment" / f"{experiment}.yaml" for place in config_directories(user_directories()))
    return any(file.is_file() and set(OmegaConf.load(file)) <= {"hydra", "defaults"} for file in files)


def _setting(key: str, value: str) -> tuple[str, bool]:
    """Return an override in short, and whether that is all of it."""
    text = value.strip("[]\"'").replace(",", "+")
    short = re.sub(r"[^\w.+-]+", "-", "-".join(Path(text).parts[-2:]))[:_LONGEST_VALUE].strip("-")
    name = f"no-{key[1:]}" if key.startswith("~") else key.rpartition(".")[2]
    joint = "-" if short and not re.match(r"[\d.]", short) else ""
    return f"{name}{joint}{short}", short == text


def _hash_of(identity: Identity) -> str:
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def _changes_in(folder: Path, identity: Identity) -> list[str] | None:
    """Return the keys in which the run in a directory differs; None if the directory holds something else."""
    if not folder.is_dir():
        return None if folder.exists() else []
    ours = (f".{Path(_RECORD).stem}-", processes.LOCKS)  # locks, and a record that another run is writing right now
    if all(path.name.startswith(ours) for path in folder.iterdir()):
        return []
    try:
        before = dict(parse_json(read_limited(folder / _RECORD), finite=False)["identity"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return _changes(before, json.loads(json.dumps(identity)))


def degradation_of(config: Config, *, assumes: bool = False) -> str:
    """Return the name of a run's degradation, as in ``scores.csv``: box, or box+gaussian_multiplicative-0.003.

    ``assumes``: whether the run's method assumes a downsampling model.
    """
    names = config["names"]
    if names.get("degradation", "plain") != "plain":
        return str(names["degradation"])
    parts = [str(names["downsampling"])]
    assumed = config["downsampling"].get("assumed")
    if assumes and assumed not in (None, parts[0]):
        parts.append(f"assumed-{assumed}")
    for group in ("noise", "holes"):
        if names.get(group, "none") != "none":
            settings_of = [value for key, value in config[group].items() if key != "_target_"]
            values = ["none" if value is None else f"{value:g}" for value in settings_of]
            parts.append("-".join((str(names[group]), *values)))
    return "+".join(parts)


def expect_free(folder: Path, config: Config, identity: Identity, tolerated: Sequence[str] = ()) -> list[str]:
    """Check that ``folder`` can become the directory of this run, and return the ``tolerated`` keys that differ."""
    try:
        expect_target(folder, folder=True)
        if folder.is_dir():
            expect_own(folder)
    except TargetError as error:
        raise ConfigError(f"output_dir: {error}") from error
    if config["overwrite"]:
        return []
    different = _changes_in(folder, identity)
    if different is None:
        raise ConfigError(f"output_dir: {folder} holds files of something else; another output_dir keeps them")
    changed = [key for key in different if key not in tolerated]
    if changed:
        cure = "another output_dir keeps it, overwrite=true replaces it"
        raise ConfigError(f"output_dir: {folder} holds a run with another {', '.join(changed)}; {cure}")
    return different


@contextlib.contextmanager
def at_work(
    folder: Path, config: Config, identity: Identity, tolerated: Sequence[str] = (), *, alone: bool = False
) -> Iterator[list[str]]:
    """Within this context ``folder`` is that of commands with these settings; if ``alone``, of this command only.

    ``config.yaml`` and ``versions.json`` are written to it. Yields the ``tolerated`` keys in which the run differs.
    """
    settings = (
        f"{socket.gethostname()} {os.getpid()}" if alone else _hash_of({**identity, "metrics": config["metrics"]})
    )
    record = {**versions(), "hash": _hash_of(identity), "identity": dict(identity)}
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(processes.at_work(folder, settings))
            different = expect_free(folder, config, identity, tolerated)
            write_text(folder / _RECORD, json.dumps(record, indent=1) + "\n")
            write_text(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(dict(config))))
        except processes.InUseError as error:
            raise ConfigError(f"output_dir: {error}") from error
        except OSError as error:
            came = f"{folder} ({error.strerror})"
            raise ConfigError(f"output_dir: expected a directory to write to, got {came}") from error
        yield different


def _changes(before: Config, now: Config, prefix: str = "") -> list[str]:
    changed = []
    for key in sorted(before.keys() | now.keys()):
        old, new = before.get(key), now.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            changed += _changes(old, new, f"{prefix}{key}.")
        elif old != new:
            changed.append(f"{prefix}{key}")
    return changed
