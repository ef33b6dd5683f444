"""The method that runs a trained network, from weights of this package or published ones of MSG-Net.

Weights in their authors' formats: ``.pth`` (Voynov et al. 2019) is read by torch's own unpickler for plain tensors,
``.caffemodel`` (Hui et al. 2016) by a reader of the protobuf wire format (protobuf.dev/programming-guides/encoding).
Neither executes code from a file. Invalid files raise a ``ValueError`` that names the file, the expected content and
the content found.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
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
from dsr.utils.guards import MOST_FILE, read_limited
from dsr.utils.ratios import SCALES
from dsr.utils.torch_files import read_torch_file

TORCH_MAGIC = (b"PK\x03\x04", b"\x80")
PARTS = ("conv.weight", "conv.bias", "activation.weight")
VARINT, BYTES = 0, 2
FIXED_SIZES = {1: 8, 5: 4}
NET_LAYER, LAYER_NAME, LAYER_TYPE, LAYER_BLOBS, BLOB_DATA, BLOB_SHAPE, SHAPE_DIM = 100, 1, 2, 7, 5, 7, 1

NETWORKS: MappingProxyType[str, type[DisparityNetwork]] = MappingProxyType(
    {
        "MSGNet": MSGNet,
        "Facets": Facets,
        "FacetsUNet": FacetsUNet,
        "PrimalDualNetwork": PrimalDualNetwork,
        "DynamicGuidance": DynamicGuidance,
        "SparseToDense": SparseToDense,
        "DDRNet": DDRNet,
    }
)

_DSR_ENSEMBLE = 4
"""Test-time augmentations with weights of this package; published networks are run as published."""


class MSGWeights(NamedTuple):
    """The content of a file; tensors have dsr's parameter names, unknown ones the file's."""

    variant: VariantName
    scale: int
    tensors: dict[str, Tensor]


def load_msg_weights(path: Path, scale: int, variant: VariantName | None = None) -> MSGNet:
    """Load the network of one of the authors' files, in float32 on the CPU.

    Args:
        path: ``.pth`` of Voynov et al. or ``.caffemodel`` of Hui et al., recognised by its content.
        scale: scale that the run requires.
        variant: variant that the run requires, None for any.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, of another format, scale, variant or architecture.

    """
    path = Path(path)
    weights = read_msg_weights(path)
    if variant is not None and weights.variant != variant:
        raise ValueError(f"{path}: expected weights of variant {variant}, got those of variant {weights.variant}")
    if weights.scale != scale:
        raise ValueError(f"{path}: weights are for scale {weights.scale}, the run is at scale {scale}")
    with torch.device("meta"):  # without memory and random numbers
        net = MSGNet(scale, weights.variant)
    load_parameters(net, weights.tensors, path, f"MSG-Net ({weights.variant}) at scale {scale}")
    return net


def read_msg_weights(path: Path) -> MSGWeights:
    """Read a file's tensors, variant and scale; shapes are not checked."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    data = read_limited(path, MOST_FILE)
    return _from_torch(path) if data.startswith(TORCH_MAGIC) else _from_caffe(path, data)


# Voynov et al.: a torch file


