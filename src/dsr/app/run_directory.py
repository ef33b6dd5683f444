"""The directory of a run: named by its configuration, and never overwritten unless the user asks for it.

A name consists of the method or model, the scale, in evaluations the data set, the choices and settings that differ
from the defaults, and the seed: ``msg_v_x8_w0.72_seed0``. The defaults of a choice's settings are those of its file.
What a run computes, such as the weight ``w`` for ``loss.w=auto``, is not in its name.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import socket
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from dsr.app.composition import compose
from dsr.app.schema import NAMED, Config, Identity, given_keys, plain_config, user_directories
from dsr.app.trust import imported
from dsr.utils import locks
from dsr.utils.configuration import ConfigError, config_directories, list_choices
from dsr.utils.files import TargetError, expect_own, expect_target, write_text
from dsr.utils.guards import parse_json, read_limited
from dsr.utils.ratios import round_ratio
from dsr.utils.versions import RESULTS, SCENES, hash_outside_code, versions

_RECORD = "versions.json"
# Arguments of a trainer that change no result.
_NO_BITS = ("log_every_n_steps", "profiler", "detect_anomaly", "enable_progress_bar", "enable_model_summary")
# Keys of a configuration that are not in a run's identity, which has the weights by their content.
_NOT_IDENTITY = ("output_dir", "overwrite", "metrics", "weights", "resume", "run", "trust", "workers", "threads",
                 "logger")  # fmt: skip
# Keys that are no settings that differ: they are in each name, or a matter of the machine.
_ELSEWHERE = (*_NOT_IDENTITY, "names", "scale", "seed", "device", "precision")
_NO_SETTINGS = ("_target_", "_partial_", "validation_of", "weights_files")
_REFERENCE = re.compile(r"\$\{([a-z_][\w.]*)\}")  # a value that is that of another key
_LONGEST, _LONGEST_VALUE = 100, 60
_ABSENT = object()
_compose = functools.lru_cache(maxsize=256)(compose)  # its result is not to be changed


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


def default_directory(kind: str, config: Config, identity: Identity) -> Path:
    """Return outputs/KIND/NAME.

    The first eight digits of the identity's hash follow where the name does not say everything, or where the directory
    of that name holds a run of another identity. The same identity gives the same directory.
    """
    name, complete = _run_name(kind, config, identity)
    plain = Path("outputs") / kind / name
    marked = plain.with_name(f"{name}-{_hash_of(identity)[:8]}")
    return plain if complete and not marked.is_dir() and _changes_in(plain, identity) == [] else marked


def _run_name(kind: str, config: Config, identity: Identity) -> tuple[str, bool]:
    """Return the name of a run of ``eval`` or ``train``, and whether it has every setting that is not the default."""
    head = "method" if "method" in config else "model"
    places = config_directories(user_directories())
    listed: Any = OmegaConf.load(places[0] / f"{kind}.yaml")
    usual = {str(group): str(name) for each in listed["defaults"] if not isinstance(each, str)
             for group, name in each.items() if group in NAMED and group in config["names"]}  # fmt: skip
    chosen = {group: str(config["names"][group]) for group in usual}
    known = [f"{group}={name}" for group, name in chosen.items() if name in list_choices(group, places)]
    composed = _compose(kind, (*known, f"scale={config['scale']}"), places[1:])
    names = [name for group, name in chosen.items()
             if group != head and (name != usual[group] or (kind, group) == ("eval", "dataset"))]  # fmt: skip
    settings = [_setting(key, value) for key, value in _differing(config, composed, head).items()]
    if config.get("run") is not None:
        settings.append((_setting("run", Path(config["run"]).absolute().name)[0], False))
    elif identity["weights_sha256"] is not None and (
        config.get("weights") != plain_config(composed).get("weights")
        or any(key.startswith("method.weights") for key in given_keys())
    ):
        settings.append((f"weights-{str(identity['weights_sha256'])[:8]}", True))
    if "alignment" in identity:
        settings.append(_setting("alignment", identity["alignment"]))
    if "precision" in given_keys():
        settings.append((str(config["precision"]), True))
    begin = (config["names"][head], f"x{round_ratio(config['scale'])}")
    name = "_".join((*begin, *names, *(text for text, _ in settings)))
    complete = len(known) == len(chosen) and all(whole for _, whole in settings) and len(name) <= _LONGEST
    return f"{name[:_LONGEST]}_seed{config['seed']}", complete


def _differing(config: Config, composed: DictConfig, head: str) -> dict[str, Any]:
    """Return the settings that differ from the defaults, by the last part of their keys if it is the only one.

    The default of a value that is another key's, as in ``${loss.w}``, is what ``config`` has for that key.
    """
    found: dict[str, Any] = {}
    count: Counter[str] = Counter()

    def compare(key: str, value: Any, usual: Any, text: Any) -> None:
        if isinstance(text, str) and (reference := _REFERENCE.fullmatch(text)):
            usual = functools.reduce(lambda node, part: node[part], reference[1].split("."), config)
            if value == usual:
                return
        if not isinstance(value, Mapping) or ("." in key and "_target_" not in value):
            count[key.rpartition(".")[2]] += 1
            if value != usual and key.rpartition(".")[2] not in _NO_SETTINGS:
                found[key] = value
            return
        for name, inner in value.items():
            parts = (each.get(name, _ABSENT) if isinstance(each, Mapping) else _ABSENT for each in (usual, text))
            compare(f"{key}.{name}", inner, *parts)

    skipped = (*_ELSEWHERE, head) if config.get("run") is not None else _ELSEWHERE
    plain, texts = plain_config(composed), OmegaConf.to_container(composed, resolve=False)
    for group, node in config.items():
        if group not in skipped and isinstance(node, Mapping):
            compare(group, node, plain.get(group, {}), texts.get(group, {}))  # type: ignore[union-attr]
    ends = {key: key.rpartition(".")[2] for key in found}
    return {ends[key] if count[ends[key]] == 1 else key: value for key, value in found.items()}


def _setting(key: str, value: Any) -> tuple[str, bool]:
    """Return a setting in short, and whether that is all of it."""
    if isinstance(value, bool | None):
        return f"{key}-{'null' if value is None else str(value).lower()}", True
    if isinstance(value, int | float):
        return f"{key}{value}", True
    if isinstance(value, Mapping):
        return key, False
    text = value if isinstance(value, str) else "+".join(map(str, value))
    end = "-".join(Path(text).parts[-2:])
    short = re.sub(r"[^\w.+-]+", "-", end)[:_LONGEST_VALUE].strip("-")
    return f"{key}-{short}", short == text


def _hash_of(identity: Identity) -> str:
    """Return the hash of an identity."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def _changes_in(folder: Path, identity: Identity) -> list[str] | None:
    """Return the keys in which the run in a directory differs; None if the directory holds something else."""
    if not folder.is_dir():
        return None if folder.exists() else []
    ours = (f".{Path(_RECORD).stem}-", locks.LOCKS)  # locks, and a record that another run is writing right now
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
    """Check that ``folder`` can become the directory of this run, and return the ``tolerated`` keys that differ.

    Nothing is written. Something else that is there already is refused without ``overwrite``, as is a link that leads
    out of the directory.
    """
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
        raise ConfigError(
            f"output_dir: {folder} holds a run with another {', '.join(changed)}; "
            "another output_dir keeps it, overwrite=true replaces it"
        )
    return different


