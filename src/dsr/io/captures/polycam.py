"""Polycam's raw export (developer mode); https://github.com/PolyCam/polyform describes it.

    keyframes/images/TIME.jpg                 photos; the same without distortion in corrected_images/
    keyframes/cameras/TIME.json               fx fy cx cy width height, t_00 .. t_23; optimised in corrected_cameras/
    keyframes/depth/TIME.png                  16-bit millimetres, 256 x 192
    keyframes/confidence/TIME.png             0 (low), 127 (medium) and 255 (high)

t_ij are the rows of the pose from ARKit's camera (y up, looking along -z) to the world. The corrected photos and
cameras are taken where a frame has both.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ValidationError

from dsr.data.formats.files import Pixels
from dsr.io.captures.poses import check_pose, describe_capture, intrinsics_camera, read_text
from dsr.io.confidence import ConfidenceMap
from dsr.io.encoding import Assumption
from dsr.io.frames import CaptureFrame, Geometry
from dsr.io.pairs import Pair, PairingResult
from dsr.utils.limits import read_limited
from dsr.utils.paths import natural_key
from dsr.utils.validation import describe

_APP = "Polycam"
_LARGEST = 1 << 20
"""Largest file of a camera in bytes."""
_KINDS = ("corrected_images", "images")
_CAMERAS = {"corrected_images": "corrected_cameras", "images": "cameras"}


class _Camera(BaseModel, strict=True):
    """A file of ``cameras``; numbers may be NaN here."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: Pixels
    height: Pixels
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float


def find_polycam(folder: Path) -> PairingResult | None:
    """Return the frames of a raw export, or of its folder ``keyframes``; None if there are none."""
    frames = folder / "keyframes" if (folder / "keyframes").is_dir() else folder
    cameras = [kind for kind in _KINDS if (frames / kind).is_dir() and any((frames / _CAMERAS[kind]).glob("*.json"))]
    if not cameras or not (frames / "depth").is_dir():
        return None
    photos = {kind: {path.stem: path for path in (frames / kind).glob("*.jpg")} for kind in cameras}
    pairs, unpaired = [], []
    for depth in sorted((frames / "depth").glob("*.png"), key=natural_key):
        kind = next((kind for kind in cameras if depth.stem in photos[kind] and _camera_of(frames, kind, depth)), None)
        if kind is None:
            unpaired.append(depth)
            continue
        path = frames / _CAMERAS[kind] / f"{depth.stem}.json"
        frame = CaptureFrame(_APP, functools.partial(_geometry, path), path, read_limited(path, _LARGEST))
        confidence = frames / "confidence" / depth.name
        known = ConfidenceMap(confidence, 255) if confidence.is_file() else None
        pairs.append(Pair(depth.stem, photos[kind][depth.stem], depth, unit=1e-3, capture=frame, confidence=known))
    notes = [describe_capture(f"a capture of {_APP}", "millimetres", pairs, poses=True)]
    corrected = sum(pair.rgb.parent.name == _KINDS[0] for pair in pairs)
    if corrected:
        notes.append(Assumption("photos and cameras are the corrected ones", f"{corrected} of {len(pairs)}"))
    return PairingResult(tuple(pairs), tuple(notes), tuple(unpaired))


def _camera_of(frames: Path, kind: str, depth: Path) -> bool:
    """Return whether a frame has a camera for a kind of photo."""
    return (frames / _CAMERAS[kind] / f"{depth.stem}.json").is_file()


def _geometry(path: Path, _: tuple[int, int]) -> Geometry:
    """Return camera and pose of a frame."""
    try:
        told = _Camera.model_validate_json(read_text(path, _LARGEST))
    except ValidationError as error:
        raise ValueError(f"{path}: expected {_APP}'s camera; {describe(error)}") from error
    camera = intrinsics_camera(str(path), (told.height, told.width), (told.fx, told.fy, told.cx, told.cy))
    rows = [[getattr(told, f"t_{row}{column}") for column in range(4)] for row in range(3)]
    return Geometry(camera, check_pose(str(path), np.array([*rows, [0, 0, 0, 1]], dtype=np.float64), opengl=True))
