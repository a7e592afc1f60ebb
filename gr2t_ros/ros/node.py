# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node: subscriptions, parameters, services and timers around the worker."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import Future
from functools import partial
import signal
import sys
import threading
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
import rclpy.task
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool, Trigger

from ..core.reconstruction import warm_up
from ..errors import InputError
from .inputs import Input, missing, transforms_profile
from .parameters import read_parameters, table
from .publishers import MapPublishers
from .worker import describe, Worker

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

NAME = 'gr2t'
_POSES = {
    'pose': PoseStamped, 'pose_with_covariance': PoseWithCovarianceStamped,
    'odometry': Odometry, 'transform': TransformStamped}
_FOLLOW_PERIOD = 0.2  # s between looks at the publishers' reliability
_SILENCE = 5.0  # s without input that are worth a warning
_SMALL = 100  # camera_info and poses that may wait for the executor


class Gr2tNode(Node):
    """
    Builds a map from the topics depth/image, depth/camera_info and tf or pose.

    :raises InputError: if a parameter cannot be used
    """

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        self.settings = read_parameters(self)
        if TFMessage is None and self.settings.pose_source == 'tf':
            raise InputError(
                'pose_source is tf, but the package tf2_msgs is not installed: install it, or '
                'take the poses from a topic (pose_source:=pose)')
        self._log_settings()
        self._compile()
        rectified = 'rect' in self.resolve_topic_name('depth/image').rpartition('/')[2]
        self.worker = Worker(
            self.settings, MapPublishers(self, self.settings), self.get_logger(),
            rectified=rectified)
        self._inputs, self._poses = self._subscribe()
        self.get_logger().info(
            'subscribed to ' + ', '.join(item.topic for item in (*self._inputs, *self._poses)))
        self._advertise_services()
        self._paused = False
        self._warned = False
        # these go on where simulated time stands still
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_FOLLOW_PERIOD, self._follow_publishers, clock=steady)
        self.create_timer(1.0, self._check_inputs, clock=steady)
        self.worker.start()

    def _log_settings(self) -> None:
        self.get_logger().info(f'settings (* differs from the default):\n{table(self.settings)}')

    def _compile(self) -> None:
        """Compile before subscribing: whoever waits for a subscriber finds one that is ready."""
        self.get_logger().info('compiling the kernels, or loading them from the cache')
        self.get_logger().info(f'kernels are ready after {warm_up(self.settings):.1f} s')

    def _subscribe(self) -> tuple[list[Input], list[Input]]:
        """Return the inputs that must go on, and those of poses; the images' comes last."""
        worker, settings = self.worker, self.settings
        transforms = [
            Input(
                self, TFMessage, topic, partial(worker.on_transforms, static=static), _SMALL,
                transforms_profile(static=static))
            for topic, static in (('/tf_static', True), ('/tf', False)) if TFMessage is not None]
        poses = transforms
        if settings.pose_source != 'tf':
            poses = [Input(self, _POSES[settings.pose_source], 'pose', worker.on_pose, _SMALL)]
        inputs = [
            Input(self, CameraInfo, 'depth/camera_info', worker.on_camera_info, _SMALL),
            Input(self, Image, 'depth/image', worker.on_depth, settings.queue_size)]
        return inputs, poses

    def _advertise_services(self) -> None:
        self.create_service(
            Trigger, '~/save_snapshot', self._on_save_snapshot,
            callback_group=ReentrantCallbackGroup())
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self._answered = self.create_guard_condition(lambda: None)

    async def _on_save_snapshot(
        self, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Answer once the worker has written the file; other callbacks go on meanwhile."""
        answer: Any = rclpy.task.Future()

        def wake(done: Future[Any]) -> None:
            answer.set_result(done)
            self._answered.trigger()

        self.worker.snapshot().add_done_callback(wake)
        done: Future[Any] = await answer
        error = done.exception()
        response.success = error is None
        if error:
            response.message = str(error)
            self.get_logger().warning(f'no snapshot: {response.message}')
        else:
            response.message = describe(done.result())
            self.get_logger().info(f'snapshot: {response.message}')
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.worker.reset()
        response.success = True
        response.message = 'the map is empty'
        self.get_logger().info(f'reset: {response.message}')
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        self.worker.pause(request.data)
        response.success = True
        response.message = 'paused: images are ignored' if request.data else 'running'
        self.get_logger().info(f'pause: {response.message}')
        return response

    def _follow_publishers(self) -> None:
        for item in (*self._poses, *self._inputs):
            if item.follow():
                self.get_logger().info(
                    f'{item.topic}: {"reliable" if item.reliable else "best effort"}, as its '
                    'publishers are')

    def _check_inputs(self) -> None:
        """Warn once when something is missing, and again only after it had come."""
        sentence = '' if self._paused else missing(self._inputs, self._poses, _SILENCE)
        if sentence and not self._warned:
            self.get_logger().warning(
                f'{sentence}; remap the node\'s topics (depth/image:=...) or start the publishers')
        self._warned = bool(sentence)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        _init(sys.argv if arguments is None else arguments)
        _spin(Gr2tNode(), stop)
    except InputError as error:
        sys.stderr.write(f'gr2t_node: {error}\n')
        return 2
    finally:
        rclpy.try_shutdown()
    return 0


def _init(arguments: Sequence[str]) -> None:
    try:
        others = remove_ros_args(args=arguments)[1:]
        # its own handlers would end the context while the worker still publishes
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        sentence = str(error).partition(', at ')[0].replace('\n', ' ')
        raise InputError(f'the ROS arguments cannot be used: {sentence}') from error
    argparse.ArgumentParser(
        prog='gr2t_node', description='Builds a mesh from depth images and camera poses. Its '
        'options are ROS\'s: --ros-args -p name:=value --params-file FILE -r depth/image:=TOPIC',
    ).parse_args(others)


def _spin(node: Gr2tNode, stop: threading.Event) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not stop.is_set():
            executor.spin_once(timeout_sec=1.0)
    finally:
        node.worker.stop()
        node.get_logger().info(node.worker.summary())
        executor.shutdown()
        node.destroy_node()


if __name__ == '__main__':
    sys.exit(main())
