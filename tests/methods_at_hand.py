"""The methods by what they need: all that dsr has, or files that a user brings."""

from pathlib import Path

import torch

from dsr.methods.base import Method
from dsr.methods.networks.peers.peer import PEERS as PEER_NETWORKS
from dsr.methods.recipe import Run, list_methods, read_recipe

PEERS = [name for name in list_methods() if "weights_files" in read_recipe(name).node]
"""Those whose weights their authors have."""


def _is_open(name: str) -> bool:
    weights = read_recipe(name).node.get("weights", {"packaged": None})
    return "???" in read_recipe(name).at(4).values() or (name not in PEERS and "packaged" not in weights)


OPEN = [name for name in list_methods() if _is_open(name)]  # Those that a user names files for
AT_HAND = [name for name in list_methods() if name not in (*PEERS, *OPEN)]
SHORT = {"dip": {"steps": 2}, "dip_v": {"steps": 2}, "tgv": {"iterations": 20}, "srfs": {"iterations": 1}}
SLOW = {"eg", "srfs", "dip", "dip_v"}


def build(name: str, folder: Path, device: str | torch.device = "cpu") -> Method:
    """Return a method for x4, of few iterations; a peer's weights are random and lie in a folder."""
    recipe = read_recipe(name, SHORT.get(name))
    if name in PEERS:
        torch.manual_seed(0)
        torch.save(PEER_NETWORKS[name](4).state_dict(), folder / f"{name}.pth")
        recipe = recipe.with_weights(folder / f"{name}.pth")
    return recipe.build(4, Run(device=torch.device(device)))
