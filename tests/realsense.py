"""Recordings as RealSense's SDK writes them, by bytes of their messages; a plane seen by two cameras."""

import sqlite3
import struct
from dataclasses import dataclass, field

import captures
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

COLOR = (64, 48, 50.0, 51.0, 31.0, 24.0)
DEPTH = (64, 48, 60.0, 60.0, 30.5, 23.0)  # Width, height, fx, fy, cx, cy
NO_LENS = ("Brown Conrady", (0.0,) * 5)
TURN, SHIFT = Rotation.from_euler("xyz", (1, -2, 0.5), degrees=True), (0.02, -0.005, 0.001)
"""From the depth camera to the colour camera, metres."""
NORMAL, DISTANCE = np.array([0.2, -0.1, 1.0]), 1.5  # Of the plane NORMAL . x = DISTANCE in the depth camera's frame


def rays(camera):
    width, height, fx, fy, cx, cy = camera
    v, u = np.mgrid[:height, :width]
    return np.stack(((u - cx) / fx, (v - cy) / fy, np.ones_like(u)), -1)


def seen_by_depth(number, unit=1e-3, camera=DEPTH):
    """The depth camera's map, (48, 64) uint16, of frame ``number``, each 0.1 m farther."""
    return np.rint((DISTANCE + 0.1 * number) / (rays(camera) @ NORMAL) / unit).astype(np.uint16)


def seen_by_color(number):
    """Depth in metres in the colour camera's pixels, (48, 64)."""
    normal = TURN.apply(NORMAL)
    return (DISTANCE + 0.1 * number + normal @ np.array(SHIFT)) / (rays(COLOR) @ normal)


@dataclass
class Recording:
    """What a recording holds; topics that are None are left out."""

    version: int = 4
    unit: float = 1e-3
    color: tuple = COLOR
    depth: tuple = DEPTH
    color_lens: tuple = NO_LENS
    depth_lens: tuple = NO_LENS
    turn: Rotation | None = TURN
    shift: tuple = SHIFT
    depths: list = field(default_factory=lambda: [seen_by_depth(number) for number in range(captures.FRAMES)])
    photos: list = field(default_factory=lambda: [captures.photo(number) for number in range(captures.FRAMES)])
    stamps: tuple = (1000.0, 1033.3, 1066.6)  # milliseconds, of both
    late: float = 0.4  # seconds by which colour arrives behind depth
    encoding: str = "rgb8"
    name: str = "Intel RealSense D435"
    raw: bool = False  # images of a .db3 without compression

    def streams(self):
        turn = self.turn
        yield 0, "Depth", self.depth, self.depth_lens, Rotation.identity(), (0, 0, 0), "mono16", self.depths, 0.0
        yield 1, "Color", self.color, self.color_lens, turn, self.shift, self.encoding, self.photos, self.late


def text1(text):
    return struct.pack("<I", len(text)) + text.encode()


def bag(path, recording):
    """Write a ``.bag`` of the SDK up to 2.57."""
    from rosbags.rosbag1 import Writer  # noqa: PLC0415 - an extra

    made = captures.RosWriter(1)
    written = []

    def add(time, topic, kind, raw):
        written.append((max(int(1e9 * time), 1), topic, kind, raw))

    add(0, "/file_version", "std_msgs/msg/UInt32", struct.pack("<I", recording.version))
    add(0, "/device_0/info", "diagnostic_msgs/msg/KeyValue", text1("Name") + text1(recording.name))
    if recording.version > 2:
        add(0, "/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", struct.pack("<f", recording.unit))
    else:
        value = text1("Depth Units") + text1(f"{recording.unit:f}")
        add(0, "/device_0/sensor_0/property", "diagnostic_msgs/msg/KeyValue", value)
    for sensor, kind, camera, lens, turn, shift, encoding, pictures, late in recording.streams():
        stream = f"/device_0/sensor_{sensor}/{kind}_0"
        width, height, *numbers = camera
        info = made.info(made.header(), (height, width), numbers, distortion_model=lens[0], d=lens[1])
        add(0, f"{stream}/info/camera_info", info.__msgtype__, bytes(made.store.serialize_ros1(info, info.__msgtype__)))
        if recording.turn is not None:
            transform = struct.pack("<7d", *shift, *turn.as_quat())
            add(0, f"{stream}/tf/1", "geometry_msgs/msg/Transform", transform)
        for number, (picture, stamp) in enumerate(zip(pictures, recording.stamps, strict=True)):
            seconds, rest = divmod(stamp / 1e3, 1)
            head = struct.pack("<III", number, int(seconds), int(1e9 * rest)) + text1("1")
            size = struct.pack("<II", *picture.shape[:2]) + text1(encoding) + struct.pack("<BI", 0, picture[0].nbytes)
            raw = head + size + struct.pack("<I", picture.nbytes) + picture.tobytes()
            add(1 + number / 30 + late, f"{stream}/image/data", "sensor_msgs/msg/Image", raw + b"\0\0\0\0")
    with Writer(path) as writer:
        found = {}
        for time, topic, kind, raw in written:
            if topic not in found:
                found[topic] = writer.add_connection(topic, kind, typestore=made.store)
            writer.write(found[topic], time, raw)
    return path


