"""Stray Scanner, an app for iPhones and iPads with lidar; https://github.com/strayrobots/scanner, docs/format.md.

``camera_matrix.csv`` has the intrinsics of the last frame, in pixels of the video; ``odometry.csv`` a pose for each
frame, and since 2026 its intrinsics. The odometry's quaternion turns a camera with the axes x right, y down, z forward
into ARKit's world, y up: the app turns ARKit's camera by 180 degrees around x before it writes the pose
(OdometryEncoder.swift). ``frame`` numbers the maps, and the video's frames if those are counted that its edit list
hides: the app writes the first one at a time before 0 (VideoEncoder.swift).
"""

from __future__ import annotations

import contextlib
import csv
import functools
import math
import os
import re
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dsr.geometry.poses import from_quaternion
from dsr.io.frames import HIGHEST_LEVEL, CaptureFrame, ConfidenceMap, Geometry, Record, Size, Source, file_state
from dsr.io.pairs import PHOTO_SUFFIXES, Pair, PairingResult, numbered_files, paired
from dsr.io.trajectories import USUAL_SIZE, describe_capture, fitting_camera
from dsr.notes import Assumption
from dsr.utils.decoding import QUIET_DECODERS
from dsr.utils.guards import expect_pixels, named_numbers, numbers_in, read_text, refusing
from dsr.utils.versions import hash_once

_APP = "Stray Scanner"
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_Row = Mapping[str, str]

_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_LARGEST = 1 << 25  # pixels of a frame, those of 8K; a decoder keeps many frames
_LOCK = threading.Lock()


def find(folder: Path) -> PairingResult | None:
    """Return the frames of a folder of Stray Scanner."""
    video, matrix, odometry = folder / "rgb.mp4", folder / "camera_matrix.csv", folder / "odometry.csv"
    photos, depths = numbered_files(folder / "rgb", PHOTO_SUFFIXES), numbered_files(folder / "depth", (".png", ".npy"))
    if not (matrix.is_file() or odometry.is_file()) or not depths or not (photos or video.is_file()):
        return None
    confidence, rows = numbered_files(folder / "confidence", (".png",)), _read_odometry(odometry)
    text = read_text(matrix) if matrix.is_file() else ""
    frames, warnings = dict[int, VideoFrame](), list[Assumption]()
    if not photos:
        photos, frames, warnings = frames_of_video(video, depths)
    both, unpaired = paired(photos, depths)
    pairs = []
    for number in sorted(both):
        row = rows.get(number, {})
        content = repr((text, sorted(row.items()))).encode()
        geometry = functools.partial(_geometry, folder, number, row, text)
        frame = CaptureFrame(_APP, geometry, odometry if row else matrix, content, frames.get(number))
        known = ConfidenceMap(confidence[number], HIGHEST_LEVEL) if number in confidence else None
        time = next((value for value in numbers_in([row.get("timestamp", "")]) if math.isfinite(value)), None)
        files = photos[number], depths[number]
        pairs.append(Pair(f"{number:06}", *files, unit=1e-3, capture=frame, confidence=known, time=time))
    note = describe_capture(f"a capture of {_APP}", "millimetres", pairs, poses=bool(rows))
    return PairingResult(tuple(pairs), (note, *warnings), unpaired)


