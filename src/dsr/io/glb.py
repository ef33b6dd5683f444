"""Meshes as binary glTF, with the photo as their texture.

Positions are whole numbers of 16 bits, normals of 8 (``KHR_mesh_quantization``, which viewers and importers of glTF
read, and which is in ``extensionsRequired``); a node's scale and translation make metres of them. Indices have 16 bits
where these are enough. The layout of the file is that of the Khronos glTF 2.0 specification, sections 3.6 and 4.4:
each attribute begins, and each of its elements, at a multiple of four bytes.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from dsr.io.photos import encode_png, to_jpeg
from dsr.utils.files import replacing

_TO_GLTF = np.array([1, -1, -1])
_STEPS = 65535
_FINEST = 4e-4  # of the distance of the nearest point: largest step between positions; the rest has floats
_LARGEST_TEXTURE = 4096  # pixels of a side, which every viewer supports
_LOSSLESS = 2**16  # pixels of a texture that is stored without loss
_QUALITY = 95  # of a JPEG with colours at half the resolution: at full resolution it takes 6 to 34 % more
_TYPES = {"int8": 5120, "uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_ATTRIBUTES, _INDICES = 34962, 34963


def write_glb(
    path: Path,
    points: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    places: np.ndarray,
    photo: np.ndarray,
    filled: np.ndarray | None = None,
) -> None:
    """Write a mesh as binary glTF atomically, with the photo as its texture, which large triangles show in full, too.

    The material is rough and lit from both sides, so that viewers show the shape as well as the photo. Positions are
    rounded to 1/65535 of the longest side of the mesh, half of which is 0.05 mm of a room of 6 m; they are floats if
    half a step is more than 0.02 % of the nearest point's distance.

    Args:
        points: (N, 3) in metres, in the camera frame.
        normals: (N, 3) unit vectors.
        faces: (M, 3) indices, counterclockwise from outside; one at least.
        places: (N, 2) column and row of each point in the photo, pixel centres at integers.
        photo: (H, W, 3) uint8, sRGB.
        filled: (N,) bool, which points were not measured: the attribute ``_FILLED``; None to leave it out.

    """
    height, width = photo.shape[:2]
    positions, node = _quantised(points * _TO_GLTF, float(np.linalg.norm(points, axis=1).min(initial=np.inf)))
    attributes = {
        "POSITION": positions,
        "NORMAL": np.rint(127 * normals * _TO_GLTF).astype(np.int8),
        "TEXCOORD_0": ((places + 0.5) / (width, height)).astype(np.float32),
        **({} if filled is None else {"_FILLED": filled.astype(np.uint8)[:, None]}),
    }
    file = _File()
    primitive = {"attributes": {name: file.add(values, _ATTRIBUTES) for name, values in attributes.items()}}
    bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    file.accessors[primitive["attributes"]["POSITION"]] |= bounds
    small = np.uint16 if len(points) <= _STEPS else np.uint32  # the last number of a type is none of a point
    kind, picture = _texture(photo)
    rough = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    content = file.packed({
        "asset": {"version": "2.0", "generator": "dsr"},
        "extensionsUsed": ["KHR_mesh_quantization"],
        "extensionsRequired": ["KHR_mesh_quantization"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [
            {**primitive, "indices": file.add(faces.reshape(-1, 1).astype(small), _INDICES), "material": 0}
        ]}],
        "materials": [{"pbrMetallicRoughness": rough, "doubleSided": True}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 33071, "wrapT": 33071}],
        "images": [{"mimeType": kind, "bufferView": file.view(picture)}],
    })  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _quantised(points: np.ndarray, nearest: float) -> tuple[np.ndarray, dict[str, Any]]:
    """Return positions, and the entries of a node that places them; its scale is uniform, as normals need it."""
    least = points.min(axis=0)
    step = float((points.max(axis=0) - least).max()) / _STEPS
    if not 0 < step <= _FINEST * nearest:
        return points.astype(np.float32), {}
    return np.rint((points - least) / step).astype(np.uint16), {"translation": least.tolist(), "scale": [step] * 3}


def _texture(photo: np.ndarray) -> tuple[str, bytes]:
    """Return the type and the bytes of a picture, at most as large as viewers support."""
    if photo.shape[0] * photo.shape[1] <= _LOSSLESS and max(photo.shape) <= _LARGEST_TEXTURE:
        return "image/png", encode_png(np.ascontiguousarray(photo[..., ::-1]))
    return "image/jpeg", to_jpeg(photo, _LARGEST_TEXTURE, _QUALITY)


class _File:
    """The binary part of a file, and what is in it."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._content = bytearray()

    def view(self, content: bytes, **entries: int) -> int:
        """Add bytes, and return the number of their view."""
        self._views.append({"buffer": 0, "byteOffset": len(self._content), "byteLength": len(content), **entries})
        self._content += content + bytes(-len(content) % 4)
        return len(self._views) - 1

    def add(self, values: np.ndarray, target: int) -> int:
        """Add numbers, (N, C), and return the number of their accessor."""
        count, channels = values.shape
        entries = {"target": target}
        stride = channels * values.itemsize
        if target == _ATTRIBUTES and stride % 4:
            entries["byteStride"] = stride + -stride % 4
            values = np.pad(values, ((0, 0), (0, (-stride % 4) // values.itemsize)))
        number = self.view(values.astype(values.dtype.newbyteorder("<")).tobytes(), **entries)
        kind = ("SCALAR", "VEC2", "VEC3")[channels - 1]
        accessor = {"bufferView": number, "componentType": _TYPES[str(values.dtype)], "count": count, "type": kind}
        self.accessors.append({**accessor, "normalized": True} if values.dtype == np.int8 else accessor)
        return len(self.accessors) - 1

    def packed(self, entries: dict[str, Any]) -> bytes:
        """Return the whole file."""
        tree = {**entries, "accessors": self.accessors, "bufferViews": self._views,
                "buffers": [{"byteLength": len(self._content)}]}  # fmt: skip
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        parts = struct.pack("<I4s", len(text), b"JSON") + text
        parts += struct.pack("<I4s", len(self._content), b"BIN\0") + self._content
        return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts
