"""Three-dimensional models as files: PLY and binary glTF, written by trimesh.

A PLY file has points in the camera frame: x right, y down, z forward. glTF has y up and +z towards the viewer (Khronos,
glTF 2.0 specification, section 3.4), so y and z change their signs there, which is a rotation about x by 180 degrees.
"""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.ply import export_ply
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from dsr.utils.files import replacing

_TO_GLTF = np.array([1, -1, -1])
_LARGEST_TEXTURE = 4096
"""Largest side of a texture in pixels, which every viewer supports."""
_LOSSLESS = 2**21
"""Largest number of pixels of a texture that is stored without loss."""
_FRAME = b"comment camera frame: x right, y down, z forward; metres\n"


def write_ply(
    path: Path, points: np.ndarray, normals: np.ndarray, colours: np.ndarray, faces: np.ndarray | None = None
) -> None:
    """Write a binary PLY file atomically.

    Args:
        path: the file.
        points: (N, 3) in metres, in the camera frame.
        normals: (N, 3) unit vectors.
        colours: (N, 3) uint8, sRGB.
        faces: (M, 3) indices, counterclockwise from outside; None for a cloud.

    """
    corners = np.empty((0, 3), int) if faces is None else faces
    model = trimesh.Trimesh(points, corners, vertex_normals=normals, vertex_colors=colours, process=False)
    header, mark, content = export_ply(model, vertex_normal=True).partition(b"element vertex")
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.writelines((header, _FRAME, mark, content))


def write_glb(
    path: Path, points: np.ndarray, normals: np.ndarray, faces: np.ndarray, places: np.ndarray, photo: np.ndarray
) -> None:
    """Write a mesh as binary glTF atomically, with the photo as its texture, as sharp as it is.

    The material is rough and lit from both sides, so that viewers show the shape as well as the photo.

    Args:
        path: the file.
        points: (N, 3) in metres, in the camera frame.
        normals: (N, 3) unit vectors.
        faces: (M, 3) indices, counterclockwise from outside; one at least.
        places: (N, 2) column and row of each point in the photo, pixel centres at integers.
        photo: (H, W, 3) uint8, sRGB.

    """
    height, width = photo.shape[:2]
    place = (places + 0.5) / (width, height)
    visual = TextureVisuals(uv=np.stack((place[:, 0], 1 - place[:, 1]), axis=1), material=_material(photo))
    model = trimesh.Trimesh(points * _TO_GLTF, faces, vertex_normals=normals * _TO_GLTF, visual=visual, process=False)
    with replacing(path) as temporary:
        temporary.write_bytes(export_glb(trimesh.Scene(model), include_normals=True))


def _material(photo: np.ndarray) -> PBRMaterial:
    """Return a material that looks like the photo."""
    height, width = photo.shape[:2]
    shrink = min(1.0, _LARGEST_TEXTURE / max(height, width))
    if shrink < 1:
        size = (round(width * shrink), round(height * shrink))
        photo = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    image = Image.fromarray(photo)
    if image.width * image.height > _LOSSLESS:  # trimesh keeps the format that an image has
        content = io.BytesIO()
        image.save(content, format="JPEG", quality=95)
        image = Image.open(content)
    return PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
