"""The files of a frame of each data set, and what the scene has to be that its reader makes of them."""

import io
import struct
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import OpenEXR
import scipy.io
from small_files import encoded_png as png
from small_files import written

from dsr.data.arkitscenes import ARKitScenes
from dsr.data.cleargrasp import ClearGrasp
from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.eight_bit import EightBit
from dsr.data.hammer import Hammer
from dsr.data.ibims import IBims
from dsr.data.icl import ICL
from dsr.data.middlebury import Middlebury, MiddleburyLevels
from dsr.data.nyu import NYU
from dsr.data.rgbdd import RGBDD
from dsr.data.sintel import Sintel
from dsr.data.stereo_board import CAMERA, StereoBoard
from dsr.data.sunrgbd import SunRGBD
from dsr.data.tartanair import TartanAir


def ramp(height, width, start):
    """Return whole millimetres that are different in every pixel of a row, with a hole in the first one."""
    values = (start + 2 * np.arange(height)[:, None] + np.arange(width)).astype(np.uint16)
    values[0, 0] = 0
    return values


def photo(height, width):
    return np.full((height, width, 3), 51, np.uint8)


def npy(values):
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


def exr(depth):
    """Return depth as ClearGrasp has it: 16-bit floats, the same in three channels."""
    channels = {each: np.ascontiguousarray(depth.astype(np.float16)) for each in "RGB"}
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.NamedTemporaryFile(suffix=".exr") as place:
        with OpenEXR.File(header, channels) as file:
            file.write(place.name)
        return Path(place.name).read_bytes()


def mat(**data):
    """Return a structure as iBims-1 has it, in a MATLAB file of version 5."""
    content = io.BytesIO()
    scipy.io.savemat(content, {"data": data})
    return content.getvalue()


