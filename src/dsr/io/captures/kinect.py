"""Recordings of the Azure Kinect and of Orbbec's Femto cameras with its SDK: Matroska files, read by the package PyAV.

https://github.com/microsoft/Azure-Kinect-Sensor-SDK: src/record (tracks and tags), src/calibration/calibration.c and
src/transformation/mode_specific_calibration.c. ``K4A_DEPTH_DELAY_NS`` is how much later than a photo its depth map was
taken, on purpose. ``calibration.json`` has for each camera cx, cy, fx, fy, k1 to k6, codx, cody, p2, p1, of an image of
1 x 1 whose corner is (0, 0), and the motion from the rig's frame to its own in metres. Each mode of a camera sees a
part of that image, scaled. The lens model is OpenCV's. That of Orbbec's wrapper of the SDK, Rational6KT, has half of
OpenCV's mixed tangential terms and is taken for it: tenths of a pixel in the corners of a 4K photo.
"""

import functools
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import AliasPath, BaseModel, Field

from dsr.geometry.camera import Camera, Lens
from dsr.geometry.poses import as_rigid, invert
from dsr.io.captures.archive import as_pixels, decode_photo
from dsr.io.frames import CaptureFrame, Geometry, Part, Record, Rig, Size, file_state, stated
from dsr.io.pairs import PairingResult, Shot, pair_by_time
from dsr.io.trajectories import describe_capture, intrinsics_camera
from dsr.utils.guards import expect_pixels, expect_size, numbers_in, refusing
from dsr.utils.validation import Number, Whole, parse_model
from dsr.utils.versions import how_to_install

_APP = "Azure Kinect"
# Bytes of each pixel, and OpenCV's conversion.
_COLOURS = {
    "NV12": (1.5, cv2.COLOR_YUV2RGB_NV12),
    "YUY2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "BGRA": (4, cv2.COLOR_BGRA2RGB),
}
# For each size of depth maps the size of the whole image, and what is cut off left and above.
_DEPTH_MODES = {
    (288, 320): (512, 96, 90),
    (576, 640): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}
_LENS, _LENS_6KT = "CALIBRATION_LensDistortionModelBrownConrady", "CALIBRATION_LensDistortionModelRational6KT"
_COLOUR_CAMERA, _DEPTH_CAMERA = "CALIBRATION_CameraLocationPV0", "CALIBRATION_CameraLocationD0"
_DEPTH = "b16g"
_LOCK = threading.Lock()


class _Camera(BaseModel):
    """One of the cameras, and the motion from the rig's frame to its own; see the module's text."""

    location: str = Field(alias="Location")
    kind: str = Field(validation_alias=AliasPath("Intrinsics", "ModelType"))
    numbers: list[Number] = Field(validation_alias=AliasPath("Intrinsics", "ModelParameters"), min_length=14)
    rotation: list[Number] = Field(validation_alias=AliasPath("Rt", "Rotation"), min_length=9, max_length=9)
    translation: list[Number] = Field(validation_alias=AliasPath("Rt", "Translation"), min_length=3, max_length=3)
    width: Whole = Field(alias="SensorWidth", ge=1)
    height: Whole = Field(alias="SensorHeight", ge=1)


class _Calibration(BaseModel):
    cameras: list[_Camera] = Field(validation_alias=AliasPath("CalibrationInformation", "Cameras"))


@dataclass(frozen=True)
class _Packet(Part):
    track: int
    time: int  # in the track's unit

    def record(self) -> Record:
        """Return the recording's name, the track's and the time, and a hash of the frame."""
        return {**super().record(), "file": f"{self.file.name}/{self.track}", "frame": self.time}


def _fetch(path: Path, number: int, time: int) -> bytes:
    with _recording(path) as container:
        track = container.streams[number]
        container.seek(time, stream=track, any_frame=True)
        for packet in container.demux(track):
            if packet.pts == time:
                return bytes(packet)
    raise ValueError(f"{path}: expected a frame at {time} in track {number}, there is none any more")


