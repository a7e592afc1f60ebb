# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Plays a rosbag2 recording over DDS, where `ros2 bag play` is not installed.

Messages go out as the recorded bytes. Topics whose message type is not installed are skipped.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
import signal
import sys
import time
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import get_typestore, Stores
from rosgraph_msgs.msg import Clock
from tqdm import tqdm

from ..errors import Gr2tError, InputError

_IMAGES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
_DEPTH = 100  # messages kept for a reader that is slow
_RELIABLE_AFTER = 2.0  # s that a best-effort subscriber has for becoming a reliable one
_POLL = 0.02  # s


def main(arguments: Sequence[str] | None = None) -> int:
    """Play what the command line says; return the exit code."""
    parser = argparse.ArgumentParser(
        prog='bag_player', description='Plays a rosbag2 recording over DDS.')
    parser.add_argument('bag', type=Path, help='folder, or bare .mcap or .db3 file')
    parser.add_argument(
        '--rate', type=float, default=1.0, help='times the recorded speed (default: 1)')
    parser.add_argument(
        '--wait', type=float, default=10.0, metavar='S',
        help='wait at most so many seconds for a subscriber of an image topic (default: 10)')
    parser.add_argument(
        '--clock', action='store_true', help='also publish /clock, for nodes with use_sim_time')
    parser.add_argument('--loop', action='store_true', help='start again at the end')
    options = parser.parse_args(arguments)
    if not options.rate > 0:
        parser.error(f'--rate must be above 0, not {options.rate:g}')
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        play(options.bag, options.rate, options.wait, clock=options.clock, loop=options.loop)
    except KeyboardInterrupt:
        return 130
    except Gr2tError as error:
        sys.stderr.write(f'bag_player: {error}\n')
        return 2 if isinstance(error, InputError) else 1
    return 0


def play(
    bag: Path, rate: float = 1.0, wait: float = 10.0, *, clock: bool = False, loop: bool = False,
) -> int:
    """
    Play a recording to its end.

    :param rate: times the recorded speed
    :param wait: seconds for a subscriber of an image topic to appear
    :param clock: publish /clock too
    :param loop: again and again
    :return: the number of messages played
    :raises InputError: if it is no rosbag2 recording or none of its message types is installed
    """
    if not bag.exists():
        raise InputError(f'{bag}: no such file or folder')
    try:
        # sqlite3 recordings from before Iron come without definitions
        reader = AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # damaged files make the library raise anything
        raise InputError(f'cannot read {bag}: {error}') from error
    try:
        if not reader.is2:
            raise InputError(
                f'{bag} is a ROS 1 recording: `gr2t replay` reads it, the player does not')
        # SIGINT must stay Python's: rclpy's handler would end the context under the publishers
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = Node('bag_player')
            publishers = _publishers(node, reader.connections)
            if not publishers:
                raise InputError(
                    'none of the message types in the recording is installed: source ROS 2')
            tick = _clock(node) if clock else None
            _wait_for_subscriber(node, publishers.values(), wait)
            played = _play(reader, publishers, rate, tick)
            while loop:
                played += _play(reader, publishers, rate, tick)
            for publisher in publishers.values():
                publisher.wait_for_all_acked(Duration(seconds=10))
            return played
        finally:
            rclpy.try_shutdown()
    finally:
        reader.close()


def _clock(node: Node) -> Callable[[int], None]:
    """Return what publishes a time on /clock, nanoseconds."""
    publisher = node.create_publisher(Clock, '/clock', QoSProfile(depth=10))
    return lambda now_ns: publisher.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))


def _play(
    reader: AnyReader, publishers: Mapping[str, Publisher], rate: float,
    tick: Callable[[int], None] | None,
) -> int:
    connections = [item for item in reader.connections if item.topic in publishers]
    duration = (reader.end_time - reader.start_time) / 1e9 / rate
    played = 0
    started = time.monotonic()
    with tqdm(
            total=sum(item.msgcount for item in connections), unit=' messages',
            desc=f'{duration:.1f} s', dynamic_ncols=True, disable=None) as progress:
        for connection, log_time, data in reader.messages(connections):
            due = started + (log_time - reader.start_time) / 1e9 / rate
            time.sleep(max(0.0, due - time.monotonic()))
            if tick:
                tick(log_time)
            publishers[connection.topic].publish(bytes(data))
            played += 1
            progress.update()
    tqdm.write(f'played {played} messages in {time.monotonic() - started:.1f} s', sys.stderr)
    return played


def _publishers(node: Node, connections: Iterable[Connection]) -> dict[str, Publisher]:
    """Return a publisher for each topic whose type is installed; say which are not."""
    publishers: dict[str, Publisher] = {}
    for connection in connections:
        if connection.topic in publishers:
            continue
        kind = _message_type(connection.msgtype)
        if kind is None:
            tqdm.write(
                f'skipped {connection.topic}: {connection.msgtype} is not installed', sys.stderr)
            continue
        durability = (
            DurabilityPolicy.TRANSIENT_LOCAL if connection.topic == '/tf_static'
            else DurabilityPolicy.VOLATILE)
        publishers[connection.topic] = node.create_publisher(
            kind, connection.topic, QoSProfile(
                depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=durability))
    return publishers


def _message_type(name: str) -> Any:
    """Return the class of `package/msg/Name`, or None where it is not installed."""
    package, _, kind = name.partition('/msg/')
    try:
        return getattr(import_module(f'{package}.msg'), kind, None)
    except ImportError:
        return None


def _wait_for_subscriber(node: Node, publishers: Iterable[Publisher], seconds: float) -> None:
    """
    Wait until someone subscribes to images, reliably if possible; in vain at most so long.

    A node may subscribe at best effort first and change once it sees that the publisher is
    reliable; and its subscription to one topic may be found before that to another. A recording
    that starts before all are found loses its first images, or their transforms.
    """
    publishers = list(publishers)
    images = [item for item in publishers if item.msg_type in map(_message_type, _IMAGES)]
    deadline = time.monotonic() + seconds
    matched = None
    while time.monotonic() < deadline:
        heard = [item for item in images or publishers if item.get_subscription_count()]
        if heard:
            matched = matched or time.monotonic()
            reliable = any(
                info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
                for item in heard
                for info in node.get_subscriptions_info_by_topic(item.topic_name))
            unmatched = [
                item for item in publishers
                if node.count_subscribers(item.topic_name) > item.get_subscription_count()]
            if (reliable and not unmatched) or time.monotonic() - matched > _RELIABLE_AFTER:
                return
        time.sleep(_POLL)
    tqdm.write(
        f'nobody subscribes to {", ".join(item.topic_name for item in images or publishers)} '
        f'after {seconds:g} s; playing nevertheless', sys.stderr)


if __name__ == '__main__':
    sys.exit(main())
