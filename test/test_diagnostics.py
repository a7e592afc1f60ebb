# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The advice in /diagnostics."""
import pytest

from gr2t_ros.settings import Settings

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from ros_for_tests import Isolation, Observer
from sensor_msgs.msg import Image

from gr2t_ros.ros.diagnostics import Diagnostics
from gr2t_ros.ros.publishers import MapPublishers
from gr2t_ros.ros.worker import Worker


def test_a_full_queue_comes_with_its_advice() -> None:
    observer = Observer(Isolation())
    settings = Settings(queue_size=2)
    # it never starts, so its images wait
    worker = Worker(
        settings, MapPublishers(observer.node, settings), observer.node.get_logger(),
        rectified={'': True})
    Diagnostics(observer.node, worker, lambda: '')
    states = observer.collect(DiagnosticArray, '/diagnostics', QoSProfile(depth=10))

    def camera() -> DiagnosticStatus | None:
        """Return the newest status of the camera after images were lost."""
        worker.intake.on_depth(Image())
        status = deserialize_message(states[-1], DiagnosticArray).status[1] if states else None
        return status if status and status.level == DiagnosticStatus.WARN else None

    status = observer.spin_until(camera, 'a status')
    assert status.name == 'observer: camera'
    assert status.message.startswith('images come faster than they can be integrated')
    assert status.message.endswith('[queue_full]')
    observer.close()
