"""Upsample the frames of a RealSense camera as they come; Ctrl-C ends it.

pip install pyrealsense2; python examples/realsense_stream.py [RECORDING]
"""

import sys
from collections.abc import Iterator

import numpy as np
import pyrealsense2 as rs

import dsr

pipeline, config = rs.pipeline(), rs.config()
if len(sys.argv) > 1:
    config.enable_device_from_file(sys.argv[1], repeat_playback=False)
profile = pipeline.start(config)
metres = profile.get_device().first_depth_sensor().get_depth_scale()
align = rs.align(rs.stream.color)
orders = {rs.format.rgb8: 1, rs.format.bgr8: -1}


def read_frames() -> Iterator[tuple[np.ndarray, np.ndarray, dsr.Camera]]:
    while True:
        there, frames = pipeline.try_wait_for_frames()
        if not there:
            return
        if not frames.get_color_frame() or not frames.get_depth_frame():
            continue  # one of them was dropped
        frames = align.process(frames)
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        kind = color.profile.format()
        if kind not in orders:
            sys.exit(f"expected photos as RGB8 or BGR8, got {kind}")
        lens = color.profile.as_video_stream_profile().intrinsics
        camera = dsr.Camera(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy)
        yield np.asanyarray(color.get_data())[..., :: orders[kind]], np.asanyarray(depth.get_data()), camera


for number, surface in enumerate(dsr.Upsampler().stream(read_frames(), unit=metres)):
    print(f"frame {number}: {np.nanmedian(surface.depth):.3f} +- {np.nanmedian(surface.depth_error):.4f} m")
pipeline.stop()
