"""Methods that are trained networks: ours, whose weights come with the package, and the published ones."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from types import MappingProxyType

import torch

from dsr.methods.networks.base import DisparityNetwork, NetworkUpsampler, Precision
from dsr.methods.networks.dg import DynamicGuidance
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.msg_guidance import VariantName
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.published import load_msg_weights
from dsr.methods.networks.weight_files import is_ours, load_network

NETWORKS: MappingProxyType[str, type[DisparityNetwork]] = MappingProxyType(
    {"MSGNet": MSGNet, "Facets": Facets, "PrimalDualNetwork": PrimalDualNetwork, "DynamicGuidance": DynamicGuidance}
)

_OUR_ENSEMBLE = 4


def build_trained(
    weights: Path,
    scale: int,
    model: str,
    variant: VariantName | None = None,
    precision: Precision = "float32",
    device: torch.device | str = "cpu",
    ensemble: int | None = None,
    networks: Mapping[str, type[DisparityNetwork]] = NETWORKS,
) -> NetworkUpsampler:
    """Return the method with the weights of a file.

    Args:
        weights: a file of ours, or one of the published ones where there is a ``variant``.
        scale: the scale of the run.
        model: the model that our files must be of.
        variant: the variant of MSG-Net that published files must be of.
        precision: of the convolutions.
        device: where to compute.
        ensemble: see :class:`~dsr.methods.networks.base.NetworkUpsampler`; None for 4 with a file of ours and 1 with a
            published one, as it was published.
        networks: the classes that files of ours may name, by :func:`~dsr.methods.networks.weight_files.network_name`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or of another model, variant or scale; the ensemble is impossible.

    """
    weights = Path(weights)
    ours = variant is None or (weights.is_file() and is_ours(weights))
    net = load_network(weights, networks, scale, model) if ours else load_msg_weights(weights, scale, variant)
    if ensemble is None:
        ensemble = _OUR_ENSEMBLE if ours else 1
    return NetworkUpsampler(net, precision, device, ensemble)


def packaged_weights(name: str) -> Path | None:
    """Return the file ``name.safetensors`` of the weights that come with the package; None if there is none."""
    path = Path(str(resources.files("dsr.methods.weights"))) / f"{name}.safetensors"
    return path if path.is_file() else None


def packaged_names() -> list[str]:
    """Return the names of the weights that come with the package."""
    return sorted(path.stem for path in Path(str(resources.files("dsr.methods.weights"))).glob("*.safetensors"))
