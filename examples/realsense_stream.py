"""Upsample the frames of a RealSense camera as they come; Ctrl-C ends it.

pip install pyrealsense2; python examples/realsense_stream.py [RECORDING]
"""

import sys

import numpy as np
import pyrealsense2 as rs

import dsr

upsampler = dsr.Upsampler()
pipeline, config = rs.pipeline(), rs.config()
if len(sys.argv) > 1:
    config.enable_device_from_file(sys.argv[1], repeat_playback=False)
profile = pipeline.start(config)
metres = profile.get_device().first_depth_sensor().get_depth_scale()
align = rs.align(rs.stream.color)
while True:
    there, frames = pipeline.try_wait_for_frames()
    if not there:
        break
    frames = align.process(frames)
    color, depth = frames.get_color_frame(), frames.get_depth_frame()
    lens = color.profile.as_video_stream_profile().intrinsics
    camera = dsr.Camera(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy)
    stored = np.asanyarray(depth.get_data())  # 0 in holes
    surface = upsampler(np.asanyarray(color.get_data()), stored * metres, camera, mask=stored > 0)
    print(f"frame {color.frame_number}: {np.nanmedian(surface.depth):.3f} +- {np.nanmedian(surface.depth_error):.4f} m")
pipeline.stop()
