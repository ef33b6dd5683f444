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

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError

from dsr.io.captures.archive import PHOTO_LIMIT, Archive, Member, decode_lzfse, decode_photo
from dsr.io.frames import HIGHEST_LEVEL, CaptureFrame, ConfidenceMap, Geometry
from dsr.io.pairs import Pair, PairingResult, join, numbered_files
from dsr.io.trajectories import describe_capture, intrinsics_camera, pose_from_quaternion
from dsr.notes import Assumption
from dsr.utils.guards import natural_key
from dsr.utils.validation import Whole, describe

_APP = "Record3D"
_METADATA_LIMIT = 1 << 27
_EXPORT_PHOTOS = (".jpg", ".jpeg", ".png")
_Side = Annotated[Whole, Field(ge=1, le=1 << 14)]
_Numbers = list[float]


class _Metadata(BaseModel, strict=True):
    """What is read of the metadata; numbers may be NaN here, each frame's are checked when it is read."""

    w: _Side
    h: _Side
    dw: _Side | None = None
    dh: _Side | None = None
    K: Annotated[_Numbers, Field(min_length=9, max_length=9)]
    poses: list[Annotated[_Numbers, Field(min_length=7, max_length=7)]] = []
    per_frame: list[Annotated[_Numbers, Field(min_length=4, max_length=4)]] = Field([], alias="perFrameIntrinsicCoeffs")

    @property
    def moves(self) -> bool:
        """Whether the poses of the frames differ."""
        return any(pose != self.poses[0] for pose in self.poses) or len(self.poses) == 1


def find_record3d(folder: Path) -> PairingResult | None:
    """Return the frames of the .r3d archives in a folder, of an unpacked one, or of an export; None if there are none.

    Raises:
        ValueError: the metadata of an archive are damaged or of another app.

    """
    if folder.is_file():
        return _read_archive(Archive(folder), "") if folder.suffix.lower() == ".r3d" else None
    scans = [path for path in folder.iterdir() if path.suffix.lower() == ".r3d" and path.is_file()]
    if scans:
        return join(_read_archive(Archive(path), path.stem) for path in sorted(scans, key=natural_key))
    if (folder / "rgbd").is_dir() and (folder / "metadata").is_file():
        return _read_archive(Archive(folder), "")
    if (folder / "metadata.json").is_file() and any((folder / "depth").glob("*.exr")):
        return _read_export(folder)
    return None


def _read_archive(archive: Archive, name: str) -> PairingResult:
    """Return the frames of an archive or of an unpacked one."""
    metadata = _parse(archive.path / "metadata", archive.read("metadata", _METADATA_LIMIT))
    kinds: dict[str, dict[int, str]] = {".jpg": {}, ".depth": {}, ".conf": {}}
    for member in archive.names():
        if match := re.fullmatch(r"rgbd/(\d{1,9})(\.jpg|\.depth|\.conf)", member):
            kinds[match[2]][int(match[1])] = member
    photos, depths, confidences = kinds.values()
    size = (metadata.dh or metadata.h, metadata.dw or metadata.w)
    make = functools.partial(_member, archive, size)
    pairs = []
    for number in sorted(photos.keys() & depths.keys()):
        photo = Member(archive, photos[number], PHOTO_LIMIT, decode_photo)
        frame = replace(
            _frame(archive.path / "metadata", metadata, number), photo=photo, depth=make(depths[number], "<f4")
        )
        known = None
        if number in confidences:
            path = archive.path / confidences[number]
            known = ConfidenceMap(path, HIGHEST_LEVEL, make(confidences[number], "u1"))
        paths = archive.path / photos[number], archive.path / depths[number]
        pairs.append(Pair(f"{name}/{number:06}".lstrip("/"), *paths, unit=1.0, capture=frame, confidence=known))
    unpaired = [archive.path / member for number, member in (photos | depths).items()
                if number not in photos.keys() & depths.keys()]  # fmt: skip
    if not pairs:
        raise ValueError(f"{archive.path}: expected photos and depth maps of {_APP} in rgbd/, found no pair")
    return PairingResult(tuple(pairs), _found(metadata, pairs), tuple(unpaired))


