"""Record3D, an app for iPhones and iPads: its .r3d archives, and its export of EXR depth and photos.

https://record3d.app; the format by the app's author: https://github.com/marek-simonik/record3d/issues/27, 33, 64, 83.

    metadata                 JSON: w, h, dw, dh; K (column by column, pixels of w x h); perFrameIntrinsicCoeffs, a
                             [fx, fy, cx, cy] for each frame; poses, a [qx, qy, qz, qw, tx, ty, tz] for each frame
    rgbd/12.jpg              photo of w x h
    rgbd/12.depth            LZFSE of dh x dw float32 in metres, NaN in holes
    rgbd/12.conf             LZFSE of dh x dw uint8, 0 (low) to 2 (high)

The export has the same as ``metadata.json``, ``rgb/12.jpg`` (or .png) and ``depth/12.exr``. Poses lead from the camera
to the world; the camera has OpenGL's axes. Recordings of the front camera have no poses: all are the same.
"""

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from dsr.geometry.poses import from_quaternion
from dsr.io.captures.archive import PHOTO_LIMIT, as_pixels, decode_photo, members, read_part
from dsr.io.frames import HIGHEST_LEVEL, CaptureFrame, ConfidenceMap, Geometry, Part, Size, stated
from dsr.io.pairs import Pair, PairingResult, numbered_files, paired
from dsr.io.trajectories import ARKIT_TO_DSR, describe_capture, intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import refusing
from dsr.utils.validation import Whole, parse_model
from dsr.utils.versions import how_to_install

_APP = "Record3D"
_METADATA_LIMIT = 1 << 27
_Side = Annotated[Whole, Field(ge=1, le=1 << 14)]


class _Metadata(BaseModel, strict=True):
    """What is read of the metadata; numbers may be NaN here, each frame's are checked when it is read."""

    w: _Side
    h: _Side
    dw: _Side | None = None
    dh: _Side | None = None
    K: Annotated[list[float], Field(min_length=9, max_length=9)]
    poses: list[Annotated[list[float], Field(min_length=7, max_length=7)]] = []
    per_frame: list[Annotated[list[float], Field(min_length=4, max_length=4)]] = Field(
        [], alias="perFrameIntrinsicCoeffs"
    )


def find(folder: Path) -> PairingResult | None:
    """Return the frames of an unpacked archive or of an export."""
    if (folder / "rgbd").is_dir() and (folder / "metadata").is_file():
        return read_archive(folder)
    path = folder / "metadata.json"
    if not path.is_file() or not any((folder / "depth").glob("*.exr")):
        return None
    content = read_part(folder, path.name, _METADATA_LIMIT)
    if not all(f'"{key}"'.encode() in content for key in ("K", "w", "h")):  # of another app
        return None
    files = {
        "jpg": numbered_files(folder / "rgb", (".jpg", ".jpeg", ".png")),
        "depth": numbered_files(folder / "depth", (".exr",)),
        "conf": numbered_files(folder / "conf", (".exr", ".png")),
    }
    metadata = parse_model(_Metadata, content, path, f"expected {_APP}'s metadata; ")
    return _frames(path, metadata, files, {})


def read_archive(path: Path) -> PairingResult:
    """Return the frames of an archive or of an unpacked one."""
    content, place = read_part(path, "metadata", _METADATA_LIMIT), path / "metadata"
    metadata = parse_model(_Metadata, content, place, f"expected {_APP}'s metadata; ")
    files: dict[str, dict[int, Path]] = {"jpg": {}, "depth": {}, "conf": {}}
    for name in members(path):
        if match := re.fullmatch(r"rgbd/(\d{1,9})\.(jpg|depth|conf)", name):
            files[match[2]][int(match[1])] = path / name
    files["jpg"] = dict(sorted(files["jpg"].items()))
    size = metadata.dh or metadata.h, metadata.dw or metadata.w
    decoders: dict[str, Callable[[bytes], np.ndarray]] = {
        "jpg": decode_photo,
        "depth": functools.partial(decode_lzfse, size=size, dtype="<f4"),
        "conf": functools.partial(decode_lzfse, size=size, dtype="u1"),
    }
    parts = {}
    for kind, numbered in files.items():
        most = PHOTO_LIMIT if kind == "jpg" else 4 * size[0] * size[1] + (1 << 16)
        for file in numbered.values():
            name = f"rgbd/{file.name}"
            parts[file] = Part(path, name, functools.partial(read_part, path, name, most), decoders[kind])
    found = _frames(place, metadata, files, parts)
    if not found.pairs:
        raise ValueError(f"{path}: expected photos and depth maps of {_APP} in rgbd/, found no pair")
    return found


def _frames(
    path: Path, metadata: _Metadata, files: Mapping[str, Mapping[int, Path]], parts: Mapping[Path, Part]
) -> PairingResult:
    """Return the frames of files by kind and number; those that are no files of their own are parts of an archive."""
    both, unpaired = paired(files["jpg"], files["depth"])
    size, K, poses = (metadata.h, metadata.w), metadata.K, metadata.poses
    moves = len(poses) == 1 or any(pose != poses[0] for pose in poses)
    pairs = []
    for number in both:
        own = metadata.per_frame[number] if number < len(metadata.per_frame) else None
        pose = poses[number] if moves and number < len(poses) else None
        content = repr((size, own or [K[0], K[4], K[6], K[7]], pose)).encode()
        geometry = stated(_geometry, f"{path}: frame {number}", metadata, own, pose)
        photo, depth = files["jpg"][number], files["depth"][number]
        frame = CaptureFrame(_APP, geometry, path, content, parts.get(photo), parts.get(depth))
        known = files["conf"].get(number)
        confidence = None if known is None else ConfidenceMap(known, HIGHEST_LEVEL, parts.get(known))
        pairs.append(Pair(f"{number:06}", photo, depth, unit=1.0, capture=frame, confidence=confidence))
    notes = [describe_capture(f"a capture of {_APP}", "metres", pairs, poses=moves)]
    if poses and not moves:
        notes.append(Assumption("no poses: those of the capture are all the same"))
    return PairingResult(tuple(pairs), tuple(notes), unpaired)


def _geometry(place: str, metadata: _Metadata, own: list[float] | None, pose: list[float] | None) -> Geometry:
    K = metadata.K
    camera = intrinsics_camera(place, (metadata.h, metadata.w), own or [K[0], K[4], K[6], K[7]])
    text = "camera: K of the first frame; the metadata have none of each frame"
    notes = () if own else (Assumption(text),)
    if pose is None:
        return Geometry(camera, None, notes)
    return Geometry(camera, from_quaternion(pose[4:], pose[:4], place) @ ARKIT_TO_DSR, notes, up="y")


def decode_lzfse(content: bytes, size: Size, dtype: str) -> np.ndarray:
    """Return the map (h, w) of some type of values that LZFSE data hold; https://github.com/lzfse/lzfse."""
    with refusing(f"LZFSE data need the package lzfse: {how_to_install('captures')}", ImportError):
        import lzfse  # noqa: PLC0415 - an extra
    with refusing(f"expected LZFSE data, got {len(content)} damaged bytes", lzfse.error, MemoryError):
        values = lzfse.decompress(content)
    return as_pixels(values, dtype, size)