def _from_torch(path: Path) -> MSGWeights:
    """Read a torch file that holds tensors only, under ``model_state_dict``."""
    content = read_torch_file(path)
    found = content.get("model_state_dict") if isinstance(content, dict) else None
    if not isinstance(found, dict) or not all(isinstance(value, Tensor) for value in found.values()):
        keys = ", ".join(map(str, list(content)[:4])) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{path}: expected tensors under the key model_state_dict, got {keys}")
    indices = re.findall(r"^upsampling_X\.(\d{1,3})\.", "\n".join(map(str, found)), re.MULTILINE)
    levels = _checked_levels(path, max(map(int, indices), default=0) // 3)  # 3 layers per level, then 2
    layer_names = zip(_author_names(levels), _layer_names(levels), strict=True)
    ours = {f"{theirs}.{part}": f"{name}.{part}" for theirs, name in layer_names for part in PARTS}
    return MSGWeights("voynov", 2**levels, {ours.get(name, str(name)): value for name, value in found.items()})


def _layer_names(levels: int) -> list[str]:
    """Return the names of dsr's layers in the order of the data flow."""
    guidance = [f"guidance.{i}" for i in range(levels + 1)]
    depth = [f"levels.{level}.{part}" for level in range(levels) for part in ("up", "fuse", "refine")]
    return [*guidance, "stem", *depth, "smooth", "reconstruct"]


def _author_names(levels: int) -> list[str]:
    """Return Voynov et al.'s names of the same layers; their guidance branch also counts poolings."""
    guidance = [f"feature_extraction_Y.{max(i, 2 * i - 2)}" for i in range(levels + 1)]
    return [*guidance, "feature_extraction_X", *(f"upsampling_X.{i}" for i in range(3 * levels + 2))]


def _checked_levels(path: Path, levels: int) -> int:
    if levels < 1 or 2**levels not in SCALES:
        raise ValueError(f"{path}: expected MSG-Net for a scale of {SCALES}, got {levels} upsampling levels")
    return levels


# Hui et al.: a Caffe model


class _Layer(NamedTuple):
    """A layer of a Caffe network, with its parameters."""

    name: str
    kind: str
    blobs: list[Tensor]


def _from_caffe(path: Path, data: bytes) -> MSGWeights:
    """Read a Caffe model; its layers are identified by their order, which is that of the data flow."""
    try:
        layers = [layer for layer in map(_layer, _messages(memoryview(data), NET_LAYER)) if layer.blobs]
    except ValueError as error:
        raise ValueError(f"{path}: expected a torch or Caffe model, got a damaged one or neither ({error})") from error
    if not layers:
        raise ValueError(f"{path}: expected a torch or Caffe model, got {len(data)} bytes without a Caffe layer")
    levels = _checked_levels(path, sum(layer.kind == "Deconvolution" for layer in layers))
    names = iter(_layer_names(levels))
    tensors: dict[str, Tensor] = {}
    name = ""
    for layer in layers:
        is_activation = layer.kind == "PReLU"  # it follows the layer that it belongs to
        name = name if is_activation else next(names, layer.name)
        keys = [f"{name}.{part}" for part in (PARTS[2:] if is_activation else PARTS[:2])]
        for i, blob in enumerate(layer.blobs):
            fits = i < len(keys) and keys[i] not in tensors
            tensors[keys[i] if fits else f"{layer.name} blob {i}"] = blob
    return MSGWeights("hui", 2**levels, tensors)


def _layer(message: memoryview) -> _Layer:
    texts = {LAYER_NAME: "", LAYER_TYPE: ""}
    blobs = []
    for number, value in _fields(message):
        if number in texts:
            texts[number] = bytes(_bytes_of(value, number)).decode("utf-8", "replace")
        elif number == LAYER_BLOBS:
            blobs.append(_blob(_bytes_of(value, number)))
    return _Layer(texts[LAYER_NAME], texts[LAYER_TYPE], blobs)


def _blob(message: memoryview) -> Tensor:
    """Return a BlobProto's values, packed or one by one, in its shape."""
    chunks, shape = [], None
    for number, value in _fields(message):
        if number == BLOB_DATA:
            chunks.append(bytes(_bytes_of(value, number)))
        elif number == BLOB_SHAPE:
            shape = _shape(_bytes_of(value, number))
    data = b"".join(chunks)
    if shape is None or 4 * math.prod(shape) != len(data):
        raise ValueError(f"a blob of shape {shape} holds {len(data)} bytes")
    return torch.from_numpy(np.frombuffer(data, dtype="<f4").astype(np.float32)).reshape(shape)


def _shape(message: memoryview) -> tuple[int, ...]:
    """Return a BlobShape's sizes, packed or one by one."""
    sizes: list[int] = []
    for number, value in _fields(message):
        if number != SHAPE_DIM:
            continue
        if isinstance(value, int):
            sizes.append(value)
            continue
        position = 0
        while position < len(value):
            size, position = _varint(value, position)
            sizes.append(size)
    return tuple(sizes)


# The protobuf wire format


def _messages(message: memoryview, wanted: int) -> Iterator[memoryview]:
    """Yield the sub-messages in field ``wanted``."""
    for number, value in _fields(message):
        if number == wanted:
            yield _bytes_of(value, number)


def _bytes_of(value: int | memoryview, number: int) -> memoryview:
    if isinstance(value, int):
        raise ValueError(f"field {number} is a number instead of bytes")
    return value


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (field number, value) of a message: an int for a varint, else the value's bytes."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, wire_type = key >> 3, key & 7
        if number == 0:
            raise ValueError("a field has number 0")
        if wire_type == VARINT:
            value, position = _varint(message, position)
            yield number, value
            continue
        if wire_type == BYTES:
            size, position = _varint(message, position)
        elif wire_type in FIXED_SIZES:
            size = FIXED_SIZES[wire_type]
        else:
            raise ValueError(f"field {number} has the unknown wire type {wire_type}")
        if size > len(message) - position:
            raise ValueError(f"field {number} is cut off: {size} bytes expected, {len(message) - position} left")
        yield number, message[position : position + size]
        position += size


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """Return the variable-length integer at ``position``, at most 64 bits, and the position after it."""
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(message):
            raise ValueError("a number is cut off")
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ValueError("a number is longer than 64 bits")


class TrainedNetwork(NetworkUpsampler):
    """A method from a file of weights.

    Args:
        weights: file that ``train.py`` wrote; or, with a ``variant``, one that the authors of MSG-Net published.
        scale: upsampling factor of the run.
        model: name of the model that dsr files must contain.
        variant: variant of MSG-Net that published files must contain.
        precision: dtype of the convolutions.
        device: device of the computations.
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
        if ensemble is None:
            ensemble = _DSR_ENSEMBLE if dsr else 1
        super().__init__(net, precision, device, ensemble)
