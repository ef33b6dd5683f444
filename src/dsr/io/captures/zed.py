"""Pictures that the ZED SDK's sample *SVO Export* writes, beside the camera's factory calibration.

https://github.com/stereolabs/zed-sdk, recording/export/svo (mode LEFT + DEPTH_16Bit), and
https://github.com/stereolabs/zed-open-capture, examples/include/calibration.hpp.

    left000000.png     the left photo, rectified
    depth000000.png    16-bit millimetres in the left photo's pixels, 0 in holes
    SN12345.conf       both cameras before they are rectified, for each resolution: fx, fy, cx, cy, k1, k2, p1, p2, k3;
                       Baseline, TY and TZ in mm, the latter for each resolution, for all, or not at all, which
                       is 0; RX, CV and RZ, a rotation vector

The camera of the rectified photo is what OpenCV's ``stereoRectify`` makes of them, as in the second source. The SDK
may calibrate anew when it opens a camera, and then has another one within about a percent.
"""

from __future__ import annotations

import configparser
import functools
from pathlib import Path

import cv2
import numpy as np

from dsr.io.frames import CaptureFrame, Geometry, Size
from dsr.io.pairs import Pair, PairingResult, numbered_files, paired
from dsr.io.trajectories import describe_capture, intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import numbers_in, read_text, refusing

_APP = "ZED"
_RESOLUTIONS = {
    (1242, 2208): "2K", (1200, 1920): "FHD1200", (1080, 1920): "FHD", (720, 1280): "HD", (600, 960): "SVGA",
    (376, 672): "VGA",
}  # fmt: skip
_CAMERA = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def find(folder: Path) -> PairingResult | None:
    """Return the frames of a folder of exported pictures with a calibration."""
    calibrations = sorted(path for path in folder.glob("SN*.conf") if path.is_file())
    photos, depths = (numbered_files(folder, (".png",), kind) for kind in ("left", "depth"))
    both, unpaired = paired(photos, depths)
    if not calibrations or not both:
        return None
    if len(calibrations) > 1:
        raise ValueError(f"{folder}: expected one calibration of {_APP}, got {', '.join(p.name for p in calibrations)}")
    path, text = calibrations[0], read_text(calibrations[0])
    frame = CaptureFrame(_APP, functools.partial(_geometry, path, text), path, text.encode())
    pairs = tuple(
        Pair(photos[number].stem.removeprefix("left"), photos[number], depths[number], unit=1e-3, capture=frame)
        for number in both
    )
    note = describe_capture(f"pictures of {_APP}", "millimetres", pairs, poses=False)
    return PairingResult(pairs, (note,), unpaired)


def _geometry(path: Path, text: str, size: Size) -> Geometry:
    """Return the camera of the rectified photo of (height, width)."""
    if size not in _RESOLUTIONS:
        sizes = ", ".join(f"{width} x {height}" for height, width in _RESOLUTIONS)
        return Geometry(None, None, (Assumption(f"{path.name} is not used: it is of photos of {sizes}"),))
    resolution = _RESOLUTIONS[size]
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    with refusing(f"{path}: expected the calibration of {_APP}, got a damaged or foreign file", configparser.Error):
        parser.read_string(text)
    if parser.has_section("STEREO"):
        for name in ("TY", "TZ"):
            parser["STEREO"].setdefault(f"{name}_{resolution}", parser.get("STEREO", name, fallback="0"))

    def numbers(section: str, *names: str) -> np.ndarray:
        came = [parser.get(section, name, fallback="nothing") for name in names]
        values = np.array(numbers_in(came))
        if not len(values) or not np.isfinite(values).all():
            raise ValueError(f"{path}: {section}: expected numbers for {', '.join(names)}, got {', '.join(came):.120}")
        return values

    left, right = (numbers(f"{side}_CAM_{resolution}", *_CAMERA) for side in ("LEFT", "RIGHT"))
    between = numbers("STEREO", "Baseline", *(f"{name}_{resolution}" for name in ("TY", "TZ", "RX", "CV", "RZ")))
    matrices = [np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) for fx, fy, cx, cy, *_ in (left, right)]
    with refusing(f"{path}: expected the calibration of two cameras side by side, got another", cv2.error):
        rectified = cv2.stereoRectify(
            matrices[0], left[4:], matrices[1], right[4:], size[::-1], cv2.Rodrigues(between[3:])[0],
            between[:3].reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
        )[2]  # fmt: skip
    camera = intrinsics_camera(str(path), size, [float(rectified[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))])
    return Geometry(camera, None, (Assumption("camera: that of the factory calibration, which the SDK refines"),))
