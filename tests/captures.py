"""Small captures in the layouts of apps, written with poses and intrinsics that are known."""

import base64
import hashlib
import io
import json
import os
import struct
import zipfile
import zlib

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from small_files import encoded_png, written

SIZE, SIZE_LR = (48, 64), (12, 16)
INTRINSICS = (50.0, 51.0, 31.0, 24.0)
FRAMES = 3
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # From ARKit's and OpenGL's axes of the camera to dsr's, and back


def photo(number=0):
    """A smooth photo, so that encoders keep it, (48, 64, 3) uint8 RGB; its red grows with the number."""
    y, x = np.mgrid[0:48, 0:64]
    return np.stack((40 * number + x, 2 * y + 60, x + y), -1).astype(np.uint8)


def large_photo():
    """The photo of four times the size, (192, 256, 3)."""
    return photo().repeat(4, 0).repeat(4, 1)


def depth(number=0):
    """Depth in metres, (12, 16), a slope without holes; 0.5 m farther with each number."""
    y, x = np.mgrid[0:12, 0:16]
    return 1.5 + 0.5 * number + 0.01 * x + 0.02 * y


def levels():
    """Confidence, (12, 16) uint8: 0 in the first two columns, 1 in the next two, then 2."""
    return np.broadcast_to(np.repeat([0, 1, 2], [2, 2, 12]).astype(np.uint8), SIZE_LR).copy()


def pose(number=0):
    """A pose from camera (x right, y down, z forward) to world, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", (10 + number, 20, -30), degrees=True).as_matrix()
    matrix[:3, 3] = (0.1 * number, 0.2, -0.3)
    return matrix


def save(path, values):
    """Write a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def millimetres(number=0):
    return np.round(1000 * depth(number)).astype(np.uint16)


def write_video(path, frames):
    """Write a video of RGB frames, without loss as far as the codec can."""
    path.parent.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # as in dsr, which only reads videos; it is read once
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, frames[0].shape[1::-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def stray(folder, *, video=True, own_intrinsics=True):
    """Write a capture of Stray Scanner: photos in a video or in files, intrinsics of each frame or of all."""
    for number in range(FRAMES):
        save(folder / "depth" / f"{number:06}.png", millimetres(number))
        save(folder / "confidence" / f"{number:06}.png", levels())
        if not video:
            save(folder / "rgb" / f"{number:06}.png", photo(number))
    if video:
        write_video(folder / "rgb.mp4", [photo(number) for number in range(FRAMES)])
    fx, fy, cx, cy = INTRINSICS
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0\n")
    more = ", fx, fy, cx, cy, distortion_center_x, distortion_center_y" if own_intrinsics else ""
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + more]
    for number in range(FRAMES):
        values = [*pose(number)[:3, 3], *Rotation.from_matrix(pose(number)[:3, :3]).as_quat()]
        values += [fx + number, fy, cx, cy] if own_intrinsics else []
        end = ", , " if own_intrinsics else ""
        lines.append(f"{10 + number / 60}, {number:06}, " + ", ".join(f"{value:.9f}" for value in values) + end)
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    return folder


def lzfse_block(values):
    """Return the bytes of an array as LZFSE data that are not compressed."""
    content = values.tobytes()
    return b"bvx-" + struct.pack("<I", len(content)) + content + b"bvx$"


def record3d_metadata(**changes):
    """The metadata of Record3D; the camera of later frames has a larger fx."""
    fx, fy, cx, cy = INTRINSICS
    poses = [
        [*Rotation.from_matrix((pose(number) @ FLIP)[:3, :3]).as_quat(), *pose(number)[:3, 3]]
        for number in range(FRAMES)
    ]
    own = [[fx + number, fy, cx, cy] for number in range(FRAMES)]
    sizes = {"w": SIZE[1], "h": SIZE[0], "dw": SIZE_LR[1], "dh": SIZE_LR[0], "fps": 30}
    K = [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    return {**sizes, "K": K, "poses": poses, "perFrameIntrinsicCoeffs": own, **changes}


def record3d(path, compress=lzfse_block, **changes):
    """Write an .r3d archive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(record3d_metadata(**changes)))
        for number in range(FRAMES):
            encoded = cv2.imencode(".jpg", photo(number)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1]
            archive.writestr(f"rgbd/{number}.jpg", encoded.tobytes())
            archive.writestr(f"rgbd/{number}.depth", compress(depth(number).astype("<f4")))
            archive.writestr(f"rgbd/{number}.conf", compress(levels()))
    return path


def record3d_unpacked(folder):
    """Write the members of an .r3d archive."""
    with zipfile.ZipFile(record3d(folder.parent / "packed.r3d")) as archive:
        archive.extractall(folder)
    (folder.parent / "packed.r3d").unlink()
    return folder


def record3d_export(folder):
    """Write Record3D's export of EXR depth and photos."""
    for number in range(FRAMES):
        save(folder / "rgb" / f"{number}.jpg", photo(number))
        (folder / "depth").mkdir(exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"R": depth(number).astype(np.float32)}) as file:
            file.write(str(folder / "depth" / f"{number}.exr"))
    (folder / "metadata.json").write_text(json.dumps(record3d_metadata()))
    return folder


