# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The real node in its own process, and an observer of what it says over DDS."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from scenes_for_tests import looking_at_origin, plane_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.view import View
from gr2t_ros.ros.isolation import isolated
from gr2t_ros.tools.recorder import CAMERA_INFO_TOPIC, DEPTH_TOPIC

PROJECT = Path(__file__).resolve().parents[1]
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
LIMIT = 60.0  # s: for what takes a second on a machine that does nothing else
REMAP = ('-r', f'depth/image:={DEPTH_TOPIC}', '-r', f'depth/camera_info:={CAMERA_INFO_TOPIC}')


def plane_views(count: int) -> list[View]:
    """Return small views of the world's plane z = 0 from a camera that moves round it."""
    camera = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
    return [
        replace(
            plane_view(
                camera, looking_at_origin((np.cos(i / 3) / 2, np.sin(i / 3) / 2, 1), 0.6),
                (0, 0, 1), 0.0),
            stamp_ns=START_NS + i * PERIOD_NS)
        for i in range(count)]


def wait_until(condition: Callable[[], Any], what: str, limit: float = LIMIT) -> Any:
    """Return the condition's value once it is true; fail after so many seconds."""
    end = time.monotonic() + limit
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f'waited {limit:g} s in vain for {what}')
        time.sleep(0.01)
    return value


class Isolation:
    """A ROS domain of its own."""

    def __init__(self) -> None:
        self.environment = isolated(os.environ)
        self.environment['PYTHONPATH'] = os.pathsep.join(
            [str(PROJECT), os.environ.get('PYTHONPATH', '')])
        self.domain = int(self.environment['ROS_DOMAIN_ID'])

    def run(self, module: str, *arguments: Any, **options: Any) -> subprocess.Popen[str]:
        """Start a module of the package."""
        return subprocess.Popen(
            [sys.executable, '-m', module, *map(str, arguments)], env=self.environment,
            text=True, **options)

    def play(self, bag: Path, *arguments: Any) -> None:
        """Play a recording to its end."""
        player = self.run(
            'gr2t_ros.ros.bag_player', bag, *arguments, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT)
        output, _ = player.communicate(timeout=LIMIT)
        assert player.returncode == 0, output


class NodeProcess:
    """
    gr2t_node, running.

    :param isolation: its domain
    :param folder: of its log and its snapshots
    :param arguments: ROS arguments
    :param ready: wait until it has subscribed
    :param remap: other ROS arguments
    """

    def __init__(
        self, isolation: Isolation, folder: Path, *arguments: str, ready: bool = True,
        remap: Sequence[str] = REMAP,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.snapshots = folder / 'snapshots'
        self._path = folder / 'node.log'
        with open(self._path, 'w') as log:
            self._process = isolation.run(
                'gr2t_ros.ros.node', '--ros-args', *remap, '-p',
                f'snapshot_directory:={self.snapshots}', *arguments, stdout=log,
                stderr=subprocess.STDOUT)
        if ready:
            # it may have to compile its kernels, beside other work
            self.wait_for('subscribed to', 5 * LIMIT)

    @property
    def log(self) -> str:
        """Return all that it has printed."""
        return self._path.read_text()

    def wait_for(self, text: str, limit: float = LIMIT) -> str:
        """Return its log once there is such a text in it."""
        wait_until(
            lambda: text in self.log or self._process.poll() is not None,
            f'{text!r} in the log:\n{self.log}', limit)
        assert text in self.log, self.log
        return self.log

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        """Send it a signal; return its exit code."""
        if self._process.poll() is None:
            self._process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """Return its exit code when it has ended."""
        return self._process.wait(timeout=LIMIT)

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()


class Observer:
    """A node in this process that subscribes and calls services."""

    def __init__(self, isolation: Isolation) -> None:
        os.environ.update({
            name: value for name, value in isolation.environment.items()
            if name.startswith(('ROS_AUTO', 'FASTDDS', 'FASTRTPS'))})
        self._context = rclpy.Context()
        self._context.init(domain_id=isolation.domain)
        self.node = rclpy.create_node('observer', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def spin_until(self, condition: Callable[[], Any], what: str, limit: float = LIMIT) -> Any:
        """Serve callbacks until a condition is true; return its value."""
        end = time.monotonic() + limit
        while not (value := condition()):
            if time.monotonic() > end:
                raise AssertionError(f'waited {limit:g} s in vain for {what}')
            self._executor.spin_once(timeout_sec=0.05)
        return value

    def collect(self, kind: Any, topic: str, profile: Any) -> list[bytes]:
        """Return a list that the messages of a topic are appended to as they come, as bytes."""
        messages: list[bytes] = []
        self.node.create_subscription(kind, topic, messages.append, profile, raw=True)
        return messages

    def call(self, kind: Any, name: str, **fields: Any) -> Any:
        """Call a service of the node; return its answer."""
        client = self.node.create_client(kind, f'/gr2t/{name}')
        self.spin_until(client.service_is_ready, f'the service {name}')
        answer = client.call_async(kind.Request(**fields))
        self.spin_until(answer.done, f'the answer of {name}')
        self.node.destroy_client(client)
        return answer.result()

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
