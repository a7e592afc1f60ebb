# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""/diagnostics: what the node does, and what to do where it does not go well."""
from __future__ import annotations

from collections.abc import Callable, Mapping
import os
from pathlib import Path
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from .intake import CameraIntake
from .worker import Worker

_PERIOD = 1.0  # s
_BUSY = 0.95  # share of its time from which on the worker counts as overloaded
_NEWEST = 100  # latencies that count


class Diagnostics:
    """
    Publishes a status of the inputs, one for each camera and one for the map, once a second.

    :param node: that publishes
    :param worker: the map
    :param missing: returns what does not arrive as lines; empty: all does
    """

    def __init__(self, node: Node, worker: Worker, missing: Callable[[], str]) -> None:
        self._node = node
        self._worker = worker
        self._missing = missing
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._before: dict[str, float] = {}
        self._drops: dict[str, dict[str, int]] = {}
        self._time = time.monotonic()
        # goes on where simulated time stands still
        node.create_timer(_PERIOD, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        now = time.monotonic()
        self._elapsed, self._time = max(now - self._time, 1e-3), now
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            self._inputs(),
            *(self._camera(name, camera) for name, camera in self._worker.intake.cameras.items()),
            self._map()]
        self._publisher.publish(message)

    def _inputs(self) -> DiagnosticStatus:
        missing = self._missing()
        return self._status(
            'inputs', DiagnosticStatus.ERROR if missing else DiagnosticStatus.OK,
            missing or 'nothing is missing', {})

    def _camera(self, name: str, camera: CameraIntake) -> DiagnosticStatus:
        dropped = dict(camera.dropped)
        before = self._drops.get(name, {})
        self._drops[name] = dropped
        new = [reason for reason, count in dropped.items() if count > before.get(reason, 0)]
        explained = camera.explanations
        level, text = DiagnosticStatus.OK, 'images come into the map'
        if worth := [reason for reason in new if reason not in ('paused', 'reset')]:
            level = DiagnosticStatus.WARN
            text = '; '.join(f'{explained.get(reason, "dropped")} [{reason}]' for reason in worth)
        elif 'paused' in new:
            text = 'paused: images are ignored'
        values = {
            'received': camera.received, 'integrated': camera.integrated,
            'received (Hz)': self._rate(f'{name} received', camera.received),
            'integrated (Hz)': self._rate(f'{name} integrated', camera.integrated),
            'waiting for the worker': camera.queued,
            'waiting for a pose': camera.assembler.waiting,
            **{f'dropped: {reason}': count for reason, count in sorted(dropped.items())}}
        return self._status(f'camera {name}'.strip(), level, text, values)

    def _map(self) -> DiagnosticStatus:
        worker = self._worker
        load = min(self._rate('busy', worker.busy), 1.0)
        values: dict[str, object] = {
            'views': worker.views, 'keyframes': worker.keyframes, 'blocks': worker.blocks,
            'waiting rays': worker.waiting_rays, 'worker load (%)': 100 * load,
            'worker on frames (s)': sum(
                worker.timings.total(stage) for stage in ('integrate', 'march', 'release'))}
        for percent in (50, 95):
            latency = worker.timings.percentile('stamp to publish', percent, _NEWEST)
            if latency is not None:
                values[f'stamp to publish p{percent} (ms)'] = 1000 * latency
        used, limit = worker.memory
        values['memory of the map (MB)'] = 1e-6 * used
        values['memory that it may have (MB)'] = 1e-6 * limit
        values['keyframes that left memory'] = worker.parts.keyframes
        values['memory (MB)'] = _resident_mb()
        values['CPU of publishing (s)'] = worker.timings.total('publish, CPU')
        values['CPU of callbacks (s)'] = time.thread_time()
        values['CPU of all (s)'] = time.process_time()
        level, text = DiagnosticStatus.OK, 'the map is up to date'
        if not worker.alive:
            level, text = DiagnosticStatus.ERROR, 'the worker has ended: restart the node'
        elif worker.failing:
            level, text = DiagnosticStatus.ERROR, f'{worker.failing}; the log says where'
        elif worker.saver.problem:
            level, text = DiagnosticStatus.WARN, worker.saver.problem
        elif load > _BUSY:
            level = DiagnosticStatus.WARN
            text = ('the worker is busy all the time: raise ray_stride or voxel_size, lower '
                    'depth_max, or lower the frame rate')
        elif worker.waiting_rays:
            text = 'older rays wait for their turn: they are marched when nothing else is to do'
        return self._status('map', level, text, values)

    def _rate(self, name: str, count: float) -> float:
        """Return the growth of a count per second since the last time."""
        before, self._before[name] = self._before.get(name, 0.0), count
        return max(count - before, 0.0) / self._elapsed

    def _status(
        self, name: str, level: bytes, text: str, values: Mapping[str, object]
    ) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=level, name=f'{self._node.get_name()}: {name}', message=text, values=[
                KeyValue(key=key, value=f'{value:.2f}' if isinstance(value, float) else f'{value}')
                for key, value in values.items()])


def _resident_mb() -> float:
    """Return the memory that the process holds now; 0 where the system does not tell."""
    statm = Path('/proc/self/statm')
    if not statm.exists():
        return 0.0
    return 1e-6 * int(statm.read_text(encoding='ascii').split()[1]) * os.sysconf('SC_PAGE_SIZE')