def polycam_camera(number=0, **changes):
    """A camera of Polycam."""
    fx, fy, cx, cy = INTRINSICS
    matrix = pose(number) @ FLIP
    entries = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
    sizes = {"width": SIZE[1], "height": SIZE[0], "blur_score": 100.0}
    return {"fx": fx + number, "fy": fy, "cx": cx, "cy": cy, **sizes, **entries, **changes}


def polycam(folder):
    """Write a raw export of Polycam whose last frame has no corrected photo."""
    for number in range(FRAMES):
        name = f"{1000 + number}"
        for kind in ("", "corrected_")[: 2 if number < FRAMES - 1 else 1]:
            brighter = photo(number) + np.uint8(10 if kind else 0)
            save(folder / "keyframes" / f"{kind}images" / f"{name}.jpg", brighter)
            path = folder / "keyframes" / f"{kind}cameras" / f"{name}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(polycam_camera(number, cy=INTRINSICS[3] - 1 if kind else INTRINSICS[3])))
        save(folder / "keyframes" / "depth" / f"{name}.png", millimetres(number))
        save(folder / "keyframes" / "confidence" / f"{name}.png", np.array([0, 127, 255], np.uint8)[levels()])
    return folder


def arkitscenes(folder, start=10.0):
    """Write a video of ARKitScenes whose last frame has no pose, and whose intrinsics are a millisecond off."""
    lines = []
    for number in range(FRAMES):
        time = start + 0.1 * number
        stem = f"41069021_{time:.3f}"
        save(folder / "lowres_wide" / f"{stem}.png", photo(number))
        save(folder / "lowres_depth" / f"{stem}.png", millimetres(number))
        save(folder / "confidence" / f"{stem}.png", levels())
        fx, fy, cx, cy = INTRINSICS
        path = folder / "lowres_wide_intrinsics" / f"41069021_{time + 0.001:.3f}.pincam"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{SIZE[1]} {SIZE[0]} {fx + number} {fy} {cx} {cy}\n")
        back = np.linalg.inv(pose(number))
        if number < FRAMES - 1:
            values = [time + 0.004, *Rotation.from_matrix(back[:3, :3]).as_rotvec(), *back[:3, 3]]
            lines.append(" ".join(f"{value:.9f}" for value in values))
    (folder / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return folder


def open3d(folder, camera="camera_intrinsic.json"):
    """Write a folder of Open3D's reconstruction system with its trajectory."""
    fx, fy, cx, cy = INTRINSICS
    lines = []
    for number in range(FRAMES):
        save(folder / "color" / f"{number:06}.jpg", photo(number))
        save(folder / "depth" / f"{number:06}.png", millimetres(number))
        lines.append(f"{number} {number} {number + 1}")
        lines += [" ".join(f"{value:.10f}" for value in row) for row in pose(number)]
    entries = {"width": SIZE[1], "height": SIZE[0], "intrinsic_matrix": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}
    (folder / camera).write_text(json.dumps(entries))
    (folder / "scene").mkdir()
    (folder / "scene" / "trajectory.log").write_text("\n".join(lines) + "\n")
    return folder


def rvl(values):
    """Values as RVL, number by number, each in parts of four bits, into words of eight."""
    parts = []

    def add(number):
        while True:
            part, number = number & 7, number >> 3
            parts.append(part | (8 if number else 0))
            if not number:
                return

    flat, place, previous = values.reshape(-1).tolist(), 0, 0
    while place < len(flat):
        for zero in (True, False):
            end = place
            while end < len(flat) and (flat[end] == 0) == zero:
                end += 1
            add(end - place)
            for value in [] if zero else flat[place:end]:
                add(2 * (value - previous) if value >= previous else 2 * (previous - value) - 1)
                previous = value
            place = end
    parts += [0] * (-len(parts) % 8)
    words = [int("".join(f"{part:x}" for part in parts[i : i + 8]), 16) for i in range(0, len(parts), 8)]
    return struct.pack("<II", values.shape[1], values.shape[0]) + struct.pack(f"<{len(words)}I", *words)


class RosWriter:
    """Messages of ROS 1 or 2, all of second 100 and 33 ms apart, and what writes them."""

    def __init__(self, version):
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - an extra

        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)

    def make(self, kind, *values, **named):
        """Return a message of a kind, such as ``sensor_msgs/Image``."""
        return self.store.types[kind.replace("/", "/msg/")](*values, **named)

    def header(self, frame="camera", number=0, late=0):
        stamp = self.make("builtin_interfaces/Time", 100, int(33e6 * number + late))
        return self.make(
            "std_msgs/Header", stamp=stamp, frame_id=frame, **({"seq": number} if self.version == 1 else {})
        )

    def image(self, header, values, encoding):
        data = np.frombuffer(values.tobytes(), np.uint8)
        size = {"height": values.shape[0], "width": values.shape[1], "step": values[0].nbytes}
        return self.make("sensor_msgs/Image", header=header, encoding=encoding, is_bigendian=0, data=data, **size)

    def compressed(self, header, content, layout):
        data = np.frombuffer(content, np.uint8)
        return self.make("sensor_msgs/CompressedImage", header=header, format=layout, data=data)

    def info(self, header, size, camera, roi=(0, 0, 0, 0), **changes):
        """CameraInfo of a size (height, width) and fx, fy, cx, cy; ``roi`` is x, y, width, height."""
        fx, fy, cx, cy = camera
        arrays = {"d": np.zeros(5), "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), "r": np.eye(3).ravel(),
                  "p": np.zeros(12)}  # fmt: skip
        arrays |= {name: np.array(changes.pop(name), float) for name in arrays.keys() & changes.keys()}
        if self.version == 1:
            arrays = {name.upper(): value for name, value in arrays.items()}
        x, y, width, height = roi
        window = self.make("sensor_msgs/RegionOfInterest", x, y, height, width, False)
        plain = {"height": size[0], "width": size[1], "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        return self.make("sensor_msgs/CameraInfo", header=header, roi=window, **{**plain, **changes}, **arrays)

    def write(self, path, topics, plugin="SQLITE3", packed=False):
        """Write the messages of each topic; ``packed``: the file of ROS 2 is compressed as a whole."""
        from rosbags import rosbag1, rosbag2  # noqa: PLC0415

        path.parent.mkdir(parents=True, exist_ok=True)
        if self.version == 1:
            writer = rosbag1.Writer(path)
        else:
            writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
        if packed:
            writer.set_compression(rosbag2.CompressionMode.FILE, rosbag2.CompressionFormat.ZSTD)
        serialize = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        with writer:
            for topic, messages in topics.items():
                kind = messages[0].__msgtype__
                connection = writer.add_connection(topic, kind, typestore=self.store)
                for number, message in enumerate(messages):
                    writer.write(connection, int(100e9 + 33e6 * number), bytes(serialize(message, kind)))
        return path


def ros(path, version, *, floats=False, compressed=False, photos=photo, image_name="image_raw", rvl_depth=False,
        plugin="SQLITE3", packed=False, **of_info):  # fmt: skip
    """Write a recording of ROS 1 or 2 with colour, depth aligned to it, raw depth and infrared.

    Args:
        floats: whether depth is in metres.
        compressed: whether photos are JPEG.
        photos: makes the photo of a number.
        rvl_depth: whether depth is compressedDepth of millimetres as RVL.
        of_info: entries of CameraInfo that are not as for a plain picture.

    """
    writer = RosWriter(version)

    def colour(number):
        if not compressed:
            return writer.image(writer.header(number=number), photos(number)[..., ::-1], "bgr8")
        content = cv2.imencode(".jpg", photos(number)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1]
        return writer.compressed(writer.header(number=number), content.tobytes(), "rgb8; jpeg compressed bgr8")

    def aligned(number):
        header = writer.header(number=number, late=5e6)
        if rvl_depth:
            content = struct.pack("<iff", 0, 0, 0) + rvl(millimetres(number))
            return writer.compressed(header, content, "16UC1; compressedDepth rvl")
        if floats:
            return writer.image(header, depth(number).astype(np.float32), "32FC1")
        return writer.image(header, millimetres(number), "16UC1")

    makers = {
        f"/camera/color/{image_name}" + "/compressed" * compressed: colour,
        "/camera/color/camera_info":
            lambda number: writer.info(writer.header(number=number), SIZE, INTRINSICS, **of_info),
        "/camera/depth/image_rect_raw":
            lambda number: writer.image(writer.header(number=number), 2 * millimetres(number), "16UC1"),
        "/camera/aligned_depth_to_color/image_raw" + "/compressedDepth" * rvl_depth: aligned,
        "/camera/infra1/image_rect_raw": lambda number: writer.image(writer.header(number=number), levels(), "mono8"),
    }  # fmt: skip
    topics = {name: [make(number) for number in range(FRAMES)] for name, make in makers.items()}
    return writer.write(path, topics, plugin, packed)


def write_matrix(path, matrix):
    """Write a matrix as rows of numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(f"{value:.9f}" for value in row) for row in matrix) + "\n")


def intrinsic_matrix(side=3):
    fx, fy, cx, cy = INTRINSICS
    matrix = np.eye(side)
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = fx, fy, cx, cy
    return matrix


def seven_scenes(folder, name="{:06}".format):
    """Write a sequence of 7-Scenes, whose holes are 65535."""
    for number in range(FRAMES):
        stem = "frame-" + name(number)
        values = millimetres(number)
        values[0, 0] = 65535
        save(folder / f"{stem}.color.png", photo(number))
        save(folder / f"{stem}.depth.png", values)
        write_matrix(folder / f"{stem}.pose.txt", pose(number))
    return folder


def scannet(folder, lost=()):
    """Write an export of ScanNet; the poses of lost frames are -inf."""
    for number in range(FRAMES):
        save(folder / "color" / f"{number}.jpg", photo(number))
        save(folder / "depth" / f"{number}.png", millimetres(number))
        write_matrix(folder / "pose" / f"{number}.txt", np.full((4, 4), -np.inf) if number in lost else pose(number))
    for kind, side in (("color", SIZE[1]), ("depth", SIZE_LR[1])):
        matrix = intrinsic_matrix(4)
        matrix[:2] *= side / SIZE[1]
        write_matrix(folder / "intrinsic" / f"intrinsic_{kind}.txt", matrix)
        write_matrix(folder / "intrinsic" / f"extrinsic_{kind}.txt", np.eye(4))
    return folder


def sens(path, *, colour="jpeg", depth="zlib", scale=1000.0, lost=(), start=1_000_000, step=33_333):
    """Write a recording of ScanNet."""
    kinds = {"raw": 0, "png": 1, "jpeg": 2}
    parts = [struct.pack("<IQ", 4, 9), b"Structure"]
    parts += [np.asarray(matrix, "<f4").tobytes() for matrix in (intrinsic_matrix(4), np.eye(4)) * 2]
    sizes = (SIZE[1], SIZE[0], SIZE_LR[1], SIZE_LR[0])
    parts.append(struct.pack("<iiIIIIfQ", kinds[colour], depth == "zlib", *sizes, scale, FRAMES))
    for number in range(FRAMES):
        matrix = np.full((4, 4), -np.inf) if number in lost else pose(number)
        rgb = photo(number).tobytes()
        if colour != "raw":
            rgb = cv2.imencode(f".{colour}", photo(number)[..., ::-1])[1].tobytes()
        stored = np.round(scale * globals()["depth"](number)).astype("<u2").tobytes()
        stored = zlib.compress(stored) if depth == "zlib" else stored
        reported = struct.pack("<4Q", start + step * number, 8, len(rgb), len(stored))
        parts += [matrix.astype("<f4").tobytes(), reported, rgb, stored]
    parts.append(struct.pack("<Q", 0))  # of the inertial sensor
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(parts))
    return path


def iphone_map(number):
    """A map of an iPhone in metres, (192, 256), with the smallest depth of :func:`depth`."""
    return 1.5 + 0.5 * number + np.mgrid[0:192, 0:256][1] / 1000


def scannetpp(folder, kind="lz4"):
    """Write the iPhone of a scene of ScanNet++, photos of 192 x 256, its maps as LZ4 or deflate, or extracted."""
    block = pytest.importorskip("lz4.block")
    entries, parts, place = {}, [], folder / "iphone"
    for number in range(FRAMES):
        matrix = np.diag([4, 4, 1]) @ intrinsic_matrix()
        matrix[0, 0] += number
        picture = cv2.resize(photo(number), (256, 192))
        aligned = {"aligned_pose": pose(number).tolist(), "pose": (pose(number) @ FLIP).tolist()}
        entries[f"frame_{number:06}"] = {"timestamp": 0.1, "intrinsic": matrix.tolist(), "imu": [], **aligned}
        values = np.round(1000 * iphone_map(number)).astype("<u2")
        packed = block.compress(values.tobytes(), store_size=False)
        if kind == "deflate":
            packing = zlib.compressobj(wbits=-15)
            packed = packing.compress(iphone_map(number).astype("<f4").tobytes()) + packing.flush()
        parts += [struct.pack("<I", len(packed)), packed]
        if kind == "files":
            save(place / "rgb" / f"frame_{number:06}.jpg", picture)
            save(place / "depth" / f"frame_{number:06}.png", values)
    place.mkdir(parents=True, exist_ok=True)
    if kind != "files":
        write_video(place / "rgb.mp4", [cv2.resize(photo(number), (256, 192)) for number in range(FRAMES)])
        (place / "depth.bin").write_bytes(b"".join(parts))
    (place / "pose_intrinsic_imu.json").write_text(json.dumps(entries))
    return folder


def replica(folder, *, step=1):
    """Write a scene of Replica as NICE-SLAM renders it: all poses, and one of every few frames."""
    rows = []
    for number in range(FRAMES * step):
        rows.append(" ".join(f"{value:.9f}" for value in pose(number // step).ravel()))
        if number % step == 0:
            save(folder / "results" / f"frame{number:06}.jpg", photo(number // step))
            values = np.round(6553.5 * depth(number // step)).astype(np.uint16)
            save(folder / "results" / f"depth{number:06}.png", values)
    (folder / "traj.txt").write_text("\n".join(rows) + "\n")
    names = zip(("fx", "fy", "cx", "cy"), INTRINSICS, strict=True)
    entries = {"camera": {"w": SIZE[1], "h": SIZE[0], **dict(names), "scale": 6553.5}}
    (folder / "cam_params.json").write_text(json.dumps(entries))
    return folder


def scanner_app(folder, name="{:05}".format):
    """Write all data of 3D Scanner App, whose last photo is left out."""
    fx, fy, cx, cy = INTRINSICS
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(FRAMES + 1):
        stem = name(number)
        reported = {"intrinsics": [fx + number, 0, cx, 0, fy, cy, 0, 0, 1], "time": 1.5, "frame_index": number}
        reported["cameraPoseARFrame"] = (pose(number) @ FLIP).ravel().tolist()
        (folder / f"frame_{stem}.json").write_text(json.dumps(reported))
        save(folder / f"depth_{stem}.png", millimetres(number))
        save(folder / f"conf_{stem}.png", levels())
        if number < FRAMES:
            save(folder / f"frame_{stem}.jpg", photo(number))
    return folder


def sunrgbd(folder):
    """Write a scene of SUN RGB-D with a distance beyond 8 m, whose turned bits are no multiple of 8."""
    values = millimetres() * np.uint16(6)
    assert values.max() > 8192
    turned = (values << 3) | (values >> 13)
    save(folder / "image" / "0000144.jpg", photo())
    save(folder / "depth" / "0000144.png", turned)
    save(folder / "depth_bfx" / "0000144.png", np.full_like(turned, 8000))
    (folder / "intrinsics.txt").write_text(" ".join(f"{value:g}" for value in intrinsic_matrix().ravel()) + "\n")
    write_matrix(folder / "extrinsics" / "20141221170930.txt", np.eye(4)[:3])


KINECT_DEPTH = (288, 320)
KINECT_COLOUR, KINECT_LENS = (0.51, 0.49, 0.48, 0.64), (0.2, -0.3, 0.05, 0.25, -0.2, 0.01, 0, 0, 2e-4, -3e-4)
KINECT_IR, KINECT_IR_LENS = (0.505, 0.502, 0.494, 0.4935), (1.1, 0.6, 0.03, 1.4, 0.9, 0.17, 0, 0, -6e-5, 4e-5)
"""Of k4a: cx, cy, fx, fy of an image of 1 x 1; k1 to k6, codx, cody, p2, p1."""


def kinect_motion():
    """The motion from the depth camera's frame to the colour camera's, (4, 4)."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", (6, 0.3, -0.2), degrees=True).as_matrix()
    motion[:3, 3] = (-0.032, -0.002, 0.004)
    return motion


