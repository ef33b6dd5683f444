"""RealSense's own filters of frames without a camera: ``python tests/realsense_sdk.py`` records their results.

Needs pyrealsense2, and libusb-1.0.so.0 on the library path.
"""

from pathlib import Path

import numpy as np

FILE = Path(__file__).resolve().parent / "golden" / "realsense.npz"
FOCAL, BASELINE = 580.0, 0.05  # pixels, metres
UNIT = 1e-3


def frames():
    """Return maps of an object that moves over a slanted wall, noisy, with holes that come and go, (5, 32, 48)."""
    random = np.random.default_rng(0)
    depth = np.full((5, 32, 48), 1000.0) + np.linspace(0, 300, 48) + 40 * np.sin(np.arange(32) / 5)[:, None]
    for number, frame in enumerate(depth):
        frame[8:20, 12 + 2 * number : 28 + 2 * number] = 700
    depth += random.normal(0, 8, depth.shape)
    depth[random.random(depth.shape) < 0.15] = 0
    depth[:, 23:27, 5:20] = depth[2:, :6, -10:] = depth[3:, 28:, :6] = depth[:4:2, 14:18, 36:44] = 0
    return depth.round().astype(np.uint16)


def run(maps, focal=FOCAL, baseline=BASELINE, unit=UNIT):
    """Return what the filters with their defaults make of maps in units, (T, h, w) each, by name."""
    import pyrealsense2 as rs  # noqa: PLC0415

    count, height, width = maps.shape
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = width, height, focal, focal, 0, 0
    stream = rs.video_stream()
    stream.type, stream.width, stream.height, stream.fps, stream.bpp = rs.stream.depth, width, height, 30, 2
    stream.fmt, stream.intrinsics = rs.format.z16, lens
    device, queue = rs.software_device(), rs.frame_queue(4)
    sensor = device.add_sensor("Stereo Module")
    profile = sensor.add_video_stream(stream)
    sensor.add_read_only_option(rs.option.depth_units, unit)
    sensor.add_read_only_option(rs.option.stereo_baseline, 1e3 * baseline)
    sensor.open(profile)
    sensor.start(queue)
    chain = {
        "disparity": rs.disparity_transform(True),
        "spatial": rs.spatial_filter(),
        "temporal": rs.temporal_filter(),
        "depth": rs.disparity_transform(False),
        "filled": rs.hole_filling_filter(),
    }
    found = {name: [] for name in chain}
    for number in range(count):
        given = rs.software_video_frame()
        given.pixels, given.stride, given.bpp = np.ascontiguousarray(maps[number]), 2 * width, 2
        given.timestamp, given.domain, given.frame_number = 33.0 * number, rs.timestamp_domain.hardware_clock, number
        given.profile, given.depth_units = profile.as_video_stream_profile(), unit
        sensor.on_video_frame(given)
        frame = queue.wait_for_frame(2000)
        for name, block in chain.items():
            frame = block.process(frame)
            values = np.array(frame.get_data())
            found[name].append(values if values.itemsize == 2 else values.view(np.float32))  # of disparity
    sensor.stop()
    sensor.close()
    return {name: np.stack(each) for name, each in found.items()}


if __name__ == "__main__":
    results = run(frames())
    np.savez_compressed(FILE, frames=frames(), **{name: results[name] for name in ("temporal", "filled")})
