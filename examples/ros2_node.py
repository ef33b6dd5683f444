"""A ROS 2 node that upsamples registered depth: ``python examples/ros2_node.py``, in an environment of ROS and dsr.

Takes ``color/image_rect``, ``depth/image_rect`` (as ``depth_image_proc`` registers it) and ``color/camera_info``; gives
``depth/upsampled``, 32FC1 in metres, NaN in holes. ``--ros-args -r color:=/camera/color`` renames them.
"""

import message_filters
import numpy as np
import rclpy
from cv_bridge import CvBridge
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

import dsr


class UpsampleNode(Node):
    def __init__(self) -> None:
        super().__init__("dsr")
        self.upsampler, self.bridge = dsr.Upsampler(), CvBridge()
        self.publisher = self.create_publisher(Image, "depth/upsampled", 1)
        topics = (Image, "color/image_rect"), (Image, "depth/image_rect"), (CameraInfo, "color/camera_info")
        subscribers = [message_filters.Subscriber(self, kind, topic) for kind, topic in topics]
        self.pairs = message_filters.ApproximateTimeSynchronizer(subscribers, queue_size=1, slop=0.02)
        self.pairs.registerCallback(self.upsample)

    def upsample(self, color: Image, depth: Image, info: CameraInfo) -> None:
        matrix = np.reshape(info.p, (3, 4))  # of rectified pictures P, not K
        camera = dsr.Camera.from_matrix(matrix, info.width, info.height)
        stored = self.bridge.imgmsg_to_cv2(depth)
        photo, unit = self.bridge.imgmsg_to_cv2(color, "rgb8"), "mm" if stored.dtype == np.uint16 else "m"  # REP 118
        surface = self.upsampler(photo, stored, camera, unit=unit)
        self.publisher.publish(self.bridge.cv2_to_imgmsg(surface.depth, "32FC1", depth.header))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(UpsampleNode())
