# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that follow their publishers' quality of service, and know what is missing."""
from __future__ import annotations

from collections.abc import Callable, Sequence
import difflib
import time
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

try:
    from rclpy.event_handler import SubscriptionEventCallbacks
except ImportError:  # humble
    from rclpy.qos_event import SubscriptionEventCallbacks

_CANDIDATES = 4  # other topics that a warning names


class Input:
    """
    One subscription.

    It is at best effort, which every publisher can serve, until all publishers are seen to be
    reliable.

    topic: the resolved name. received: messages so far.

    :param node: that subscribes
    :param kind: message class
    :param topic: name
    :param callback: called with each message
    :param depth: messages that may wait for the executor
    :param reliability: auto, or one that does not follow the publishers: reliable, best_effort
    :param once: whether one message may be all; then what was sent before counts, where all
        publishers keep it
    :param profile: QoS that follows nothing
    """

    def __init__(
        self, node: Node, kind: Any, topic: str, callback: Callable[[Any], None], depth: int, *,
        reliability: str = 'auto', once: bool = False, profile: QoSProfile | None = None,
    ) -> None:
        self.name = topic
        self.once = once
        self._node = node
        self._kind = kind
        self._callback = callback
        self._follows = profile is None
        self._fixed = reliability != 'auto'
        self._profile = profile or QoSProfile(
            depth=depth, reliability=(
                ReliabilityPolicy.RELIABLE if reliability == 'reliable'
                else ReliabilityPolicy.BEST_EFFORT))
        self._mismatched = False
        self._complained: set[str] = set()
        self._subscription = self._subscribe()
        self.topic = str(self._subscription.topic_name)
        self.received = 0
        self.last = time.monotonic()

    @property
    def type_name(self) -> str:
        """Return the message's type, as package/msg/Name."""
        return f'{self._kind.__module__.partition(".")[0]}/msg/{self._kind.__name__}'

    @property
    def publishers(self) -> list[Any]:
        """Return rclpy's TopicEndpointInfo of all publishers of the name, of any type."""
        return list(self._node.get_publishers_info_by_topic(self.topic))

    @property
    def requested(self) -> str:
        """Return the QoS that is asked for, as text."""
        return qos_text(self._profile)

    @property
    def silent(self) -> float:
        """Return the seconds since the last message, or since the start."""
        return time.monotonic() - self.last

    def missing(self, seconds: float) -> bool:
        """Tell whether nothing came for so long; where once is enough, since the start."""
        return self.silent > seconds and not (self.once and self.received)

    def follow(self) -> bool:
        """Subscribe anew where the publishers' QoS asks for it; tell whether it did."""
        if not self._follows:
            return False
        offered = [
            info.qos_profile for info in self.publishers if info.topic_type == self.type_name]
        if not offered:
            return False
        wanted = QoSProfile(depth=self._profile.depth, reliability=self._profile.reliability)
        if not self._fixed:
            wanted.reliability = (
                ReliabilityPolicy.RELIABLE
                if all(item.reliability == ReliabilityPolicy.RELIABLE for item in offered)
                else ReliabilityPolicy.BEST_EFFORT)
        if self.once and all(
                item.durability == DurabilityPolicy.TRANSIENT_LOCAL for item in offered):
            wanted.durability = DurabilityPolicy.TRANSIENT_LOCAL
        if qos_text(wanted) == self.requested:
            return False
        self._profile = wanted
        self._node.destroy_subscription(self._subscription)
        self._mismatched = False
        self._subscription = self._subscribe()
        return True

    def mismatch(self) -> str:
        """Return which publishers cannot be heard, as a sentence; each is named once."""
        if not self._mismatched:
            return ''
        deaf = {
            f'{node_name(info)} offers {qos_text(info.qos_profile)}' for info in self.publishers
            if 'UNKNOWN' not in info.node_name  # it is known a moment later
            and not _compatible(info.qos_profile, self._profile)} - self._complained
        if not deaf:
            return ''
        self._complained |= deaf
        way = ('set input_qos to auto or best_effort' if self._fixed
               else 'change the publisher\'s QoS')
        return (f'{self.topic}: {", ".join(sorted(deaf))}, but {self.requested} is asked for: '
                f'none of its messages can come; {way}')

    def state(self) -> str:
        """Return who publishes it and how, as text."""
        described = {
            f'{node_name(info)} ({qos_text(info.qos_profile)})' for info in self.publishers
            if info.topic_type == self.type_name}
        others = {info.topic_type for info in self.publishers} - {self.type_name}
        if described:
            return (f'published by {", ".join(sorted(described))}, asked for {self.requested}; '
                    f'{self.received} messages so far')
        if others:
            return f'published as {", ".join(sorted(others))} only'
        return 'nobody publishes it'

    def candidates(self) -> list[str]:
        """Return topics of its type that other nodes publish, the most similar first."""
        own = {name for name, _ in self._node.get_publisher_names_and_types_by_node(
            self._node.get_name(), self._node.get_namespace())}
        names = [
            name for name, types in self._node.get_topic_names_and_types()
            if self.type_name in types and name not in {self.topic, *own}
            and self._node.count_publishers(name)]
        return sorted(names, key=lambda name: -difflib.SequenceMatcher(
            None, self.topic, name, autojunk=False).ratio())[:_CANDIDATES]

    def _subscribe(self) -> Any:
        return self._node.create_subscription(
            self._kind, self.name, self._receive, self._profile,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._note_mismatch))

    def _note_mismatch(self, _: Any) -> None:
        self._mismatched = True

    def _receive(self, message: Any) -> None:
        self.received += 1
        self.last = time.monotonic()
        self._callback(message)


