# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What gr2t_node makes of a live stream, in a process of its own, over DDS.

    python benchmarks/node.py [--data DIR]

Plays kitchen_30hz at its own speed, stamped with the time of now, while someone listens to ~/mesh;
then publishes markers of 100 000 triangles. Writes benchmarks/results/node.json.
"""
from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from common import found, KITCHEN_30HZ, machine, table
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.io.cdr import marker_array
from gr2t_ros.ros.isolation import isolated
from gr2t_ros.ros.outputs import outputs_profile, triangles

_PROJECT = Path(__file__).resolve().parents[1]
_KINDS = {'Image': Image, 'CameraInfo': CameraInfo, 'TFMessage': TFMessage}
_VARIANTS = {
    'defaults': (),
    'voxels of 1 cm': (
        '-p', 'voxel_size:=0.01', '-p', 'depth_bandwidth:=0.01', '-p', 'depth_max:=3.5')}
_LAST = 4.0  # s after the last image for what is still on its way
_TRIANGLES, _REPEATS = 100_000, 20


def measure_stream(bag: Path, name: str, arguments: tuple[str, ...]) -> dict[str, Any]:
    """Play a recording into a node; return what its diagnostics say at the end."""
    with AnyReader([bag]) as reader:
        messages = [
            (item.topic, _KINDS[item.msgtype.rpartition('/')[2]], log_ns, bytes(data))
            for item, log_ns, data in reader.messages()
            if item.msgtype.rpartition('/')[2] in _KINDS]
    node = rclpy.create_node('benchmark')
    states: list[bytes] = []
    node.create_subscription(DiagnosticArray, '/diagnostics', states.append, 10, raw=True)
    node.create_subscription(
        MarkerArray, '/gr2t/mesh', lambda _: None, outputs_profile(5), raw=True)
    publishers = {
        topic: node.create_publisher(
            kind, topic, outputs_profile(100) if topic == '/tf_static' else QoSProfile(depth=100))
        for topic, kind in {topic: kind for topic, kind, _, _ in messages}.items()}
    depth = next(topic for topic, kind, _, _ in messages if kind is Image)
    info = next(topic for topic, kind, _, _ in messages if kind is CameraInfo)
    with tempfile.TemporaryFile() as log, subprocess.Popen([
            sys.executable, '-m', 'gr2t_ros.ros.node', '--ros-args', '-r',
            f'depth/image:={depth}', '-r', f'depth/camera_info:={info}', *arguments],
            stdout=log, stderr=log) as process:
        try:
            while not all(item.get_subscription_count() for item in publishers.values()):
                rclpy.spin_once(node, timeout_sec=0.1)
            _spin(node, 3.0)  # its subscriptions become reliable
            while not states:
                _spin(node, 0.1)
            before = _values(states)
            _play(node, publishers, messages)
            _spin(node, _LAST)
        finally:
            process.send_signal(signal.SIGINT)
    node.destroy_node()
    values = _values(states)
    seconds = (messages[-1][2] - messages[0][2]) / 1e9
    cpu = {name: values[f'CPU of {name} (s)'] - before[f'CPU of {name} (s)']
           for name in ('publishing', 'callbacks', 'all')}
    return {
        'node': name, 'sent': sum(kind is Image for _, kind, _, _ in messages), 'seconds': seconds,
        **{key: int(values[key]) for key in ('received', 'integrated')},
        'dropped': ' '.join(
            f'{key[9:]} {value:.0f}' for key, value in values.items()
            if key.startswith('dropped')) or '-',
        'p50 ms': values.get('stamp to publish p50 (ms)'),
        'p95 ms': values.get('stamp to publish p95 (ms)'),
        **{f'{name} CPU s': value for name, value in cpu.items()},
        'glue %': 100 * (cpu['publishing'] + cpu['callbacks']) / (cpu['all'] - cpu['callbacks']),
        'memory MB': values['memory (MB)']}


def _values(states: list[bytes]) -> dict[str, float]:
    """Return the numbers of the newest diagnostics."""
    status = deserialize_message(states[-1], DiagnosticArray).status
    return {item.key: float(item.value) for one in status for item in one.values}


def _play(node: Node, publishers: dict[str, Any], messages: list[Any]) -> None:
    """Publish a recording at its speed, with the stamps of now."""
    began_ns, first_ns = time.time_ns(), messages[0][2]
    for topic, kind, log_ns, data in messages:
        message = deserialize_message(data, kind) if kind is TFMessage else None
        while (ahead := (log_ns - first_ns) - (time.time_ns() - began_ns)) > 0:
            rclpy.spin_once(node, timeout_sec=min(ahead * 1e-9, 0.01))
        shift = began_ns - first_ns
        if message is None:
            seconds, nanoseconds = np.frombuffer(data, '<u4', 2, 4).tolist()
            stamp = divmod(seconds * 10 ** 9 + nanoseconds + shift, 10 ** 9)
            data = data[:4] + np.array(stamp, '<u4').tobytes() + data[12:]
        else:
            for item in message.transforms:
                stamp_ns = Time.from_msg(item.header.stamp).nanoseconds + shift
                item.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
            data = serialize_message(message)
        publishers[topic].publish(data)


def _spin(node: Node, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)


def measure_markers() -> list[dict[str, Any]]:
    """Return the milliseconds of publishing many triangles, without and with a subscriber."""
    side = 225
    rng = np.random.default_rng(0)
    corners = rng.integers(0, side * side, (_TRIANGLES, 3)).astype(np.int32)
    mesh = ViewMesh.__new__(ViewMesh)
    for field, value in (
            ('vertices', rng.normal(size=(side * side, 3))), ('faces', corners),
            ('vertex_likelihood', rng.random(side * side, np.float32))):
        object.__setattr__(mesh, field, value)
    node = rclpy.create_node('markers')
    publisher = node.create_publisher(MarkerArray, 'markers', outputs_profile(1))
    rows = []
    for listener in (False, True):
        if listener:
            other = rclpy.create_node('viewer')
            other.create_subscription(
                MarkerArray, 'markers', lambda _: None, outputs_profile(1), raw=True)
            while not publisher.get_subscription_count():
                _spin(node, 0.1)
        times = []
        for _ in range(_REPEATS):
            steps = [time.perf_counter()]
            marker = triangles(0, mesh, 1.0, 'turbo', shading=True)
            steps.append(time.perf_counter())
            data = marker_array('map', 'mesh', [marker])
            steps.append(time.perf_counter())
            publisher.publish(data)
            steps.append(time.perf_counter())
            times.append(np.diff(steps))
        colour, write, publish = 1e3 * np.median(times, axis=0)
        rows.append({
            'listens': str(listener), 'colour and shade ms': float(colour),
            'write ms': float(write), 'publish ms': float(publish),
            'all ms': float(colour + write + publish)})
    return rows


def main() -> None:
    """Measure both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        '--data', type=Path, default=_PROJECT.parent / 'shared' / 'data', metavar='DIR',
        help='holds bags/kitchen_30hz')
    arguments = parser.parse_args()
    os.environ.update(isolated(os.environ))
    about = machine()
    rclpy.init(args=[])
    bag = found(arguments.data, KITCHEN_30HZ)
    streams = [measure_stream(bag, *item) for item in _VARIANTS.items()] if bag else []
    table('kitchen_30hz; glue: callbacks and publishing, against all but callbacks', streams)
    markers = measure_markers()
    table('100 000 triangles, medians', markers)
    rclpy.try_shutdown()
    results = _PROJECT / 'benchmarks' / 'results'
    results.mkdir(exist_ok=True)
    with open(results / 'node.json', 'w', encoding='utf-8') as file:
        json.dump({'machine': about, 'streams': streams, 'markers': markers}, file, indent=1)


if __name__ == '__main__':
    main()
