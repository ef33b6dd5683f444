"""Recordings of the Azure Kinect and of Orbbec's Femto cameras with its SDK: Matroska files, read by the package PyAV.

https://github.com/microsoft/Azure-Kinect-Sensor-SDK: src/record (tracks and tags), src/calibration/calibration.c and
src/transformation/mode_specific_calibration.c.

    DEPTH, K4A_DEPTH_MODE    raw 16-bit big-endian millimetres (FOURCC b16g), 0 in holes
    COLOR, K4A_COLOR_MODE    MJPG, NV12, YUY2 or BGRA
    calibration.json         attachment: for each camera cx, cy, fx, fy, k1 to k6, codx, cody, p2, p1, of an image of
                             1 x 1 whose corner is (0, 0), and the motion from the rig's frame to its own in metres
    K4A_DEPTH_DELAY_NS       how much later than a photo its depth map was taken, on purpose

Each mode of a camera sees a part of that image, scaled. The lens model is OpenCV's. That of Orbbec's wrapper of the
SDK, Rational6KT, has half of OpenCV's mixed tangential terms and is taken for it: tenths of a pixel in the corners of a
4K photo. Photo and depth map are paired by their times, within 20 ms.
"""

from __future__ import annotations

import functools
import hashlib
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import BaseModel, Field

from dsr.geometry.camera import Camera, Lens
from dsr.geometry.poses import as_rigid, invert
from dsr.io.captures.archive import PHOTO_LIMIT, decode_photo
from dsr.io.frames import CaptureFrame, Geometry, Record, Rig, file_state
from dsr.io.pairs import Pair, PairingResult, join, match_times
from dsr.io.trajectories import describe_capture, intrinsics_camera
from dsr.utils.guards import expect_pixels, naming, natural_key, numbers_in, opened, refusing
from dsr.utils.validation import Number, Whole, parse_model
from dsr.utils.versions import how_to_install

_APP = "Azure Kinect"
_HEAD = 1 << 20
"""Bytes at the beginning of a file in which its tags are."""
_MARK = b"K4A_DEPTH_MODE"
_COLOURS: dict[str, tuple[float, int]] = {
    "NV12": (1.5, cv2.COLOR_YUV2RGB_NV12),
    "YUY2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "BGRA": (4, cv2.COLOR_BGRA2RGB),
}
"""Bytes of each pixel, and OpenCV's conversion."""
_DEPTH_MODES = {
    (288, 320): (512, 96, 90),
    (576, 640): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}
"""For each size of depth maps the size of the whole image, and what is cut off left and above."""
_LENS, _LENS_6KT = "CALIBRATION_LensDistortionModelBrownConrady", "CALIBRATION_LensDistortionModelRational6KT"
_COLOUR_CAMERA, _DEPTH_CAMERA = "CALIBRATION_CameraLocationPV0", "CALIBRATION_CameraLocationD0"
_DEPTH = "b16g"
_LOCK = threading.Lock()


class _Motion(BaseModel):
    """Of the rig's frame to a camera's."""

    Rotation: Annotated[list[Number], Field(min_length=9, max_length=9)]
    Translation: Annotated[list[Number], Field(min_length=3, max_length=3)]


class _Intrinsics(BaseModel):
    """See the module's text."""

    ModelType: str
    ModelParameters: Annotated[list[Number], Field(min_length=14)]


class _Camera(BaseModel):
    """One of the cameras."""

    Location: str
    Intrinsics: _Intrinsics
    Rt: _Motion
    SensorWidth: Annotated[Whole, Field(ge=1)]
    SensorHeight: Annotated[Whole, Field(ge=1)]


class _Cameras(BaseModel):
    """What is read of the calibration."""

    Cameras: list[_Camera]


class _Calibration(BaseModel):
    """The attachment."""

    CalibrationInformation: _Cameras


