# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A camera and what localises it, as publishers of the test's process."""
from __future__ import annotations

from array import array
from typing import Any

import cv2
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from ros_for_tests import Observer
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tf2_msgs.msg import TFMessage

from gr2t_ros.core.view import View
from gr2t_ros.ros.inputs import transforms_profile

POSES = {
    'tf': TFMessage, 'pose': PoseStamped, 'pose_with_covariance': PoseWithCovarianceStamped,
    'odometry': Odometry, 'transform': TransformStamped}
RELIABLE = QoSProfile(depth=20)
BEST_EFFORT = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)


class LiveCamera:
    """
    Publishes views on the plain topics below a prefix.

    :param source: of the poses, as the parameter pose_source; '': none
    :param encoding: of the images; compressed ones are png
    :param child: frame of the poses
    """

    def __init__(
        self, observer: Observer, prefix: str = '', *, source: str = 'tf',
        encoding: str = '16UC1', compressed: bool = False, profile: QoSProfile = RELIABLE,
        frame: str = 'camera', child: str = '', parent: str = 'map',
    ) -> None:
        self._encoding, self._compressed = encoding, compressed
        self._source, self._parent = source, parent
        self._frame, self._child = frame, child or frame
        node = observer.node
        self.infos = node.create_publisher(CameraInfo, f'{prefix}/depth/camera_info', profile)
        self.images = node.create_publisher(
            CompressedImage if compressed else Image,
            f'{prefix}/depth/image' + ('/compressedDepth' if compressed else ''), profile)
        self.poses = None
        if source == 'tf':
            self.poses = node.create_publisher(TFMessage, '/tf', RELIABLE)
        elif source:
            self.poses = node.create_publisher(POSES[source], f'{prefix}/pose', profile)

    @property
    def heard(self) -> bool:
        """Return whether someone subscribes to all of it, reliably where it is offered so."""
        publishers = [item for item in (self.infos, self.images, self.poses) if item]
        return all(item.get_subscription_count() for item in publishers)

    def publish(
        self, view: View, T_camera_child: Any = np.eye(4), frame: str | None = None,  # noqa: B008
    ) -> None:
        """Publish a view's pose, camera_info and image; frame: another one, of the image."""
        self.publish_pose(view, T_camera_child)
        self.infos.publish(self.info_message(view))
        message = self.image_message(view)
        if frame is not None:
            message.header.frame_id = frame
        self.images.publish(message)

    def publish_pose(self, view: View, T_camera_child: Any = np.eye(4)) -> None:  # noqa: B008
        """Publish a view's pose."""
        if self.poses:
            self.poses.publish(pose_message(
                self._source, self._parent, self._child, view.stamp_ns,
                view.T_world_camera @ T_camera_child))

    def info_message(self, view: View) -> CameraInfo:
        """Return a view's camera_info."""
        camera = view.camera
        info = CameraInfo(
            height=camera.height, width=camera.width,
            k=[camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0])
        return stamped(info, self._frame, view.stamp_ns)

    def image_message(self, view: View) -> Any:
        """Return a view's image."""
        depth = view.depth
        if self._encoding != '32FC1':
            depth = np.round(1000 * np.nan_to_num(depth)).astype('<u2')
        if self._compressed:
            png = bytes(12) + cv2.imencode('.png', depth)[1].tobytes()
            message = CompressedImage(
                format=f'{self._encoding}; compressedDepth png', data=array('B', png))
        else:
            message = Image(
                height=depth.shape[0], width=depth.shape[1], encoding=self._encoding,
                step=depth.strides[0], data=array('B', depth.tobytes()))
        return stamped(message, self._frame, view.stamp_ns)


def mask_message(pixels: np.ndarray, stamp_ns: int) -> Image:
    """Return a mask."""
    pixels = np.ascontiguousarray(pixels, np.uint8)
    return stamped(Image(
        height=pixels.shape[0], width=pixels.shape[1], encoding='mono8', step=pixels.shape[1],
        data=array('B', pixels.tobytes())), 'camera', stamp_ns)


def stamped(message: Any, frame: str, stamp_ns: int) -> Any:
    """Fill in a message's header, and return it."""
    message.header.frame_id = frame
    message.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
    return message


def pose_message(source: str, parent: str, child: str, stamp_ns: int, T: np.ndarray) -> Any:
    """Return the message of a pose source."""
    if source == 'tf':
        return TFMessage(transforms=[pose_message('transform', parent, child, stamp_ns, T)])
    message = stamped(POSES[source](), parent, stamp_ns)
    if hasattr(message, 'child_frame_id'):
        message.child_frame_id = child
    if source == 'transform':
        place, turn = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose if source == 'pose' else message.pose.pose
        place, turn = pose.position, pose.orientation
    place.x, place.y, place.z = map(float, T[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
    return message


def publish_static(observer: Observer, parent: str, child: str, T: np.ndarray) -> None:
    """Publish a transform on /tf_static."""
    publisher = observer.node.create_publisher(
        TFMessage, '/tf_static', transforms_profile(static=True))
    publisher.publish(pose_message('tf', parent, child, 0, T))
