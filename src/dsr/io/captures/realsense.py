"""Recordings of RealSense's SDK: ``.bag`` (ROS 1, up to 2.57) and ``.db3`` (ROS 2, from 2.59), of one device.

https://github.com/IntelRealSense/librealsense, src/media/ros/ros_file_format.h and ros_writer.cpp; ``.db3`` as the SDK
2.59 writes it. Topics below ``/device_0/sensor_0``, for which the sensor of the stream has its own number:

    .bag                                    .db3
    option/Depth_Units/value (Float32)      the same (String)                           metres; version 2: ``property``
    Depth_0/image/data (Image)              ... or .../data/compressedDepth, /compressed
    Depth_0/info/camera_info (CameraInfo)   Depth_0/camera_info (String: key=value;...)
    Depth_0/tf/1 (Transform)                Depth_0/tf/ref_1 (String), column by column
    Depth_0/image/metadata                  the same, with the frame's time stamp       ms; .bag: in the image's header

``tf`` leads from the frame of reference of its number to the stream's, so depth to colour is that of colour after the
inverse of that of depth.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsr.geometry.camera import Camera, Lens
from dsr.geometry.poses import Matrix, as_rigid, from_quaternion, invert
from dsr.io.captures.bags import deserialize, first_message, images_of, messages_of, naming_recording
from dsr.io.frames import CaptureFrame, Geometry, Rig
from dsr.io.pairs import PairingResult, Shot, pair_by_time
from dsr.io.trajectories import describe_capture, intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import naming, numbers_in
from dsr.utils.progress import show_length

VERSION = "/file_version"
_IMAGES = re.compile(
    r"(?P<stream>(?P<sensor>/device_\d+/sensor_\d+)/(?P<kind>\w+)_\d+)/image/data(/compressed(Depth)?)?"
)
_USUAL_UNIT = 1e-3
_ALIKE = 1e-5  # difference of numbers of two cameras, and of a transform to none, up to which they are the same
# The SDK's names of distortion models (rs2_distortion_to_string), in lower case.
_LENSES = {
    "brown conrady": "brown_conrady",
    "modified brown conrady": "modified_brown_conrady",
    "inverse brown conrady": "modified_brown_conrady",
    "kannala brandt4": "kannala_brandt",
}


class _Stream(NamedTuple):
    """A stream's camera, its lens, its frame of reference with the transform from there, and notes."""

    camera: Camera
    lens: Lens | None
    reference: str
    transform: Matrix | None
    notes: tuple[Assumption, ...]


def read(reader: Any, path: Path) -> PairingResult:
    """Return the frames of an open recording."""
    topics = {each.topic: match for each in reader.connections if (match := _IMAGES.fullmatch(each.topic))}
    color, depth = (_choose(reader, path, topics, kind) for kind in ("Color", "Depth"))
    unit, notes = _unit(reader, path, depth["sensor"])
    streams, registered = None, list[Assumption]()
    try:
        with naming_recording(path):
            streams = _stream(reader, path, color["stream"]), _stream(reader, path, depth["stream"])
            geometry, registered = _geometry(*streams)
    except ValueError as error:  # which does not matter where cameras are given
        geometry = Geometry(damage=str(error))
    device = _device(reader)
    apart = all(_transforms(reader, each["stream"]) for each in (color, depth))
    frame = CaptureFrame(device, geometry, path, repr(streams or geometry.damage).encode(), apart=apart)
    found = pair_by_time(_shots(reader, path, color), _shots(reader, path, depth), frame, unit)
    about = describe_capture(f"a recording of {device}", f"units of {show_length(unit)}", found.pairs, poses=False)
    others = sorted(topics.keys() - {color[0], depth[0]})
    if others:
        notes.append(Assumption(f"topics that are not read: {', '.join(others)}"))
    return replace(found, assumptions=(about, *registered, *notes))


def _choose(reader: Any, path: Path, topics: dict[str, re.Match[str]], kind: str) -> re.Match[str]:
    """Return the topic of the images of the stream of a kind that has the most, the first by name of several."""
    counts = {each.topic: each.msgcount for each in reader.connections
              if each.topic in topics and topics[each.topic]["kind"] == kind and each.msgcount}  # fmt: skip
    if not counts:
        found = ", ".join(sorted({match["kind"] for match in topics.values()})) or "no images"
        raise ValueError(f"{path}: expected a stream {kind} of RealSense's SDK, got {found}")
    return topics[min(counts, key=lambda topic: (-counts[topic], topic))]


