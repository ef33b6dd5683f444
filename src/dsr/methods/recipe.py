"""A method before the factor is known: list, read and build the methods.

A method is a file of ``conf/method``, in the project's configuration or in a directory of the user's: its ``method`` is
a node whose ``_target_`` is the class that makes it; ``label`` is its name in tables. ``eval.py`` composes that file
with Hydra, :func:`read_recipe` without, which is faster.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import torch
import yaml
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.degradation.downsampling import Downsampling
from dsr.methods.base import Abilities, Method
from dsr.methods.networks.network import DisparityNetwork
from dsr.methods.networks.trained import NETWORKS, load_msg_weights
from dsr.methods.networks.weight_files import find_weights, has_weights, is_dsr_weights, load_network, network_name
from dsr.utils.configuration import ConfigError, Node, build, config_directories, list_choices, load_target
from dsr.utils.ratios import SCALES

_NETWORK = "network"  # key of a method's node: the dotted path of the network's class, for weights of a training
_ALONE: Mapping[str, Any] = {"scale": 4, "seed": 0, "downsampling": None}  # what a node may refer to without a run


class Known(NamedTuple):
    """Known properties of low-resolution maps: their kernel, their scenes' depth steps, no noise; None for unknown."""

    kernel: str | None = None
    edges: Literal["sharp", "soft"] | None = None
    clean: bool | None = None


@dataclass(frozen=True, kw_only=True)
class Run:
    """Settings of a run for its method, which gets those that the signature of its class names."""

    device: torch.device | str = "cpu"
    precision: str = "float32"
    seed: int = 0
    downsampling: Downsampling = field(default_factory=lambda: Downsampling("box"))
    known: Known = field(default_factory=Known)  # for arguments that the method's node leaves open, by null or ``auto``
    alignment: str = "none"  # of the predictions to the ground truth before scores
    # the rest is of :class:`~dsr.methods.dip.upsampler.DeepImagePrior`
    metrics: Any = None
    workspace: Path | None = None
    display: Any = None
    about: Mapping[str, str] | None = None
    lpips_trunk: str | Path | None = field(default_factory=lambda: os.environ.get("DSR_LPIPS_TRUNK"))


@dataclass(frozen=True, eq=False)
class Recipe:
    """A method before the factor is known."""

    name: str
    node: DictConfig  # its content, in which ``${scale}`` is not resolved
    directories: tuple[Path, ...] = ()  # of the user's configuration
    others: Mapping[str, Any] = field(default_factory=lambda: _ALONE)  # that the node may refer to, such as ``scale``
    settings: frozenset[str] = frozenset()  # keys that the caller has set
    label: str | None = None  # name in tables; None for ``name``
    _resolved: dict[float | None, dict[str, Any]] = field(default_factory=dict, init=False, repr=False)

    def at(self, factor: float | None = None) -> Node:
        """Return the node for a factor, as plain values; None for the run's scale as it is named."""
        if factor not in self._resolved:
            scale = {} if factor is None else {"scale": factor}
            try:
                config = OmegaConf.create({**self.others, **scale})
                config["method"] = self.node
                self._resolved[factor] = OmegaConf.to_container(config.method, resolve=True)  # type: ignore[assignment]
            except OmegaConfBaseException as error:
                raise ConfigError(f"method={self.name}: {str(error).splitlines()[0]}") from error
        return self._resolved[factor]

    @functools.cached_property
    def kind(self) -> type[Method]:
        """The method's class."""
        target = load_target("method", self.at())
        if not (isinstance(target, type) and issubclass(target, Method)):
            expected, came = f"{Method.__module__}.{Method.__name__}", self.at()["_target_"]
            raise ConfigError(f"method._target_: expected a class that derives from {expected}, got {came}")
        return target

    @functools.cached_property
    def abilities(self) -> Abilities:
        """What the method can do."""
        return self.kind.abilities_of(self.at())

    @functools.cached_property
    def factors(self) -> tuple[int, ...]:
        """The factors that it is made for; a ValueError if it has no weights for any."""
        if self.abilities.needs is None:
            return SCALES
        factors = tuple(scale for scale in SCALES if has_weights(self.at(scale).get("weights"), scale))
        if not factors:
            found = self.weights(4)  # raises an error that says where to get them, unless there are others
            raise ValueError(f"method={self.name}: expected weights for one of the factors {SCALES}, got {found}")
        return factors

    @functools.cached_property
    def of_run(self) -> tuple[str, ...]:
        """Keys of the node that a run gives in another way, of weights only to a method that needs a file."""
        return ("weights", "scale", "downsampling") if self.abilities.needs else ("scale", "downsampling")

    @property
    def computed_at(self) -> tuple[float, ...]:
        """Factors at which a method computes that takes a map of any size, if there are only some."""
        weights = self.at(4).get("weights")
        packaged = weights.get("packaged") if isinstance(weights, Mapping) else None
        return tuple(packaged.values()) if self.abilities.own_size and isinstance(packaged, Mapping) else ()

    def with_weights(self, path: Path | None) -> Recipe:
        """Return the method with a file of weights, or a directory with published ones; None for its own."""
        if path is None or self.abilities.needs is None:
            return self
        return replace(self, node=_merge(self.node, {"weights": {"path": str(path)}}))

    def weights(self, factor: float) -> Path | None:
        """Return the file of weights for a factor, else raise a ConfigError; None for a method that needs none."""
        if self.abilities.needs is None:
            return None
        return find_weights(self.at(factor).get("weights"), factor, self.name)

    def build(self, factor: float, run: Run | None = None, **decided: Any) -> Method:
        """Build the method for a factor; ``decided`` are arguments that the caller decides, not the method's file."""
        given = {**vars(run or Run()), "scale": factor}
        known = given.pop("known")._asdict()
        if self.abilities.needs is not None:
            given |= {"weights": self.weights(factor), "networks": self._networks}
        node = dict(self.at(factor))
        for key, value in known.items():
            if value is not None and node.get(key) in (None, "auto"):
                node.pop(key, None)
                given[key] = value
        for key in (*self.of_run, _NETWORK, *(decided.keys() - self.settings)):
            node.pop(key, None)
        method: Method = build("method", node, {**given, **decided}, self.name)
        return method

    def network(self, factor: int) -> DisparityNetwork:
        """Load the network of dsr that the method runs, in float32 on the CPU."""
        if self.abilities.needs != "network":
            names = list_methods(self.directories)
            known = [name for name in names if read_recipe(name, None, self.directories).abilities.needs == "network"]
            raise ConfigError(f"method: expected one with a network of dsr, {', '.join(known)}; got {self.name!r}")
        node = self.at(factor)
        path, variant = find_weights(node.get("weights"), factor, self.name), node.get("variant")
        if variant is not None and not is_dsr_weights(path):
            return load_msg_weights(path, factor, variant)
        return load_network(path, self._networks, factor, str(node["model"]))

    def targets(self) -> Iterator[str]:
        """Yield the dotted paths of the method's class and of its network's class."""
        if "_target_" in self.at():
            yield str(self.at()["_target_"])
        if (network := self._network_path()) is not None:
            yield network

    @functools.cached_property
    def _networks(self) -> dict[str, type[DisparityNetwork]]:
        """The network classes that weights may name: the package's, and the one that the configuration names."""
        path = self._network_path()
        if path is None:
            return dict(NETWORKS)
        network = load_target("model", {"_target_": path})
        return {**NETWORKS, network_name(network): network}

    def _network_path(self) -> str | None:
        """Return the dotted path of the class of the network, from the node or from ``conf/model``."""
        node, places = self.at(), config_directories(self.directories)
        if node.get(_NETWORK) is not None:
            return str(node[_NETWORK])
        model = node.get("model")
        if model is None or model not in list_choices("model", places):
            return None
        target = OmegaConf.select(_read_file("model", str(model), places), "net._target_")
        return None if target is None else str(target)


