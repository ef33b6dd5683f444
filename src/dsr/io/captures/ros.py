"""Recordings of ROS 1 (``.bag``) and ROS 2 (``.mcap``, ``.db3``, or a folder of them with ``metadata.yaml``).

The files in such a folder may be packed (``.zstd``). Messages of sensor_msgs: Image, CompressedImage and CameraInfo,
http://docs.ros.org/en/api/sensor_msgs/html/index-msg.html; depth is in millimetres as whole numbers and in metres as
floats, https://ros.org/reps/rep-0118.html.

Of the topics of depth one named *aligned* or *registered* is taken before others, then one with more messages, then the
first by name; of those of colour one named *color*, *colour* or *rgb*, then the same. The photo's camera is that of the
topic ``camera_info`` beside it, for its window and binning and with its distortion; of photos of a topic of
``image_rect`` its P, without. Photo and depth map are paired by the times in their headers, within 20 ms. Poses are
not read.

Recordings of RealSense's SDK are those of :mod:`dsr.io.captures.realsense`.
"""

from __future__ import annotations

import functools
import struct
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from dsr.geometry.lens import Lens
from dsr.io.captures import realsense
from dsr.io.captures.bags import COMPRESSED, IMAGE, Message, NamedErrors, connections_of, first_message, open_recording
from dsr.io.captures.ros_images import COLOURS, DEPTHS
from dsr.io.frames import CaptureFrame, Geometry
from dsr.io.pairs import Pair, PairingResult, join, match_times
from dsr.io.trajectories import intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import naming, natural_key

FILES = (".bag", ".mcap", ".db3")
"""Suffixes of recordings that are a single file."""
_FILES_2 = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
"""Those beside ``metadata.yaml``."""
_UNITS = {"u": 1e-3, "f": 1.0}
_PREFERRED = {"depth": ("aligned", "registered"), "rgb": ("color", "colour", "rgb")}

_LENSES = {
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "kannala_brandt",
}
"""Distortion models of CameraInfo, see sensor_msgs/distortion_models.h."""


def find_ros(folder: Path) -> PairingResult | None:
    """Return the frames of a recording, or of those in a folder; None if there is none.

    Raises:
        ValueError: a recording is damaged, or has no topic of photos or of depth; or rosbags is missing.

    """
    if folder.is_file():
        return _read(folder) if folder.suffix.lower() in FILES else None
    if (folder / "metadata.yaml").is_file() and any(any(folder.glob(f"*{suffix}")) for suffix in _FILES_2):
        return _read(folder)
    bags = [path for path in folder.iterdir() if path.suffix.lower() in FILES and path.is_file()]
    if not bags:
        return None
    return join([_read(path, f"{path.stem}/") for path in sorted(bags, key=natural_key)])


def _read(path: Path, prefix: str = "") -> PairingResult:
    """Return the frames of a recording."""
    with NamedErrors(path):
        reader = open_recording(path)
        if realsense.is_recording(reader):
            return realsense.read(reader, path, prefix)
        topics = _topics(reader)
        photo_topic, depth_topic = _choose(path, topics, "rgb"), _choose(path, topics, "depth")
        photos, depths = _times(reader, path, photo_topic), _times(reader, path, depth_topic)
        info = _camera_info(reader, photo_topic)
        kind = depths[0][0].read().dtype.kind
    named = {kind: {Path(f"{i:09}"): stamp for i, (_, stamp) in enumerate(each)} for kind, each in
             (("rgb", photos), ("depth", depths))}  # fmt: skip
    partner = match_times(named["rgb"], named["depth"])
    if not partner:
        raise ValueError(f"{path}: expected photos and depth maps within 20 ms of each other, found none")
    described = repr(info).encode()
    place = f"{path}{PurePosixPath(photo_topic).parent / 'camera_info'}"
    pairs = []
    for first, second in sorted(partner.items()):
        photo, depth = photos[int(first.name)][0], depths[int(second.name)][0]
        geometry = functools.partial(_geometry, place, info)
        frame = CaptureFrame("ROS", geometry, path, described, photo, depth, named["rgb"][first])
        name = f"{prefix}{int(first.name):06}"
        pairs.append(
            Pair(name, Path(f"{path}{photo_topic}"), Path(f"{path}{depth_topic}"), unit=_UNITS[kind], capture=frame)
        )
    unit = "millimetres" if kind == "u" else "metres"
    notes = [Assumption(f"a recording of ROS: photos of {photo_topic}, depth in {unit} of {depth_topic}")]
    others = sorted(topic for topic, kind in topics.items() if kind[0] and topic not in (photo_topic, depth_topic))
    if others:
        notes.append(Assumption(f"topics that are not read: {', '.join(others)}"))
    lone = [Path(f"{path}{photo_topic}")] * (len(photos) - len(pairs))
    lone += [Path(f"{path}{depth_topic}")] * (len(depths) - len(pairs))
    return PairingResult(tuple(pairs), tuple(notes), tuple(lone))