def _stream(reader: Any, path: Path, stream: str) -> _Stream:
    place = f"{path}{stream}"
    info = first_message(reader, f"{stream}/info/camera_info")
    if info is not None:
        size, model, distortion = (int(info.height), int(info.width)), info.distortion_model, info.D
        numbers = [info.K[0], info.K[4], info.K[2], info.K[5]]
    else:
        entries = _entries(first_message(reader, f"{stream}/camera_info"), f"{place}: expected camera_info")
        numbers = numbers_in(entries.get(key, "") for key in ("fx", "fy", "ppx", "ppy"))
        sizes = numbers_in(entries.get(key, "") for key in ("height", "width"))
        model, distortion = entries.get("model", "None"), numbers_in(entries.get("coeffs", "").split(","))
        if not numbers or not sizes:
            raise ValueError(f"{place}: expected width, height, fx, fy, ppx, ppy in camera_info, got {entries!s:.120}")
        size = int(sizes[0]), int(sizes[1])
    if min(size) < 1:
        raise ValueError(f"{place}: expected a positive width and height, got {size[1]} x {size[0]}")
    camera = intrinsics_camera(place, size, [float(number) for number in numbers])
    lens, notes = None, tuple[Assumption, ...]()
    if np.any(distortion):
        name = _LENSES.get(model.strip().lower())
        if name is None:
            text = f"the lens distortion of {stream} is not undone: its model {model!r:.40} is not known"
            notes = (Assumption(text),)
        else:
            with naming(place):
                lens = Lens(name, tuple(map(float, distortion))[: 4 if name == "kannala_brandt" else None])
    reference, transform = _transform(reader, place, stream)
    return _Stream(camera, lens, reference, transform, notes)


def _transforms(reader: Any, stream: str) -> list[str]:
    return sorted(each.topic for each in reader.connections if each.topic.startswith(f"{stream}/tf/"))


def _transform(reader: Any, place: str, stream: str) -> tuple[str, Matrix | None]:
    """Return the number of a stream's frame of reference, and the transform from there; None if there is none."""
    for topic in _transforms(reader, stream):
        message = first_message(reader, topic)
        if message is None:
            continue
        reference = topic.rpartition("/")[2]
        if hasattr(message, "rotation"):
            shift, turn = message.translation, message.rotation
            return reference, from_quaternion((shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w), place)
        entries = _entries(message, f"{place}: expected a transform")
        rotation, translation = (numbers_in(entries.get(key, "").split(",")) for key in ("rotation", "translation"))
        if (len(rotation), len(translation)) != (9, 3):
            raise ValueError(f"{place}: expected 9 numbers of rotation and 3 of translation, got {entries!s:.120}")
        return reference, as_rigid(np.column_stack((np.array(rotation).reshape(3, 3).T, translation)), place)
    return "", None


def _entries(message: Any, expected: str) -> dict[str, str]:
    """Return the keys and values of a String of the form key=value;key=value."""
    if message is None:
        raise ValueError(f"{expected}, there is none")
    pairs = (part.partition("=") for part in str(message.data).split(";"))
    return {key.strip(): value.strip() for key, _, value in pairs}


def _geometry(color: _Stream, depth: _Stream) -> tuple[Geometry, list[Assumption]]:
    notes = (*color.notes, *depth.notes)
    geometry = Geometry(color.camera, None, notes, color.lens)
    if color.transform is None or depth.transform is None or color.reference != depth.reference:
        text = "the recording has no transform from depth to colour: depth is assumed to be registered to the photo"
        return geometry, [Assumption(text)]
    transform = color.transform @ invert(depth.transform)
    own, other = ((c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (color.camera, depth.camera))
    if np.allclose(own, other, rtol=_ALIKE) and np.allclose(transform, np.eye(4), atol=_ALIKE):
        return geometry, [Assumption("depth is registered to the photo: both streams have the same camera")]
    return geometry._replace(rig=Rig(depth.camera, transform, depth.lens)), []


def _unit(reader: Any, path: Path, sensor: str) -> tuple[float, list[Assumption]]:
    message = first_message(reader, f"{sensor}/option/Depth_Units/value")
    if message is not None:
        unit = numbers_in([str(message.data)])
        if not unit or not 0 < unit[0] < 1:
            raise ValueError(f"{path}{sensor}: expected Depth_Units in metres, got {message.data!s:.40}")
        return float(f"{unit[0]:.6g}"), []  # float32: 0.001 is 0.0010000000475
    for _, found in messages_of(reader, f"{sensor}/property"):
        unit = numbers_in([found.value])
        if found.key.replace("_", " ") == "Depth Units" and unit and 0 < unit[0] < 1:
            return unit[0], []
    return _USUAL_UNIT, [Assumption("the recording does not state Depth Units: millimetres assumed (--depth-unit)")]


def _shots(reader: Any, path: Path, topic: re.Match[str]) -> list[Shot]:
    """Return the images of a stream in the order of the time stamps of their frames."""
    stamps = {}
    for time, message in messages_of(reader, f"{topic['stream']}/image/metadata") if reader.is2 else ():
        stamps[time] = numbers_in([_entries(message, "").get("timestamp", "")])
    shots = []
    for message in images_of(reader, path, topic[0]):
        if reader.is2:
            stamp = 1e-3 * (stamps.get(message.time) or [1e-6 * message.time])[0]
        else:
            header = deserialize(reader, message.raw, message.kind).header.stamp
            stamp = header.sec + 1e-9 * header.nanosec
        shots.append(Shot(Path(f"{path}{topic[0]}"), message.source, stamp))
    return sorted(shots, key=lambda shot: shot.seconds)


def _device(reader: Any) -> str:
    for _, message in messages_of(reader, "/device_0/info"):
        name = message.value if getattr(message, "key", "") == "Name" else ""
        if hasattr(message, "data"):
            name = _entries(message, "").get("Name", "")
        if name:
            return str(name)
    return "RealSense"