def labelled(depth):
    """Return a MATLAB file of version 7.3 as NYU has it, its axes turned around, with one frame."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file["images"] = np.full((1, 3, 640, 480), 51, np.uint8)
        file["rawDepths"] = file["depths"] = depth.T[None].astype(np.float32)
    return content.getvalue()


def dpt(metres):
    return struct.pack("<fii", 202021.25, *metres.shape[::-1]) + metres.astype("<f4").tobytes()


def pfm(values):
    """Return floats as Middlebury has them: bottom row first, little endian."""
    return b"Pf\n%d %d\n-1\n" % values.shape[::-1] + np.where(values > 0, values, np.inf)[::-1].astype("<f4").tobytes()


def turned(millimetres):
    """Return the levels of SUN RGB-D: 16 bits, turned left by three."""
    return (millimetres << 3 | millimetres >> 13).astype(np.uint16)


def rays(values):
    """Return values as ICL-NUIM has them as rendered: text."""
    return " ".join(map(str, values.ravel())).encode() + b" "


@dataclass
class Set:
    """A data set: its files of a frame by path, photo first and truth last, and what the scene has to be."""

    make: Any
    name: str
    files: dict[str, bytes]
    truth: float | None  # metres at row 10, column 20
    camera: tuple[float, ...]
    measured: dict[float, float] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    absent: dict[str, Any] = field(default_factory=dict)  # settings with which the frame is not found
    count: int | None = None
    holes: bytes | None = None  # of a truth without a known pixel


SIXTY = 1 / np.tan(np.pi / 6) / 2
JPG = cv2.imencode(".jpg", photo(384, 512))[1].tobytes()
VGA, GLASS = ramp(480, 640, 1000), ramp(36, 64, 1000) / 1024
LEVELS = (VGA[:60, :80] // 4).astype(np.uint8)  # 250 to 255, and 0 to 23 beyond
STEPS = (20 + np.arange(370)[:, None] // 4 + np.arange(40)).astype(np.uint8)
STEPS[0, 0] = LEVELS[0, 0] = 0
VIDEO = "41069021_305.244"
SETS = {
    "hammer": Set(Hammer, "scene12_traj1_1_000000", {
        "scene12_traj1_1/polarization/rgb/000000.png": png(photo(52, 68)),
        "scene12_traj1_1/polarization/depth_tof/000000.png": png(ramp(52, 68, 720)),
        "scene12_traj1_1/polarization/intrinsics.txt": b"44.17 0 34.1\n0 44.22 24.37\n0 0 1\n",
        "scene12_traj1_1/polarization/_gt/000000.png": png(ramp(52, 68, 700)),
    }, 0.740, (44.17, 44.22, 34.1, 24.37), {1: 0.760}, {"sensor": "tof"}, {"sensor": "l515"},
        holes=png(0 * ramp(52, 68, 0))),
    "ddrnet": Set(DDRNetFrames, "20170907_group1_frame_000001", {
        "20170907/group1/color_map/frame_000001.png": png(photo(480, 640)),
        "20170907/group1/depth_map/frame_000001.png": png(ramp(480, 640, 995)),
        "20170907/group1/high_quality_depth/frame_000001.png": png(VGA),
    }, 1.040, (536.628, 536.606, 310.591, 234.759), {1: 1.035}, holes=png(0 * VGA)),
    "rgbdd": Set(RGBDD, "20200509112638", {
        "plants/plants_test/20200509112638/20200509112638_RGB.jpg": JPG,
        "plants/plants_test/20200509112638/20200509112638_LR_fill_depth.png": png(ramp(144, 192, 930)),
        "plants/plants_test/20200509112638/20200509112638_HR_gt.png": png(ramp(384, 512, 1000)),
    }, 1.040, (512 * SIXTY, 512 * SIXTY, 255.5, 191.5), {8 / 3: 0.970}, {"real": True}, {"split": "train"}, 405),
    "rgbdd in circulation": Set(RGBDD, "20200509112638", {
        "RGB/20200509112638_RGB.jpg": JPG,
        "Depth/20200509112638_HR_gt.png": png(ramp(384, 512, 1000)),
    }, 1.040, (512 * SIXTY, 512 * SIXTY, 255.5, 191.5), {}, {"real": False}, {"real": True}, 405),
    "arkitscenes": Set(ARKitScenes, VIDEO, {
        f"Validation/41069021/wide/{VIDEO}.png": png(photo(1440, 1920)),
        f"Validation/41069021/wide_intrinsics/{VIDEO}.pincam": b"1920 1440 1590.25 1591.5 958.5 724.75",
        f"Validation/41069021/lowres_depth/{VIDEO}.png": png(ramp(192, 256, 990)),
        f"Validation/41069021/highres_depth/{VIDEO}.png": png(ramp(1440, 1920, 1000)),
    }, 1.040, (1590.25, 1591.5, 958.5, 724.75), {7.5: 1.030}, {}, {"split": "training"}),
    "cleargrasp": Set(ClearGrasp, "real-val_d435_000000080", {
        "real-val/d435/000000080-transparent-rgb-img.jpg": png(photo(36, 64)),
        "real-val/d435/000000080-transparent-depth-img.exr": exr(GLASS + 0.25 * (GLASS > 0)),
        "real-val/d435/000000080-mask.png": png(np.eye(36, 64, dtype=np.uint8)),
        "real-val/d435/camera_intrinsics.yaml": b"xres: 64  # wide\nyres: 36\nfx: 46.5\nfy: 46\ncx: 32\ncy: 17.5\n",
        "real-val/d435/000000080-opaque-depth-img.exr": exr(GLASS),
    }, 1040 / 1024, (46.5, 46, 32, 17.5), {1: 1040 / 1024 + 0.25}, {"synthetic": False}, {"split": "test"},
        holes=exr(0 * GLASS)),
    "cleargrasp as rendered": Set(ClearGrasp, "cup-val_0", {
        "cup-val/rgb-imgs/0-rgb.jpg": png(photo(36, 64)),
        "cup-val/segmentation-masks/0-segmentation-mask.png": png(np.eye(36, 64, dtype=np.uint8)),
        "cup-val/depth-imgs-rectified/0-depth-rectified.exr": exr(GLASS),
    }, None, (46.213868, 46.213866, 31.5, 17.5), {}, {"synthetic": True}, {"split": "test"}, holes=exr(0 * GLASS)),
    "lu": Set(EightBit, "RGBD_01", {
        "Lu/RGB/RGBD_01_ouput_color.png": png(photo(60, 80)), "Lu/Depth/RGBD_01_output_depth.png": png(LEVELS),
    }, 525 * 0.5 / (4 + 75), (525, 525, 39.5, 29.5), {}, {"benchmark": "lu"}, {"benchmark": "middlebury8"}, 6),
    "ibims": Set(IBims, "corridor_01", {
        "rgb/corridor_01.png": png(photo(480, 640)), "calib/corridor_01.txt": b"560.5,561.25,321,239.5\n",
        "mask_invalid/corridor_01.png": png(np.ones_like(VGA, np.uint8)),
        "mask_transp/corridor_01.png": png(np.ones_like(VGA, np.uint8)), "depth/corridor_01.png": png(VGA),
    }, 1040 * 50 / 65535, (560.5, 561.25, 320, 238.5), {}, {}, {}, 100),
    "ibims as matrices": Set(IBims, "corridor_01", {
        "corridor_01.mat": mat(rgb=photo(480, 640), depth=VGA / 1024, mask_invalid=np.ones_like(VGA, np.uint8),
                               mask_transp=np.ones_like(VGA, np.uint8),
                               calib=np.array([[560.5, 0, 0], [0, 561.25, 0], [321, 239.5, 1]])),
    }, 1040 / 1024, (560.5, 561.25, 320, 238.5), {}, {}, {}, 100),
    "icl": Set(ICL, "traj_0007", {
        "traj/rgb/7.png": png(photo(480, 640)), "traj/depth/7.png": png(VGA),
    }, 0.208, (481.2, 480, 319.5, 239.5), {}, {"size": None}, holes=png(0 * VGA)),
    "icl as rendered": Set(ICL, "room_0007", {
        "room/scene_00_0007.png": png(photo(480, 640)), "room/scene_00_0007.depth": rays(VGA),
    }, 10.40 / np.hypot(1, np.hypot(299.5 / 481.2, 229.5 / 480)), (481.2, 480, 319.5, 239.5), {}, {"size": None},
        holes=rays(0 * VGA)),
    "middlebury": Set(Middlebury, "recycle", {
        "Recycle-perfect/im0.png": png(photo(52, 68)),
        "Recycle-perfect/calib.txt": b"cam0=[ 100.5 0 3.25 ; 0 100.5 2 ; 0 0 1 ] \n doffs= 5 \nbaseline= 176.252\n"
                                     b" width= 68\nheight= 52 \n",
        "Recycle-perfect/disp0.pfm": pfm(ramp(52, 68, 10)),
    }, 0.176252 * 100.5 / (50 + 5), (100.5, 100.5, 3.25, 2), {}, {"size": None}, {}, 7, pfm(0 * ramp(52, 68, 0))),
    "middlebury2006": Set(MiddleburyLevels, "aloe", {
        "Aloe/view1.png": png(photo(370, 40)), "Aloe/dmin.txt": b"270\n", "Aloe/disp1.png": png(STEPS),
    }, 3740 * 0.16 / (42 + 270), (3740 / 3, 3740 / 3, 19.5, 184.5), {}, {"year": 2006, "size": None, "smooth": False},
        {}, 21, png(0 * STEPS)),
    "sintel": Set(Sintel, "alley_1_frame_0001", {
        "training/clean/alley_1/frame_0001.png": png(photo(480, 640)),
        "training/camdata_left/alley_1/frame_0001.cam": struct.pack(
            "<f9d12d", 202021.25, 500, 0, 319.5, 0, 510, 217.5, 0, 0, 1, *range(12)),
        "training/depth/alley_1/frame_0001.dpt": dpt(VGA / 1024),
    }, 1040 / 1024, (500, 510, 319.5, 217.5), {}, {}, {"rendering": "final"}, 58, dpt(0 * VGA)),
    "stereo_board": Set(StereoBoard, "14", {
        "color/14.png": png(photo(1080, 1920)), "depth/14.png": png(ramp(1080, 1920, 1000)),
    }, None, (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy), {1: 1.040}, {}, {}, 5, png(0 * ramp(1080, 1920, 0))),
    "sunrgbd": Set(SunRGBD, "kv2_x", {
        "kv2/x/image/1.jpg": JPG, "kv2/x/intrinsics.txt": b"350 0 255 0 355 190 0 0 1\n",
        "kv2/x/depth/1.png": png(turned(ramp(384, 512, 8180))),
    }, 8.220, (350, 355, 255, 190), {}, {"size": None}),
    "tartanair": Set(TartanAir, "office_000000", {
        "office/image_left/000000_left.png": png(photo(480, 640)),
        "office/depth_left/000000_left_depth.npy": npy(VGA.astype(np.float32) / 1024),
    }, 1040 / 1024, (320, 320, 320, 240), {}, {"size": None}, holes=npy(VGA.astype(np.float32) * 0)),
    "nyu labelled": Set(NYU, "0001", {
        "nyu_depth_v2_labeled.mat": labelled(np.roll(VGA, (44, 40), (0, 1)) / 1024),  # the border is cut off
    }, 1040 / 1024, (518.857901, 519.469611, 324.582449 - 40, 252.736166 - 44), {}, {"size": None}, {"split": "test"}),
    "nyu": Set(NYU, "1001", {
        "DCTNet/RGB/1000.jpg": cv2.imencode(".jpg", photo(480, 640))[1].tobytes(),
        "DCTNet/Depth/1000.npy": npy(VGA.astype(np.float32) / 1024),
    }, 1040 / 1024, (518.857901, 519.469611, 324.582449, 252.736166), {}, {"split": "test"}, {"split": "train"}, 449),
}  # fmt: skip


def write_frame(name, folder, **changes):
    """Write the files of a frame; ``changes`` are contents by the ends of their paths, with _ for a dot."""
    for path, content in SETS[name].files.items():
        changed = [each for end, each in changes.items() if path.endswith(end.replace("_", "."))]
        written(folder / path, (changed or [content])[0])
    return SETS[name]


def opened(kind, folder, **settings):
    """Return the data set in a folder."""
    return kind.make(str(folder), **{"scenes": "found", **kind.settings, **settings})
