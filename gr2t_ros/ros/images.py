# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The newest keyframe as images: its denoised depth and the likelihood, with their camera_info."""
from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

from ..core.reconstruction import Keyframe, Reconstruction
from .timings import Timings


class ImagePublishers:
    """
    The topics ~/depth/image, ~/depth/camera_info and ~/likelihood/image.

    All three are sent when there is a new keyframe, when the newest one's rays changed, or when
    someone new listens; nothing is computed while nobody does.

    :param node: on which to advertise
    :param profile: QoS of all three
    :param timings: learns how long it takes
    """

    def __init__(self, node: Node, profile: QoSProfile, timings: Timings) -> None:
        self._timings = timings
        self._depth = node.create_publisher(Image, '~/depth/image', profile)
        self._camera_info = node.create_publisher(CameraInfo, '~/depth/camera_info', profile)
        self._likelihood = node.create_publisher(Image, '~/likelihood/image', profile)
        self._listeners = 0
        self._changed: set[int] = set()  # keyframes

    def change(self, keyframes: Iterable[int]) -> None:
        """Note keyframes whose rays changed."""
        self._changed.update(keyframes)

    def publish(self, reconstruction: Reconstruction) -> bool:
        """Send the newest keyframe if that is due; tell whether it was sent."""
        before, self._listeners = self._listeners, sum(
            publisher.get_subscription_count()
            for publisher in (self._depth, self._camera_info, self._likelihood))
        newest = len(reconstruction.keyframes) - 1
        due = newest in self._changed or (newest >= 0 and self._listeners > before)
        self._changed.clear()
        if not due or not self._listeners:
            return False
        with self._timings.measure('publish', cpu=True):
            depth, info, likelihood = images(
                reconstruction.keyframes[newest], reconstruction.density.size,
                reconstruction.settings.ray_stride)
            self._camera_info.publish(info)
            self._depth.publish(depth)
            self._likelihood.publish(likelihood)
        return True


def images(keyframe: Keyframe, views: int, stride: int) -> tuple[Image, CameraInfo, Image]:
    """
    Return a keyframe's depth (metres), its camera and its likelihood (1 / (px^2 m)).

    Pixels whose ray found no maximum are NaN. With a stride the images hold the marched pixels
    only, and the camera is that of the smaller images.

    :param views: in the density
    :param stride: of the rays
    """
    rays, view = keyframe.rays, keyframe.view
    found = rays.converged
    camera = view.camera
    v, u = np.divmod(rays.pixels[found], camera.width)
    height, width = -(-camera.height // stride), -(-camera.width // stride)

    def image(values: NDArray[np.float32]) -> Image:
        pixels = np.full((height, width), np.nan, '<f4')
        pixels[v // stride, u // stride] = values[found]
        return Image(
            height=height, width=width, encoding='32FC1', is_bigendian=0,
            step=pixels.strides[0], data=array('B', pixels.tobytes()))

    depth, likelihood = image(rays.depth), image(rays.total / np.float32(max(views, 1)))
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
    for message in (depth, info, likelihood):
        message.header.stamp = Time(nanoseconds=view.stamp_ns).to_msg()
        message.header.frame_id = view.frame_id
    return depth, info, likelihood