def list_methods(directories: Sequence[Path] = ()) -> list[str]:
    """Return the names of all methods."""
    return list_choices("method", config_directories(directories))


def read_recipe(name: str, settings: Mapping[str, Any] | None = None, directories: Sequence[Path] = ()) -> Recipe:
    """Read the file of a method; ``settings`` are arguments to change, by name."""
    places = config_directories(directories)
    names = list_choices("method", places)
    if name not in names:
        raise ConfigError(f"method: expected one of {', '.join(names)}, got {name!r}")
    try:
        content = _read_file("method", name, places)
        node, given = content.get("method", {}), dict(settings or {})
        if isinstance(given.get("weights"), str) and isinstance(node.get("weights"), DictConfig):
            given["weights"] = {"path": given["weights"]}
        node = _merge(node, given)
    except OmegaConfBaseException as error:
        raise ConfigError(f"method={name}: {str(error).splitlines()[0]}") from error
    label = str(content.get("label") or name)
    recipe = Recipe(name, node, tuple(directories), settings=frozenset(settings or {}), label=label)
    recipe.at()  # its error says what cannot be resolved
    return recipe


def _read_file(group: str, name: str, places: Sequence[Path], above: tuple[str, ...] = ()) -> DictConfig:
    """Return the content of a group's file, merged with the files of its ``defaults``."""
    path = next((path for place in places if (path := place / group / f"{name}.yaml").is_file()), None)
    if path is None or name in above:
        raise ConfigError(f"{group}: expected a readable file {name}.yaml, which {above[-1:] or group} begins with")
    try:
        own = OmegaConf.load(path)
    except (OSError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: expected a readable YAML file, got {type(error).__name__}") from error
    listed = own.pop("defaults", None) or [] if isinstance(own, DictConfig) else None
    if not isinstance(own, DictConfig) or not isinstance(listed, list | ListConfig):
        raise ConfigError(f"{path}: expected keys and values, with a list of names as defaults")
    if group == "method" and not isinstance(own.get(group), DictConfig):  # without "@package _global_"
        own = OmegaConf.create({group: own})
    names = list(listed) if "_self_" in listed else [*listed, "_self_"]
    parts = [own if each == "_self_" else _read_file(group, str(each), places, (*above, name)) for each in names]
    return _merge(*parts)


def _merge(*nodes: Mapping[str, Any]) -> DictConfig:
    return cast(DictConfig, OmegaConf.merge(*nodes))  # all have keys
