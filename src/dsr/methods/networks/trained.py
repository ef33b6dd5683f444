"""The networks by the names in files of weights, the method that runs one of them, and MSG-Net's published weights.

``.pth`` (Voynov et al. 2019) is read by torch's own unpickler for plain tensors, ``.caffemodel`` (Hui et al. 2016) by a
reader of the protobuf wire format (protobuf.dev/programming-guides/encoding). Neither executes code from a file.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from dsr.methods.networks.ddrnet import DDRNet
from dsr.methods.networks.dynamic_guidance import DynamicGuidance
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet, VariantName
from dsr.methods.networks.network import DisparityNetwork, NetworkUpsampler, Precision
from dsr.methods.networks.pdn import PrimalDualNetwork
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.methods.networks.weight_files import is_dsr_weights, load_network, load_parameters
from dsr.utils.arrays import read_tensors
from dsr.utils.guards import MOST_FILE, read_limited, refusing
from dsr.utils.ratios import SCALES

_KINDS: tuple[type[DisparityNetwork], ...] = (
    MSGNet, Facets, FacetsUNet, PrimalDualNetwork, DynamicGuidance, SparseToDense, DDRNet,
)  # fmt: skip
NETWORKS: Mapping[str, type[DisparityNetwork]] = MappingProxyType({kind.__name__: kind for kind in _KINDS})
_PARTS = ("conv.weight", "conv.bias", "activation.weight")


class TrainedNetwork(NetworkUpsampler):
    """A method from a file of weights: of ``train.py``, or, with a ``variant``, of the authors of MSG-Net."""

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


def load_msg_weights(path: Path, scale: int, variant: VariantName | None = None) -> MSGNet:
    """Load the network of one of the authors' files, recognised by its content, in float32 on the CPU."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    data = read_limited(path, MOST_FILE)
    is_torch = data.startswith((b"PK\x03\x04", b"\x80"))
    found: VariantName = "voynov" if is_torch else "hui"
    if is_torch:
        values = read_tensors(path, "model_state_dict")
        indices = re.findall(r"^upsampling_X\.(\d{1,3})\.", "\n".join(values), re.MULTILINE)
        levels = max(map(int, indices), default=0) // 3  # 3 layers per level, then 2
    else:
        levels, values = _from_caffe(path, data)
    if levels < 1 or 2**levels not in SCALES:
        raise ValueError(f"{path}: expected MSG-Net for a scale of {SCALES}, got {levels} upsampling levels")
    if variant is not None and found != variant:
        raise ValueError(f"{path}: expected weights of variant {variant}, got those of variant {found}")
    if 2**levels != scale:
        raise ValueError(f"{path}: weights are for scale {2**levels}, the run is at scale {scale}")
    with torch.device("meta"):  # without memory and random numbers
        net = MSGNet(scale, found)
    own = list(net.state_dict())
    if is_torch:
        guidance = [f"feature_extraction_Y.{max(i, 2 * i - 2)}" for i in range(levels + 1)]  # which also count poolings
        theirs = [*guidance, "feature_extraction_X", *(f"upsampling_X.{i}" for i in range(3 * levels + 2))]
        layers = [name.removesuffix(".conv.weight") for name in own if name.endswith(".conv.weight")]
        names = {f"{old}.{part}": f"{new}.{part}" for old, new in zip(theirs, layers, strict=True) for part in _PARTS}
    else:  # both are in the order of the data flow
        names = dict(zip(values, own, strict=False))
    tensors = {names.get(name, name): value for name, value in values.items()}
    load_parameters(net, tensors, path, f"MSG-Net ({found}) at scale {scale}")
    return net


def _from_caffe(path: Path, data: bytes) -> tuple[int, dict[str, Tensor]]:
    """Return the same of a NetParameter, in the order of its layers."""
    levels, blobs = 0, {}
    message = f"{path}: expected a torch or Caffe model, got a damaged one or neither"
    with refusing(message, ValueError, TypeError, IndexError, KeyError):
        for number, content in enumerate(_fields(memoryview(data)).get(100, [])):
            layer = _fields(content)
            levels += bytes(layer.get(2, [b""])[0]) == b"Deconvolution" and 7 in layer
            for i, blob in enumerate(layer.get(7, [])):
                blobs[f"layer {number} blob {i}"] = _read_blob(blob)
    if not blobs:
        raise ValueError(f"{path}: expected a torch or Caffe model, got {len(data)} bytes without a Caffe layer")
    return levels, blobs


def _read_blob(message: memoryview) -> Tensor:
    """Return a BlobProto's values in its shape; both are packed or one by one."""
    fields = _fields(message)
    sizes: list[int] = []
    for value in _fields(fields[7][0]).get(1, []):
        place = 0
        while not isinstance(value, int) and place < len(value):
            size, place = _read_varint(value, place)
            sizes.append(size)
        sizes += [value] if isinstance(value, int) else []
    data = bytearray(b"".join(map(bytes, fields[5])))
    if 4 * math.prod(sizes) != len(data):
        raise ValueError(f"a blob of shape {tuple(sizes)} holds {len(data)} bytes")
    return torch.frombuffer(data, dtype=torch.float32).reshape(sizes)


def _fields(message: memoryview) -> dict[int, list[Any]]:
    """Return the values of a message's fields by their numbers: an int for a varint, else the value's bytes."""
    found: dict[int, list[Any]] = {}
    place = 0
    while place < len(message):
        key, place = _read_varint(message, place)
        value: int | memoryview
        if key & 7 == 0:
            value, place = _read_varint(message, place)
        else:
            size, place = _read_varint(message, place) if key & 7 == 2 else ({1: 8, 5: 4}[key & 7], place)
            value, place = message[place : place + size], place + size
            if len(value) < size:
                raise ValueError(f"field {key >> 3} is cut off")
        found.setdefault(key >> 3, []).append(value)
    return found


def _read_varint(message: memoryview, place: int) -> tuple[int, int]:
    """Return the variable-length integer at a place, and the place after it."""
    value = 0
    for shift in range(0, 70, 7):
        byte = message[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise ValueError("a number is longer than 64 bits")
