"""List, read and build the methods.

A method is a file of ``conf/method``, in the project's configuration or in a directory of the user's: its ``target`` is
the class or function that makes it, its other keys are the arguments. ``eval.py`` composes that file with Hydra;
everything else reads it with :func:`read_method`. Both then call :func:`build_method`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.methods.base import Upsampler
from dsr.methods.networks.base import DisparityNetwork
from dsr.methods.networks.peers.files import nearest_scale
from dsr.methods.networks.published import load_msg_weights
from dsr.methods.networks.trained import NETWORKS, packaged_names, packaged_weights
from dsr.methods.networks.weight_files import is_dsr_weights, load_network, network_name, read_header
from dsr.utils.builder import ConfigError, build, load_target, takes
from dsr.utils.config_files import config_directories, list_choices
from dsr.utils.ratios import round_ratio

SLACK = 1.05
"""By how much a scale may exceed the factor of weights that are used for it."""
_NETWORK = "network"
"""Key of a method's node: the dotted path of the network's class, for a method whose weights come from a training."""
_NETWORK_TARGETS = ("dsr.methods.networks.trained.build_trained", "dsr.methods.networks.any_map.build_any_map")
"""Targets of the methods that are one pass of a network of dsr."""
_OPEN = (None, "auto")
"""Values of a method's keys that leave them to what is known of the maps."""


def list_methods(directories: Sequence[Path] = ()) -> list[str]:
    """Return the names of all methods.

    Args:
        directories: the user's configuration directories.

    """
    return list_choices("method", config_directories(directories))


def read_method(
    name: str, scale: int, settings: Mapping[str, Any] | None = None, directories: Sequence[Path] = ()
) -> dict[str, Any]:
    """Read the node that describes a method, as plain values.

    Args:
        name: the method's name.
        scale: the upsampling factor, which ``${scale}`` stands for.
        settings: arguments to change, by name.
        directories: the user's configuration directories.

    Raises:
        ConfigError: there is no such method, or its file cannot be read.

    """
    places = config_directories(directories)
    names = list_choices("method", places)
    if name not in names:
        raise ConfigError(f"method: expected one of {', '.join(names)}, got {name!r}")
    config = OmegaConf.create({"scale": scale, "seed": 0})
    try:
        config["method"] = OmegaConf.merge(_read_file("method", name, places, ()), dict(settings or {}))
        plain: dict[str, Any] = OmegaConf.to_container(config, resolve=True)["method"]  # type: ignore[index,assignment,call-overload]
    except OmegaConfBaseException as error:
        raise ConfigError(f"method={name}: {str(error).splitlines()[0]}") from error
    return plain


def build_method(
    node: Mapping[str, Any],
    scale: int,
    *,
    directories: Sequence[Path] = (),
    weights: Path | None = None,
    told: Mapping[str, Any] | None = None,
    **given: Any,
) -> Upsampler:
    """Build the method that a node describes.

    Args:
        node: of :func:`read_method`, or the group ``method`` of a composed configuration.
        scale: the upsampling factor.
        directories: the user's configuration directories.
        weights: a file of weights, or a directory with the published files; None for those that the node names.
        told: what is known of the maps, such as ``kernel``; a target gets what its signature names and the node leaves
            open, by null or ``auto``.
        **given: values that the run sets, not the method's file, such as ``device``, ``precision``, ``seed`` and
            ``downsampling``, the assumed model; a target gets those that its signature names.

    Raises:
        ConfigError: a key is unknown, missing or of another type, the method rejects a value, or there are no weights.

    """
    trunk = os.environ.get("DSR_LPIPS_TRUNK")
    run = {**dict.fromkeys(("metrics", "workspace", "display", "about")), "lpips_trunk": trunk, "seed": 0}
    told = {key: value for key, value in (told or {}).items() if node.get(key) in _OPEN}
    available = {**run, **told, **given, "scale": scale}
    if takes("method", node, "weights"):
        available |= {"weights": find_weights(node, scale, weights), "networks": _networks(node, directories)}
    arguments = {key: value for key, value in node.items() if key not in ("weights", _NETWORK, *told)}
    method: Upsampler = build("method", arguments, available)
    return method


def find_weights(node: Mapping[str, Any], scale: int, given: Path | None = None) -> Path:
    """Find the file of weights of a method that takes one.

    Args:
        node: the method's; ``weights`` names its file, or ``weights_packaged`` one that comes with dsr, or several and
            the factor of each.
        scale: the upsampling factor.
        given: a file of weights, or a directory in which ``weights_file`` or one of ``weights_files`` is looked for;
            None for the node's own.

    Raises:
        ConfigError: there is no such file.

    """
    if given is None and node.get("weights") is not None:
        given = Path(str(node["weights"])).expanduser()
    files = _files_for(node, scale)
    if given is None or (given.is_dir() and not files):
        return _packaged(node, scale)
    if given.is_dir():
        given = next((given / file for file in files if (given / file).is_file()), given / files[0])
    if not given.is_file():
        name = node["name"]
        raise ConfigError(f"weights: expected a file of weights for method={name}, got {given} (no such file)")
    return given


