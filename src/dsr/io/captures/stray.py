"""Stray Scanner, an app for iPhones and iPads with lidar; https://github.com/strayrobots/scanner, docs/format.md.

    rgb.mp4                  the photos, 1920 x 1440; or extracted ones in rgb/000000.png
    depth/000000.png         16-bit millimetres, 256 x 192; .npy of millimetres in old versions
    confidence/000000.png    0 (low) to 2 (high), of the depth map's size
    camera_matrix.csv        3 x 3 intrinsics of the last frame, in pixels of the video
    odometry.csv             timestamp, frame, x, y, z, qx, qy, qz, qw; fx, fy, cx, cy since 2026

The odometry's quaternion turns a camera with the axes x right, y down, z forward into ARKit's world, y up: the app
turns ARKit's camera by 180 degrees around x before it writes the pose (OdometryEncoder.swift). ``frame`` numbers the
maps, and the video's frames if those are counted that its edit list hides: the app writes the first one at a time
before 0 (VideoEncoder.swift).
"""

from __future__ import annotations

import contextlib
import csv
import functools
import math
import os
import re
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dsr.geometry.camera import Camera
from dsr.io.frames import HIGHEST_LEVEL, CaptureFrame, ConfidenceMap, Geometry, Record, Size, Source, file_state
from dsr.io.pairs import PHOTO_SUFFIXES, Pair, PairingResult, numbered_files
from dsr.io.trajectories import USUAL_SIZE, describe_capture, fitting_camera, pose_from_quaternion
from dsr.notes import Assumption
from dsr.utils.decoding import QUIET_DECODERS
from dsr.utils.guards import expect_pixels, numbers_in, read_text, refusing
from dsr.utils.versions import hash_once

_APP = "Stray Scanner"
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_Row = Mapping[str, str]

# Makes FFmpeg decode the frames that the file's edit list hides: Stray Scanner's first one.
_OPTIONS, _ALL_FRAMES = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "ignore_editlist;1"
_LOG_LEVEL, _SILENT = "OPENCV_FFMPEG_LOGLEVEL", "-8"
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
    pairs, unpaired = [], []
    for number, depth in depths.items():
        photo = photos.get(number)
        if photo is None and photos:
            unpaired.append(depth)
            continue
        row = rows.get(number, {})
        described = (odometry if row else matrix, repr((text, sorted(row.items()))).encode())
        geometry = functools.partial(_geometry, folder, number, row, text)
        frame = CaptureFrame(_APP, geometry, *described, photo=None if photo else VideoFrame(video, number))
        known = ConfidenceMap(confidence[number], HIGHEST_LEVEL) if number in confidence else None
        time = next((value for value in numbers_in([row.get("timestamp", "")]) if math.isfinite(value)), None)
        files = photo or video / f"{number:06}", depth
        pairs.append(Pair(f"{number:06}", *files, unit=1e-3, capture=frame, confidence=known, time=time))
    unpaired += [path for number, path in photos.items() if number not in depths]
    notes = [describe_capture(f"a capture of {_APP}", "millimetres", pairs, poses=bool(rows))]
    if not photos:
        notes += check_count(video, max(depths) + 1)
    return PairingResult(tuple(pairs), tuple(notes), tuple(unpaired))


def check_count(video: Path, expected: int) -> list[Assumption]:
    """Return a warning if a video has another number of frames than there are maps: they may belong to others."""
    try:
        with _LOCK:
            count = _player(video, file_state(video, "a video")).count
    except ValueError:  # each frame says so when it is read
        return []
    text = f"{video.name} has {count} frames, the depth maps count to {expected}: photos may be some frames off"
    return [] if count == expected else [Assumption(text)]


def _read_odometry(path: Path) -> dict[int, _Row]:
    """Return the rows of the odometry by frame, with their values as text; empty without the file."""
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