@contextlib.contextmanager
def at_work(folder: Path, config: Config, identity: Identity, *, alone: bool = False) -> Iterator[None]:
    """Within this context ``folder`` is that of commands with these settings; if ``alone``, of this command only."""
    settings = (
        f"{socket.gethostname()} {os.getpid()}" if alone else _hash_of({**identity, "metrics": config["metrics"]})
    )
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locks.at_work(folder, settings))
        except locks.InUseError as error:
            shared = "" if alone else " with other settings"
            raise ConfigError(
                f"output_dir: {error.owner} is at work in {folder}{shared}; wait for its end, or take another"
            ) from error
        except OSError as error:
            raise _unwritable(folder, error) from error
        yield


def _unwritable(folder: Path, error: OSError) -> ConfigError:
    """Return the error of a directory that cannot be written."""
    return ConfigError(f"output_dir: expected a directory to write to, got {folder} ({error.strerror})")


def claim(folder: Path, config: Config, identity: Identity, tolerated: Sequence[str] = ()) -> list[str]:
    """Write ``config.yaml`` and ``versions.json`` of this run into ``folder``, checked by :func:`expect_free`."""
    different = expect_free(folder, config, identity, tolerated)
    record = {**versions(), "hash": _hash_of(identity), "identity": dict(identity)}
    try:
        write_text(folder / _RECORD, json.dumps(record, indent=1) + "\n")
        write_text(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(dict(config))))
    except OSError as error:
        raise _unwritable(folder, error) from error
    return different


def _changes(before: Config, now: Config, prefix: str = "") -> list[str]:
    """Return the dotted keys whose values differ."""
    changed = []
    for key in sorted(before.keys() | now.keys()):
        old, new = before.get(key), now.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            changed += _changes(old, new, f"{prefix}{key}.")
        elif old != new:
            changed.append(f"{prefix}{key}")
    return changed
