# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are as reliable as their publishers, and know what is missing."""
from __future__ import annotations

from collections.abc import Callable, Sequence
import time
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


class Input:
    """
    One subscription.

    It is at best effort, which every publisher can serve, until all publishers are seen to be
    reliable.

    :param node: that subscribes
    :param kind: message class
    :param topic: relative name
    :param callback: called with each message
    :param depth: messages that may wait for the executor
    :param profile: QoS that does not follow the publishers
    """

    def __init__(
        self, node: Node, kind: Any, topic: str, callback: Callable[[Any], None], depth: int,
        profile: QoSProfile | None = None,
    ) -> None:
        self._node = node
        self._kind = kind
        self._callback = callback
        self._follows = profile is None
        self._profile = profile or QoSProfile(
            depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._name = topic
        self._subscription = self._subscribe()
        self.received = 0
        self.last = time.monotonic()

    @property
    def topic(self) -> str:
        """Return the resolved name."""
        return str(self._subscription.topic_name)

    @property
    def publishers(self) -> int:
        """Return the number of publishers, compatible or not."""
        return int(self._node.count_publishers(self.topic))

    @property
    def silent(self) -> float:
        """Return the seconds since the last message, or since the start."""
        return time.monotonic() - self.last

    def follow(self) -> bool:
        """Subscribe anew where the publishers' reliability asks for it; tell whether it did."""
        if not self._follows:
            return False
        offered = [
            info.qos_profile.reliability
            for info in self._node.get_publishers_info_by_topic(self.topic)]
        if not offered:
            return False
        wanted = (
            ReliabilityPolicy.RELIABLE
            if all(item == ReliabilityPolicy.RELIABLE for item in offered)
            else ReliabilityPolicy.BEST_EFFORT)
        if wanted == self._profile.reliability:
            return False
        self._profile.reliability = wanted
        self._node.destroy_subscription(self._subscription)
        self._subscription = self._subscribe()
        return True

    @property
    def reliable(self) -> bool:
        """Return whether messages that are lost on the way are sent again."""
        return bool(self._profile.reliability == ReliabilityPolicy.RELIABLE)

    def _subscribe(self) -> Any:
        return self._node.create_subscription(
            self._kind, self._name, self._receive, self._profile)

    def _receive(self, message: Any) -> None:
        self.received += 1
        self.last = time.monotonic()
        self._callback(message)


def transforms_profile(*, static: bool) -> QoSProfile:
    """Return the QoS with which tf2 listens."""
    return QoSProfile(
        depth=100, reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if static else DurabilityPolicy.VOLATILE)


def missing(inputs: Sequence[Input], poses: Sequence[Input], seconds: float) -> str:
    """
    Return what does not arrive as one sentence; empty: all does.

    :param inputs: each of them is needed
    :param poses: of these one is enough, and it may have been long ago
    :param seconds: of silence from which on an input counts as missing
    """
    silent = [item for item in inputs if item.silent > seconds]
    if all(item.silent > seconds and not item.received for item in poses):
        silent += poses
    if not silent:
        return ''
    state = ', '.join(
        f'{item.topic} ({item.publishers} publishers, {item.received} messages)'
        for item in silent)
    return f'nothing came for {seconds:g} s on {state}'
