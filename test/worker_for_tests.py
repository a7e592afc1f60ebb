# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A worker without ROS, fed with a recording's messages."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
import time
from typing import Any

import numpy as np
from scenes_for_tests import looking_at_origin, plane_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.io.bags import Bag
from gr2t_ros.ros.worker import Worker
from gr2t_ros.settings import Settings
from gr2t_ros.tools.recorder import CAMERA_INFO_TOPIC, DEPTH_TOPIC, record

LIMIT = 60.0  # s
COUNT = 5


class Outputs:
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.changed: set[int] = set()
        self.published: list[tuple[str, int, int]] = []
        self.cleared: list[str] = []

    def change(self, keyframes: Any) -> None:
        self.changed.update(keyframes)

    def publish(
        self, reconstruction: Reconstruction, frame_id: str, stamp_ns: int, views: int
    ) -> bool:
        self.published.append((frame_id, stamp_ns, views))
        return True

    def clear(self, frame_id: str) -> None:
        self.cleared.append(frame_id)

    def update(self, settings: Settings) -> None:
        self.settings = settings


class Log:
    """Keeps lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.info = self.warning = self.error = self.lines.append


class Rig:
    """A worker with its outputs, and the messages of a recording."""

    def __init__(self, bag: Path, settings: Settings) -> None:
        self.outputs = Outputs()
        self.log = Log()
        self.worker = Worker(settings, self.outputs, self.log, rectified={'': True})
        with Bag([bag]) as opened:
            self.messages = [
                (topic, message) for topic, message, _ in opened.messages(opened.topics)]

    @property
    def integrated(self) -> int:
        return self.worker.intake.cameras[''].integrated

    @property
    def dropped(self) -> dict[str, int]:
        return self.worker.intake.cameras[''].dropped

    def feed(self, *topics: str) -> None:
        """Hand over all messages of these topics; of all where none is named."""
        hands: dict[str, Callable[[Any], None]] = {
            DEPTH_TOPIC: self.worker.intake.on_depth,
            CAMERA_INFO_TOPIC: self.worker.intake.on_camera_info,
            '/tf': lambda message: self.worker.intake.on_transforms(message, static=False),
            '/tf_static': lambda message: self.worker.intake.on_transforms(message, static=True)}
        for topic, message in self.messages:
            if topic in (topics or hands):
                hands[topic](message)

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, f'waited in vain for {what}: {self.log.lines}'
            time.sleep(0.005)

    def said(self, text: str) -> int:
        """Return how often a line with such a text was logged."""
        return sum(text in line for line in self.log.lines)


def record_plane(path: Path) -> Path:
    """Write a recording of a plane."""
    camera = Camera(48, 36, 45.0, 45.0, 23.5, 17.5)
    record(path, [
        replace(
            plane_view(
                camera, looking_at_origin((np.cos(i / 3), np.sin(i / 3), 2), 0.6), (0, 0, 1), 0.0),
            stamp_ns=1_700_000_000_000_000_000 + i * 100_000_000)
        for i in range(COUNT)])
    return path


@contextmanager
def workers(bag: Path, snapshots: Path) -> Iterator[Callable[..., Rig]]:
    """Yield a function that makes a running worker with some parameters."""
    rigs = []

    def rig(start: bool = True, bag: Path = bag, **values: object) -> Rig:
        settings = Settings().updated({
            'publish_rate': 60.0, 'snapshot_directory': str(snapshots), **values})
        rigs.append(Rig(bag, settings))
        if start:
            rigs[-1].worker.start()
        return rigs[-1]

    yield rig
    for item in rigs:
        if item.worker.alive:
            item.worker.stop()
