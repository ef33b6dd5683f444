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
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from dsr.io.captures.archive import PHOTO_LIMIT, Archive, Member, decode_lzfse, decode_photo
from dsr.io.frames import HIGHEST_LEVEL, CaptureFrame, ConfidenceMap, Geometry, stated
from dsr.io.pairs import Pair, PairingResult, numbered_files, paired
from dsr.io.trajectories import describe_capture, intrinsics_camera, pose_from_quaternion
from dsr.notes import Assumption
from dsr.utils.validation import Whole, describe

_APP = "Record3D"
_METADATA_LIMIT = 1 << 27
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

    @functools.cached_property
    def moves(self) -> bool:
        """Whether the poses of the frames differ."""
        return any(pose != self.poses[0] for pose in self.poses) or len(self.poses) == 1


def find(folder: Path) -> PairingResult | None:
    """Return the frames of an unpacked archive or of an export."""
    if (folder / "rgbd").is_dir() and (folder / "metadata").is_file():
        return read_archive(folder)
    path = folder / "metadata.json"
    if not path.is_file() or not any((folder / "depth").glob("*.exr")):
        return None
    content = Archive(folder).read(path.name, _METADATA_LIMIT)
    if not _is_ours(content):
        return None
    metadata = _parse(path, content)
    photos, depths, confidences = (
        numbered_files(folder / kind, suffixes)
        for kind, suffixes in (("rgb", (".jpg", ".jpeg", ".png")), ("depth", (".exr",)), ("conf", (".exr", ".png")))
    )
    both, unpaired = paired(photos, depths)
    pairs = [
        Pair(f"{number:06}", photos[number], depths[number], unit=1.0, capture=_frame(path, metadata, number),
             confidence=ConfidenceMap(confidences[number], HIGHEST_LEVEL) if number in confidences else None)
        for number in both
    ]  # fmt: skip
    return PairingResult(tuple(pairs), _found(metadata, pairs), unpaired)


def read_archive(path: Path) -> PairingResult:
    """Return the frames of an archive or of an unpacked one."""
    archive = Archive(path)
    metadata = _parse(path / "metadata", archive.read("metadata", _METADATA_LIMIT))
    files: dict[str, dict[int, Path]] = {"jpg": {}, "depth": {}, "conf": {}}
    for name in archive.names():
        if match := re.fullmatch(r"rgbd/(\d{1,9})\.(jpg|depth|conf)", name):
            files[match[2]][int(match[1])] = path / name
    both, unpaired = paired(dict(sorted(files["jpg"].items())), files["depth"])
    if not both:
        raise ValueError(f"{path}: expected photos and depth maps of {_APP} in rgbd/, found no pair")
    size = metadata.dh or metadata.h, metadata.dw or metadata.w

    def member(kind: str, number: int, dtype: str = "") -> Member:
        name = f"rgbd/{files[kind][number].name}"
        if not dtype:
            return Member(archive, name, PHOTO_LIMIT, decode_photo)
        decoder = functools.partial(decode_lzfse, size=size, dtype=dtype)
        return Member(archive, name, 4 * size[0] * size[1] + (1 << 16), decoder)

    pairs = []
    for number in both:
        frame = _frame(path / "metadata", metadata, number)
        frame = replace(frame, photo=member("jpg", number), depth=member("depth", number, "<f4"))
        pair = Pair(f"{number:06}", files["jpg"][number], files["depth"][number], unit=1.0, capture=frame)
        if number in files["conf"]:
            confidence = ConfidenceMap(files["conf"][number], HIGHEST_LEVEL, member("conf", number, "u1"))
            pair = replace(pair, confidence=confidence)
        pairs.append(pair)
    return PairingResult(tuple(pairs), _found(metadata, pairs), unpaired)


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
        return _Metadata.model_validate(json.loads(content))
    except ValidationError as error:
        raise ValueError(f"{path}: expected {_APP}'s metadata; {describe(error)}") from error
    except (ValueError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path}: expected {_APP}'s metadata as JSON, got something else") from error


def _frame(path: Path, metadata: _Metadata, number: int) -> CaptureFrame:
    """Return what the metadata say of a frame."""
    size, K = (metadata.h, metadata.w), metadata.K
    own = number < len(metadata.per_frame)
    numbers = metadata.per_frame[number] if own else [K[0], K[4], K[6], K[7]]
    pose = metadata.poses[number] if metadata.moves and number < len(metadata.poses) else None
    place, text = f"{path}: frame {number}", "camera: K of the first frame; the metadata have none of each frame"
    notes = () if own else (Assumption(text),)

    def geometry() -> Geometry:
        camera = intrinsics_camera(place, size, numbers)
        if pose is None:
            return Geometry(camera, None, notes)
        return Geometry(camera, pose_from_quaternion(place, pose[:4], pose[4:], opengl=True), notes, up="y")

    return CaptureFrame(_APP, stated(geometry), path, repr((size, numbers, pose)).encode())
