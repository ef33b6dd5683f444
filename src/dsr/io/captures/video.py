"""Frames of videos, decoded one by one as they are asked for."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dsr.data.formats.decoding import quiet_decoders
from dsr.io.frames import Record
from dsr.utils.hashing import file_hash
from dsr.utils.limits import expect_pixels

_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_ALL_FRAMES = "ignore_editlist;1"
"""Makes FFmpeg decode the frames that the file's edit list hides: Stray Scanner's first one."""
_LOG_LEVEL, _SILENT = "OPENCV_FFMPEG_LOGLEVEL", "-8"
_LARGEST = 1 << 25
"""Largest number of pixels of a frame, that of 8K; a decoder keeps many frames."""
_LOCK = threading.Lock()


@dataclass(frozen=True)
class VideoFrame:
    """A :class:`~dsr.io.frames.Source` of a frame of a video.

    Args:
        file: the video.
        index: number of the frame, from 0.

    """

    file: Path
    index: int

    def read(self) -> np.ndarray:
        """Return the frame, (H, W, 3) uint8 RGB.

        Raises:
            ValueError: the file is no video, is damaged, or ends before the frame.

        """
        with _LOCK:
            return _player(self.file, _state(self.file)).read(self.index)

    def record(self) -> Record:
        """Return the video's name and hash, and the frame's number."""
        return {"file": self.file.name, "frame": self.index, "sha256": _hash(self.file, _state(self.file))}


class _Player:
    """A video that is open at some frame."""

    def __init__(self, path: Path) -> None:
        self._path, self._next = path, 0
        self._capture = self._open()

    @property
    def count(self) -> int:
        """Number of frames that the file declares."""
        return int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))

    def read(self, index: int) -> np.ndarray:
        """Return a frame; the frames between the last one and this one are skipped."""
        if index < self._next:
            self._capture.release()
            self._capture, self._next = self._open(), 0
        with quiet_decoders():
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
        if not self._path.is_file():
            raise ValueError(f"{self._path}: expected a video, there is none")
        os.environ.setdefault(_LOG_LEVEL, _SILENT)  # read once; its threads may speak after they were asked
        with quiet_decoders(), _environment(_OPTIONS, _ALL_FRAMES):
            capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        width, height = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not capture.isOpened() or not width * height > 0:
            raise ValueError(f"{self._path}: expected a video, got a damaged or foreign file")
        expect_pixels(self._path, int(height), int(width), _LARGEST)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # intrinsics are those of the pixels as they are stored
        return capture


def count_frames(path: Path) -> int:
    """Return how many frames a video declares, those that an edit list hides among them.

    Raises:
        ValueError: the file is no video.

    """
    with _LOCK:
        return _player(path, _state(path)).count


def video_size(path: Path) -> tuple[int, int]:
    """Return height and width of a video's frames.

    Raises:
        ValueError: the file is no video.

    """
    shape = VideoFrame(path, 0).read().shape
    return shape[0], shape[1]


def _state(path: Path) -> tuple[int, int]:
    """Return size and time of a file, which tell whether it was replaced."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a video, there is none")
    return path.stat().st_size, path.stat().st_mtime_ns


@functools.lru_cache(maxsize=1)
def _player(path: Path, _: tuple[int, int]) -> _Player:
    """Return the open video."""
    return _Player(path)


@functools.lru_cache(maxsize=4)
def _hash(path: Path, _: tuple[int, int]) -> str:
    """Return the hash of a video, which is computed once."""
    return file_hash(path)


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
