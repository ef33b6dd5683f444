"""Readers of MSG-Net weights: the published ones, straight from their authors' files, and our own.

``.pth`` (Voynov et al. 2019) is read by torch's own unpickler for plain tensors, ``.caffemodel`` (Hui et al. 2016) by a
reader of the protobuf wire format (protobuf.dev/programming-guides/encoding). Neither ever runs code that a file holds,
and whatever does not fit raises a ``ValueError`` that names the file, what was expected and what came.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from dsr.methods.msg_net import SCALES, VARIANTS, MSGNet, VariantName

OUR_FORMAT = "dsr-msg-1"
TORCH_MAGIC = (b"PK\x03\x04", b"\x80")
PARTS = ("conv.weight", "conv.bias", "activation.weight")
VARINT, BYTES = 0, 2
FIXED_SIZES = {1: 8, 5: 4}
NET_LAYER, LAYER_NAME, LAYER_TYPE, LAYER_BLOBS, BLOB_DATA, BLOB_SHAPE, SHAPE_DIM = 100, 1, 2, 7, 5, 7, 1


class MSGWeights(NamedTuple):
    """What a file holds; tensors go by our parameter names, those that we don't know by the file's."""

    variant: VariantName
    scale: int
    tensors: dict[str, Tensor]
    trained_as: str | None = None
    """The model that our own training made, ``msg`` or ``msg_v``; None for the authors' files."""


def load_msg_weights(
    path: Path, scale: int, variant: VariantName | None = None, trained_as: str | None = None
) -> MSGNet:
    """Return the network with the weights of one of the authors' files or of our training, float32, on the CPU.

    Args:
        path: a ``.pth`` of Voynov et al., a ``.caffemodel`` of Hui et al. or our ``.safetensors``; the content tells.
        scale: the scale that the run needs.
        variant: the variant that the run needs of the authors' files, None for any.
        trained_as: the model that the run needs of our own files, None for any.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, of another format, scale, variant or architecture.

    """
    path = Path(path)
    weights = read_msg_weights(path)
    if weights.trained_as is not None:
        if trained_as is not None and weights.trained_as != trained_as:
            raise ValueError(f"{path}: expected weights of model {trained_as}, got those of {weights.trained_as}")
    elif variant is not None and weights.variant != variant:
        raise ValueError(f"{path}: expected weights of variant {variant}, got those of variant {weights.variant}")
    if weights.scale != scale:
        raise ValueError(f"{path}: weights are for scale {weights.scale}, the run is at scale {scale}")
    with torch.device("meta"):  # without memory, and without a draw from the random generator
        net = MSGNet(scale, weights.variant)
    problems = _misfits(weights.tensors, {name: tuple(value.shape) for name, value in net.state_dict().items()})
    if problems:
        found = problems[0] if len(problems) == 1 else f"{problems[0]}, and {len(problems) - 1} more do not fit"
        raise ValueError(f"{path}: expected the tensors of MSG-Net ({weights.variant}) at scale {scale}, but {found}")
    net.load_state_dict({name: value.float().contiguous() for name, value in weights.tensors.items()}, assign=True)
    return net


def read_msg_weights(path: Path) -> MSGWeights:
    """Return what the file holds, with its variant and scale; shapes are not checked yet."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    data = path.read_bytes()
    if data[8:9] == b"{":
        return _from_ours(path, data)
    return _from_torch(path) if data.startswith(TORCH_MAGIC) else _from_caffe(path, data)


def save_msg_weights(path: Path, net: MSGNet, trained_as: str) -> None:
    """Write a network's weights as ``.safetensors``, with the few facts that rebuild it.

    Args:
        path: the file; written as it is, wrap it for atomicity.
        net: the network.
        trained_as: the model's name, ``msg`` or ``msg_v``.

    """
    facts = {"format": OUR_FORMAT, "variant": net.variant.name, "scale": str(net.scale), "trained_as": trained_as}
    safetensors.torch.save_file({k: v.detach().cpu().contiguous() for k, v in net.state_dict().items()}, path, facts)


def _misfits(tensors: dict[str, Tensor], shapes: dict[str, tuple[int, ...]]) -> list[str]:
    """Return what is wrong with the tensors, in words: missing, unexpected, of another shape or kind."""
    problems = [f"{name} is missing" for name in shapes if name not in tensors]
    problems += [f"{name!r} is unexpected" for name in tensors if name not in shapes]
    for name, value in ((name, tensors[name]) for name in shapes if name in tensors):
        if tuple(value.shape) != shapes[name]:
            problems.append(f"{name} has shape {tuple(value.shape)} instead of {shapes[name]}")
        elif not value.is_floating_point() or not bool(value.isfinite().all()):
            problems.append(f"{name} holds values other than finite real numbers")
    return problems


# Ours: safetensors with a few facts


def _from_ours(path: Path, data: bytes) -> MSGWeights:
    """Read a file of :func:`save_msg_weights`."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            facts = file.metadata() or {}
        tensors = safetensors.torch.load(data)
    except Exception as error:  # the library names no set of errors for damaged files
        raise ValueError(f"{path}: expected a safetensors file, got a damaged one ({type(error).__name__})") from error
    if (
        facts.get("format") != OUR_FORMAT
        or facts.get("variant") not in VARIANTS
        or not facts.get("scale", "").isdigit()
    ):
        raise ValueError(f"{path}: expected weights that train.py wrote, got safetensors with the facts {facts}")
    variant: VariantName = facts["variant"]
    return MSGWeights(variant, int(facts["scale"]), tensors, facts.get("trained_as", ""))


# Voynov et al.: a torch file


def _from_torch(path: Path) -> MSGWeights:
    """Read a torch file that holds tensors only, under ``model_state_dict``."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch names no set of errors for damaged files
        raise ValueError(
            f"{path}: expected a torch file of plain tensors, got one that is damaged or holds other Python objects, "
            f"which are never loaded ({type(error).__name__})"
        ) from error
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
    """Return the names of our layers in the order in which data passes them."""
    guidance = [f"guidance.{i}" for i in range(levels + 1)]
    depth = [f"levels.{level}.{part}" for level in range(levels) for part in ("up", "fuse", "refine")]
    return [*guidance, "stem", *depth, "smooth", "reconstruct"]


def _author_names(levels: int) -> list[str]:
    """Return Voynov et al.'s names for the same layers; their guidance branch counts its poolings, too."""
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
    """Read a Caffe model: its layers lie in the order in which data passes them, whatever their names."""
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
