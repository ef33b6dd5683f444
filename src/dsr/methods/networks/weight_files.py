"""Files of our own networks' weights: ``.safetensors`` with the few facts that rebuild the network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from dsr.methods.networks.base import DisparityNetwork

FORMAT = "dsr-network-1"
_KEY = "dsr"


def save_network(path: Path, net: DisparityNetwork, model: str, facts: Mapping[str, Any] | None = None) -> None:
    """Write a network's weights; equal networks and facts give equal bytes.

    Args:
        path: the file; written as it is, wrap it for atomicity.
        net: the network.
        model: its name in ``conf/model/``, such as ``msg_v``.
        facts: more that a reader may want to know, as plain values: data, steps, scores.

    """
    head = {
        "format": FORMAT,
        "network": network_name(type(net)),
        "arguments": net.arguments(),
        "model": model,
        "facts": dict(facts or {}),
    }
    tensors = {name: value.detach().cpu().contiguous() for name, value in net.state_dict().items()}
    safetensors.torch.save_file(tensors, path, {_KEY: json.dumps(head, sort_keys=True)})


def network_name(network: type[DisparityNetwork]) -> str:
    """Return how a file of weights names a class: the package's by its name, others by their dotted path."""
    inside = network.__module__.partition(".")[0] == __name__.partition(".")[0]
    return network.__name__ if inside else f"{network.__module__}.{network.__qualname__}"


def is_ours(path: Path) -> bool:
    """Return whether a file looks like one of ours rather than like one of the published networks'."""
    with path.open("rb") as file:
        return file.read(9)[8:] == b"{"


def read_head(path: Path) -> dict[str, Any]:
    """Return what a file of ours says of its network: ``network``, ``arguments``, ``model``, ``facts``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged or none of ours.

    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except Exception as error:  # the library names no set of errors for damaged files
        raise ValueError(f"{path}: expected a safetensors file, got a damaged one ({type(error).__name__})") from error
    try:
        head = dict(json.loads(metadata[_KEY]))
        if head["format"] == FORMAT and head.keys() >= {"network", "arguments", "model"}:
            return head
    except (KeyError, ValueError, TypeError):
        pass
    raise ValueError(f"{path}: expected weights that train.py wrote, got safetensors with {metadata or 'no facts'}")


def load_network(
    path: Path, networks: Mapping[str, type[DisparityNetwork]], scale: int | None = None, model: str | None = None
) -> DisparityNetwork:
    """Return the network of a file of ours, float32, on the CPU.

    Args:
        path: the file.
        networks: the classes that there are, by name.
        scale: the scale that the run needs, None for any.
        model: the model that the run needs, None for any.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, none of ours, or of another model, scale or architecture.

    """
    path = Path(path)
    head = read_head(path)
    if model is not None and head["model"] != model:
        raise ValueError(f"{path}: expected weights of model {model}, got those of {head['model']}")
    try:
        with torch.random.fork_rng(devices=[]):  # its first weights, replaced below, draw from the generator
            net = networks[head["network"]](**head["arguments"])
    except (KeyError, TypeError, ValueError) as error:
        known = ", ".join(networks)
        raise ValueError(
            f"{path}: expected one of the networks {known}, got {head['network']} of {head['arguments']}"
        ) from error
    if scale is not None and net.scale != scale:
        raise ValueError(f"{path}: weights are for scale {net.scale}, the run is at scale {scale}")
    try:
        tensors = safetensors.torch.load(path.read_bytes())
    except Exception as error:  # the library names no set of errors for damaged files
        raise ValueError(f"{path}: expected a safetensors file, got a damaged one ({type(error).__name__})") from error
    fill(net, tensors, path, f"{head['network']} at scale {net.scale}")
    return net


def fill(net: DisparityNetwork, tensors: Mapping[str, Tensor], path: Path, expected: str) -> None:
    """Give a network its parameters.

    Args:
        net: the network.
        tensors: by parameter name.
        path: of the file, for the message.
        expected: what it should hold, for the message.

    Raises:
        ValueError: a tensor is missing, unexpected, of another shape or kind, or not finite.

    """
    shapes = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    problems = _misfits(tensors, shapes)
    if problems:
        found = problems[0] if len(problems) == 1 else f"{problems[0]}, and {len(problems) - 1} more do not fit"
        raise ValueError(f"{path}: expected the tensors of {expected}, but {found}")
    net.load_state_dict({name: value.float().contiguous() for name, value in tensors.items()}, assign=True)


def _misfits(tensors: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Return what is wrong with the tensors, in words: missing, unexpected, of another shape or kind."""
    problems = [f"{name} is missing" for name in shapes if name not in tensors]
    problems += [f"{name!r} is unexpected" for name in tensors if name not in shapes]
    for name, value in ((name, tensors[name]) for name in shapes if name in tensors):
        if tuple(value.shape) != shapes[name]:
            problems.append(f"{name} has shape {tuple(value.shape)} instead of {shapes[name]}")
        elif not value.is_floating_point() or not bool(value.isfinite().all()):
            problems.append(f"{name} holds values other than finite real numbers")
    return problems