def _topics(reader: Any) -> dict[str, tuple[str, int]]:
    """Return, for each topic of images, its role (``rgb``, ``depth`` or empty) by its first message, and the count."""
    topics: dict[str, tuple[str, int]] = {}
    for topic in sorted({each.topic for each in reader.connections if each.msgtype in (IMAGE, COMPRESSED)}):
        message = first_message(reader, topic)
        if message is not None:
            topics[topic] = _role(message), sum(each.msgcount for each in connections_of(reader, topic))
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


def _choose(path: Path, topics: dict[str, tuple[str, int]], role: str) -> str:
    """Return the topic of a role, see the module's text."""
    found = [topic for topic, (kind, _) in topics.items() if kind == role]
    if not found:
        what = "photos (sensor_msgs/Image of colour, or CompressedImage)" if role == "rgb" else \
            "depth (sensor_msgs/Image of 16UC1 or 32FC1)"  # fmt: skip
        raise ValueError(f"{path}: expected a topic of {what}, got {', '.join(sorted(topics)) or 'no images'}")
    return min(found, key=lambda topic: (not any(word in topic for word in _PREFERRED[role]), -topics[topic][1], topic))


def _times(reader: Any, path: Path, topic: str) -> list[tuple[Message, float]]:
    """Return the messages of a topic with the times in their headers, in seconds."""
    found: list[tuple[Message, float]] = []
    for connection, time, raw in reader.messages(connections_of(reader, topic)):
        same = found[-1][0].order + 1 if found and found[-1][0].time == time else 0
        seconds, nanoseconds = struct.unpack_from("<II", raw, 4)  # after a sequence number, or CDR's header
        stamp = seconds + 1e-9 * nanoseconds if seconds else 1e-9 * time
        found.append((Message(path, connection.topic, time, same), stamp))
    return found


class _Info(NamedTuple):
    """What is read of a CameraInfo.

    ``numbers``: fx, fy, cx, cy of (height, width) pixels. ``window``: x, y, width and height of the part of them that
    the photo shows, 0 for all. ``binning``: how many of them are one pixel of the photo, across and down. ``model``,
    ``distortion``: of the lens; no numbers without one.
    """

    height: int
    width: int
    numbers: tuple[float, ...]
    window: tuple[int, int, int, int]
    binning: tuple[int, int]
    model: str
    distortion: tuple[float, ...]


def _camera_info(reader: Any, photo_topic: str) -> _Info | None:
    """Return the content of the topic beside the photo's; None if there is none.

    Photos of a rectified topic have the camera that P states, and no distortion.
    """
    for place in PurePosixPath(photo_topic).parents:
        info = first_message(reader, str(place / "camera_info"))
        if info is not None:
            k, d, p = (info.K, info.D, info.P) if hasattr(info, "K") else (info.k, info.d, info.p)
            rectified = "image_rect" in photo_topic
            matrix = (p[0], p[5], p[2], p[6]) if rectified and p[0] else (k[0], k[4], k[2], k[5])
            roi = info.roi
            return _Info(
                info.height,
                info.width,
                tuple(map(float, matrix)),
                (roi.x_offset, roi.y_offset, roi.width, roi.height),
                (max(info.binning_x, 1), max(info.binning_y, 1)),
                info.distortion_model,
                () if rectified else tuple(map(float, d)),
            )
        if len(place.parts) < 3:
            return None
    return None


def _geometry(place: str, info: _Info | None, _: tuple[int, int]) -> Geometry:
    """Return the camera of a recording."""
    if info is None:
        return Geometry(None, None, (Assumption("the recording has no camera_info beside the photo's topic"),))
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
    text = f"the photo's lens distortion is not undone: its model {info.model!r:.40} is not known"
    return Geometry(camera, None, (Assumption(text),))
