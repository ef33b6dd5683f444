"""Reading of the weights that the networks' authors publish: torch files of tensors, from which no code is executed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from dsr.methods.networks.peers.base import PeerNetwork
from dsr.methods.networks.weight_files import load_parameters, read_torch_file

_PARALLEL = "module."
"""Prefix of the names in files of networks that were trained on several GPUs."""
_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")


def load_peer(path: Path, network: type[PeerNetwork], scale: float) -> PeerNetwork:
    """Load a network of its authors' file, in float32 on the CPU.

    Args:
        path: path of the file.
        network: the network's class.
        scale: the factor that the weights were trained for.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, holds other Python objects than tensors, or is of another network.

    """
    tensors = network.convert(read_tensors(path))
    with torch.device("meta"):  # without memory and random numbers
        net = network(scale)
    load_parameters(net, tensors, path, network.title)
    return net


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read the tensors of an authors' file by name, without the prefix of networks trained on several GPUs.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or holds other Python objects than tensors.

    """
    content = read_torch_file(path)
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        keys = ", ".join(map(str, list(content)[:4])) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{path}: expected a network's tensors by name, got {keys}")
    return {str(name).removeprefix(_PARALLEL): value for name, value in content.items()}


def rename(tensors: Mapping[str, Tensor], names: Mapping[str, str]) -> dict[str, Tensor]:
    """Return tensors by new names.

    Args:
        tensors: tensors by name.
        names: replacements of regular expressions, applied one after the other to every name.

    """
    renamed = {}
    for name, value in tensors.items():
        for pattern, replacement in names.items():
            name = re.sub(pattern, replacement, name)  # noqa: PLW2901 - each replaces its part
        renamed[name] = value
    return renamed


def fold_batch_norm(tensors: dict[str, Tensor], conv: str, norm: str, eps: float = 1e-5) -> None:
    """Merge a batch normalisation, as evaluation runs it, into the convolution before it.

    Args:
        tensors: content of a file; the convolution's are replaced and the normalisation's removed, unless one is
            missing or of another shape.
        conv: name of the convolution, which has a bias.
        norm: name of the batch normalisation.
        eps: constant that the normalisation adds to the variance.

    """
    weight, bias = (tensors.get(f"{conv}.{part}") for part in ("weight", "bias"))
    parts = [tensors.get(f"{norm}.{part}") for part in _NORM_PARTS]
    if weight is None or bias is None or weight.dim() != 4:
        return
    known = [part for part in parts if part is not None and part.shape == bias.shape == weight.shape[:1]]
    if len(known) < len(_NORM_PARTS):
        return
    gain, shift, mean, variance = (part.double() for part in known)
    factor = gain / (variance + eps).sqrt()
    tensors[f"{conv}.weight"] = (weight * factor[:, None, None, None]).float()
    tensors[f"{conv}.bias"] = ((bias - mean) * factor + shift).float()
    for part in (*_NORM_PARTS, "num_batches_tracked"):
        tensors.pop(f"{norm}.{part}", None)