def kinect_calibration(*, wide=False):
    """calibration.json of an Azure Kinect; its rig's frame is not the depth camera's. ``wide``: of an old device."""
    rig = pose()
    cx, cy, fx, fy = KINECT_COLOUR
    colour = [cx, (3072 * cy - 384) / 2304, fx, fy * 3072 / 2304] if wide else [cx, cy, fx, fy]
    cameras = [
        {
            "Intrinsics": {
                "ModelParameterCount": 14, "ModelParameters": [*numbers, *lens],
                "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
            },
            "Location": f"CALIBRATION_CameraLocation{place}", "MetricRadius": 1.7,
            "Rt": {"Rotation": motion[:3, :3].ravel().tolist(), "Translation": motion[:3, 3].tolist()},
            "SensorHeight": size[0], "SensorWidth": size[1],
        }
        for place, numbers, lens, size, motion in (
            ("D0", KINECT_IR, KINECT_IR_LENS, (1024, 1024), rig),
            ("PV0", colour, KINECT_LENS, (2304 if wide else 3072, 4096), kinect_motion() @ rig),
        )
    ]  # fmt: skip
    return {"CalibrationInformation": {"Cameras": cameras, "InertialSensors": []}}


def kinect(path, photos, depths, mode="MJPG", calibration=None, late=0.0):
    """Write a recording of an Azure Kinect as k4arecorder does.

    Args:
        photos: of (H, W, 3) RGB; each is 1/30 s after the one before.
        depths: (h, w) millimetres.
        late: seconds from a photo to its depth map.

    """

    def element(name, *content):
        body = b"".join(
            each if isinstance(each, bytes) else each.encode() if isinstance(each, str) else struct.pack(">Q", each)
            for each in content
        )
        return bytes.fromhex(name) + struct.pack(">Q", len(body) | 1 << 56) + body

    def track(number, name, fourcc, bits, size):
        header = struct.pack("<IiiHH4sIiiII", 40, size[1], size[0], 0, bits, fourcc, 0, 0, 0, 0, 0)
        video = element("E0", element("B0", size[1]), element("BA", size[0]))
        return element("AE", element("D7", number), element("73C5", number), element("83", 1), element("536E", name),
                       element("86", "V_MS/VFW/FOURCC"), element("63A2", header), video)  # fmt: skip

    def tag(name, value, track=0):
        target = element("63C0", element("63C5", track), *([element("63CA", "TRACK")] if track else []))
        return element("7373", target, element("67C8", element("45A3", name), element("4487", value)))

    def encode(pixels):
        yuv = cv2.cvtColor(pixels, cv2.COLOR_RGB2YUV_I420)
        if mode == "MJPG":
            return cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        if mode == "BGRA":
            return cv2.cvtColor(pixels, cv2.COLOR_RGB2BGRA).tobytes()
        height, width = pixels.shape[:2]
        y, u, v = np.split(yuv.ravel(), [height * width, height * width * 5 // 4])
        if mode == "NV12":
            return y.tobytes() + np.stack((u, v), -1).tobytes()
        half = np.stack((u, v), -1).reshape(height // 2, width // 2, 2).repeat(2, 0)
        return np.stack((y.reshape(height, width), half.reshape(height, width)), -1).tobytes()

    def block(number, time, data):
        return element("A3", bytes([0x80 | number]), struct.pack(">hB", time, 0x80), data)

    size, size_lr = photos[0].shape[:2], depths[0].shape
    content = json.dumps(kinect_calibration() if calibration is None else calibration)
    bits = {"MJPG": 24, "NV12": 12, "YUY2": 16, "BGRA": 32}[mode]
    clusters = []
    for number, (photo, depth) in enumerate(zip(photos, depths, strict=True)):
        later = round(1e6 * late)
        clusters.append(element("1F43B675", element("E7", 1_000_000 + 33_333 * number), block(1, 0, encode(photo)),
                                block(2, later, depth.astype(">u2").tobytes()),
                                block(3, later, bytes(2 * depth.size))))  # fmt: skip
    file = element("61A7", element("466E", "calibration.json"), element("4660", "application/octet-stream"),
                   element("465C", content), element("46AE", 7))  # fmt: skip
    tags = [tag("K4A_COLOR_TRACK", "1", 1), tag("K4A_COLOR_MODE", f"{mode}_{size[0]}P", 1),
            tag("K4A_DEPTH_TRACK", "2", 2), tag("K4A_DEPTH_MODE", "NFOV_2X2BINNED", 2), tag("K4A_IR_TRACK", "3", 3),
            tag("K4A_DEPTH_DELAY_NS", f"{round(1e9 * late)}")]  # fmt: skip
    segment = element(
        "18538067", element("1549A966", element("2AD7B1", 1000), element("7BA9", "Azure Kinect")),
        element("1654AE6B", track(1, "COLOR", mode.encode(), bits, size), track(2, "DEPTH", b"b16g", 16, size_lr),
                track(3, "IR", b"b16g", 16, size_lr)),
        element("1941A469", file), element("1254C367", *tags), *clusters,
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(element("1A45DFA3", element("4282", "matroska"), element("4287", 2), element("4285", 2)) + segment)
    return path


HEIC, HEIC_MAP = (192, 256), (48, 64)
FLAT = np.full(HEIC_MAP, 99, np.uint8)
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" {}</rdf:Description></rdf:RDF></x:xmpmeta>"""
APPLE = """xmlns:depthData="http://ns.apple.com/depthData/1.0/">
<depthData:IntrinsicMatrixReferenceWidth>{width}</depthData:IntrinsicMatrixReferenceWidth>
<depthData:IntrinsicMatrixReferenceHeight>{height}</depthData:IntrinsicMatrixReferenceHeight>
<depthData:IntrinsicMatrix><rdf:Seq>{matrix}</rdf:Seq></depthData:IntrinsicMatrix>
<depthData:Accuracy>{accuracy}</depthData:Accuracy>"""


def apple_text(size=HEIC, numbers=(200.0, 201.0, 120.0, 90.0), accuracy="absolute"):
    """XMP text of a depth map as iPhones write it."""
    fx, fy, cx, cy = numbers
    matrix = "".join(f"<rdf:li>{each}</rdf:li>" for each in (fx, 0.0, 0.0, 0.0, fy, 0.0, cx, cy, 1))
    return XMP.format(APPLE.format(width=size[1], height=size[0], matrix=matrix, accuracy=accuracy))


def depth_message(kind, **values):
    """HEVC's depth representation information in an auxC box: z_near, z_far, d_min, d_max of powers of 2 and halves."""

    def golomb(number):
        return f"{number + 1:b}".rjust(2 * (number + 1).bit_length() - 1, "0")

    def real(number):
        mantissa, exponent = np.frexp(abs(number))
        return f"{int(number < 0)}{exponent - 1 + 31:07b}{15:05b}{round((2 * mantissa - 1) * 65536):016b}"

    names = ("z_near", "z_far", "d_min", "d_max")
    bits = "".join(str(int(name in values)) for name in names) + golomb(kind)
    bits += golomb(0) if {"d_min", "d_max"} & values.keys() else ""
    bits += "".join(real(values[name]) for name in names if name in values) + "1"
    payload = int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8))
    unit = b"\x4e\x01\xb1" + bytes([len(payload)]) + payload
    return struct.pack(">II", len(unit) + 4, len(unit)) + unit


def heic(path, levels, message=None, text="", orientation=1):
    """Write a HEIC photo with a depth map as iPhones do: a file of two pictures, the second of which is made auxiliary.

    Args:
        levels: (h, w) uint8 of the map.
        message: of the map; None for disparity from 0.5 to 2.
        text: XMP of the map.
        orientation: EXIF orientation, by which readers of HEIC turn both.

    """
    import pillow_heif  # noqa: PLC0415 - an extra

    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "iPhone 13 Pro", orientation
    exif.get_ifd(0x8769)[0xA405] = 52
    pixels = large_photo()
    file = pillow_heif.from_pillow(Image.fromarray(pixels))
    file.add_from_pillow(Image.fromarray(levels))
    path.parent.mkdir(parents=True, exist_ok=True)
    file.save(path, quality=-1, chroma=444, exif=exif.tobytes())
    content = path.read_bytes()

    def box(kind, *parts):
        body = b"".join(parts)
        return struct.pack(">I", len(body) + 8) + kind + body

    def parts_of(content):
        place, found = 0, {}
        while place < len(content):
            (size,) = struct.unpack_from(">I", content, place)
            found.setdefault(content[place + 4 : place + 8], []).append(content[place + 8 : place + size])
            place += size
        return found

    top = parts_of(content)
    meta = parts_of(top[b"meta"][0][4:])
    located = meta[b"iloc"][0]
    entries = list(struct.iter_unpack(">HHIHII", located[8:]))
    properties = parts_of(meta[b"iprp"][0])
    kinds, at = [], 0
    while at < len(properties[b"ipco"][0]):
        kinds.append(properties[b"ipco"][0][at + 4 : at + 8])
        at += struct.unpack_from(">I", properties[b"ipco"][0], at)[0]
    message = depth_message(1, d_min=0.5, d_max=2.0) if message is None else message
    auxiliary = box(b"auxC", bytes(4), b"urn:mpeg:hevc:2015:auxid:2\0", message)
    of_items, place = bytearray(properties[b"ipma"][0]), 8
    for _ in range(struct.unpack_from(">I", of_items, 4)[0]):  # ends at the second picture, the last one
        last = place
        place += 3 + of_items[last + 2]
    own = [len(kinds) + 1, *(number for number, kind in enumerate(kinds, 1) if kind == b"irot")]
    of_items[last + 2] += len(own)
    of_items += bytes(0x80 | each for each in own)
    second = struct.unpack_from(">H", of_items, last)[0]
    references = meta.get(b"iref", [bytes(4)])[0] + box(b"auxl", struct.pack(">HHH", second, 1, entries[0][0]))
    boxes = [box(name, each) for name in meta if name not in (b"iloc", b"iprp", b"iref") for each in meta[name]]
    boxes += [
        box(b"iref", references),
        box(b"iprp", box(b"ipco", properties[b"ipco"][0], auxiliary), box(b"ipma", of_items)),
    ]
    old = len(top[b"meta"][0])
    later = 4 + sum(map(len, boxes)) + len(located) + 8 - old
    moved = b"".join(struct.pack(">HHIHII", *entry[:2], entry[2] + later, *entry[3:]) for entry in entries)
    whole = box(b"ftyp", top[b"ftyp"][0]) + box(b"meta", bytes(4), *boxes, box(b"iloc", located[:8], moved))
    path.write_bytes(whole + b"".join(box(b"mdat", each) for each in top[b"mdat"]) + box(b"mdat", text.encode()))
    return path


def encoded_jpeg(pixels, **options):
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "JPEG", quality=98, **options)
    return content.getvalue()


def with_xmp(photo, standard, extended="", swap=False):
    """A JPEG with XMP in its first segments, of which the extended one may be in several, in another order."""
    parts, size = [], 60_000
    if extended:
        guid = hashlib.md5(extended.encode()).hexdigest().upper()
        standard = f'xmlns:xmpNote="http://ns.adobe.com/xmp/note/" xmpNote:HasExtendedXMP="{guid}" {standard}'
        for place in range(0, len(extended), size):
            head = guid.encode() + struct.pack(">II", len(extended), place)
            parts.append(b"http://ns.adobe.com/xmp/extension/\0" + head + extended[place : place + size].encode())
    parts = [b"http://ns.adobe.com/xap/1.0/\0" + XMP.format(standard).encode(), *(parts[::-1] if swap else parts)]
    return photo[:2] + b"".join(b"\xff\xe1" + struct.pack(">H", len(each) + 2) + each for each in parts) + photo[2:]


def gdepth(path, levels, confidence=None, *, original=b"", extended=True, swap=False, file=b"", **values):
    """Write a JPEG with GDepth: near and far are 0.5 and 4 m unless ``values`` say else, empty ones are left out."""
    keys = {"Format": "RangeInverse", "Near": 0.5, "Far": 4.0, "Units": "m", **values}
    sure = b"" if confidence is None else encoded_png(confidence)
    data = {"GDepth:Data": encoded_png(levels), "GDepth:Confidence": sure, "GImage:Data": original}
    large = " ".join(f'{name}="{base64.b64encode(each).decode()}"' for name, each in data.items() if each)
    small = " ".join(f'GDepth:{name}="{value}"' for name, value in keys.items() if value != "")
    small = f'xmlns:GDepth="http://ns.google.com/photos/1.0/depthmap/" {small}'
    text = (f"{small}>", XMP.format(f"{large}>")) if extended else (f"{small} {large}>",)
    return written(path, with_xmp(file or encoded_jpeg(large_photo()), *text, swap=swap))


def dynamic_depth(path, levels, confidence=None, *, original=None, model="", padding=0, progressive=False, **values):
    """Write a JPEG with Dynamic Depth, whose maps lie behind the photo, as Android writes it: all in extended XMP."""
    keys = {"Format": "RangeInverse", "Near": 0.5, "Far": 4.0, "Units": "Meters", "DepthURI": "android/depthmap",
            **({} if confidence is None else {"ConfidenceURI": "android/confidencemap"}), **values}  # fmt: skip
    items = {"android/mainimage": b"", "android/original": original, "android/depthmap": encoded_png(levels),
             "android/confidencemap": None if confidence is None else encoded_png(confidence)}  # fmt: skip
    items = {name: content for name, content in items.items() if content is not None}
    directory = "".join(
        f'<rdf:li rdf:parseType="Resource"><Container:Item Item:Mime="image/png" Item:Length="{len(content)}" '
        f'Item:DataURI="{name}" Item:Padding="{padding}"/></rdf:li>' for name, content in items.items()
    )  # fmt: skip
    depth_map = " ".join(f'DepthMap:{name}="{value}"' for name, value in keys.items())
    uri = "android/mainimage" if original is None else "android/original"
    text = (
        'xmlns:DepthMap="http://ns.google.com/photos/dd/1.0/depthmap/">'
        f"<Device:Container><Container:Directory><rdf:Seq>{directory}</rdf:Seq></Container:Directory></Device:Container>"
        f'<Device:Cameras><rdf:Seq><rdf:li><Device:Camera Camera:Trait="Physical"><Camera:Image Image:ItemURI="{uri}"/>'
        f"<Camera:DepthMap {depth_map}/>{model}</Device:Camera></rdf:li></rdf:Seq></Device:Cameras>"
    )
    photo_file = encoded_jpeg(large_photo(), progressive=progressive)
    behind = b"".join(content + bytes(padding) for content in items.values())
    return written(path, with_xmp(photo_file, ">", XMP.format(text)) + behind)


def imaging_model(column=0.5, row=0.5):
    return (
        '<Camera:ImagingModel ImagingModel:FocalLengthX="200" ImagingModel:FocalLengthY="201" '
        'ImagingModel:ImageWidth="256" ImagingModel:ImageHeight="192" '
        f'ImagingModel:PrincipalPointX="{column}" ImagingModel:PrincipalPointY="{row}"/>'
    )


def zed(folder, fx=700.0, **changes):
    """Write pictures of a ZED at 1280 x 720 as its SDK exports them, without distortion and already side by side."""
    for number in range(FRAMES):
        save(folder / f"left{number:06}.png", np.kron(photo(number)[:45], np.ones((16, 20, 1), np.uint8)))
        save(folder / f"depth{number:06}.png", np.full((720, 1280), 1000 + 100 * number, np.uint16))
    camera = {"fx": fx, "fy": fx, "cx": 650.0, "cy": 355.0, **dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0.0)}
    stereo = {"Baseline": 119.9, **{f"{name}_HD": 0.0 for name in ("TY", "TZ", "RX", "CV", "RZ")}}
    sections = {"LEFT_CAM_HD": camera, "RIGHT_CAM_HD": camera, "STEREO": stereo | changes}
    lines = [f"[{name}]\n" + "".join(f"{key}={value}\n" for key, value in each.items())
             for name, each in sections.items()]  # fmt: skip
    (folder / "SN12345.conf").write_text("\n".join(lines))
    return folder