def frames_of_video(
    video: Path, depths: Iterable[int]
) -> tuple[dict[int, Path], dict[int, VideoFrame], list[Assumption]]:
    """Return the names and the frames of a video that belong to depth maps of these numbers, and warnings."""
    frames, warnings = {number: VideoFrame(video, f"{number:06}", number) for number in depths}, []
    expected = max(frames) + 1
    with contextlib.suppress(ValueError), _LOCK:  # each frame says so when it is read
        count = int(_player(video, file_state(video, "a video")).capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if count != expected:
            text = f"{video.name} has {count} frames, the depth maps count to {expected}: photos may be some frames off"
            warnings.append(Assumption(text))
    return {number: video / frame.name for number, frame in frames.items()}, frames, warnings


def _read_odometry(path: Path) -> dict[int, _Row]:
    if not path.is_file():
        return {}
    with refusing(f"{path}: expected a table of {_APP}, got a damaged or foreign file", csv.Error):
        names, *lines = list(csv.reader(read_text(path).splitlines(), skipinitialspace=True)) or [[]]
    names = [name.strip() for name in names]
    missing = [name for name in ("frame", *_POSE) if name not in names]
    if missing:
        raise ValueError(f"{path}: expected {_APP}'s columns, there is no {', '.join(missing)}")
    rows: dict[int, _Row] = {}
    for values in lines:
        row = dict(zip(names, (value.strip() for value in values), strict=False))
        if re.fullmatch(r"\d{1,9}", row.get("frame", "")):
            rows.setdefault(int(row["frame"]), row)
    return rows


def _geometry(folder: Path, number: int, row: _Row, text: str, size: Size) -> Geometry:
    place = f"{folder / 'odometry.csv'}: frame {number}"
    camera, pose, notes = None, None, []
    if row:
        values = named_numbers(place, row, _POSE)
        pose = from_quaternion(values[:3], values[3:], place)
    else:
        notes.append(Assumption("no pose: odometry.csv has none of the frame"))
    intrinsics: list[float] = []
    if all(row.get(name) for name in _INTRINSICS):
        intrinsics = named_numbers(place, row, _INTRINSICS)
    elif text:
        notes.append(Assumption("camera: camera_matrix.csv of the whole capture; odometry.csv has none of each frame"))
        place = str(folder / "camera_matrix.csv")
        entries = numbers_in(text.replace(",", " ").split())
        matrix = np.array(entries).reshape(3, 3) if len(entries) == 9 else np.full((3, 3), np.nan)
        if not np.isfinite(matrix).all() or not np.allclose(matrix[2], (0, 0, 1)):
            raise ValueError(f"{place}: expected a 3 x 3 matrix of intrinsics, got {text!r:.80}")
        intrinsics = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    if intrinsics:
        video, sizes = folder / "rgb.mp4", [size]
        if video.is_file() and (folder / "rgb").is_dir():  # extracted photos may have been made smaller
            height, width, _ = VideoFrame(video, "000000", 0).read().shape
            sizes.append((height, width))
        camera = fitting_camera(place, (*sizes, USUAL_SIZE), intrinsics)
    return Geometry(camera, pose, tuple(notes), up="y")


@dataclass(frozen=True)
class VideoFrame(Source):
    """The frame of a video with a number from 0, decoded as it is asked for."""

    index: int

    def read(self) -> np.ndarray:
        """Return the frame, (H, W, 3) uint8 RGB."""
        with _LOCK:
            return _player(self.file, file_state(self.file, "a video")).read(self.index)

    def record(self) -> Record:
        """Return the video's name and hash, and the frame's number."""
        return {"file": self.file.name, "frame": self.index, "sha256": hash_once(self.file)}


class _Player:
    """A video of a :func:`file_state` that is open at some frame."""

    def __init__(self, path: Path, _state: tuple[int, int]) -> None:
        self._path = path
        self._open()

    def read(self, index: int) -> np.ndarray:
        """Return a frame; the frames between the last one and this one are skipped."""
        if index < self._next:
            self.capture.release()
            self._open()
        with QUIET_DECODERS:
            while self._next <= index:
                if not self.capture.grab():
                    end = f"the video is damaged or ends after {self._next} frames"
                    raise ValueError(f"{self._path}: expected a frame {index}, {end}")
                self._next += 1
            there, frame = self.capture.retrieve()
        if not there:
            raise ValueError(f"{self._path}: expected a picture as frame {index}, it cannot be decoded")
        return cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)

    def _open(self) -> None:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once; its threads may print messages later
        before = os.environ.get(_OPTIONS)
        os.environ[_OPTIONS] = "ignore_editlist;1"  # decodes the frames that it hides: Stray Scanner's first one
        try:
            with QUIET_DECODERS:
                self.capture, self._next = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG), 0
        finally:
            del os.environ[_OPTIONS]
            if before is not None:
                os.environ[_OPTIONS] = before
        width, height = (self.capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not self.capture.isOpened() or not width * height > 0:
            raise ValueError(f"{self._path}: expected a video, got a damaged or foreign file")
        expect_pixels(self._path, int(height), int(width), _LARGEST)
        self.capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # intrinsics are those of the pixels as they are stored


_player = functools.lru_cache(maxsize=1)(_Player)  # the open video
