"""What is written beside an upsampled depth map: renderings, normals, a cloud and a mesh, and the input.

A PLY file has points in the camera frame: x right, y down, z forward. A GLB file has them with y up and z towards the
viewer, and the photo as their texture (Khronos, glTF 2.0 specification, sections 3.4, 3.6 and 4.4): positions of 16
bits and normals of 8 (``KHR_mesh_quantization``), of which a node's scale and translation make metres.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.mesh import QUADRIC, project, select_points, simplify, thin, triangulate, vertex_normals
from dsr.geometry.surface import depth_to_normals, render
from dsr.io.photos import encode_png, to_jpeg, write_png
from dsr.notes import Assumption
from dsr.sample import expect_distances
from dsr.utils.arrays import read_arrays
from dsr.utils.decoding import decode_pixels
from dsr.utils.files import replacing
from dsr.utils.guards import MOST_FACES, MOST_POINTS
from dsr.utils.progress import show_length
from dsr.utils.versions import how_to_install

FLAT = "large triangles where the surface is flat"  # which makes a mesh smaller without a limit
CAMERA_FRAME = "camera frame: x right, y down, z forward; metres"
INPUT = "input.npz"
LONGEST = 2048  # pixels of the longer side of the stored photo
_STRIP = 1 << 20  # pixels whose normals are held in memory at a time
# the order and the signs of axes that make y point up, by the axis that does; "" for the camera frame, or not known
_TO_GLTF = {"": ((0, 1, 2), (1, -1, -1)), "y": ((0, 1, 2), (1, 1, 1)), "z": ((0, 2, 1), (1, 1, -1))}
_STEPS = 65535
_FINEST = 4e-4  # of the distance of the nearest point: largest step between positions; the rest has floats
_LARGEST_TEXTURE = 4096  # pixels of a side, which every viewer supports
_LOSSLESS = 2**16  # pixels of a texture that is stored without loss
_QUALITY = 95  # of a JPEG with colours at half the resolution: at full resolution it takes 6 to 34 % more
_LARGEST_JPEG = 65535  # pixels of a side
_EYES = 0.063  # metres between a person's eyes (Dodgson, 2004)
_MOST_SHIFT = 30
_NEARLY_ALL = 0.999  # of the pixels, without which a wrong one would decide
_TYPES = {"int8": 5120, "uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_ATTRIBUTES, _INDICES = 34962, 34963


def world_comment(up: str) -> str:
    """Return a PLY file's comment on its frame, the world with the axis ``up``, see :data:`dsr.io.frames.UPS`."""
    return f"world frame of the poses{f': {up} up' if up else ''}; metres"


def write_ply(
    path: Path,
    points: np.ndarray,
    colours: np.ndarray,
    normals: np.ndarray | None = None,
    faces: np.ndarray | None = None,
    *,
    filled: np.ndarray | None = None,
    frame: str = CAMERA_FRAME,
) -> None:
    """Write a binary PLY file of points (N, 3), colours (N, 3) uint8, normals, faces (M, 3) and flags ``filled``."""
    import trimesh  # noqa: PLC0415 - half a second that most results save
    from trimesh.exchange.ply import export_ply  # noqa: PLC0415

    corners = np.empty((0, 3), int) if faces is None else faces
    model = trimesh.Trimesh(
        points, corners, vertex_normals=normals, vertex_colors=colours, process=False,
        vertex_attributes=None if filled is None else {"filled": filled.astype(np.uint8)},
    )  # fmt: skip
    content = export_ply(model, vertex_normal=normals is not None)
    header, mark, content = content.partition(b"element vertex")
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.writelines((header, f"comment {frame}\n".encode(), mark, content))


class Written(NamedTuple):
    """How much of a surface was written."""

    before: int  # triangles of the mesh, or points of the cloud, at full density
    after: int  # as written
    how: str = ""  # what made them fewer, empty if nothing did; see FLAT

    def __str__(self) -> str:
        return f"{self.after} of {self.before}, by {self.how}"