def tum(folder, name="{:06}".format):
    """Write lists of TUM that name files of any names, by time."""
    lines = {"rgb": [], "depth": [], "groundtruth": []}
    for number in range(FRAMES):
        stem, time = name(number), f"{95.5 + number / 8:.4f}"
        save(folder / "rgb" / f"{stem}.png", photo(number))
        save(folder / "depth" / f"{stem}.png", 5 * millimetres(number))
        for kind in ("rgb", "depth"):
            lines[kind].append(f"{time} {kind}/{stem}.png")
        lines["groundtruth"].append(f"{time} {0.1 * number} 0 0 0 0 0 1")
    for kind, each in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(each) + "\n")
    return folder


FOLDERS = {
    "stray": lambda folder: stray(folder, video=False),
    "stray video": stray,
    "record3d": lambda folder: record3d(folder / "scan.r3d"),
    "record3d unpacked": record3d_unpacked,
    "record3d export": record3d_export,
    "polycam": polycam,
    "arkitscenes": arkitscenes,
    "scanner app": scanner_app,
    "scannetpp": scannetpp,
    "scannetpp deflate": lambda folder: scannetpp(folder, "deflate"),
    "scannet": scannet,
    "sens": lambda folder: sens(folder / "a.sens", lost=(1,)),
    "sens raw": lambda folder: sens(folder / "b.sens", colour="raw", depth="raw", scale=5000.0),
    "7-scenes": seven_scenes,
    "sunrgbd": sunrgbd,
    "replica": replica,
    "zed": zed,
    "open3d": open3d,
    "tum": tum,
    "ros 1": lambda folder: ros(folder / "scan.bag", 1),
    "ros 1 jpeg": lambda folder: ros(folder / "scan.bag", 1, floats=True, compressed=True),
    "ros 1 rvl": lambda folder: ros(folder / "scan.bag", 1, rvl_depth=True),
    "ros 2": lambda folder: ros(folder / "recording", 2),
    "ros 2 packed": lambda folder: ros(folder / "recording", 2, packed=True),
    "ros 2 mcap": lambda folder: ros(folder / "recording", 2, plugin="MCAP"),
    "kinect": lambda folder: kinect(folder / "scan.mkv", [photo()] * 2, [np.full(KINECT_DEPTH, 1000, np.uint16)] * 2),
    "gdepth": lambda folder: gdepth(folder / "photo.jpg", FLAT, FLAT),
    "dynamic depth": lambda folder: dynamic_depth(folder / "photo.jpg", FLAT, model=imaging_model()),
    "heic": lambda folder: heic(folder / "photo.heic", FLAT, text=apple_text()),
}
"""What writes each kind of capture into a folder."""
