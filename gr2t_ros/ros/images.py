# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The newest keyframe as images: its denoised depth and how sure it is, with camera_info."""
from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

from ..core.confidence import confidences, deviations
from ..core.ray_march import Density
from ..core.reconstruction import Keyframe, Reconstruction
from .timings import Timings

_CAMERA_INFO = 'depth/camera_info'
_UNCERTAINTY = ('sigma/image', 'confidence/image')  # made only for who listens to them
_TOPICS = ('depth/image', _CAMERA_INFO, 'likelihood/image', *_UNCERTAINTY)


class ImagePublishers:
    """
    The topics ~/depth/image, ~/likelihood/image, ~/sigma/image, ~/confidence/image.

    And ~/depth/camera_info, which is the camera of all of them. They are sent when there is a new
    keyframe, when the newest one's rays changed, or when someone new listens; nothing is computed
    while nobody does.

    :param node: on which to advertise
    :param profile: QoS of all
    :param timings: learns how long it takes
    """

    def __init__(self, node: Node, profile: QoSProfile, timings: Timings) -> None:
        self._timings = timings
        self._publishers = {
            topic: node.create_publisher(
                CameraInfo if topic == _CAMERA_INFO else Image, f'~/{topic}', profile)
            for topic in _TOPICS}
        self._listeners = 0
        self._changed: set[int] = set()  # keyframes

    def change(self, keyframes: Iterable[int]) -> None:
        """Note keyframes whose rays changed."""
        self._changed.update(keyframes)

    def publish(self, reconstruction: Reconstruction) -> bool:
        """Send the newest keyframe if that is due; tell whether it was sent."""
        heard = {
            topic: publisher.get_subscription_count()
            for topic, publisher in self._publishers.items()}
        before, self._listeners = self._listeners, sum(heard.values())
        newest = len(reconstruction.keyframes) - 1
        due = newest in self._changed or (newest >= 0 and self._listeners > before)
        self._changed.clear()
        if not due or not self._listeners:
            return False
        with self._timings.measure('publish', cpu=True):
            messages = images(
                reconstruction.keyframes[newest], reconstruction.density,
                reconstruction.settings.ray_stride,
                uncertainty=any(heard[topic] for topic in _UNCERTAINTY))
            for topic, message in messages.items():
                self._publishers[topic].publish(message)
        return True


def images(
    keyframe: Keyframe, density: Density, stride: int, uncertainty: bool = True
) -> dict[str, Image | CameraInfo]:
    """
    Return a keyframe's depth (metres), likelihood (1 / (px^2 m)), and how sure the depths are.

    Pixels whose ray found no maximum are NaN. With a stride the images hold the marched pixels
    only, and the camera is that of the smaller images.

    :param stride: of the rays
    :param uncertainty: whether to make the last two too: the standard deviation of the depth
        (metres), and the confidence (0 to 1)
    :return: topic below the node's name -> message
    """
    rays, view = keyframe.rays, keyframe.view
    found = np.flatnonzero(rays.converged)
    camera = view.camera
    v, u = np.divmod(rays.pixels[found], camera.width)
    height, width = -(-camera.height // stride), -(-camera.width // stride)

    def image(values: NDArray[np.float32]) -> Image:
        pixels = np.full((height, width), np.nan, '<f4')
        pixels[v // stride, u // stride] = values
        return Image(
            height=height, width=width, encoding='32FC1', is_bigendian=0,
            step=pixels.strides[0], data=array('B', pixels.tobytes()))

    depth = rays.depth[found]
    messages: dict[str, Image | CameraInfo] = {
        'depth/image': image(depth),
        'likelihood/image': image(rays.total[found] / np.float32(max(density.size, 1)))}
    if uncertainty:
        sigma = deviations(density, rays, found)
        messages['sigma/image'] = image(sigma)
        messages['confidence/image'] = image(confidences(sigma, density.h3(depth)))
    info = CameraInfo(height=height, width=width, distortion_model='plumb_bob')
    info.d = [0.0] * 5
    if any(camera.distortion):
        info.distortion_model, info.d = camera.model, list(camera.distortion)
    # pixel centres are integers, so pixel u is now u / stride; the distortion has no pixels in it
    fx, fy, cx, cy = (
        value / stride for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    info.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    messages[_CAMERA_INFO] = info
    for message in messages.values():
        message.header.stamp = Time(nanoseconds=view.stamp_ns).to_msg()
        message.header.frame_id = view.frame_id
    return messages
