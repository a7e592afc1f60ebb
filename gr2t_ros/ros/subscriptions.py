# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node's subscriptions: which topics go where, and what is said when nothing comes."""
from __future__ import annotations

from functools import partial

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from ..errors import InputError
from ..settings import Settings
from .inputs import Input, silence, transforms_profile
from .intake import Intake

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

_POSES = {
    'pose': PoseStamped, 'pose_with_covariance': PoseWithCovarianceStamped,
    'odometry': Odometry, 'transform': TransformStamped}
_FOLLOW_PERIOD = 0.2  # s between looks at the publishers' QoS
_SILENCE = 5.0  # s without input that are worth a warning
_SMALL = 100  # camera_info and poses that may wait for the executor


def check_source(settings: Settings) -> None:
    """
    Check that the poses' messages are installed.

    :raises InputError: if they are not
    """
    if TFMessage is None and settings.pose_source == 'tf':
        raise InputError(
            'pose_source is tf, but the package tf2_msgs is not installed: install it, or '
            'take the poses from a topic (pose_source:=pose)')


def rectified(node: Node, settings: Settings) -> dict[str, bool]:
    """Return for each camera whether its depth images are, as their topic's name says."""
    return {
        camera: 'rect' in node.resolve_topic_name(
            relative(camera, 'depth/image')).rpartition('/')[2]
        for camera in settings.cameras}


def relative(camera: str, topic: str) -> str:
    """Return the name of a camera's topic."""
    return f'{camera}/{topic}' if camera else topic


class Subscriptions:
    """
    Hands the messages of all input topics over.

    :param node: that subscribes
    :param settings: parameters
    :param intake: where the messages go
    """

    def __init__(self, node: Node, settings: Settings, intake: Intake) -> None:
        self._node = node
        self._intake = intake
        self._warned = False
        self.paused = False
        self._transforms = [
            Input(
                node, TFMessage, topic, partial(intake.on_transforms, static=static), _SMALL,
                once=True, profile=transforms_profile(static=static))
            for topic, static in (('/tf_static', True), ('/tf', False)) if TFMessage is not None]
        self._needed = [
            item for camera in settings.cameras for item in self._of_camera(camera, settings)]
        self._tf_is_needed = settings.pose_source == 'tf'
        node.get_logger().info('subscribed to ' + ', '.join(item.topic for item in self.inputs))
        # of use_sim_time's clock
        self._jumps = node.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(seconds=-1), on_clock_change=False),
            post_callback=lambda _: intake.on_clock_jump(node.get_clock().now().nanoseconds))
        # these go on where simulated time stands still
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_FOLLOW_PERIOD, self._follow_publishers, clock=steady)
        node.create_timer(1.0, self._check_inputs, clock=steady)

    def _of_camera(self, camera: str, settings: Settings) -> list[Input]:
        """Return a camera's inputs; the images' comes last."""
        node, intake = self._node, self._intake
        inputs = []
        if settings.pose_source != 'tf':
            inputs.append(Input(
                node, _POSES[settings.pose_source], relative(camera, 'pose'),
                partial(intake.on_pose, camera=camera), _SMALL, reliability=settings.input_qos))
        inputs.append(Input(
            node, CameraInfo, relative(camera, 'depth/camera_info'),
            partial(intake.on_camera_info, camera=camera), _SMALL, once=True,
            reliability=settings.input_qos))
        if settings.use_mask:
            inputs.append(Input(
                node, Image, relative(camera, 'depth/mask'),
                partial(intake.on_mask, camera=camera), settings.queue_size, once=True,
                reliability=settings.input_qos))
        kind, topic = Image, relative(camera, 'depth/image')
        if settings.depth_transport != 'raw':  # as image_transport: by the name that was remapped
            kind = CompressedImage
            topic = f'{node.resolve_topic_name(topic)}/{settings.depth_transport}'
        inputs.append(Input(
            node, kind, topic, partial(intake.on_depth, camera=camera), settings.queue_size,
            reliability=settings.input_qos))
        return inputs

    @property
    def inputs(self) -> list[Input]:
        """Return all of them."""
        return [*self._transforms, *self._needed]

    def missing(self) -> str:
        """Return what does not arrive as lines; empty: all does, or nothing is wanted."""
        return '' if self.paused else silence(
            self._needed, self._transforms if self._tf_is_needed else (), _SILENCE,
            self._intake.world.frames())

    def _follow_publishers(self) -> None:
        for item in self.inputs:
            if item.follow():
                self._node.get_logger().info(
                    f'{item.topic}: {item.requested}, as its publishers are')
            if mismatch := item.mismatch():
                self._node.get_logger().warning(mismatch)

    def _check_inputs(self) -> None:
        """Warn once when something is missing, and again only after it had come."""
        lines = self.missing()
        if lines and not self._warned:
            self._node.get_logger().warning(lines)
        self._warned = bool(lines)