def cdr_text(text):
    raw = text.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw + bytes(-len(raw) % 4)


def db3(path, recording):
    """Write a ``.db3`` of the SDK from 2.59, which has no ``metadata.yaml``."""
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,"
                 "serialization_format TEXT NOT NULL,offered_qos_profiles TEXT NOT NULL)")  # fmt: skip
    base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,"
                 "timestamp INTEGER NOT NULL, data BLOB NOT NULL)")  # fmt: skip
    topics = {}

    def add(time, topic, kind, raw):
        if topic not in topics:
            topics[topic] = len(topics) + 1
            base.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", (topics[topic], topic, kind))
        row = (topics[topic], int(1e9 * time), b"\0\1\0\0" + raw)
        base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", row)

    def add_text(time, topic, text):
        add(time, topic, "std_msgs/msg/String", cdr_text(text).rstrip(b"\0") + b"\0")

    add(0, "/file_version", "std_msgs/msg/UInt32", struct.pack("<I", recording.version))
    add_text(0, "/device_0/info", f"Name={recording.name};Serial Number=0123")
    add_text(0, "/device_0/sensor_0/option/Depth_Units/value", f"{recording.unit:f}")
    for sensor, kind, camera, lens, turn, shift, encoding, pictures, late in recording.streams():
        stream = f"/device_0/sensor_{sensor}/{kind}_0"
        width, height, fx, fy, cx, cy = camera
        add_text(0, f"{stream}/camera_info", f"width={width};height={height};fx={fx:g};ppx={cx:g};fy={fy:g};ppy={cy:g};"
                 f"model={lens[0]};coeffs={','.join(f'{each:g}' for each in lens[1])}")  # fmt: skip
        if recording.turn is not None:
            columns = ",".join(f"{each:f}" for each in turn.as_matrix().T.reshape(-1))
            add_text(
                0, f"{stream}/tf/ref_1", f"rotation={columns};translation={','.join(f'{each:f}' for each in shift)}"
            )
        for number, (picture, stamp) in enumerate(zip(pictures, recording.stamps, strict=True)):
            time = 1 + number / 30 + late
            head = struct.pack("<II", int(time), int(1e9 * (time % 1))) + cdr_text(kind)
            if recording.raw:
                about = struct.pack("<II", *picture.shape[:2]) + cdr_text("16UC1" if kind == "Depth" else encoding)
                step = picture[0].nbytes
                if kind == "Depth":  # "16UC1" and its zero take 6 bytes, the order of bytes one, the step is aligned
                    about = about[:-2] + struct.pack("<BxI", 0, step)
                else:  # "rgb8" and its zero take 5
                    about = about[:-3] + struct.pack("<BxxI", 0, step)
                raw = head + about + struct.pack("<I", picture.nbytes) + picture.tobytes()
                add(time, f"{stream}/image/data", "sensor_msgs/msg/Image", raw)
            else:
                shown = picture if kind == "Depth" else picture[..., ::-1]
                content = cv2.imencode(".png", shown)[1].tobytes()
                content = bytes(12) + content if kind == "Depth" else content
                about = "16UC1; compressedDepth png" if kind == "Depth" else "rgb8; png compressed bgr8"
                raw = head + cdr_text(about) + struct.pack("<I", len(content)) + content
                topic = f"{stream}/image/data/compressed{'Depth' if kind == 'Depth' else ''}"
                add(time, topic, "sensor_msgs/msg/CompressedImage", raw)
            add_text(time, f"{stream}/image/metadata", f"Frame number={number};timestamp={stamp:f};Actual Fps=30;")
    base.commit()
    base.close()
    return path


WRITERS = {".bag": bag, ".db3": db3}
