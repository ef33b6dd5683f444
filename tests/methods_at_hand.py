"""The methods by what they need: all that dsr has, or files that a user brings."""

from dsr.methods.recipe import list_methods, read_recipe

PEERS = [name for name in list_methods() if "weights_files" in read_recipe(name).node]
"""Those whose weights their authors have."""


def _is_open(name: str) -> bool:
    weights = read_recipe(name).node.get("weights", {"packaged": None})
    return "???" in read_recipe(name).at(4).values() or (name not in PEERS and "packaged" not in weights)


OPEN = [name for name in list_methods() if _is_open(name)]  # Those that a user names files for
AT_HAND = [name for name in list_methods() if name not in (*PEERS, *OPEN)]
