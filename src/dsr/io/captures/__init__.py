"""All captures and layouts that dsr reads, in the order in which they are asked whether a folder or a file is theirs.

Other packages add readers by an entry point of the group ``dsr.captures`` that names a
:class:`~dsr.io.captures.contract.Capture`.
"""

from __future__ import annotations

from functools import cache, partial
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dsr.io.captures.contract import Capture, has_any, in_head
from dsr.utils.guards import refusing

if TYPE_CHECKING:
    from dsr.io.pairs import PairingResult

_LIDAR = "bent edges, nothing thin"
_KINECT1 = "stairs far away, smeared edges, shadows beside near things"
_STEREO = "blobs, guesses on blank walls, wrong depth on glass"


def _call(name: str, place: Path) -> Any:
    """Call ``module.function`` of this package, which is imported now: the table alone needs no torch."""
    module, function = name.split(".")
    return getattr(import_module(f"dsr.io.captures.{module}"), function)(place)


CAPTURES = (
    Capture(
        "Stray Scanner",
        "share the scan's folder",
        "`camera_matrix.csv` or `odometry.csv`, with `depth/` and `rgb.mp4` or `rgb/000000.png`",
        "depth in mm (16-bit PNG, NPY); intrinsics and pose of each frame; confidence 0 to 2",
        "tables of a real scan; pictures written by its format",
        _LIDAR,
        "https://github.com/strayrobots/scanner/blob/main/docs/format.md",
        partial(_call, "stray.find"),
        marks=("odometry.csv", "camera_matrix.csv"),
        needs=("depth/*", "rgb.mp4 or rgb/*"),
    ),
    Capture(
        "Polycam",
        "raw data of a scan in developer mode",
        "`keyframes/` with `cameras/*.json`",
        "depth in mm (16-bit PNG); corrected photos, else all; intrinsics and pose of each frame; confidence",
        "written by its format",
        _LIDAR,
        "https://github.com/PolyCam/polyform#polycams-data-format",
        partial(_call, "arkit.find_polycam"),
        marks=("keyframes/*",),
        needs=(
            "keyframes/images/*.jpg or keyframes/corrected_images/*.jpg",
            "keyframes/cameras/*.json or keyframes/corrected_cameras/*.json",
            "keyframes/depth/*.png",
        ),
    ),
    Capture(
        "ARKitScenes",
        "`raw` or `3dod` of the data set",
        "`lowres_depth/` with `wide/`, `color/` or `lowres_wide/`",
        "depth in mm (16-bit PNG); intrinsics (`*.pincam`); poses by time; confidence 0 to 2",
        "written by its format",
        _LIDAR,
        "https://github.com/apple/ARKitScenes/blob/main/DATA.md",
        partial(_call, "arkit.find_arkitscenes"),
        marks=("lowres_depth/*", "lowres_wide.traj"),
        needs=("lowres_depth/*.png", "wide/*.png or color/*.png or lowres_wide/*.png"),
    ),
    Capture(
        "3D Scanner App",
        "share the scan as All data, a folder or ZIP file",
        "`frame_*.json` with `cameraPoseARFrame`, `frame_*.jpg`, `depth_*.png`",
        "depth in mm (16-bit PNG; EXR); intrinsics and pose of each frame; confidence 0 to 2",
        "two real scans, of 24 and 146 photos",
        _LIDAR,
        "https://github.com/laanlabs/3dScannerApp_samples",
        partial(_call, "arkit.find_scanner_app"),
        marks=("conf_00000.png", "frame_*.json"),
        needs=("frame_*.jpg", "frame_*.json", "depth_*.png or frame_*.exr"),
    ),
    # before Kinects, which have videos of the same suffix
    Capture(
        "ScanNet++ iPhone",
        "`iphone/` of a scene",
        "`pose_intrinsic_imu.json` with `rgb.mkv` or `rgb/`, and `depth.bin` or `depth/`",
        "depth in mm (LZ4) or m (deflate), 256 x 192; intrinsics and pose of each frame",
        "written by its format",
        _LIDAR,
        "https://github.com/scannetpp/scannetpp/blob/main/iphone/prepare_iphone_data.py",
        partial(_call, "scannet.find_scannetpp"),
        marks=("pose_intrinsic_imu.json", "depth.bin"),
        needs=("pose_intrinsic_imu.json", "depth.bin or depth/*.png", "rgb.mkv or rgb.mp4 or rgb/*.jpg"),
    ),
    Capture(
        "ScanNet",
        "the `.sens` recording, or its export with SensReader",
        "`*.sens`; `intrinsic/intrinsic_color.txt` with `color/` and `depth/`",
        "depth in mm (zlib, raw, 16-bit PNG); intrinsics; poses, none where tracking was lost",
        "written by its format",
        _KINECT1,
        "https://github.com/ScanNet/ScanNet/blob/master/SensReader/python/SensorData.py",
        partial(_call, "scannet.find_export"),
        partial(_call, "scannet.read_sens"),
        (".sens",),
        marks=("intrinsic/intrinsic_*.txt", "pose/*.txt"),
        needs=("color/*", "depth/*.png", "intrinsic/intrinsic_*.txt"),
    ),
    Capture(
        "7-Scenes or 3DMatch",
        "a sequence",
        "`*.color.png` or `.jpg`, `*.depth.png`, `*.pose.txt`",
        "depth in mm (16-bit PNG), 65535 in holes; `camera-intrinsics.txt`, else those of its page; poses",
        "a real sequence of 1000 frames",
        _KINECT1,
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
        partial(_call, "data_sets.find_seven_scenes"),
        marks=("*.pose.txt",),
        needs=("*.color.png or *.color.jpg", "*.depth.png"),
    ),
    Capture(
        "SUN RGB-D",
        "a scene in its own folders",
        "`image/`, `depth/`, `intrinsics.txt`, and `depth_bfx/` or `extrinsics/`",
        "depth in mm with turned bits; intrinsics",
        "real frames of two sensors",
        "Kinects, Xtion and RealSense",
        "https://rgbd.cs.princeton.edu/",
        partial(_call, "data_sets.find_sunrgbd"),
        marks=("depth_bfx/*",),
        needs=("image/*", "intrinsics.txt"),
    ),
    Capture(
        "Replica of NICE-SLAM",
        "a rendered scene, or another program's in the same layout",
        "`results/frame*.jpg`, `results/depth*.png`, and `traj.txt` or `cam_params.json`",
        "depth in 1/`scale` m (1/6553.5); intrinsics (`cam_params.json`, here or one folder up); poses",
        "written by its format",
        "",
        "https://github.com/cvg/nice-slam/blob/master/src/utils/datasets.py",
        partial(_call, "data_sets.find_replica"),
        marks=("results/depth*.png",),
        needs=("results/frame*", "traj.txt or cam_params.json"),
    ),
    Capture(
        "ZED",
        "LEFT + DEPTH_16Bit of the SDK's sample SVO Export, and `SN*.conf` of the settings folder put beside it",
        "`left000000.png`, `depth000000.png` and `SN*.conf`",
        "depth in mm (16-bit PNG); intrinsics of the rectified photo (2208, 1920, 1280, 960 or 672 pixels wide)",
        "written by its format; calibrations as other programs' tests have them",
        _STEREO,
        "https://github.com/stereolabs/zed-open-capture",
        partial(_call, "data_sets.find_zed"),
        marks=("SN*.conf", "left000000.png"),
        needs=("left*.png", "depth*.png", "SN*.conf"),
    ),
    Capture(
        "Record3D",
        "the `.r3d` archive, or its export EXR + RGB",
        "`*.r3d`; its unpacked folder (`metadata`, `rgbd/`); `metadata.json` with `rgb/` and `depth/*.exr`",
        "depth in m (LZFSE, EXR); intrinsics of each frame, else of all; poses; confidence 0 to 2",
        "a real export of 341 frames",
        _LIDAR,
        "https://github.com/marek-simonik/record3d/issues/27",
        partial(_call, "record3d.find"),
        partial(_call, "record3d.read_archive"),
        (".r3d",),
        marks=("rgbd/*.depth",),
        needs=("metadata",),
    ),
    Capture(
        "ROS 1 and 2",
        "`rosbag record`, `ros2 bag record` of a colour and a depth topic with their `camera_info`",
        "`*.bag`, `*.mcap`, `*.db3`; a folder of them, or of `*.zstd`, with `metadata.yaml`",
        "depth in mm (16UC1), m (32FC1), compressedDepth (PNG, RVL), warped by `/tf_static`; `camera_info`; time",
        "written by rosbags",
        "",
        "https://docs.ros.org/en/api/sensor_msgs/html/index-msg.html",
        partial(_call, "ros.find"),
        partial(_call, "ros.read"),
        (".bag", ".mcap", ".db3"),
    ),
    # which the reader of ROS opens
    Capture(
        "RealSense SDK",
        "record in RealSense Viewer, or `enable_record_to_file`, with depth and colour",
        "`*.bag` (SDK up to 2.57), `*.db3` (since)",
        "depth in the unit of `Depth_Units`, warped to the photo; both intrinsics, extrinsics and distortions; time",
        "two recordings that SDK 2.55 and 2.59 wrote",
        _STEREO,
        "https://github.com/IntelRealSense/librealsense/blob/master/src/media/ros/ros_file_format.h",
    ),
    Capture(
        "Azure Kinect",
        "the `.mkv` of `k4arecorder`; of a Femto Bolt or Mega, that of Orbbec's K4A wrapper",
        "`*.mkv` with its tracks `COLOR` and `DEPTH`",
        "depth in mm (b16g), warped into the photo's view; photos as MJPEG, NV12, YUY2, BGRA; intrinsics, extrinsics "
        "and distortion of both cameras (`calibration.json`), undone; time",
        "written by its format; a real device's calibration gives its SDK's own numbers",
        "flying pixels, noise on dark surfaces, rounded corners",
        "https://github.com/microsoft/Azure-Kinect-Sensor-SDK/tree/develop/src/record",
        of_file=partial(_call, "kinect.read"),
        suffixes=(".mkv",),
        mark=partial(in_head, b"K4A_DEPTH_MODE"),
    ),
    Capture(
        "HEIC photos with depth",
        "the unmodified `.heic`, as of iPhones in portrait mode; no JPEG of it",
        "`*.heic`, `*.heif` with a depth map",
        "depth in m or disparity in 1/m (8 bits), and whether it is relative; intrinsics (XMP, else EXIF); orientation",
        "a real iPhone photo",
        "256 steps; of two lenses or a network: guesses on blank walls, hair and glass, mostly no true distances",
        "https://developer.apple.com/documentation/avfoundation/avdepthdata",
        of_file=partial(_call, "heic.read"),
        suffixes=(".heic", ".heif"),
        mark=partial(in_head, b"urn:mpeg:hevc:2015:auxid:2|urn:mpeg:mpegB:cicp:systems:auxiliary:depth"),
    ),
    Capture(
        "JPEG photos with depth",
        "the unmodified `.jpg` of an Android phone's portrait or depth mode, or of Google Camera's Lens Blur",
        "`*.jpg`, `*.jpeg` with GDepth or Dynamic Depth 1.0 in their XMP, of a folder if no depth maps are beside them",
        "depth in m, mm or dioptres, or relative (8 or 16 bits); the photo before effects; confidence; intrinsics of "
        "Dynamic Depth, else EXIF",
        "written by their specifications",
        "256 steps; of two lenses or a network: guesses on blank walls, hair and glass, mostly no true distances",
        "https://developers.google.com/depthmap-metadata",
        of_file=partial(_call, "jpeg.read"),
        suffixes=(".jpg", ".jpeg"),
        mark=partial(_call, "jpeg.has_depth"),
        fallback=True,
    ),
    Capture(
        "COLMAP",
        "a sparse model, in the folder of photos and depth maps, or of photos alone; or `--poses MODEL`",
        "`sparse/0/`, `sparse/`, `colmap/sparse/0/` with `images.bin` or `images.txt`, or these beside the photos",
        "intrinsics; distortion; poses; depth of the maps by its values, without maps of the model's points",
        "written by pycolmap; models of two real scenes",
        source="https://colmap.github.io/format.html",
    ),
    # Layouts of loose pictures, which dsr.io.layouts recognises.
    Capture(
        "Open3D",
        "a folder of its reconstruction system",
        "two folders of pictures, and `scene/trajectory.log` or `trajectory.log`",
        "depth by its values, mostly mm; intrinsics (`camera_intrinsic.json`, `intrinsic.json`); poses",
        "written by its format",
        source="https://www.open3d.org/docs/release/tutorial/reconstruction_system/system_overview.html",
        marks=("scene/trajectory.log", "trajectory.log"),
        needs=("color/* or image/* or rgb/*", "depth/*"),
    ),
    Capture(
        "TUM RGB-D",
        "a sequence of the data set, or of a program that writes its lists",
        "`rgb.txt` and `depth.txt`",
        "depth in 1/5000 m; pairs by time, within 20 ms; poses by time (`groundtruth.txt`)",
        "193 real frames of another program; lists and poses of a real sequence",
        _KINECT1,
        "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats",
        marks=("rgb.txt", "depth.txt"),
        needs=("rgb.txt", "depth.txt"),
    ),
    Capture(
        "ICL-NUIM",
        "the rendered frames",
        "`*.depth` beside the photos",
        "depth in cm along the ray (text); the data set's intrinsics",
        "a real frame",
        source="https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html",
    ),
    Capture(
        "any two folders, or files side by side",
        "photos, and depth as PNG, TIFF, EXR, PFM, NPY or NPZ",
        "names that say rgb, color, depth ..., else by one channel of 16 bits or floats",
        "depth by its values, intrinsics of a camera file beside them",
        "real frames of seven sensors",
    ),
)
CAPTURE_FILES = (*dict.fromkeys(suffix for each in CAPTURES for suffix in each.suffixes), ".zip")


@cache
def all_captures() -> tuple[Capture, ...]:
    """Return the captures in the order of asking, those of other packages first."""
    others = []
    for entry in entry_points(group="dsr.captures"):
        with refusing(f"the capture {entry.name} of another package ({entry.value}) cannot be imported", Exception):
            others.append(entry.load())
    return (*others, *CAPTURES)


def find_capture(place: Path, *, fallback: bool = False) -> PairingResult | None:
    """Return the frames of a capture, a file or a folder; None if it is none. Fallbacks are asked apart."""
    asked = (each for each in all_captures() if each.fallback == fallback or place.is_file())
    return next((found for each in asked if (found := each.frames(place)) is not None), None)


def lacking(folder: Path) -> list[str]:
    """Return the captures that a folder resembles, each with its missing files: ``like ScanNet, without depth/``."""
    found = []
    for each in all_captures():
        if has_any(folder, each.marks):
            missing = [part for part in each.needs if not has_any(folder, part.split(" or "))]
            found += [f"like {each.name}, without {', '.join(missing)}"] if missing else []
    return found
