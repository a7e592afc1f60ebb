# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Messages on their way to views: a bounded queue, and an assembler for each camera."""
from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import threading
import time
from typing import Any

from ..core.view import View
from ..errors import FrameError
from ..io import messages
from ..io.frames import FrameAssembler
from ..io.world import World
from ..settings import Settings
from .timings import Timings

MAX_MESSAGES = 20_000  # other than images that may wait: 20 s of a 1 kHz tf
_QUEUE_FULL = (
    'images come faster than they can be integrated, and the oldest are left out: raise '
    'ray_stride or lower the frame rate')


@dataclass
class CameraIntake:
    """
    One camera's images; the numbers may be read by any thread.

    received: images that came. integrated: those in the map. queued: those that wait for the
    worker. lost: those that were dropped before or after the assembler, by reason. refused:
    sentences on these.
    """

    assembler: FrameAssembler
    received: int = 0
    integrated: int = 0
    queued: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    refused: dict[str, str] = field(default_factory=dict)

    @property
    def dropped(self) -> Counter[str]:
        """Return the number of images that were not used, by reason."""
        return Counter(dict(self.lost)) + Counter(dict(self.assembler.dropped))

    @property
    def explanations(self) -> dict[str, str]:
        """Return a sentence for each reason for which something was left out."""
        explanations = {**self.refused, **self.assembler.explanations}
        if self.lost['queue_full']:
            explanations['queue_full'] = _QUEUE_FULL
        return explanations

    @property
    def waiting(self) -> int:
        """Return the number of images of which it is not known yet what becomes of them."""
        return self.received - self.integrated - self.dropped.total()


