"""The programs of ``examples/``."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from commands import run_python

import dsr

CAMERA = dsr.Camera(32, 24, 27.7, 27.7, 15.5, 11.5)
REPOSITORY = Path(__file__).resolve().parents[2]


FRAMES = """
import numpy as np
class Any:  # what is configured needs no answer
    def __init__(self, *arguments, **named): pass
    def __getattr__(self, name): return Any()
    def __call__(self, *arguments, **named): return Any()
    def __getitem__(self, name): return Any()
    def __len__(self): return 0
v, u = np.mgrid[:24, :32]
PHOTOS = [np.stack([8 * u % 255, v * 10, 0 * u + 90 * k], -1).astype(np.uint8) for k in (1, 2)]
STORED = [(1500 + 300 * k + 4 * u).astype(np.uint16) * (v > 1) for k in (1, 2)]
"""  # Two frames, their first rows without depth, of stand-ins for the packages of cameras

STAND_INS = {
    "pyrealsense2": """
class Frame:
    def __init__(self, number, values, kind="z16"): self.frame_number, self.values, self.kind = number, values, kind
    def format(self): return self.kind
    def get_data(self): return self.values
    @property
    def profile(self): return self
    def as_video_stream_profile(self): return self
    class intrinsics: width, height, fx, fy, ppx, ppy = 32, 24, 27.7, 27.7, 15.5, 11.5
class Frames:
    def __init__(self, number): self.number = number
    def get_color_frame(self):  # BGR in the second frame
        kind = ("rgb8", "bgr8")[self.number]
        return Frame(self.number, PHOTOS[self.number][..., :: 1 - 2 * self.number], kind)
    def get_depth_frame(self): return Frame(self.number, STORED[self.number])
class WithoutDepth(Frames):
    def get_depth_frame(self): return None
class pipeline:
    def __init__(self): self.left = [Frames(0), WithoutDepth(1), Frames(1)]
    def start(self, config): return self
    def get_device(self): return self
    def first_depth_sensor(self): return self
    def get_depth_scale(self): return 0.001
    def try_wait_for_frames(self): return (True, self.left.pop(0)) if self.left else (False, None)
    def stop(self): pass
class align:
    def __init__(self, stream): pass
    def process(self, frames): return frames
class stream: color = 2
class format: rgb8, bgr8 = "rgb8", "bgr8"
config = Any
""",
    "depthai": """
class Image:
    def __init__(self, values): self.values = values
    def getCvFrame(self): return self.values[..., ::-1]
    def getFrame(self): return self.values
    def getTransformation(self): return self
    def getIntrinsicMatrix(self): return [[27.7, 0, 15.5], [0, 27.7, 11.5], [0, 0, 1]]
class Pipeline(Any):
    left = [0, 1]
    def __enter__(self): return self
    def __exit__(self, *_): pass
    def create(self, kind): return kind(self)
    def isRunning(self): return bool(self.left)
class Queue:
    def get(self):
        number = Pipeline.left.pop(0)
        return {"color": Image(PHOTOS[number]), "depth": Image(STORED[number])}
class Sync(Any):
    class out:
        createOutputQueue = Queue
class node: Camera, StereoDepth, Sync = Any, Any, Sync
CameraBoardSocket = ImgFrame = Any()
""",
    "rclpy": """
import message_filters
class Message:
    header = None
    def __init__(self, values): self.values = values
def init(): pass
def spin(node):
    for photo, stored in zip(PHOTOS, STORED):
        for values in (stored, np.where(stored > 0, stored / np.float32(1000), np.nan)):
            message_filters.callback(Message(photo), Message(values), message_filters.Info)
""",
    "rclpy.node": """
class Node:
    def __init__(self, name): pass
    def create_publisher(self, *_): return self
    def publish(self, depth): print(f"{np.nanmedian(depth):.3f}")
""",
    "message_filters": """
class Info: width, height, p = 32, 24, [27.7, 0, 15.5, 0, 0, 27.7, 11.5, 0, 0, 0, 1, 0]
Subscriber = Any
class ApproximateTimeSynchronizer:
    def __init__(self, *_, **__): pass
    def registerCallback(self, function): globals()["callback"] = function
""",
    "cv_bridge": """
class CvBridge:
    def imgmsg_to_cv2(self, message, encoding=None): return message.values
    def cv2_to_imgmsg(self, depth, encoding, header): return depth
""",
    "sensor_msgs.msg": "Image = CameraInfo = None",
}


def with_stand_ins(tmp_path):
    """Write the stand-ins, and return the environment in which they are found."""
    for name, content in STAND_INS.items():
        path = tmp_path / "modules" / f"{name.replace('.', '/')}.py"
        if any(other.startswith(f"{name}.") for other in STAND_INS):
            path = path.with_suffix("") / "__init__.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(FRAMES + content)
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (REPOSITORY / "src", tmp_path / "modules")))}


@pytest.mark.parametrize(("program", "times"), [("realsense_stream.py", 1), ("oak_stream.py", 1), ("ros2_node.py", 2)])
def test_frames_of_a_camera_are_those_of_dsr_upsample(tmp_path, program, times):
    environment = with_stand_ins(tmp_path)
    ended = run_python(str(REPOSITORY / "examples" / program), cwd=tmp_path, env=environment)
    assert ended.returncode == 0, ended.stderr
    frames = {}
    exec(FRAMES, frames)
    expected = [
        f"{np.nanmedian(dsr.upsample(photo, stored / 1000, CAMERA, mask=stored > 0)):.3f}"
        for photo, stored in zip(frames["PHOTOS"], frames["STORED"], strict=True)
    ]
    assert expected[0] != expected[1]
    assert re.findall(r"\d\.\d{3}(?!\d)", ended.stdout) == [each for each in expected for _ in range(times)]
