"""Table of the captures and layouts that dsr reads, a row per device, program or data set, as in docs/captures.md.

A row also lists the files by which a reader in :mod:`dsr.io.captures` or :mod:`dsr.io.layouts` recognises the layout;
for a folder that has only some of them, :func:`dsr.io.layouts.lacking` names those that are missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

_LIDAR = "bent edges, nothing thin"
_KINECT1 = "stairs far away, smeared edges, shadows beside near things"
_STEREO = "blobs, guesses on blank walls, wrong depth on glass"
_FLIGHT = "flying pixels, noise on dark surfaces, rounded corners"


class Format(NamedTuple):
    """What is read of a device, program or data set.

    Args:
        name: of the device, program or data set.
        export: what to export, or what its files are called.
        found_by: what it is recognised by.
        read: depth, and which of intrinsics, poses, confidence, distortion and time.
        tried: the files that it was tried with: real ones, or ones that an independent program wrote.
        faults: of the sensor; empty where any sensor may have been used.
        source: address of the writer's own description or code.
        marks: patterns of paths below its folder, any of which distinguishes it from other layouts; ``*`` in the last
            part stands for anything. Empty for single files, and for layouts without characteristic names.
        needs: names of its parts, each with patterns of which one has to match.

    """

    name: str
    export: str
    found_by: str
    read: str
    tried: str
    faults: str
    source: str
    marks: tuple[str, ...] = ()
    needs: Mapping[str, tuple[str, ...]] = MappingProxyType({})


FORMATS = (
    Format(
        "Stray Scanner",
        "share the scan's folder",
        "`camera_matrix.csv` or `odometry.csv`, with `depth/` and `rgb.mp4` or `rgb/000000.png`",
        "depth in mm (16-bit PNG, NPY); intrinsics and pose of each frame; confidence 0 to 2",
        "tables of a real scan; pictures written by its format",
        _LIDAR,
        "https://github.com/strayrobots/scanner/blob/main/docs/format.md",
        marks=("odometry.csv", "camera_matrix.csv"),
        needs={"depth/": ("depth/*",), "rgb.mp4 or rgb/": ("rgb.mp4", "rgb/*")},
    ),
    Format(
        "Record3D",
        "the `.r3d` archive, or its export EXR + RGB",
        "`*.r3d`; its unpacked folder (`metadata`, `rgbd/`); `metadata.json` with `rgb/` and `depth/*.exr`",
        "depth in m (LZFSE, EXR); intrinsics of each frame, else of all; poses; confidence 0 to 2",
        "a real export of 341 frames",
        _LIDAR,
        "https://github.com/marek-simonik/record3d/issues/27",
        marks=("rgbd/*.depth",),
        needs={"metadata": ("metadata",)},
    ),
    Format(
        "Polycam",
        "raw data of a scan in developer mode",
        "`keyframes/` with `cameras/*.json`",
        "depth in mm (16-bit PNG); corrected photos, else all; intrinsics and pose of each frame; confidence",
        "written by its format",
        _LIDAR,
        "https://github.com/PolyCam/polyform#polycams-data-format",
        marks=("keyframes/*",),
        needs={
            "keyframes/images/": ("keyframes/images/*.jpg", "keyframes/corrected_images/*.jpg"),
            "keyframes/cameras/*.json": ("keyframes/cameras/*.json", "keyframes/corrected_cameras/*.json"),
            "keyframes/depth/": ("keyframes/depth/*.png",),
        },
    ),
    Format(
        "ARKitScenes",
        "`raw` or `3dod` of the data set",
        "`lowres_depth/` with `wide/`, `color/` or `lowres_wide/`",
        "depth in mm (16-bit PNG); intrinsics (`*.pincam`); poses by time; confidence 0 to 2",
        "written by its format",
        _LIDAR,
        "https://github.com/apple/ARKitScenes/blob/main/DATA.md",
        marks=("lowres_depth/*", "lowres_wide.traj"),
        needs={
            "lowres_depth/": ("lowres_depth/*.png",),
            "wide/, color/ or lowres_wide/": ("wide/*.png", "color/*.png", "lowres_wide/*.png"),
        },
    ),
    Format(
        "3D Scanner App",
        "share the scan as All data, a folder or ZIP file",
        "`frame_*.json` with `cameraPoseARFrame`, `frame_*.jpg`, `depth_*.png`",
        "depth in mm (16-bit PNG; EXR); intrinsics and pose of each frame; confidence 0 to 2",
        "two real scans, of 24 and 146 photos",
        _LIDAR,
        "https://github.com/laanlabs/3dScannerApp_samples",
        marks=("conf_00000.png", "frame_*.json"),
        needs={
            "frame_*.jpg": ("frame_*.jpg",),
            "frame_*.json": ("frame_*.json",),
            "depth_*.png": ("depth_*.png", "frame_*.exr"),
        },
    ),
    Format(
        "ROS 1 and 2",
        "`rosbag record`, `ros2 bag record` of a colour and a depth topic with their `camera_info`",
        "`*.bag`, `*.mcap`, `*.db3`; a folder of them, or of `*.zstd`, with `metadata.yaml`",
        "depth in mm (16UC1), m (32FC1), compressedDepth (PNG, RVL), warped by `/tf_static`; `camera_info`; time",
        "written by rosbags",
        "",
        "https://docs.ros.org/en/api/sensor_msgs/html/index-msg.html",
    ),
    Format(
        "RealSense SDK",
        "record in RealSense Viewer, or `enable_record_to_file`, with depth and colour",
        "`*.bag` (SDK up to 2.57), `*.db3` (since)",
        "depth in the unit of `Depth_Units`, warped to the photo; both intrinsics, extrinsics and distortions; time",
        "two recordings that SDK 2.55 and 2.59 wrote",
        _STEREO,
        "https://github.com/IntelRealSense/librealsense/blob/master/src/media/ros/ros_file_format.h",
    ),
    Format(
        "Azure Kinect",
        "the `.mkv` of `k4arecorder`; of a Femto Bolt or Mega, that of Orbbec's K4A wrapper",
        "`*.mkv` with its tracks `COLOR` and `DEPTH`",
        "depth in mm (b16g), warped into the photo's view; photos as MJPEG, NV12, YUY2, BGRA; intrinsics, extrinsics "
        "and distortion of both cameras (`calibration.json`), undone; time",
        "written by its format; a real device's calibration gives its SDK's own numbers",
        _FLIGHT,
        "https://github.com/microsoft/Azure-Kinect-Sensor-SDK/tree/develop/src/record",
    ),
    Format(
        "HEIC photos with depth",
        "the unmodified `.heic`, as of iPhones in portrait mode; no JPEG of it",
        "`*.heic`, `*.heif` with a depth map",
        "depth in m or disparity in 1/m (8 bits), and whether it is relative; intrinsics (XMP, else EXIF); orientation",
        "a real iPhone photo",
        "256 steps; of two lenses or a network: guesses on blank walls, hair and glass, mostly no true distances",
        "https://developer.apple.com/documentation/avfoundation/avdepthdata",
    ),
    Format(
        "ZED",
        "LEFT + DEPTH_16Bit of the SDK's sample SVO Export, and `SN*.conf` of the settings folder put beside it",
        "`left000000.png`, `depth000000.png` and `SN*.conf`",
        "depth in mm (16-bit PNG); intrinsics of the rectified photo (2208, 1920, 1280, 960 or 672 pixels wide)",
        "written by its format; calibrations as other programs' tests have them",
        _STEREO,
        "https://github.com/stereolabs/zed-open-capture",
        marks=("SN*.conf", "left000000.png"),
        needs={"left*.png": ("left*.png",), "depth*.png": ("depth*.png",), "SN*.conf": ("SN*.conf",)},
    ),
    Format(
        "COLMAP",
        "a sparse model, in the folder of photos and depth maps, or of photos alone; or `--poses MODEL`",
        "`sparse/0/`, `sparse/`, `colmap/sparse/0/` with `images.bin` or `images.txt`, or these beside the photos",
        "intrinsics; distortion; poses; depth of the maps by its values, without maps of the model's points",
        "written by pycolmap; models of two real scenes",
        "",
        "https://colmap.github.io/format.html",
    ),
    Format(
        "Open3D",
        "a folder of its reconstruction system",
        "two folders of pictures, and `scene/trajectory.log` or `trajectory.log`",
        "depth by its values, mostly mm; intrinsics (`camera_intrinsic.json`, `intrinsic.json`); poses",
        "written by its format",
        "",
        "https://www.open3d.org/docs/release/tutorial/reconstruction_system/system_overview.html",
        marks=("scene/trajectory.log", "trajectory.log"),
        needs={"color/": ("color/*", "image/*", "rgb/*"), "depth/": ("depth/*",)},
    ),
    Format(
        "TUM RGB-D",
        "a sequence of the data set, or of a program that writes its lists",
        "`rgb.txt` and `depth.txt`",
        "depth in 1/5000 m; pairs by time, within 20 ms; poses by time (`groundtruth.txt`)",
        "193 real frames of another program; lists and poses of a real sequence",
        _KINECT1,
        "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats",
        marks=("rgb.txt", "depth.txt"),
        needs={"rgb.txt": ("rgb.txt",), "depth.txt": ("depth.txt",)},
    ),
    Format(
        "ScanNet",
        "the `.sens` recording, or its export with SensReader",
        "`*.sens`; `intrinsic/intrinsic_color.txt` with `color/` and `depth/`",
        "depth in mm (zlib, raw, 16-bit PNG); intrinsics; poses, none where tracking was lost",
        "written by its format",
        _KINECT1,
        "https://github.com/ScanNet/ScanNet/blob/master/SensReader/python/SensorData.py",
        marks=("intrinsic/intrinsic_*.txt", "pose/*.txt"),
        needs={
            "color/": ("color/*",),
            "depth/": ("depth/*.png",),
            "intrinsic/intrinsic_color.txt": ("intrinsic/intrinsic_*.txt",),
        },
    ),
    Format(
        "ScanNet++ iPhone",
        "`iphone/` of a scene",
        "`pose_intrinsic_imu.json` with `rgb.mkv` or `rgb/`, and `depth.bin` or `depth/`",
        "depth in mm (LZ4) or m (deflate), 256 x 192; intrinsics and pose of each frame",
        "written by its format",
        _LIDAR,
        "https://github.com/scannetpp/scannetpp/blob/main/iphone/prepare_iphone_data.py",
        marks=("pose_intrinsic_imu.json", "depth.bin"),
        needs={
            "pose_intrinsic_imu.json": ("pose_intrinsic_imu.json",),
            "depth.bin": ("depth.bin", "depth/*.png"),
            "rgb.mkv": ("rgb.mkv", "rgb.mp4", "rgb/*.jpg"),
        },
    ),
    Format(
        "7-Scenes or 3DMatch",
        "a sequence",
        "`*.color.png` or `.jpg`, `*.depth.png`, `*.pose.txt`",
        "depth in mm (16-bit PNG), 65535 in holes; `camera-intrinsics.txt`, else those of its page; poses",
        "a real sequence of 1000 frames",
        _KINECT1,
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
        marks=("*.pose.txt",),
        needs={"*.color.png": ("*.color.png", "*.color.jpg"), "*.depth.png": ("*.depth.png",)},
    ),
    Format(
        "SUN RGB-D",
        "a scene in its own folders",
        "`image/`, `depth/`, `intrinsics.txt`, and `depth_bfx/` or `extrinsics/`",
        "depth in mm with turned bits; intrinsics",
        "real frames of two sensors",
        "Kinects, Xtion and RealSense",
        "https://rgbd.cs.princeton.edu/",
        marks=("depth_bfx/*",),
        needs={"image/": ("image/*",), "intrinsics.txt": ("intrinsics.txt",)},
    ),
    Format(
        "Replica of NICE-SLAM",
        "a rendered scene, or another program's in the same layout",
        "`results/frame*.jpg`, `results/depth*.png`, and `traj.txt` or `cam_params.json`",
        "depth in 1/`scale` m (1/6553.5); intrinsics (`cam_params.json`, here or one folder up); poses",
        "written by its format",
        "",
        "https://github.com/cvg/nice-slam/blob/master/src/utils/datasets.py",
        marks=("results/depth*.png",),
        needs={
            "results/frame*.jpg": ("results/frame*",),
            "traj.txt or cam_params.json": ("traj.txt", "cam_params.json"),
        },
    ),
    Format(
        "ICL-NUIM",
        "the rendered frames",
        "`*.depth` beside the photos",
        "depth in cm along the ray (text); the data set's intrinsics",
        "a real frame",
        "",
        "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html",
    ),
    Format(
        "any two folders, or files side by side",
        "photos, and depth as PNG, TIFF, EXR, PFM, NPY or NPZ",
        "names that say rgb, color, depth ..., else by one channel of 16 bits or floats",
        "depth by its values, intrinsics of a camera file beside them",
        "real frames of seven sensors",
        "",
        "",
    ),
)


def rows(each: Format) -> dict[str, str]:
    """Return the description of a format, text by label, its name first; empty texts are left out."""
    texts = {"": each.name, "export": each.export, "found by": each.found_by, "read": each.read, "tried": each.tried,
             "sensor": each.faults, "source": each.source}  # fmt: skip
    return {label: text.replace("`", "") for label, text in texts.items() if text}


def show(formats: Sequence[Format] = FORMATS) -> str:
    """Return formats as text, a block each."""
    return "\n\n".join(
        "\n".join(f"  {label:9}{text}" if label else text for label, text in rows(each).items()) for each in formats
    )


def markdown(formats: Sequence[Format] = FORMATS) -> list[str]:
    """Return the lines of a table of formats in Markdown."""
    lines = ["| device or program | export | recognised by | read | tried | the sensor |", "| --- " * 6 + "|"]
    for each in formats:
        name = f"[{each.name}]({each.source})" if each.source else each.name
        lines.append(f"| {name} | {each.export} | {each.found_by} | {each.read} | {each.tried} | {each.faults} |")
    return lines