class Intake:
    """
    Takes messages from any thread, and makes views of them, in their order, in the worker's.

    Images wait in a bounded queue: when a camera's are more than queue_size its oldest is dropped,
    and counted.

    cameras: by name; one without a name where there is only one. world: where their views are.

    :param settings: parameters
    :param rectified: for each camera's name, whether its depth images are
    :param notify: called when there is something to do
    :param timings: learns how long images wait
    :param on_time_jump: called by take when the clock went back, with the stamp it went back to
    """

    def __init__(
        self, settings: Settings, rectified: Mapping[str, bool], notify: Callable[[], None],
        timings: Timings,
        on_time_jump: Callable[[int], None],
    ) -> None:
        self.world = World(settings)
        self.cameras = {
            name: CameraIntake(FrameAssembler(
                settings, self.world, name=name, rectified=flag, max_waiting=settings.queue_size))
            for name, flag in rectified.items()}
        self._queue_size = settings.queue_size
        self._notify = notify
        self._timings = timings
        self._on_time_jump = on_time_jump
        self._jumps = 0  # that were told
        self._lock = threading.Lock()
        # what to do with a message, and the camera if it is an image
        self._messages: deque[tuple[Callable[[], None], CameraIntake | None]] = deque()
        self._paused = False
        self._told: set[tuple[str, str]] = set()

    def on_depth(self, message: Any, camera: str = '') -> None:
        """Enqueue a depth image."""
        received_ns = time.monotonic_ns()
        into = self.cameras[camera]
        with self._lock:
            into.received += 1
            try:
                messages.check_size(message)
            except FrameError as error:
                into.lost[error.reason] += 1
                into.refused.setdefault(error.reason, str(error))
                self._notify()
                return
            if self._paused:
                into.lost['paused'] += 1
                return
            if into.queued == self._queue_size:
                self._remove(lambda of: of is into)
                into.lost['queue_full'] += 1
            else:
                into.queued += 1
            self._messages.append((lambda: self._feed(into, message, received_ns), into))
        self._notify()

    def on_camera_info(self, message: Any, camera: str = '') -> None:
        """Enqueue a camera_info."""
        assembler = self.cameras[camera].assembler
        self._enqueue(lambda: assembler.on_camera_info(message))

    def on_pose(self, message: Any, camera: str = '') -> None:
        """Enqueue a pose."""
        assembler = self.cameras[camera].assembler
        self._enqueue(lambda: assembler.on_pose(message))

    def on_transforms(self, message: Any, *, static: bool) -> None:
        """Enqueue transforms."""
        self._enqueue(lambda: self.world.on_transforms(message, static))

    def on_mask(self, message: Any, camera: str = '') -> None:
        """Enqueue a mask."""
        assembler = self.cameras[camera].assembler
        try:
            messages.check_size(message)
        except FrameError as error:
            self.cameras[camera].refused.setdefault('mask', str(error))
            return
        self._enqueue(lambda: assembler.on_mask(message))

    def on_clock_jump(self, now_ns: int) -> None:
        """
        Enqueue that the clock went back.

        :param now_ns: where to; the images may have told it already
        """
        def tell() -> None:
            if any(item.assembler.is_of_another_time(now_ns) for item in self.cameras.values()):
                self.world.go_back(now_ns)

        self._enqueue(tell)

    def update(self, settings: Settings) -> None:
        """Take parameters that may change; in the worker's thread."""
        for camera in self.cameras.values():
            camera.assembler.update(settings)

    def pause(self, paused: bool) -> None:
        """Ignore images from now on, or no longer."""
        with self._lock:
            self._paused = paused

    def drop(self, view: View, reason: str, sentence: str = '') -> None:
        """Count a view that did not come into the map; the sentence is among the news once."""
        camera = self.cameras[view.camera_name]
        with self._lock:
            camera.lost[reason] += 1
            if sentence:
                camera.refused[reason] = sentence

    def drop_images(self, reason: str) -> None:
        """Drop the images that wait for the worker."""
        with self._lock:
            for _, camera in self._messages:
                if camera is not None:
                    camera.lost[reason] += 1
                    camera.queued = 0
            self._messages = deque(item for item in self._messages if item[1] is None)

    @property
    def load(self) -> float:
        """Return how full the fullest camera's queue of images is, 0 to 1."""
        return max(camera.queued for camera in self.cameras.values()) / self._queue_size

    @property
    def queued(self) -> int:
        """Return the number of messages that wait."""
        return len(self._messages)

    def take(self) -> list[View]:
        """
        Take the next message, if there is one; return the views that are ready now.

        :raises Exception: whatever a defect raises; an image that it costs is counted
        """
        feed = camera = None
        with self._lock:
            if self._messages:
                feed, camera = self._messages.popleft()
                if camera is not None:
                    camera.queued -= 1
        if feed:
            try:
                feed()
            except Exception:  # the message is lost, and must not be missed
                if camera is not None:
                    camera.lost['error'] += 1
                raise
        if len(self.world.went_back) > self._jumps:
            self._jumps = len(self.world.went_back)
            stamp_ns = self.world.went_back[-1]
            for item in self.cameras.values():
                item.assembler.forget(stamp_ns)
            self._on_time_jump(stamp_ns)
        now_ns = time.monotonic_ns()  # images may have waited for their poses long enough
        views = []
        for camera in self.cameras.values():
            views += camera.assembler.ready(now_ns)
            while camera.assembler.waits:
                self._timings.add('queue and pose', camera.assembler.waits.pop(0))
        return views

    def news(self) -> list[str]:
        """Return sentences on what was left out or noticed, each reason's once."""
        found = [('', reason, sentence)
                 for reason, sentence in self.world.explanations.items()]
        for name, camera in self.cameras.items():
            found += [(name, reason, sentence)
                      for reason, sentence in camera.explanations.items()]
        news = []
        for name, reason, sentence in found:
            if (name, reason) not in self._told:
                self._told.add((name, reason))
                counted = name in self.cameras and reason in self.cameras[name].dropped
                line = f'{sentence} [{reason}: said once{", then counted" if counted else ""}]'
                news.append(f'camera {name}: {line}' if name else line)
        return news

    def _feed(self, camera: CameraIntake, message: Any, received_ns: int) -> None:
        self._timings.add('queue', 1e-9 * (time.monotonic_ns() - received_ns))
        camera.assembler.on_depth(message, received_ns)

    def _enqueue(self, feed: Callable[[], None]) -> None:
        with self._lock:
            images = sum(camera.queued for camera in self.cameras.values())
            if len(self._messages) - images >= MAX_MESSAGES:
                self._remove(lambda of: of is None)
            self._messages.append((feed, None))
        self._notify()

    def _remove(self, chosen: Callable[[CameraIntake | None], bool]) -> None:
        """Remove the oldest message that is chosen by the camera it is an image of."""
        del self._messages[next(i for i, item in enumerate(self._messages) if chosen(item[1]))]