@dataclass(frozen=True)
class Packet:
    """A :class:`~dsr.io.frames.Source` of a frame of a recording.

    Args:
        file: the recording.
        track: index of the track.
        time: when it was taken, in the track's unit.
        size: (height, width).
        kind: ``b16g`` of depth, or the first letters of ``K4A_COLOR_MODE``.
        seconds: when it was taken, or should have been, of a depth map that is late on purpose.

    """

    file: Path
    track: int
    time: int
    size: tuple[int, int]
    kind: str
    seconds: float

    def read(self) -> np.ndarray:
        """Return (H, W, 3) uint8 RGB of a photo, (h, w) uint16 of a depth map as it is stored."""
        content, (height, width) = self._content(), self.size
        with naming(f"{self.file}: {self.kind} frame at {self.time}"):
            if self.kind == "MJPG":
                if len(content) > PHOTO_LIMIT:
                    raise ValueError(f"expected a photo of at most {PHOTO_LIMIT} bytes, got {len(content)}")
                photo = decode_photo(content)
                if photo.shape[:2] != self.size:
                    got = f"{photo.shape[1]} x {photo.shape[0]}"
                    raise ValueError(f"expected a photo of {width} x {height} pixels, got {got}")
                return photo
            each, code = _COLOURS.get(self.kind, (2, 0))
            if len(content) != height * width * each:
                raise ValueError(
                    f"expected {width} x {height} pixels of {each:g} bytes, which are {height * width * each:g}, "
                    f"got {len(content)} bytes"
                )
        if self.kind not in _COLOURS:
            return np.frombuffer(content, ">u2").reshape(self.size).astype(np.uint16)
        rows = (height * 3 // 2, width, 1) if self.kind == "NV12" else (height, width, int(each))
        return cv2.cvtColor(np.frombuffer(content, np.uint8).reshape(rows), code)

    def record(self) -> Record:
        """Return the recording's name, the track's and the time, and a hash of the frame."""
        sha256 = hashlib.sha256(self._content()).hexdigest()
        return {"file": f"{self.file.name}/{self.track}", "frame": self.time, "sha256": sha256}

    def _content(self) -> bytes:
        """Return the frame as it is stored."""
        with _LOCK, _demuxing(self.file):
            container = _open(self.file, file_state(self.file, "a recording"))
            track = container.streams[self.track]
            container.seek(self.time, stream=track, any_frame=True)
            for packet in container.demux(track):
                if packet.pts == self.time:
                    return bytes(packet)
        raise ValueError(f"{self.file}: expected a frame at {self.time} in track {self.track}, there is none any more")


def find_kinect(place: Path) -> PairingResult | None:
    """Return the frames of a recording, or of those in a folder; None if there is none.

    Raises:
        ValueError: a recording is damaged, or has no photos, no depth maps or no calibration; or PyAV is missing.

    """
    if place.is_file():
        return _read(place) if place.suffix.lower() == ".mkv" else None
    found = [path for path in place.iterdir() if path.suffix.lower() == ".mkv" and _is_ours(path)]
    if not found:
        return None
    return join([_read(path, f"{path.stem}/") for path in sorted(found, key=natural_key)])


def _is_ours(path: Path) -> bool:
    """Return whether a file is a recording of a Kinect, not another video."""
    if not path.is_file():
        return False
    with opened(path) as file:
        return _MARK in file.read(_HEAD)


def _read(path: Path, prefix: str = "") -> PairingResult:
    """Return the frames of a recording."""
    with _LOCK, _demuxing(path):
        container = _open(path, file_state(path, "a recording"))
        times = _times(path, container)
        attached = [each.data for each in container.streams.attachments if each.name == "calibration.json"]
    if not attached:
        raise ValueError(f"{path}: expected a recording with the attachment calibration.json, there is none")
    photos, depths = ({path / role / f"{number:06}": packet for number, packet in enumerate(each)}
                      for role, each in times.items())  # fmt: skip
    partner = match_times(*({name: packet.seconds for name, packet in each.items()} for each in (photos, depths)))
    if not partner:
        raise ValueError(f"{path}: expected photos and depth maps within 20 ms of each other, found none")
    size, size_lr = (next(iter(each.values())).size for each in (photos, depths))
    geometry = functools.partial(_geometry, f"{path}: calibration.json", bytes(attached[0]), size, size_lr)
    pairs = tuple(
        Pair(f"{prefix}{photo.name}", photo, depth, unit=1e-3, capture=CaptureFrame(
            _APP, geometry, path, bytes(attached[0]), photos[photo], depths[depth], photos[photo].seconds, apart=True))
        for photo, depth in sorted(partner.items())
    )  # fmt: skip
    note = describe_capture(f"a recording of {_APP}", "millimetres", pairs, poses=False)
    lone = [name for name in (*photos, *depths) if name not in {*partner, *partner.values()}]
    return PairingResult(pairs, (note,), tuple(lone))


def _times(path: Path, container: Any) -> dict[str, list[Packet]]:
    """Return the frames of both tracks in order; the depth maps' times are those that their photos should have."""
    tracks = {role: _track(path, container, role) for role in ("color", "depth")}
    kinds = {"color": tracks["color"].metadata.get("K4A_COLOR_MODE", "MJPG").partition("_")[0], "depth": _DEPTH}
    if kinds["color"] not in ("MJPG", *_COLOURS):
        raise ValueError(f"{path}: expected photos as MJPG, {', '.join(_COLOURS)}, got {kinds['color']:.40}")
    text = container.metadata.get("K4A_DEPTH_DELAY_NS", "0")
    delay = numbers_in([text])
    if not delay:
        raise ValueError(f"{path}: K4A_DEPTH_DELAY_NS: expected a whole number, got {text:.40}")
    late = {"color": 0.0, "depth": 1e-9 * delay[0]}
    roles = {track.index: role for role, track in tracks.items()}
    found: dict[str, list[Packet]] = {role: [] for role in tracks}
    container.seek(0)
    for packet in container.demux(list(tracks.values())):
        if packet.pts is not None:
            role = roles[packet.stream.index]
            size = tracks[role].height, tracks[role].width
            seconds = packet.pts * float(packet.time_base) - late[role]
            found[role].append(Packet(path, packet.stream.index, packet.pts, size, kinds[role], seconds))
    return found


def _track(path: Path, container: Any, role: str) -> Any:
    """Return a track by its tag or its name."""
    name = role.upper()
    for track in container.streams.video:
        known = f"K4A_{name}_TRACK" in track.metadata or track.metadata.get("title") == name
        if known and track.codec_context is not None:  # which a codec that FFmpeg does not know lacks
            expect_pixels(path, track.height, track.width)
            return track
    raise ValueError(f"{path}: expected a recording of {_APP} with tracks COLOR and DEPTH, there is no {name}")


def _geometry(
    place: str, content: bytes, size: tuple[int, int], size_lr: tuple[int, int], _: tuple[int, int]
) -> Geometry:
    """Return the cameras of a recording."""
    calibration = parse_model(_Calibration, content.rstrip(b"\0"), place, f"expected the calibration of {_APP}; ")
    cameras = {each.Location: each for each in calibration.CalibrationInformation.Cameras}
    for location in (_COLOUR_CAMERA, _DEPTH_CAMERA):
        if location not in cameras:
            raise ValueError(f"{place}: expected the camera {location}, there is none")
    if size_lr not in _DEPTH_MODES:
        sizes = ", ".join(f"{width} x {height}" for height, width in _DEPTH_MODES)
        raise ValueError(f"{place}: expected depth maps of {sizes}, got {size_lr[1]} x {size_lr[0]}")
    photo, depth = cameras[_COLOUR_CAMERA], cameras[_DEPTH_CAMERA]
    width = size[1]
    numbers = photo.Intrinsics.ModelParameters
    if photo.SensorWidth * 9 == photo.SensorHeight * 16:  # of old devices: the middle three quarters of the image
        numbers = [numbers[0], (numbers[1] * 0.75) + 0.125, numbers[2], numbers[3] * 0.75, *numbers[4:]]
    whole = (width * 3 // 4, width)
    camera = _scale(place, numbers, whole, (0, (whole[0] - size[0]) / 2), size)
    side, left, top = _DEPTH_MODES[size_lr]
    own = _scale(place, depth.Intrinsics.ModelParameters, (side, side), (left, top), size_lr)
    motions = []  # from the rig's frame to the cameras', (4, 4), metres
    for each in (depth, photo):
        motion = np.column_stack((np.reshape(each.Rt.Rotation, (3, 3)), each.Rt.Translation))
        motions.append(as_rigid(motion, f"{place}: Rt of {each.Location}"))
    transform = motions[1] @ invert(motions[0])
    return Geometry(camera, lens=_lens(place, photo), rig=Rig(own, transform, _lens(place, depth)))


def _scale(
    place: str, numbers: Sequence[float], whole: tuple[int, int], cut: tuple[float, float], size: tuple[int, int]
) -> Camera:
    """Return the camera of a part of an image.

    Args:
        numbers: cx, cy, fx, fy of an image of 1 x 1 whose corner is (0, 0).
        whole: (height, width) of the image.
        cut: columns and rows that are cut off left and above.
        size: (height, width) of the part.

    """
    cx, cy, fx, fy = numbers[:4]
    height, width = whole
    return intrinsics_camera(
        place, size, (fx * width, fy * height, cx * width - cut[0] - 0.5, cy * height - cut[1] - 0.5)
    )


def _lens(place: str, camera: _Camera) -> Lens:
    """Return the lens of a camera."""
    kind = camera.Intrinsics.ModelType
    k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = camera.Intrinsics.ModelParameters[4:14]
    if kind != _LENS and (kind != _LENS_6KT or codx or cody):  # with a centre of its own: of devices that were not sold
        centre = f"({codx:g}, {cody:g})"
        raise ValueError(f"{place}: expected a lens of {_LENS}, got {kind:.60} of the centre {centre}")
    return Lens("brown_conrady", (k1, k2, p1, p2, k3, k4, k5, k6))


@contextmanager
def _demuxing(path: Path) -> Iterator[None]:
    """Raise a ValueError that names the recording in place of PyAV's errors."""
    with refusing(f"{path}: recordings of {_APP} need the package av: {how_to_install('captures')}", ImportError):
        import av  # noqa: PLC0415 - an extra
    with refusing(f"{path}: expected a recording of {_APP}, got a damaged or foreign file", av.FFmpegError):
        yield


@functools.lru_cache(maxsize=1)
def _open(path: Path, _: tuple[int, int]) -> Any:
    """Return the open recording; FFmpeg only takes it apart, and decodes nothing."""
    import av  # noqa: PLC0415 - an extra

    with opened(path) as file:
        file.read(1)  # or the error names the file, such as that of a link to a device
    return av.open(str(path), format="matroska", options={"codec_whitelist": "rawvideo", "analyzeduration": "0"})