def _read_export(folder: Path) -> PairingResult | None:
    """Return the frames of an export; None if the metadata are of another app."""
    path = folder / "metadata.json"
    content = Archive(folder).read(path.name, _METADATA_LIMIT)
    if not _is_ours(content):
        return None
    metadata = _parse(path, content)
    photos, depths, confidences = (
        numbered_files(folder / kind, suffixes)
        for kind, suffixes in (("rgb", _EXPORT_PHOTOS), ("depth", (".exr",)), ("conf", (".exr", ".png")))
    )
    both = sorted(photos.keys() & depths.keys())
    pairs = [
        Pair(f"{number:06}", photos[number], depths[number], unit=1.0, capture=_frame(path, metadata, number),
             confidence=ConfidenceMap(confidences[number], HIGHEST_LEVEL) if number in confidences else None)
        for number in both
    ]  # fmt: skip
    unpaired = [each[number] for each in (photos, depths) for number in each if number not in both]
    return PairingResult(tuple(pairs), _found(metadata, pairs), tuple(unpaired))


def _found(metadata: _Metadata, pairs: Sequence[Pair]) -> tuple[Assumption, ...]:
    """Return what was found out about a capture."""
    found = [describe_capture(f"a capture of {_APP}", "metres", pairs, poses=metadata.moves)]
    if metadata.poses and not metadata.moves:
        found.append(Assumption("no poses: those of the capture are all the same"))
    return tuple(found)


def _is_ours(content: bytes) -> bool:
    """Return whether JSON has the keys of the app, so that a file of another app is left alone."""
    try:
        entries = json.loads(content)
    except (ValueError, RecursionError):
        return False
    return isinstance(entries, dict) and {"K", "w", "h"} <= entries.keys()


def _parse(path: Path, content: bytes) -> _Metadata:
    """Return the metadata."""
    try:
        entries: Any = json.loads(content)
        return _Metadata.model_validate(entries)
    except ValidationError as error:
        raise ValueError(f"{path}: expected {_APP}'s metadata; {describe(error)}") from error
    except (ValueError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path}: expected {_APP}'s metadata as JSON, got something else") from error


def _member(archive: Archive, size: tuple[int, int], name: str, dtype: str) -> Member:
    """Return the source of a compressed map."""
    decode: Callable[..., Any] = functools.partial(decode_lzfse, size=size, dtype=dtype)
    return Member(archive, str(PurePosixPath(name)), 4 * size[0] * size[1] + (1 << 16), decode)


def _frame(path: Path, metadata: _Metadata, number: int) -> CaptureFrame:
    """Return what the metadata say of a frame."""
    size = (metadata.h, metadata.w)
    own = number < len(metadata.per_frame)
    K = metadata.K
    numbers = metadata.per_frame[number] if own else [K[0], K[4], K[6], K[7]]
    pose = metadata.poses[number] if metadata.moves and number < len(metadata.poses) else None
    geometry = functools.partial(_geometry, f"{path}: frame {number}", size, numbers, pose, own)
    return CaptureFrame(_APP, geometry, path, repr((size, numbers, pose)).encode())


def _geometry(
    place: str, size: tuple[int, int], numbers: _Numbers, pose: _Numbers | None, own: bool, _: tuple[int, int]
) -> Geometry:
    """Return camera and pose of a frame."""
    camera = intrinsics_camera(place, size, numbers)
    text = "camera: K of the first frame; the metadata have none of each frame"
    assumptions = () if own else (Assumption(text),)
    if pose is None:
        return Geometry(camera, None, assumptions)
    return Geometry(camera, pose_from_quaternion(place, pose[:4], pose[4:], opengl=True), assumptions, up="y")
