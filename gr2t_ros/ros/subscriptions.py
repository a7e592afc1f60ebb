# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node's subscriptions: which topics go where, and what is said when nothing comes."""
from __future__ import annotations

from functools import partial

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from ..errors import InputError
from ..settings import Settings
from .inputs import Input, missing, transforms_profile
from .intake import Intake

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

_POSES = {
    'pose': PoseStamped, 'pose_with_covariance': PoseWithCovarianceStamped,
    'odometry': Odometry, 'transform': TransformStamped}
_FOLLOW_PERIOD = 0.2  # s between looks at the publishers' reliability
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


def rectified(node: Node) -> dict[str, bool]:
    """Return for each camera whether its depth images are, as their topic's name says."""
    return {'': 'rect' in node.resolve_topic_name('depth/image').rpartition('/')[2]}


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
        transforms = [
            Input(
                node, TFMessage, topic, partial(intake.on_transforms, static=static), _SMALL,
                transforms_profile(static=static))
            for topic, static in (('/tf_static', True), ('/tf', False)) if TFMessage is not None]
        self._poses = transforms
        if settings.pose_source != 'tf':
            self._poses = [
                Input(node, _POSES[settings.pose_source], 'pose', intake.on_pose, _SMALL)]
        # the images' comes last
        self._inputs = [
            Input(node, CameraInfo, 'depth/camera_info', intake.on_camera_info, _SMALL),
            Input(node, Image, 'depth/image', intake.on_depth, settings.queue_size)]
        node.get_logger().info('subscribed to ' + ', '.join(item.topic for item in self.inputs))
        # these go on where simulated time stands still
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_FOLLOW_PERIOD, self._follow_publishers, clock=steady)
        node.create_timer(1.0, self._check_inputs, clock=steady)

    @property
    def inputs(self) -> list[Input]:
        """Return all of them."""
        return [*self._poses, *self._inputs]

    def _follow_publishers(self) -> None:
        for item in self.inputs:
            if item.follow():
                self._node.get_logger().info(
                    f'{item.topic}: {"reliable" if item.reliable else "best effort"}, as its '
                    'publishers are')

    def _check_inputs(self) -> None:
        """Warn once when something is missing, and again only after it had come."""
        sentence = '' if self.paused else missing(self._inputs, self._poses, _SILENCE)
        if sentence and not self._warned:
            self._node.get_logger().warning(
                f'{sentence}; remap the node\'s topics (depth/image:=...) or start the publishers')
        self._warned = bool(sentence)