def normal_strips(depth: Tensor, camera: Camera) -> Iterator[tuple[slice, Tensor]]:
    """Yield the rows of one strip after another, and its normals, (3, rows, W) float32, NaN where unknown."""
    height, width = camera.height, camera.width
    rows = max(1, _STRIP // width)
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        first, last = max(0, min(start, height - 2)), min(stop + 1, height)
        part = depth[None, :, first:last].double()
        normals = depth_to_normals(part, camera.crop(first, 0, last - first, width).rays()[None], torch.float32)[0]
        yield slice(start, stop), normals[:, start - first : stop - first]


def whole_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Return the normals of a map, (1, H, W), as (3, H, W) float32, NaN where unknown."""
    normals = torch.empty((3, camera.height, camera.width))
    for rows, part in normal_strips(depth, camera):
        normals[:, rows] = part
    return normals


def write_renderings(folder: Path, depth: Tensor, camera: Camera) -> list[Path]:
    """Write the renderings of a map, (1, H, W), as ``e1.png`` to ``e4.png``, 8 bits of grey, holes transparent."""
    shades = np.zeros((len(LIGHT_NAMES), camera.height, camera.width), np.uint8)
    known = np.zeros(shades.shape[1:], bool)
    for rows, normals in normal_strips(depth, camera):
        known[rows] = normals[0].isfinite().numpy()
        shades[:, rows] = as_bytes(render(normals[None])[0])
    paths = [folder / f"{name}.png" for name in LIGHT_NAMES]
    for path, picture in zip(paths, shades, strict=True):
        write_png(path, picture, known)
    return paths


def write_normals(path: Path, depth: Tensor, camera: Camera) -> None:
    """Write the normals as an 8-bit colour picture, holes transparent.

    Red is x to the right, green is y up, blue is towards the viewer, each from -1 at 0 to 1 at 255: a wall that faces
    the camera is (128, 128, 255), as in the normal maps of modelling programs.
    """
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    known = np.zeros(picture.shape[:2], bool)
    signs = torch.tensor([-1, -1, 1])[:, None, None]  # blue, green, red is -z, -y, x
    for rows, normals in normal_strips(depth, camera):
        known[rows] = normals[0].isfinite().numpy()
        picture[rows] = as_bytes((1 + signs * normals.flip(0)) / 2).transpose(1, 2, 0)
    write_png(path, picture, known)


def write_cloud(
    path: Path, rgb: Tensor, depth: Tensor, camera: Camera, *, most: int = MOST_POINTS, filled: Tensor | None = None
) -> Written:
    """Write the known pixels as a coloured PLY cloud with normals, in metres; x right, y down, z forward.

    Of more than ``most`` points, those in rows and columns at equal distances are taken. ``filled``, (1, H, W) bool,
    depth that was not measured, is a property of the points.
    """
    mesh = triangulate(depth, camera, isolated=True)
    chosen, normals = select_points(mesh, most, camera), vertex_normals(mesh)
    colours, flags = _at(mesh.pixels[chosen], rgb, filled)
    write_ply(path, mesh.vertices[chosen], colours, normals[chosen], filled=flags)
    fewer = len(chosen) < len(mesh.vertices)
    return Written(len(mesh.vertices), len(chosen), "leaving out rows and columns" if fewer else "")


def write_mesh(
    paths: Path | Sequence[Path],
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    *,
    most: int = MOST_FACES,
    tolerance: Tensor | None = None,
    filled: Tensor | None = None,
) -> Written:
    """Write the surface as a mesh with the photo's colours, cut at depth steps, as files ``.ply`` or ``.glb``.

    ``rgb``: (3, H, W) in [0, 1]. ``depth``: (1, H, W) orthogonal in metres, NaN in holes. A mesh of more than ``most``
    triangles is simplified. ``tolerance``: see :func:`dsr.geometry.mesh.triangulate`. ``filled``, (1, H, W) bool, depth
    that was not measured, is a property of a PLY file's points, and the attribute ``_FILLED`` of a GLB file.
    """
    paths = [paths] if isinstance(paths, Path) else list(paths)
    mesh = triangulate(depth, camera, tolerance=tolerance)
    if not len(mesh.faces):
        raise ValueError(f"{paths[0]}: expected neighbours of known depth to make a surface of, got none")
    before, how = mesh.dense, FLAT if len(mesh.faces) < mesh.dense else ""
    if len(mesh.faces) > most:
        try:
            mesh, how = simplify(mesh, most, camera), QUADRIC
        except ImportError:
            mesh, stride = thin(depth, camera, most)
            how = f"a stride of {stride} pixels; {how_to_install('mesh')} simplifies and keeps more detail"
    normals, (colours, flags) = vertex_normals(mesh), _at(mesh.pixels, rgb, filled)
    for path in paths:
        if path.suffix.lower() == ".ply":
            write_ply(path, mesh.vertices, colours, normals, mesh.faces, filled=flags)
        else:
            places, photo = project(mesh.vertices, camera), as_bytes(rgb).transpose(1, 2, 0).copy()
            write_glb(path, mesh.vertices, normals, mesh.faces, places, photo, flags)
    return Written(before, len(mesh.faces), how)


def write_glb(
    path: Path,
    points: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    places: np.ndarray | None = None,
    photo: np.ndarray | None = None,
    filled: np.ndarray | None = None,
    *,
    colours: np.ndarray | None = None,
    up: str = "",
) -> None:
    """Write a mesh, in metres in a frame with the axis ``up`` or the camera's, as binary glTF atomically.

    ``faces``, (M, 3), one at least, are counterclockwise from outside. ``places``, (N, 2), are column and row of each
    point in ``photo``, (H, W, 3) uint8, which becomes the texture. Without a photo the points have ``colours``, (N, 3)
    uint8 (``COLOR_0``, which is linear light). The material is rough and lit from both sides, so that viewers show the
    shape, too. Positions are rounded to 1/65535 of the longest side of the mesh, half of which is 0.05 mm of a room of
    6 m; they are floats if half a step is more than 0.02 % of the nearest point's distance.
    """
    order, signs = _TO_GLTF[up]
    positions, node = points[:, order] * signs, dict[str, Any]()
    least, nearest = positions.min(axis=0), float(np.linalg.norm(points, axis=1).min(initial=np.inf))
    step = float((positions.max(axis=0) - least).max()) / _STEPS  # one for all axes, as normals need it
    if 0 < step <= _FINEST * nearest:
        positions = np.rint((positions - least) / step).astype(np.uint16)
        node = {"translation": least.tolist(), "scale": [step] * 3}
    else:
        positions = positions.astype(np.float32)
    attributes = {"POSITION": positions, "NORMAL": np.rint(127 * normals[:, order] * signs).astype(np.int8)}
    file, texture = _Glb(), dict[str, Any]()
    rough: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if photo is not None and places is not None:
        attributes["TEXCOORD_0"] = ((places + 0.5) / photo.shape[1::-1]).astype(np.float32)
    if colours is not None:
        light = np.where(colours <= 10, colours / 255 / 12.92, ((colours / 255 + 0.055) / 1.055) ** 2.4)  # of sRGB
        attributes["COLOR_0"] = light.astype(np.float32)
    if filled is not None:
        attributes["_FILLED"] = filled.astype(np.uint8)[:, None]
    primitive = {"attributes": {name: file.add(values, _ATTRIBUTES) for name, values in attributes.items()}}
    bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    file.accessors[primitive["attributes"]["POSITION"]] |= bounds
    small = np.uint16 if len(points) <= _STEPS else np.uint32  # the last number of a type is none of a point
    indices = file.add(faces.reshape(-1, 1).astype(small), _INDICES)
    if photo is not None:
        if photo.shape[0] * photo.shape[1] <= _LOSSLESS and max(photo.shape) <= _LARGEST_TEXTURE:
            kind, picture = "image/png", encode_png(np.ascontiguousarray(photo[..., ::-1]))
        else:
            kind, picture = "image/jpeg", to_jpeg(photo, _LARGEST_TEXTURE, _QUALITY)
        rough = {"baseColorTexture": {"index": 0}, **rough}
        texture = {
            "textures": [{"source": 0, "sampler": 0}],
            "samplers": [{"wrapS": 33071, "wrapT": 33071}],
            "images": [{"mimeType": kind, "bufferView": file.view(picture)}],
        }
    content = file.packed({
        "asset": {"version": "2.0", "generator": "dsr"},
        "extensionsUsed": ["KHR_mesh_quantization"],
        "extensionsRequired": ["KHR_mesh_quantization"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{**primitive, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": rough, "doubleSided": True}],
        **texture,
    })  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_stereo(path: Path, rgb: Tensor, depth: Tensor, camera: Camera) -> list[Assumption]:
    """Write a JPEG of the photo and, at its right, what the right eye sees; return a note on the distance of the eyes.

    That is 63 mm, or less if the nearest points would be shifted by more than 1/30 of the width, a rule of stereo
    photography. Points at depth Z are shifted by f * distance / Z. What the photo does not show, and holes of the
    depth, (1, H, W) in metres, continue what is behind them.
    """
    inverse, _ = _filled(depth[0].double().reciprocal().nan_to_num(-1.0).numpy())
    height, width = inverse.shape
    eyes = min(_EYES, width / (_MOST_SHIFT * camera.fx * max(np.quantile(inverse, _NEARLY_ALL), 1e-9)))
    shift = camera.fx * eyes * inverse
    rows, columns = np.mgrid[:height, :width]
    seen = torch.full((height * width,), -1.0, dtype=torch.float64)  # shifts; the nearest point hides others
    pure = cv2.dilate(shift, np.ones((1, 5), np.uint8)) < shift + 1  # not coloured by what is in front of it
    for target in (np.floor(columns - shift), np.ceil(columns - shift)):  # both, so that slopes have no gaps
        shown = pure & (target >= 0)
        places = torch.from_numpy((rows * width + target).astype(np.int64)[shown])
        seen.scatter_reduce_(0, places, torch.from_numpy(shift[shown]), "amax")
    shifts, behind = _filled(seen.view(height, width).numpy())
    source = (2 * behind - columns + shifts).clip(0, width - 1)  # mirrored at the edge of a gap
    nearer = np.take_along_axis(shift, source.round().astype(np.int64), 1) >= shifts + 1
    source = np.where(nearer, behind + shifts, source)
    photo = as_bytes(rgb).transpose(1, 2, 0)
    maps = source.astype(np.float32), rows.astype(np.float32)
    right = cv2.remap(photo, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    with replacing(path) as temporary:
        temporary.write_bytes(to_jpeg(np.hstack((photo, right)), _LARGEST_JPEG, _QUALITY))
    return [Assumption("the views of the stereo picture are apart", show_length(eyes))]


def write_rgbd_picture(path: Path, rgb: Tensor, depth: Tensor, _camera: Camera) -> list[Assumption]:
    """Write a PNG of the photo and, at its right, inverse depth as grey; holes continue what is behind them."""
    inverse, _ = _filled(depth[0].double().reciprocal().nan_to_num(-1.0).numpy())
    far, near = np.quantile(inverse, (1 - _NEARLY_ALL, _NEARLY_ALL))
    grey = as_bytes(torch.from_numpy((inverse - far) / max(near - far, np.finfo(float).tiny)))
    photo = as_bytes(rgb.flip(0)).transpose(1, 2, 0)
    write_png(path, np.hstack((photo, np.dstack((grey,) * 3))))
    return []


def _filled(inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse depth, (H, W), with what is behind its holes, the values below 0, and the column of that."""
    columns = np.broadcast_to(np.arange(inverse.shape[1]), inverse.shape)
    left = np.maximum.accumulate(np.where(inverse >= 0, columns, 0), 1)
    right = np.minimum.accumulate(np.where(inverse >= 0, columns, columns[0, -1])[:, ::-1], 1)[:, ::-1]
    sides = np.stack([np.take_along_axis(inverse, each, 1) for each in (left, right)])
    first, second = np.where(sides < 0, np.inf, sides)
    behind = np.where(first < second, left, right)
    return np.take_along_axis(inverse, behind, 1).clip(0), behind


class _Glb:
    """The binary part of a GLB file, whose parts begin at multiples of four bytes, and what is in it."""

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


def _at(pixels: np.ndarray, rgb: Tensor, filled: Tensor | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return colours, (N, 3) uint8, and values of a mask, (N,) bool, at some pixels, indices of the flattened map."""
    flags = None if filled is None else filled.flatten().cpu().numpy()[pixels]
    return as_bytes(rgb.flatten(1)[:, torch.from_numpy(pixels)]).T, flags


def as_bytes(values: Tensor) -> np.ndarray:
    """Return values in [0, 1] as uint8; NaN becomes 0."""
    return (values.nan_to_num(0) * 255).round().clamp(0, 255).byte().cpu().numpy()


def write_input(path: Path, rgb: Tensor, depth_lr: Tensor) -> None:
    """Write the input: ``depth_lr`` (h, w) float32 in metres, NaN in holes, and ``photo``, the bytes of a JPEG."""
    photo = np.frombuffer(to_jpeg(as_bytes(rgb).transpose(1, 2, 0), LONGEST, 90), np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, depth_lr=depth_lr[0].float().cpu().numpy(), photo=photo)


def read_input(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the photo, (H, W, 3) uint8, and the depth map, (h, w) float32 in metres, NaN in holes."""
    arrays = read_arrays(path)
    kinds = {name: (str(array.dtype), array.ndim) for name, array in arrays.items()}
    if kinds != {"depth_lr": ("float32", 2), "photo": ("uint8", 1)}:
        raise ValueError(f"{path}: expected depth_lr (h, w) float32 and photo (n,) uint8, got {kinds}")
    depth = arrays["depth_lr"]
    if min(depth.shape) < 2:
        raise ValueError(f"{path}: expected a depth map of 2 x 2 pixels or more, got {depth.shape}")
    expect_distances(str(path), torch.from_numpy(depth[np.isfinite(depth)]))
    photo = decode_pixels(path, arrays["photo"].tobytes(), cv2.IMREAD_COLOR, LONGEST**2)
    if photo is None:
        raise ValueError(f"{path}: expected the bytes of a JPEG as photo, got something else")
    return photo[..., ::-1], np.where(np.isfinite(depth), depth, np.float32(np.nan))
