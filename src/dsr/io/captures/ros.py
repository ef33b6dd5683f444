"""Recordings of ROS 1 (``.bag``) and ROS 2 (``.mcap``, ``.db3``, or a folder of them with ``metadata.yaml``).

Messages of sensor_msgs, http://docs.ros.org/en/api/sensor_msgs/html/index-msg.html; depth is in millimetres as whole
numbers and in metres as floats, https://ros.org/reps/rep-0118.html. Depth that is registered to the photos, by the
cameras, frame_id or else the topic's name, is taken before other depth, photos of a topic named *color*, *colour* or
*rgb* before others; then topics with more messages, then the first one. Depth of another camera is warped to the photo
by /tf_static, /tf or RealSense's ``extrinsics``. A camera is that of the topic ``camera_info`` beside the images, for
its window and binning and with its distortion; of a topic of ``image_rect`` its P, without. Poses are not read.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from dsr.geometry.camera import Lens
from dsr.geometry.poses import Matrix, as_rigid, from_quaternion, invert
from dsr.io.captures import realsense
from dsr.io.captures.bags import (
    COLOURS,
    COMPRESSED,
    DEPTHS,
    IMAGE,
    connections_of,
    first_message,
    images_of,
    naming_recording,
    open_recording,
)
from dsr.io.frames import CaptureFrame, Geometry, Rig, stated
from dsr.io.pairs import PairingResult, Shot, is_registered, pair_by_time
from dsr.io.trajectories import intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import naming

_BESIDE_METADATA = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
_COLOUR_NAMES = ("color", "colour", "rgb")
_ALIKE = 2e-3  # difference of focal lengths and centres, over the picture's size, of cameras that are the same
_AT_ONE_PLACE = 1e-3  # metres between two cameras, and entries of the rotation, of cameras at one place
_MOST_TRANSFORMS = 10_000  # messages that are searched for a transform
_EXTRINSICS = re.compile(r"(.*/)extrinsics/(\w+)_to_(\w+)")
# Distortion models of CameraInfo, see sensor_msgs/distortion_models.h.
_LENSES = {"plumb_bob": "brown_conrady", "rational_polynomial": "brown_conrady", "equidistant": "kannala_brandt"}


def find(folder: Path) -> PairingResult | None:
    """Return the frames of a recording of ROS 2 that is a folder."""
    there = (folder / "metadata.yaml").is_file() and any(any(folder.glob(f"*{each}")) for each in _BESIDE_METADATA)
    return read(folder) if there else None


def read(path: Path) -> PairingResult:
    """Return the frames of a recording."""
    with naming_recording(path):
        reader = open_recording(path)
        if connections_of(reader, realsense.VERSION):
            return realsense.read(reader, path)
        topics = _topics(reader)
        photo, depth = _choose(path, topics)
        photos, depths = (_shots(reader, path, each.name) for each in (photo, depth))
        in_metres = depths[0].source.read().dtype.kind == "f"
        motion = np.eye(4) if _have_same_frame(photo, depth) else _transform(reader, photo, depth)
    registered = _are_registered(photo, depth)
    if motion is not None and not is_registered(depth.name):
        registered = registered and np.allclose(motion, np.eye(4), rtol=0, atol=_AT_ONE_PLACE)
    geometry = stated(_registered, path, photo, depth) if registered else stated(_apart, path, photo, depth, motion)
    content = repr(photo.info if registered else (photo, depth, motion)).encode()
    frame = CaptureFrame("ROS", geometry, path, content, apart=not registered)
    found = pair_by_time(photos, depths, frame, 1.0 if in_metres else 1e-3)
    unit = "metres" if in_metres else "millimetres"
    notes = [Assumption(f"a recording of ROS: photos of {photo.name}, depth in {unit} of {depth.name}")]
    others = [each.name for each in topics if each.role and each not in (photo, depth)]
    if others:
        notes.append(Assumption(f"topics that are not read: {', '.join(others)}"))
    return replace(found, assumptions=tuple(notes))


class _Topic(NamedTuple):
    """Topic of images: role (``rgb``, ``depth`` or empty), encoding, frame, number of messages, its camera_info."""

    name: str
    role: str
    encoding: str
    frame: str
    messages: int
    info: _Info | None


def _topics(reader: Any) -> list[_Topic]:
    topics = []
    for name in sorted({each.topic for each in reader.connections if each.msgtype in (IMAGE, COMPRESSED)}):
        message = first_message(reader, name)
        if message is not None:
            role, frame = _role(message), message.header.frame_id.strip("/")
            count = sum(each.msgcount for each in connections_of(reader, name))
            encoding = message.encoding if hasattr(message, "encoding") else message.format
            topics.append(_Topic(name, role, encoding, frame, count, _camera_info(reader, name, role)))
    return topics


def _role(message: Any) -> str:
    """Return whether a message is a photo or a depth map; an empty text if it is neither, such as an infrared image."""
    if hasattr(message, "encoding"):
        return "depth" if message.encoding in DEPTHS else "rgb" if message.encoding in COLOURS else ""
    words = message.format.lower()
    if "compresseddepth" in words:
        return "depth"
    encoding = words.partition(";")[0].strip()
    return "" if encoding in ("mono8", "8uc1", "16uc1", "mono16") else "rgb"


def _choose(path: Path, topics: Sequence[_Topic]) -> tuple[_Topic, _Topic]:
    photos, depths = ([each for each in topics if each.role == role] for role in ("rgb", "depth"))
    read = {f"photos ({', '.join(COLOURS)}, or CompressedImage)": photos, f"depth ({', '.join(DEPTHS)})": depths}
    for what, found in read.items():
        if not found:
            got = ", ".join(f"{each.name} of {each.encoding:.40}" for each in topics) or "no images"
            raise ValueError(f"{path}: expected a topic of {what}, got {got}")

    def order(both: tuple[_Topic, _Topic]) -> tuple[Any, ...]:
        photo, depth = both
        return (
            not _are_registered(photo, depth), photo.frame != depth.frame,
            not any(word in photo.name for word in _COLOUR_NAMES), -photo.messages, photo.name,
            not is_registered(depth.name), -depth.messages, depth.name,
        )  # fmt: skip

    return min(itertools.product(photos, depths), key=order)


def _shots(reader: Any, path: Path, topic: str) -> list[Shot]:
    shots = []
    for message in images_of(reader, path, topic):
        seconds, nanoseconds = struct.unpack_from("<II", message.raw, 4)  # after a sequence number, or CDR's header
        stamp = seconds + 1e-9 * nanoseconds if seconds else 1e-9 * message.time
        shots.append(Shot(Path(f"{path}{topic}"), message.source, stamp))
    return shots


def _are_registered(photo: _Topic, depth: _Topic) -> bool:
    """Return whether depth is in the photo's pixels: by the cameras of both, else by their frames, or depth's name."""
    views = []
    for topic in (photo, depth):
        with contextlib.suppress(ValueError):  # which is reported where the camera is needed
            if (camera := _camera(Path(), topic).camera) is not None:
                unit = camera.rescale(1, 1)
                views.append((unit.fx, unit.fy, unit.cx, unit.cy))
    if len(views) == 2:
        return np.allclose(views[0], views[1], rtol=0, atol=_ALIKE)
    return _have_same_frame(photo, depth) or not (photo.frame and depth.frame) or is_registered(depth.name)


def _have_same_frame(photo: _Topic, depth: _Topic) -> bool:
    """Return whether two topics are of one frame, which may be without its namespace in one of them."""
    return photo.frame != "" and photo.frame.rpartition("/")[2] == depth.frame.rpartition("/")[2]


def _transform(reader: Any, photo: _Topic, depth: _Topic) -> Matrix | None:
    """Return the transform from the depth camera's frame to the photo camera's; None if the recording has none."""
    motions: dict[tuple[str, str], Matrix] = {}  # from a frame to another one
    tree = [each for each in reader.connections if each.topic.rpartition("/")[2] in ("tf", "tf_static")]
    for connection, _, raw in itertools.islice(reader.messages(tree), _MOST_TRANSFORMS) if tree else ():
        for each in reader.deserialize(raw, connection.msgtype).transforms:
            ends = each.child_frame_id.strip("/"), each.header.frame_id.strip("/")
            shift, turn = each.transform.translation, each.transform.rotation
            with contextlib.suppress(ValueError):  # of a frame that may be on no way to the photo's
                motions[ends] = from_quaternion((shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w), "tf")
                motions[ends[::-1]] = invert(motions[ends])
    reached = {depth.frame: np.eye(4)}
    for frame in (queue := [depth.frame]):
        for (start, end), motion in motions.items():
            if start == frame and end not in reached:
                reached[end] = motion @ reached[frame]
                queue.append(end)
    if photo.frame and photo.frame in reached:
        return reached[photo.frame]
    for each in reader.connections:
        names = _EXTRINSICS.fullmatch(each.topic)
        if names and all(topic.name.startswith(f"{names[1]}{stream}/") for topic, stream in
                         ((depth, names[2]), (photo, names[3]))):  # fmt: skip
            for _, _, raw in reader.messages([each]):
                numbers = np.frombuffer(raw[-96:], "<f8")  # which end RealSense's message: the rotation by columns
                return as_rigid(np.column_stack((numbers[:9].reshape(3, 3).T, numbers[9:])), each.topic)
    return None


class _Info(NamedTuple):
    height: int
    width: int
    numbers: tuple[float, ...]  # fx, fy, cx, cy of (height, width) pixels
    window: tuple[int, int, int, int]  # x, y, width, height of the part of them that the photo shows, 0 for all
    binning: tuple[int, int]  # how many of them are one pixel of the photo, across and down
    model: str  # of the lens
    distortion: tuple[float, ...]  # empty without one


def _camera_info(reader: Any, topic: str, role: str) -> _Info | None:
    """Return the content of the topic beside that of images, for photos or above it; None if there is none."""
    for place in PurePosixPath(topic.removesuffix("/compressedDepth").removesuffix("/compressed")).parents:
        info = first_message(reader, str(place / "camera_info"))
        if info is not None:
            k, d, p = (info.K, info.D, info.P) if hasattr(info, "K") else (info.k, info.d, info.p)
            rectified = "image_rect" in topic  # then the camera is that of P, without distortion
            matrix = (p[0], p[5], p[2], p[6]) if rectified and p[0] else (k[0], k[4], k[2], k[5])
            window = info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height
            binning = max(info.binning_x, 1), max(info.binning_y, 1)
            lens = info.distortion_model, () if rectified else tuple(map(float, d))
            return _Info(info.height, info.width, tuple(map(float, matrix)), window, binning, *lens)
        if role == "depth" or len(place.parts) < 3:
            return None
    return None


def _registered(path: Path, photo: _Topic, depth: _Topic) -> Geometry:
    found = _camera(path, photo)
    if _have_same_frame(photo, depth):
        return found
    text = f"depth of the frame {depth.frame!r} counts as registered to photos of {photo.frame!r}"
    code = "" if is_registered(depth.name) else "other-frame"
    return found._replace(assumptions=(*found.assumptions, Assumption(text, "", code, 1.0 if code else None)))


def _apart(path: Path, photo: _Topic, depth: _Topic, motion: Matrix | None) -> Geometry:
    found = _camera(path, photo)
    own = Geometry() if motion is None else _camera(path, depth)
    if motion is None or own.camera is None:
        missing = "transform between them (tf_static, extrinsics)" if motion is None else "camera_info of the depth"
        text = (
            f"{path}{depth.name}: expected depth that is registered to the photos, got depth of the frame "
            f"{depth.frame!r} and photos of {photo.frame!r}, and the recording has no {missing}; --depth-camera and "
            "--extrinsics give both"
        )
        return found._replace(apart=text)
    rig = Rig(own.camera, motion, own.lens)
    return found._replace(rig=rig, assumptions=(*found.assumptions, *own.assumptions))


def _camera(path: Path, topic: _Topic) -> Geometry:
    info, what = topic.info, "photo" if topic.role == "rgb" else "depth map"
    place = f"{path}{PurePosixPath(topic.name).parent / 'camera_info'}"
    if info is None:
        return Geometry(None, None, (Assumption(f"the recording has no camera_info beside the {what}'s topic"),))
    if not info.numbers[0]:  # as sensor_msgs says
        return Geometry(None, None, (Assumption("the camera is not calibrated, by the recording's camera_info"),))
    if min(info.height, info.width) < 1:
        raise ValueError(f"{place}: expected a positive width and height, got {info.width} x {info.height}")
    camera = intrinsics_camera(place, (info.height, info.width), info.numbers)
    x, y, width, height = info.window
    with naming(place):
        if width and height:
            camera = camera.crop(y, x, height, width)
        across, down = (min(by, n) for by, n in zip(info.binning, (camera.width, camera.height), strict=True))
        height, width = camera.height // down, camera.width // across
        camera = camera.crop(0, 0, height * down, width * across).rescale(width, height)
        if not info.distortion:
            return Geometry(camera)
        if info.model in _LENSES:
            return Geometry(camera, lens=Lens(_LENSES[info.model], info.distortion))
    if not any(info.distortion):
        return Geometry(camera)
    text = f"the {what}'s lens distortion is not undone: its model {info.model!r:.40} is not known"
    return Geometry(camera, None, (Assumption(text),))