def _decode(size: Size, kind: str, content: bytes) -> np.ndarray:
    """Return (H, W, 3) uint8 RGB of a photo, (h, w) uint16 of a depth map as it is stored."""
    height, width = size
    if kind == "MJPG":
        photo = decode_photo(content)
        expect_size("expected a photo of", photo, size)
        return photo
    each, code = _COLOURS.get(kind, (2, 0))
    if kind == _DEPTH:
        return as_pixels(content, ">u2", size).astype(np.uint16)
    rows = (height * 3 // 2, width, 1) if kind == "NV12" else (height, width, int(each))
    return cv2.cvtColor(as_pixels(content, "u1", rows), code)


def read(path: Path) -> PairingResult:
    """Return the frames of a recording."""
    shots: dict[str, list[Shot]] = {"color": [], "depth": []}
    with _recording(path) as container:
        color, depth = (_track(path, container, role) for role in shots)
        kind = color.metadata.get("K4A_COLOR_MODE", "MJPG").partition("_")[0]
        if kind not in ("MJPG", *_COLOURS):
            raise ValueError(f"{path}: expected photos as MJPG, {', '.join(_COLOURS)}, got {kind:.40}")
        text = container.metadata.get("K4A_DEPTH_DELAY_NS", "0")
        delay = numbers_in([text])
        if not delay:
            raise ValueError(f"{path}: K4A_DEPTH_DELAY_NS: expected a whole number, got {text:.40}")
        about = {color.index: ("color", color, kind, 0.0), depth.index: ("depth", depth, _DEPTH, 1e-9 * delay[0])}
        container.seek(0)
        for packet in container.demux([color, depth]):
            if packet.pts is not None:
                role, track, stored, late = about[packet.stream.index]
                fetch = functools.partial(_fetch, path, track.index, packet.pts)
                decode = functools.partial(_decode, (track.height, track.width), stored)
                name = f"{stored} frame at {packet.pts}"
                source = _Packet(path, name, fetch, decode, track.index, packet.pts)
                seconds = packet.pts * float(packet.time_base) - late
                shots[role].append(Shot(path / role / f"{len(shots[role]):06}", source, seconds))
        attached = [bytes(each.data) for each in container.streams.attachments if each.name == "calibration.json"]
        sizes = (color.height, color.width), (depth.height, depth.width)
    if not attached:
        raise ValueError(f"{path}: expected a recording with the attachment calibration.json, there is none")
    geometry = stated(_geometry, f"{path}: calibration.json", attached[0], *sizes)
    frame = CaptureFrame(_APP, geometry, path, attached[0], apart=True)
    found = pair_by_time(shots["color"], shots["depth"], frame, 1e-3)
    note = describe_capture(f"a recording of {_APP}", "millimetres", found.pairs, poses=False)
    return replace(found, assumptions=(note,))


def _track(path: Path, container: Any, role: str) -> Any:
    name = role.upper()
    for track in container.streams.video:
        known = f"K4A_{name}_TRACK" in track.metadata or track.metadata.get("title") == name
        if known and track.codec_context is not None:  # which a codec that FFmpeg does not know lacks
            expect_pixels(path, track.height, track.width)
            return track
    raise ValueError(f"{path}: expected a recording of {_APP} with tracks COLOR and DEPTH, there is no {name}")


def _geometry(place: str, content: bytes, size: Size, size_lr: Size) -> Geometry:
    calibration = parse_model(_Calibration, content.rstrip(b"\0"), place, f"expected the calibration of {_APP}; ")
    cameras = {each.location: each for each in calibration.cameras}
    for location in (_COLOUR_CAMERA, _DEPTH_CAMERA):
        if location not in cameras:
            raise ValueError(f"{place}: expected the camera {location}, there is none")
    if size_lr not in _DEPTH_MODES:
        sizes = ", ".join(f"{width} x {height}" for height, width in _DEPTH_MODES)
        raise ValueError(f"{place}: expected depth maps of {sizes}, got {size_lr[1]} x {size_lr[0]}")
    photo, depth = cameras[_COLOUR_CAMERA], cameras[_DEPTH_CAMERA]
    width = size[1]
    numbers = photo.numbers
    if photo.width * 9 == photo.height * 16:  # of old devices: the middle three quarters of the image
        numbers = [numbers[0], (numbers[1] * 0.75) + 0.125, numbers[2], numbers[3] * 0.75, *numbers[4:]]
    whole = (width * 3 // 4, width)
    camera = _part_of(place, numbers, whole, (0, (whole[0] - size[0]) / 2), size)
    side, left, top = _DEPTH_MODES[size_lr]
    own = _part_of(place, depth.numbers, (side, side), (left, top), size_lr)
    motions = []  # from the rig's frame to the cameras', (4, 4), metres
    for each in (depth, photo):
        motion = np.column_stack((np.reshape(each.rotation, (3, 3)), each.translation))
        motions.append(as_rigid(motion, f"{place}: Rt of {each.location}"))
    transform = motions[1] @ invert(motions[0])
    return Geometry(camera, lens=_lens(place, photo), rig=Rig(own, transform, _lens(place, depth)))


def _part_of(place: str, numbers: Sequence[float], whole: Size, cut: tuple[float, float], size: Size) -> Camera:
    """Return the camera of a part of size (height, width) of a ``whole`` image, of which ``cut`` is left and above."""
    cx, cy, fx, fy = numbers[:4]
    height, width = whole
    centre = cx * width - cut[0] - 0.5, cy * height - cut[1] - 0.5
    return intrinsics_camera(place, size, (fx * width, fy * height, *centre))


def _lens(place: str, camera: _Camera) -> Lens:
    kind = camera.kind
    k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = camera.numbers[4:14]
    if kind != _LENS and (kind != _LENS_6KT or codx or cody):  # with a centre of its own: of devices that were not sold
        centre = f"({codx:g}, {cody:g})"
        raise ValueError(f"{place}: expected a lens of {_LENS}, got {kind:.60} of the centre {centre}")
    return Lens("brown_conrady", (k1, k2, p1, p2, k3, k4, k5, k6))


@contextmanager
def _recording(path: Path) -> Iterator[Any]:
    """Yield the open recording to one thread; a ValueError that names it takes the place of PyAV's errors."""
    with refusing(f"{path}: recordings of {_APP} need the package av: {how_to_install('captures')}", ImportError):
        import av  # noqa: PLC0415 - an extra
    wrong = f"{path}: expected a recording of {_APP}, got a damaged or foreign file"
    with _LOCK, refusing(wrong, av.FFmpegError):
        yield _open(path, file_state(path, "a recording"))


@functools.lru_cache(maxsize=1)
def _open(path: Path, _state: tuple[int, int]) -> Any:
    """Return the open recording; FFmpeg only takes it apart, and decodes nothing."""
    import av  # noqa: PLC0415 - an extra

    return av.open(str(path), format="matroska", options={"codec_whitelist": "rawvideo", "analyzeduration": "0"})
