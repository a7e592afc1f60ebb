# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node: subscriptions, parameters, services and timers around the worker."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields
import signal
import sys
import threading
import time

from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ..core.compiled import cache_notice
from ..core.warm_up import warm_up
from ..errors import InputError
from .diagnostics import Diagnostics
from .parameters import changed, read_parameters, table, typed
from .publishers import MapPublishers
from .services import Services
from .subscriptions import check_source, rectified, Subscriptions
from .timings import Timings
from .worker import Worker

NAME = 'gr2t'
_LAST_ANSWERS = 1.0  # s at the end for telling those who wait for a snapshot


class Gr2tNode(Node):
    """
    Builds a map from the topics depth/image, depth/camera_info and tf or pose.

    :raises InputError: if a parameter cannot be used
    """

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        self.settings = read_parameters(self)
        check_source(self.settings)
        self._log_settings()
        self._compile()
        timings = Timings()
        self.worker = Worker(
            self.settings, MapPublishers(self, self.settings, timings), self.get_logger(),
            rectified=rectified(self, self.settings), timings=timings,
            now_ns=lambda: self.get_clock().now().nanoseconds)
        self.inputs = Subscriptions(self, self.settings, self.worker.intake)
        self.offered = Services(self, self.worker, self._pause)
        self.diagnostics = Diagnostics(self, self.worker, self.inputs.missing)
        self.worker.start()

    def set_parameters_atomically(
        self, parameter_list: Sequence[Parameter]
    ) -> SetParametersResult:
        """Change parameters of the running node; a refusal says why in our table's words."""
        try:
            settings = changed(self.settings, parameter_list)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(typed(settings, parameter_list))
        if result.successful and settings != self.settings:
            for item in fields(settings):
                new = getattr(settings, item.name)
                if new != getattr(self.settings, item.name):
                    self.get_logger().info(f'parameter {item.name} is now {new!r}')
            self.settings = settings
            self.worker.update(settings)
        return result

    def _log_settings(self) -> None:
        self.get_logger().info(f'settings (* differs from the default):\n{table(self.settings)}')

    def _compile(self) -> None:
        """Compile before subscribing: whoever waits for a subscriber finds one that is ready."""
        self.get_logger().info('compiling the kernels, or loading them from the cache')
        if notice := cache_notice():
            self.get_logger().warning(notice)
        self.get_logger().info(f'kernels are ready after {warm_up(self.settings):.1f} s')

    def _pause(self, paused: bool) -> None:
        self.inputs.paused = paused
        self.worker.intake.pause(paused)


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
        end = time.monotonic() + _LAST_ANSWERS
        while node.offered.unanswered and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
        node.get_logger().info(node.worker.summary())
        executor.shutdown()
        node.destroy_node()


if __name__ == '__main__':
    sys.exit(main())
