"""Which file of weights a method takes: functions of the node that describes it, whose ``${scale}`` is resolved.

``weights`` names its file, or ``weights_packaged`` one that comes with dsr, or several and the factor of each. In a
directory, ``weights_file`` or one of ``weights_files`` is looked for.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from dsr.methods.networks.weight_files import is_dsr_weights, read_header
from dsr.utils.configuration import ConfigError
from dsr.utils.ratios import round_ratio

SLACK = 1.05
"""By how much a scale may exceed the factor of weights that are used for it."""


def find_weights(node: Mapping[str, Any], scale: float) -> Path:
    """Find the file of weights of a method that takes one.

    Args:
        node: the method's.
        scale: the upsampling factor.

    Raises:
        ConfigError: there is no such file.

    """
    given, files = _given(node), _files_for(node, scale)
    if given is None or (given.is_dir() and not files):
        found = _packaged_file(node, scale)
        if found is None:
            raise ConfigError(f"weights: {_lack(node, scale, files)}")
        return found
    if given.is_dir():
        given = next((given / file for file in files if (given / file).is_file()), given / files[0])
    if not given.is_file():
        name = node["name"]
        raise ConfigError(f"weights: expected a file of weights for method={name}, got {given} (no such file)")
    return given


def has_weights(node: Mapping[str, Any], scale: float) -> bool:
    """Return whether the weights that a method's node names are there, for that scale."""
    path, files = _given(node), _files_for(node, scale)
    if path is not None and path.is_dir() and files:
        return any((path / file).is_file() for file in files)
    if path is not None and not path.is_dir():
        return path.is_file() and (not is_dsr_weights(path) or read_header(path)["arguments"].get("scale") == scale)
    return _packaged_file(node, scale) is not None


def nearest_scale(trained: Collection[float], scale: float) -> float:
    """Return the trained factor whose weights suit a factor: itself, else the smallest whole one above, or the largest.

    Weights for a factor that is not whole were trained on one sensor's maps and suit no others.
    """
    if scale in trained:
        return scale
    whole = [each for each in trained if float(each).is_integer()]
    return min((each for each in whole if each >= scale), default=max(whole))


def packaged_weights(name: str) -> Path | None:
    """Return the path of the packaged weights ``name.safetensors``, or None if there are none."""
    path = Path(str(resources.files("dsr.methods.weights"))) / f"{name}.safetensors"
    return path if path.is_file() else None


def packaged_names() -> list[str]:
    """Return the names of the packaged weights."""
    return sorted(path.stem for path in Path(str(resources.files("dsr.methods.weights"))).glob("*.safetensors"))


def _given(node: Mapping[str, Any]) -> Path | None:
    """Return the file or directory of weights that a node names."""
    return None if node.get("weights") is None else Path(str(node["weights"])).expanduser()


def _lack(node: Mapping[str, Any], scale: float, files: list[str]) -> str:
    """Say which weights a method needs, and where they are."""
    published = f", or a directory with {files[0]} (from {node.get('weights_source')})" if files else ""
    needs = f"method={node['name']} at scale {round_ratio(scale)} needs weights=FILE{published}"
    if "weights_files" in node:
        return f"{needs}; its authors publish them, dsr does not come with them"
    return f"dsr comes with {', '.join(packaged_names())}; {needs}"


def _packaged_file(node: Mapping[str, Any], scale: float) -> Path | None:
    """Return the file of packaged weights, the one for a scale where the node names several by their factors."""
    packaged = node.get("weights_packaged")
    if isinstance(packaged, Mapping):
        there = {str(name): factor for name, factor in packaged.items() if packaged_weights(str(name)) is not None}
        nearest = nearest_scale(there.values(), scale / SLACK) if there else None
        packaged = next((name for name, factor in there.items() if factor == nearest), None)
    return None if packaged is None else packaged_weights(str(packaged))


def _files_for(node: Mapping[str, Any], scale: float) -> list[str]:
    """Return the names of published files with the weights for a scale, in order of preference."""
    files = node.get("weights_files")
    if files is None:
        return [str(node["weights_file"])] if node.get("weights_file") else []
    trained = nearest_scale(files.values(), scale)
    return [str(file) for file, factor in files.items() if factor == trained]
