"""Weights of networks: which file a method takes, and dsr's files, ``.safetensors`` with what rebuilds the network.

The node ``weights`` of a method's configuration is a file or directory alone, or has these keys. ``path``: a file, or
a directory with published files. ``packaged``: the name of weights that come with dsr, or the factors of several by
their names. ``file``: the name of the published file in a directory; ``files``: the factors of several by their names.
``source``: where the published files are from, for messages.
"""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from dsr.methods.networks.network import DisparityNetwork
from dsr.methods.weights import left_out, packaged_names, packaged_weights
from dsr.utils.configuration import ConfigError
from dsr.utils.guards import expect_bytes, opened, parse_json, refusing
from dsr.utils.ratios import round_ratio

SLACK = 1.05  # by how much a scale may exceed the factor of weights that are used for it
_NODE = ("file", "files", "packaged", "path", "source")
FORMAT = "dsr-network-1"
_KEY = "dsr"
_SHARED: Final = "shared"
_DAMAGED = "expected a safetensors file, got a damaged one"
_LARGEST_ARGUMENT = 4096  # largest whole number among the arguments of a network in a file of weights
Link = Literal["shared", "clean", "soft"]
LINKS: Mapping[Link, str] = MappingProxyType(
    {
        _SHARED: "whose layers it shares",
        "clean": "for box means without noise",
        "soft": "for bicubic maps without noise, with soft depth steps",
    }
)  # keys of the files beside a file that it names, and what they are for


def find_weights(node: Any, scale: float, method: str) -> Path:
    """Return the file of weights for a factor, else raise a ConfigError; ``method`` is its name, for messages."""
    node = node if isinstance(node, Mapping) else {"path": node}
    if unknown := [key for key in node if key not in _NODE]:
        raise ConfigError(f"weights.{unknown[0]}: unknown key; expected {', '.join(_NODE)}")
    published = [node["file"]] if node.get("file") else []
    if files := node.get("files"):
        trained = nearest_scale(files.values(), scale)
        published = [str(file) for file, factor in files.items() if factor == trained]
    if node.get("path") is not None:
        given = Path(str(node["path"])).expanduser()
        candidates = [given / file for file in published] if given.is_dir() else [given]
        for path in candidates:
            if path.is_file():
                return path
        if candidates:
            first = candidates[0]
            raise ConfigError(f"weights: method={method}: expected a file of weights, got {first} (no such file)")
    packaged = node.get("packaged")
    factors = packaged if isinstance(packaged, Mapping) else {packaged: 1} if packaged else {}
    there = {path: factor for name, factor in factors.items() if (path := packaged_weights(str(name))) is not None}
    if there:
        nearest = nearest_scale(there.values(), scale / SLACK)
        return next(path for path, factor in there.items() if factor == nearest)
    raise ConfigError(f"weights: method={method}: {_where_to_get(node, scale, published)}")


def _where_to_get(node: Mapping[str, Any], scale: float, published: list[str]) -> str:
    packaged, needs = node.get("packaged"), f"scale {round_ratio(scale)} needs weights=FILE"
    if published:
        needs += f", or a directory with {published[0]} (from {node.get('source')})"
    if published and packaged is None:
        return f"{needs}; its authors publish them, dsr does not come with them"
    if isinstance(packaged, str) and packaged in left_out():
        return f"{packaged} does not come with this installation; `dsr data get weights`, or weights=FILE"
    return f"dsr comes with {', '.join(packaged_names())}; {needs}"


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
    """Return the trained factor that suits a factor: itself, else the smallest whole one above, or the largest."""
    if scale in trained:
        return scale
    whole = [each for each in trained if float(each).is_integer()]
    return min((each for each in whole if each >= scale), default=max(whole))


def save_network(
    path: Path,
    net: DisparityNetwork,
    model: str,
    facts: Mapping[str, Any] | None = None,
    *,
    half: bool = False,
    links: Mapping[str, Path] = MappingProxyType({}),
) -> None:
    """Write a network's weights, not atomically; equal networks and facts give equal bytes.

    ``model`` is its name in ``conf/model``, ``half`` stores the kernels of convolutions in half precision, ``links``
    are other files in the same folder by keys of ``LINKS``: tensors that the ``shared`` one has are not written again.
    """
    header = {
        "format": FORMAT,
        "network": network_name(type(net)),
        "arguments": net.arguments(),
        "model": model,
        "facts": dict(facts or {}),
        **{key: other.name for key, other in links.items()},
    }
    shared = _read_tensors(links[_SHARED]) if _SHARED in links else {}
    tensors = {}
    for name, value in net.state_dict().items():
        dtype = torch.float16 if half and value.dim() > 1 else value.dtype
        tensor, there = value.detach().to("cpu", dtype).contiguous(), shared.get(name)
        if there is None or there.dtype != dtype or not torch.equal(there, tensor):
            tensors[name] = tensor
    # save_file would make a file that nobody else can read
    path.write_bytes(safetensors.torch.save(tensors, {_KEY: json.dumps(header, sort_keys=True)}))


def network_name(network: type[DisparityNetwork]) -> str:
    """Return the name of a class in weights files: the plain name within the package, else the dotted path."""
    inside = network.__module__.partition(".")[0] == __name__.partition(".")[0]
    return network.__name__ if inside else f"{network.__module__}.{network.__qualname__}"