def load_method_network(
    name: str, scale: int, *, directories: Sequence[Path] = (), weights: Path | None = None
) -> DisparityNetwork:
    """Load the network of a method, in float32 on the CPU.

    Args:
        name: the method's name.
        scale: the upsampling factor.
        directories: the user's configuration directories.
        weights: a file of weights, or a directory with the published files; None for those that the method names.

    Raises:
        ConfigError: there is no such method, it has no network of dsr, or there are no weights.
        FileNotFoundError: the weights share layers with a file that is missing.
        ValueError: the weights are damaged or of another model or scale.

    """
    node = read_method(name, scale, directories=directories)
    if node.get("target") not in _NETWORK_TARGETS:
        nodes = {each: read_method(each, scale, directories=directories) for each in list_methods(directories)}
        known = [each for each, other in nodes.items() if other.get("target") in _NETWORK_TARGETS]
        raise ConfigError(f"method: expected one with a network of dsr, {', '.join(known)}; got {name!r}")
    path, model = find_weights(node, scale, weights), str(node["model"])
    variant = node.get("variant")
    if variant is not None and not is_dsr_weights(path):
        return load_msg_weights(path, scale, variant)
    networks = _networks(node, directories)
    trained = read_header(path)["arguments"].get("scale")
    kind = networks.get(read_header(path)["network"])
    serves = kind is not None and trained is not None and kind.serves(trained, scale)
    return load_network(path, networks, None if serves else scale, model)


def has_weights(node: Mapping[str, Any], scale: int) -> bool:
    """Return whether the weights that a method's node names are there, for that scale."""
    path = None if node.get("weights") is None else Path(str(node["weights"])).expanduser()
    files = _files_for(node, scale)
    if path is not None and path.is_dir() and files:
        return any((path / file).is_file() for file in files)
    if path is not None and not path.is_dir():
        return path.is_file() and (not is_dsr_weights(path) or read_header(path)["arguments"].get("scale") == scale)
    return _packaged_file(node, scale) is not None


def target_paths(node: Mapping[str, Any], directories: Sequence[Path] = ()) -> Iterator[str]:
    """Yield the dotted paths of a method's class or function and of its network's class."""
    if "target" in node:
        yield str(node["target"])
    network = _network_path(node, directories)
    if network is not None:
        yield network


def _packaged(node: Mapping[str, Any], scale: float) -> Path:
    """Return the file of the weights that come with dsr."""
    found = _packaged_file(node, scale)
    if found is not None:
        return found
    files, source = _files_for(node, scale), node.get("weights_source")
    published = f", or a directory with {files[0]} (from {source})" if files else ""
    needs = f"method={node['name']} at scale {round_ratio(scale)} needs weights=FILE{published}"
    if "weights_files" in node:
        raise ConfigError(f"weights: {needs}; its authors publish them, dsr does not come with them")
    raise ConfigError(f"weights: dsr comes with {', '.join(packaged_names())}; {needs}")


def _packaged_file(node: Mapping[str, Any], scale: float) -> Path | None:
    """Return the file of packaged weights, the one for a scale where the node names several by their factors."""
    packaged = node.get("weights_packaged")
    if isinstance(packaged, Mapping):
        there = {str(name): factor for name, factor in packaged.items() if packaged_weights(str(name)) is not None}
        nearest = nearest_scale(there, scale / SLACK) if there else None
        packaged = next((name for name, factor in there.items() if factor == nearest), None)
    return None if packaged is None else packaged_weights(str(packaged))


def _files_for(node: Mapping[str, Any], scale: float) -> list[str]:
    """Return the names of published files with the weights for a scale, in order of preference."""
    files = node.get("weights_files")
    if files is None:
        return [str(node["weights_file"])] if node.get("weights_file") else []
    trained = nearest_scale(files, scale)
    return [str(file) for file, factor in files.items() if factor == trained]


def _networks(node: Mapping[str, Any], directories: Sequence[Path]) -> dict[str, type[DisparityNetwork]]:
    """Return the network classes that weights may name: the package's, and the one that the configuration names."""
    path = _network_path(node, directories)
    if path is None:
        return dict(NETWORKS)
    network = load_target("model", {"target": path})
    return {**NETWORKS, network_name(network): network}


def _network_path(node: Mapping[str, Any], directories: Sequence[Path]) -> str | None:
    """Return the dotted path of the class of a method's network, from its node or from ``conf/model``."""
    if node.get(_NETWORK) is not None:
        return str(node[_NETWORK])
    model, places = node.get("model"), config_directories(directories)
    if model is None or model not in list_choices("model", places):
        return None
    target = _read_file("model", str(model), places, ()).get("target")
    return None if target is None else str(target)


def _read_file(group: str, name: str, places: Sequence[Path], above: tuple[str, ...]) -> DictConfig:
    """Return the content of a group's file, merged with the files of its ``defaults``."""
    path = next(
        (place / group / f"{name}.yaml" for place in places if (place / group / f"{name}.yaml").is_file()), None
    )
    if path is None or name in above:
        wanted = f"a file {name}.yaml that {above[-1]}.yaml begins with" if above else f"a readable file {name}.yaml"
        raise ConfigError(f"{group}: expected {wanted}")
    try:
        own = OmegaConf.load(path)
    except (OSError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: expected a readable YAML file, got {type(error).__name__}") from error
    if not isinstance(own, DictConfig):
        raise ConfigError(f"{path}: expected keys and values")
    listed = own.pop("defaults", None)
    listed = ListConfig([]) if listed is None else listed
    if not isinstance(listed, ListConfig):
        raise ConfigError(f"{path}: defaults: expected a list of names, got {listed!r:.60}")
    defaults = [str(each) for each in listed]
    parts = [
        own if each == "_self_" else _read_file(group, each, places, (*above, name))
        for each in (defaults if "_self_" in defaults else [*defaults, "_self_"])
    ]
    merged = OmegaConf.merge(*parts)
    if not isinstance(merged, DictConfig):
        raise ConfigError(f"{path}: expected keys and values")
    return merged