def _geometry(folder: Path, number: int, row: _Row, matrix: str, size: Size) -> Geometry:
    """Return camera and pose of a frame."""
    place = f"{folder / 'odometry.csv'}: frame {number}"

    def numbers(names: tuple[str, ...]) -> list[float]:
        came = [row.get(name, "nothing") for name in names]
        if not (values := numbers_in(came)):
            raise ValueError(f"{place}: expected numbers for {', '.join(names)}, got {', '.join(came):.120}")
        return values

    camera, pose, notes = None, None, []
    if row:
        values = numbers(_POSE)
        pose = pose_from_quaternion(place, values[3:], values[:3])
    else:
        notes.append(Assumption("no pose: odometry.csv has none of the frame"))
    if all(row.get(name) for name in _INTRINSICS):
        camera = _camera(folder, place, numbers(_INTRINSICS), size)
    elif matrix:
        text = "camera: camera_matrix.csv of the whole capture; odometry.csv has none of each frame"
        notes.append(Assumption(text))
        path = folder / "camera_matrix.csv"
        camera = _camera(folder, str(path), _read_matrix(path, matrix), size)
    return Geometry(camera, pose, tuple(notes), up="y")


def _read_matrix(path: Path, text: str) -> list[float]:
    """Return fx, fy, cx, cy of the matrix."""
    values = numbers_in(text.replace(",", " ").split())
    matrix = np.array(values).reshape(3, 3) if len(values) == 9 else np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all() or not np.allclose(matrix[2], (0, 0, 1)):
        raise ValueError(f"{path}: expected a 3 x 3 matrix of intrinsics, got {text!r:.80}")
    return [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]


def _camera(folder: Path, place: str, numbers: list[float], size: Size) -> Camera:
    """Return the camera, of the photo's pixels, or of the video's if extracted photos were made smaller."""
    video, sizes = folder / "rgb.mp4", [size]
    if video.is_file() and (folder / "rgb").is_dir():
        height, width, _ = VideoFrame(video, 0).read().shape
        sizes.append((height, width))
    return fitting_camera(place, (*sizes, USUAL_SIZE), numbers)


@dataclass(frozen=True)
class VideoFrame(Source):
    """The frame of a video with a number from 0, decoded as it is asked for."""

    file: Path
    index: int

    def read(self) -> np.ndarray:
        """Return the frame, (H, W, 3) uint8 RGB."""
        with _LOCK:
            return _player(self.file, file_state(self.file, "a video")).read(self.index)

    def record(self) -> Record:
        """Return the video's name and hash, and the frame's number."""
        return {"file": self.file.name, "frame": self.index, "sha256": hash_once(self.file)}


class _Player:
    """A video that is open at some frame."""

    def __init__(self, path: Path) -> None:
        self._path, self._next = path, 0
        self._capture = self._open()

    @property
    def count(self) -> int:
        """Number of frames that the file declares, those that an edit list hides among them."""
        return int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))

    def read(self, index: int) -> np.ndarray:
        """Return a frame; the frames between the last one and this one are skipped."""
        if index < self._next:
            self._capture.release()
            self._capture, self._next = self._open(), 0
        with QUIET_DECODERS:
            while self._next <= index:
                if not self._capture.grab():
                    end = f"the video is damaged or ends after {self._next} frames"
                    raise ValueError(f"{self._path}: expected a frame {index}, {end}")
                self._next += 1
            there, frame = self._capture.retrieve()
        if not there:
            raise ValueError(f"{self._path}: expected a picture as frame {index}, it cannot be decoded")
        return cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)

    def _open(self) -> cv2.VideoCapture:
        """Open the video at its first frame."""
        os.environ.setdefault(_LOG_LEVEL, _SILENT)  # read once; its threads may print messages later
        with QUIET_DECODERS, _environment(_OPTIONS, _ALL_FRAMES):
            capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        width, height = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not capture.isOpened() or not width * height > 0:
            raise ValueError(f"{self._path}: expected a video, got a damaged or foreign file")
        expect_pixels(self._path, int(height), int(width), _LARGEST)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # intrinsics are those of the pixels as they are stored
        return capture


@functools.lru_cache(maxsize=1)
def _player(path: Path, _state: tuple[int, int]) -> _Player:
    """Return the open video."""
    return _Player(path)


@contextlib.contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    """Set a variable of the environment for a while."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