def is_dsr_weights(path: Path) -> bool:
    """Return whether a file starts like a safetensors file; the published networks' files do not."""
    with opened(path) as file:
        return file.read(9)[8:] == b"{"


def read_header(path: Path) -> dict[str, Any]:
    """Read the metadata of a dsr weights file: ``network``, ``arguments``, ``model``, ``facts``."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    with refusing(f"{path}: {_DAMAGED}", Exception), safetensors.safe_open(path, framework="pt") as file:
        metadata = file.metadata() or {}
    try:
        header = dict(parse_json(metadata[_KEY]))
        if header["format"] == FORMAT and header.keys() >= {"network", "arguments", "model"}:
            return header
    except (KeyError, ValueError, TypeError):
        pass
    raise ValueError(f"{path}: expected weights that train.py wrote, got safetensors with {metadata or 'no facts'}")


def load_network(
    path: Path, networks: Mapping[str, type[DisparityNetwork]], scale: int | None = None, model: str | None = None
) -> DisparityNetwork:
    """Load the network of a dsr weights file on the CPU; it has to be of the scale and model that are given."""
    path = Path(path)
    header = read_header(path)
    if model is not None and header["model"] != model:
        raise ValueError(f"{path}: expected weights of model {model}, got those of {header['model']}")
    shared = linked_weights(path, _SHARED)
    came = f"{header['network']} of {header['arguments']}"
    message = f"{path}: expected one of the networks {', '.join(networks)}, got {came}"
    with refusing(message, KeyError, TypeError, ValueError):
        kind, arguments = networks[header["network"]], dict(header["arguments"])
        if scale is not None and kind.serves(arguments["scale"], scale):
            arguments["scale"] = scale
        net = make_network(path, kind, arguments, shared)
    if scale is not None and net.scale != scale:
        raise ValueError(f"{path}: weights are for scale {net.scale}, the run is at scale {scale}")
    needed = net.state_dict().keys()
    tensors = {} if shared is None else {name: each for name, each in _read_tensors(shared).items() if name in needed}
    load_parameters(net, {**tensors, **_read_tensors(path)}, path, f"{header['network']} at scale {net.scale}")
    return net


def files_of_weights(path: Path) -> list[Path]:
    """Return a file of weights and those beside it that it needs; one that is not dsr's is alone."""
    if not is_dsr_weights(path):
        return [path]
    found: list[Path | None] = [path]
    for key in LINKS:
        other = linked_weights(path, key)
        if other is not None:
            found += [other, linked_weights(other, _SHARED)]
    return [file for file in dict.fromkeys(found) if file is not None]


def linked_weights(path: Path, key: Link) -> Path | None:
    """Return the file that a file of weights names by a key of ``LINKS``, if any, in its own folder."""
    name = read_header(path).get(key)
    if name is None:
        return None
    other = path.with_name(Path(str(name)).name)
    if not other.is_file():
        raise FileNotFoundError(f"{path}: expected {other.name} beside it, {LINKS[key]}; there is none")
    return other


def make_network(
    path: Path, kind: type[DisparityNetwork], arguments: Mapping[str, Any], shared: Path | None = None
) -> DisparityNetwork:
    """Return a network without values, or one of the user's with random ones, which may need them as it is made.

    A ValueError if it would be larger than the file that names its arguments, with the one that it shares layers of.
    """
    if any(isinstance(value, int) and abs(value) > _LARGEST_ARGUMENT for value in arguments.values()):
        raise ValueError(f"{path}: expected sizes of a network of at most {_LARGEST_ARGUMENT}")
    if kind.__module__.partition(".")[0] != __name__.partition(".")[0]:
        with torch.random.fork_rng(devices=[]):  # the initial weights draw random numbers
            return kind(**arguments)
    with torch.device("meta"):  # takes no memory
        net = kind(**arguments)
    count = sum(value.numel() for value in net.parameters())
    expect_bytes(path, count, sum(file.stat().st_size for file in (path, shared) if file is not None))
    return net


def _read_tensors(path: Path) -> dict[str, Tensor]:
    with refusing(f"{path}: {_DAMAGED}", Exception):
        return dict(safetensors.torch.load(path.read_bytes()))


def load_parameters(net: nn.Module, tensors: Mapping[str, Tensor], path: Path, expected: str) -> None:
    """Load the tensors of a file into a network that ``expected`` describes; a ValueError names one that is wrong."""
    own = net.state_dict()
    problems = [f"{name} is missing" for name in own if name not in tensors]
    problems += [f"{name!r} is unexpected" for name in tensors if name not in own]
    for name in (name for name in own if name in tensors):
        value, shape = tensors[name], tuple(own[name].shape)
        if tuple(value.shape) != shape:
            problems.append(f"{name} has shape {tuple(value.shape)} instead of {shape}")
        elif not value.is_floating_point() or not bool(value.isfinite().all()):
            problems.append(f"{name} holds values other than finite real numbers")
    if problems:
        found = problems[0] if len(problems) == 1 else f"{problems[0]}, and {len(problems) - 1} more do not fit"
        raise ValueError(f"{path}: expected the tensors of {expected}, but {found}")
    net.load_state_dict({name: value.float().contiguous() for name, value in tensors.items()}, assign=True)