def transforms_profile(*, static: bool) -> QoSProfile:
    """Return the QoS with which tf2 listens."""
    return QoSProfile(
        depth=100, reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if static else DurabilityPolicy.VOLATILE)


def qos_text(profile: QoSProfile) -> str:
    """Return what matters of a QoS profile, as text."""
    return ', '.join(
        policy.name.lower().replace('_', ' ')
        for policy in (profile.reliability, profile.durability))


def node_name(info: Any) -> str:
    """Return the full name of a publisher's node."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def silence(inputs: Sequence[Input], poses: Sequence[Input], seconds: float, frames: str) -> str:
    """
    Return what does not arrive, why, and what to do, as lines; empty: all does.

    :param inputs: each of them is needed
    :param poses: of these one message is enough
    :param seconds: of silence from which on an input counts as missing
    :param frames: known to tf
    """
    missing = [item for item in inputs if item.missing(seconds)]
    if poses and all(not item.received and item.missing(seconds) for item in poses):
        missing += poses
    if not missing:
        return ''
    lines = [f'nothing came for {seconds:g} s on {", ".join(item.topic for item in missing)}']
    for item in missing:
        lines.append(f'  {item.topic} ({item.type_name}): {item.state()}')
        others = [] if item in poses else item.candidates()
        if others:
            lines.append(
                f'    topics of this type there are: {", ".join(others)}; to take the first: '
                f'-r {item.name}:={others[0]}')
    lines.append(f'  frames that tf knows: {frames or "none"}')
    if any(not item.publishers for item in missing):
        lines.append(
            '  start what publishes them, or remap the node\'s topics to it; ROS_DOMAIN_ID must '
            'be the same on both sides')
    return '\n'.join(lines)


def _compatible(offered: QoSProfile, requested: QoSProfile) -> bool:
    """Tell whether messages can come, by what nodes differ in."""
    return not (
        (requested.reliability == ReliabilityPolicy.RELIABLE
         and offered.reliability == ReliabilityPolicy.BEST_EFFORT)
        or (requested.durability == DurabilityPolicy.TRANSIENT_LOCAL
            and offered.durability == DurabilityPolicy.VOLATILE))
