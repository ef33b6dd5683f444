"""The method that runs a published network of the field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import torch

from dsr.geometry.camera import RangeType
from dsr.methods.base import Abilities
from dsr.methods.networks.network import Precision
from dsr.methods.networks.peers.dctnet import DCTNet
from dsr.methods.networks.peers.dornet import DORNet
from dsr.methods.networks.peers.local_filters import FDKN, SVLRM
from dsr.methods.networks.peers.peer_network import PeerNetwork, PeerUpsampler, Range, load_peer
from dsr.methods.networks.peers.pgsr import PGSR
from dsr.methods.networks.weight_files import nearest_scale
from dsr.utils.configuration import Node
from dsr.utils.versions import file_hash

PEERS: MappingProxyType[str, type[PeerNetwork]] = MappingProxyType(
    {"dctnet": DCTNet, "dornet": DORNet, "fdkn": FDKN, "pgsr": PGSR, "svlrm": SVLRM}
)


class Peer(PeerUpsampler):
    """A method from a file of weights that the network's authors published.

    At a whole factor that the network was trained for, the file must be for that factor. At any other factor, such as a
    sensor's 8/3, any of its files may be taken.

    Args:
        peer: name of the network, a key of ``PEERS``.
        weights: the file.
        scale: the upsampling factor of the run.
        weights_files: the trained factors of the authors' files by their names.
        range: the ``value_range`` of :class:`~dsr.methods.networks.peers.peer_network.PeerUpsampler`.

    """

    @classmethod
    def abilities_of(cls, node: Node) -> Abilities:
        """Return the abilities of the network that a node names."""
        network = PEERS.get(str(node.get("peer")))
        return cls.abilities if network is None else replace(cls.abilities, cost=network.cost)

    def __init__(
        self,
        peer: str,
        weights: Path,
        scale: float,
        weights_files: Mapping[str, float],
        range_type: RangeType = "disparity",
        range: Range = "measured",  # noqa: A002 - the key's name
        precision: Precision = "float32",
        device: torch.device | str = "cpu",
    ) -> None:
        if peer not in PEERS:
            raise ValueError(f"peer: expected one of {', '.join(PEERS)}, got {peer!r}")
        network, weights = PEERS[peer], Path(weights)
        if not weights.is_file():
            raise FileNotFoundError(f"{weights}: no such weights file")
        named = (factor for name, factor in weights_files.items() if weights.as_posix().endswith(f"/{name}"))
        trained = network.checksums.get(file_hash(weights)[:16]) or next(named, None)
        if trained is not None and scale != trained and scale in weights_files.values() and float(scale).is_integer():
            raise ValueError(f"{weights}: weights are for scale {trained:g}, the run is at scale {scale:g}")
        net = load_peer(weights, network, trained or nearest_scale(weights_files.values(), scale))
        super().__init__(net, range_type, range, precision, device)
