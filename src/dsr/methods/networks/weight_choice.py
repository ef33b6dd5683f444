"""Which file of weights a method takes: what the node ``weights`` of its configuration says.

The node is a file or directory alone, or has these keys. ``path``: a file, or a directory with published files.
``packaged``: the name of weights that come with dsr, or the factors of several by their names. ``file``: the name of
the published file in a directory; ``files``: the factors of several by their names. ``source``: where the published
files are from, for messages.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from dsr.methods.networks.weight_files import is_dsr_weights, read_header
from dsr.methods.weights import left_out, packaged_names, packaged_weights
from dsr.utils.configuration import ConfigError
from dsr.utils.ratios import round_ratio

SLACK = 1.05  # by how much a scale may exceed the factor of weights that are used for it
_KEYS = ("file", "files", "packaged", "path", "source")


def find_weights(node: Any, scale: float, method: str) -> Path:
    """Return the file of weights for a factor; ``method`` is its name, for messages.

    Raises:
        ConfigError: there is none; it says where to get it.

    """
    node = node if isinstance(node, Mapping) else {"path": node}
    unknown = next((key for key in node if key not in _KEYS), None)
    if unknown is not None:
        raise ConfigError(f"weights.{unknown}: unknown key; expected {', '.join(_KEYS)}")
    given = None if node.get("path") is None else Path(str(node["path"])).expanduser()
    published = [node["file"]] if node.get("file") else []
    if files := node.get("files"):
        trained = nearest_scale(files.values(), scale)
        published = [str(file) for file, factor in files.items() if factor == trained]
    if given is not None and given.is_dir() and published:
        given = next((given / file for file in published if (given / file).is_file()), given / published[0])
    if given is not None and not given.is_dir():
        if not given.is_file():
            raise ConfigError(f"weights: method={method}: expected a file of weights, got {given} (no such file)")
        return given
    packaged = node.get("packaged")
    if isinstance(packaged, Mapping):
        there = {str(name): factor for name, factor in packaged.items() if packaged_weights(str(name)) is not None}
        nearest = nearest_scale(there.values(), scale / SLACK) if there else None
        found = next((packaged_weights(name) for name, factor in there.items() if factor == nearest), None)
    else:
        found = None if packaged is None else packaged_weights(packaged)
    if found is not None:
        return found
    from_authors = f", or a directory with {published[0]} (from {node.get('source')})" if published else ""
    needs = f"scale {round_ratio(scale)} needs weights=FILE{from_authors}"
    if published and packaged is None:
        text = f"{needs}; its authors publish them, dsr does not come with them"
    elif isinstance(packaged, str) and packaged in left_out():
        text = f"{packaged} does not come with this installation; `dsr data get weights`, or weights=FILE"
    else:
        text = f"dsr comes with {', '.join(packaged_names())}; {needs}"
    raise ConfigError(f"weights: method={method}: {text}")


def has_weights(node: Any, scale: float) -> bool:
    """Return whether there are weights for a factor, for which a file of dsr's that the node names has to be made."""
    try:
        found = find_weights(node, scale, "")
    except ConfigError:
        return False
    named = node.get("path") if isinstance(node, Mapping) else node
    if named is None or Path(str(named)).expanduser().is_dir() or not is_dsr_weights(found):
        return True
    return bool(read_header(found)["arguments"].get("scale") == scale)


def nearest_scale(trained: Collection[float], scale: float) -> float:
    """Return the trained factor whose weights suit a factor: itself, else the smallest whole one above, or the largest.

    Weights for a factor that is not whole were trained on one sensor's maps and suit no others.
    """
    if scale in trained:
        return scale
    whole = [each for each in trained if float(each).is_integer()]
    return min((each for each in whole if each >= scale), default=max(whole))
