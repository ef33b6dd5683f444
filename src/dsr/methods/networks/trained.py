"""The networks by the names in files of weights, and the method that runs one of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import torch

from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.dynamic_guidance import DynamicGuidance
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet, VariantName
from dsr.methods.networks.network import DisparityNetwork, NetworkUpsampler, Precision
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.published import load_msg_weights
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.methods.networks.weight_files import is_dsr_weights, load_network

_KINDS: tuple[type[DisparityNetwork], ...] = (
    MSGNet, Facets, FacetsUNet, PrimalDualNetwork, DynamicGuidance, SparseToDense, DDRNet,
)  # fmt: skip
NETWORKS: Mapping[str, type[DisparityNetwork]] = MappingProxyType({kind.__name__: kind for kind in _KINDS})


class TrainedNetwork(NetworkUpsampler):
    """A method from a file of weights.

    Args:
        weights: file that ``train.py`` wrote; or, with a ``variant``, one that the authors of MSG-Net published.
        scale: upsampling factor of the run.
        model: name of the model that dsr files must contain.
        variant: variant of MSG-Net that published files must contain.
        ensemble: number of test-time augmentations, see :class:`~dsr.methods.networks.network.NetworkUpsampler`; None
            for 4 with dsr files and 1 with published ones.
        networks: network classes by their :func:`~dsr.methods.networks.weight_files.network_name` in dsr files.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or of another model, variant or scale, or the ensemble is not supported.

    """

    def __init__(
        self,
        weights: Path,
        scale: int,
        model: str,
        variant: VariantName | None = None,
        precision: Precision = "float32",
        device: torch.device | str = "cpu",
        ensemble: int | None = None,
        networks: Mapping[str, type[DisparityNetwork]] = NETWORKS,
    ) -> None:
        weights = Path(weights)
        dsr = variant is None or (weights.is_file() and is_dsr_weights(weights))
        net = load_network(weights, networks, scale, model) if dsr else load_msg_weights(weights, scale, variant)
        super().__init__(net, precision, device, (4 if dsr else 1) if ensemble is None else ensemble)
