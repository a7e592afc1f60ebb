# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What another process asks of a running gr2t_node."""
from __future__ import annotations

from pathlib import Path
import struct
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from ..errors import Gr2tError

_STAMP = struct.Struct('<iI')  # seconds and nanoseconds, with which a message's header begins
_ENCAPSULATION = 4  # bytes before it


class Client:
    """
    A ROS node beside gr2t_node; a context manager. Nothing happens but in spin.

    newest_ns: stamp of the newest image in the map, nanoseconds; 0 before the first.
    snapshot: the file of the last snapshot asked for, or None.
    """

    def __init__(self) -> None:
        self.newest_ns = 0
        self.snapshot: Path | None = None
        # SIGINT stays Python's
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('gr2t_client')
        self._save: Any = self._node.create_client(Trigger, '/gr2t/save_snapshot')
        self._answer: Any = None
        profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._node.create_subscription(
            PointCloud2, '/gr2t/points', self._note, profile, raw=True)

    def spin(self, seconds: float) -> None:
        """
        Wait for something to happen.

        :raises Gr2tError: with the node's reason, if it saved no snapshot
        """
        rclpy.spin_once(self._node, timeout_sec=seconds)
        if self._answer is not None and self._answer.done():
            answer, self._answer = self._answer.result(), None
            if not answer.success:
                raise Gr2tError(f'gr2t_node saved no snapshot: {answer.message}')
            self.snapshot = Path(answer.message.partition(': ')[0])

    def save_snapshot(self) -> None:
        """
        Ask for a snapshot.

        :raises Gr2tError: if the node is not there
        """
        if not self._save.wait_for_service(timeout_sec=30.0):
            raise Gr2tError('gr2t_node does not offer save_snapshot')
        self.snapshot = None
        self._answer = self._save.call_async(Trigger.Request())

    def _note(self, message: bytes) -> None:
        seconds, nanoseconds = _STAMP.unpack_from(message, _ENCAPSULATION)
        self.newest_ns = seconds * 10 ** 9 + nanoseconds

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown()
