# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One thread that takes the messages in their order and builds the map from them."""
from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
import threading
import time
import traceback
from typing import Any, Protocol

from ..core.reconstruction import Reconstruction, Update
from ..core.view import View
from ..errors import FrameError
from ..io.frames import FrameAssembler
from ..io.ply import Written
from ..io.snapshots import save_snapshot
from ..settings import Settings

MAX_MESSAGES = 20_000  # other than images that may wait: 20 s of a 1 kHz tf
_IDLE_STEP = 0.1  # s of marching before another look at the queue


class Log(Protocol):
    """What the worker needs of a logger."""

    def info(self, message: str) -> Any:
        """Log what a user may want to know."""

    def warning(self, message: str) -> Any:
        """Log what a user should know."""

    def error(self, message: str) -> Any:
        """Log what went wrong."""


class Outputs(Protocol):
    """Where the map goes."""

    def change(self, keyframes: Iterable[int]) -> None:
        """Note keyframes whose meshes changed."""

    def publish(
        self, reconstruction: Reconstruction, frame_id: str, stamp_ns: int, views: int
    ) -> None:
        """Send what changed to whoever listens."""

    def clear(self, frame_id: str) -> None:
        """Take back all that was sent."""


class Worker:
    """
    The map and the thread that builds it.

    Methods named on_... and the services' may be called from any thread, and only enqueue. Images
    wait in a bounded queue: when it is full the oldest is dropped, and counted.

    :param settings: parameters
    :param outputs: called from the worker's thread, publish_rate times a second
    :param log: likewise
    :param rectified: whether the depth images are
    """

    def __init__(
        self, settings: Settings, outputs: Outputs, log: Log, *, rectified: bool
    ) -> None:
        self._settings = settings
        self._outputs = outputs
        self._log = log
        self._assembler = FrameAssembler(
            settings, rectified=rectified, max_waiting=settings.queue_size)
        self._reconstruction = Reconstruction(settings)
        self._in_map = 0  # views since the last reset
        self.waiting_rays = 0
        self._views: deque[View] = deque()
        self._stamp_ns = 0  # of the newest view in the map
        self._publish_at = 0.0

        self._wake = threading.Condition()
        self._messages: deque[tuple[Callable[[], None], bool]] = deque()  # feed, is an image
        self._images = 0
        self._orders: deque[Callable[[], None]] = deque()
        self._stop = False
        self._paused = False
        self._thread = threading.Thread(target=self._run, name='worker')

        self.received = 0
        self.integrated = 0
        self._dropped: Counter[str] = Counter()
        self._told: set[str] = set()
        self._seconds: Counter[str] = Counter()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the step at hand, with a snapshot where settings ask for one."""
        with self._wake:
            self._stop = True
            self._wake.notify()
        self._thread.join()

    @property
    def alive(self) -> bool:
        """Return whether it runs."""
        return self._thread.is_alive()

    def on_depth(self, message: Any) -> None:
        """Enqueue a depth image."""
        received_ns = time.monotonic_ns()
        with self._wake:
            self.received += 1
            if self._paused:
                self._dropped['paused'] += 1
                return
            if self._images == self._settings.queue_size:
                oldest = next(i for i, item in enumerate(self._messages) if item[1])
                del self._messages[oldest]
                self._dropped['queue_full'] += 1
            else:
                self._images += 1
            self._messages.append(
                (lambda: self._assembler.on_depth(message, received_ns), True))
            self._wake.notify()

    def on_camera_info(self, message: Any) -> None:
        """Enqueue a camera_info."""
        self._enqueue(lambda: self._assembler.on_camera_info(message))

    def on_transforms(self, message: Any, *, static: bool) -> None:
        """Enqueue transforms."""
        self._enqueue(lambda: self._assembler.on_transforms(message, static))

    def on_pose(self, message: Any) -> None:
        """Enqueue a pose."""
        self._enqueue(lambda: self._assembler.on_pose(message))

    def pause(self, paused: bool) -> None:
        """Ignore images from now on, or no longer."""
        with self._wake:
            self._paused = paused

    def reset(self) -> None:
        """Forget the map, and the images that wait."""
        with self._wake:
            kept = [item for item in self._messages if not item[1]]
            self._dropped['reset'] += len(self._messages) - len(kept)
            self._messages = deque(kept)
            self._images = 0
            self._orders.appendleft(self._reset)
            self._wake.notify()

    def snapshot(self) -> Future[Written]:
        """Save the map after the step at hand; the future may hold a Gr2tError."""
        answer: Future[Written] = Future()

        def order() -> None:
            try:
                answer.set_result(self._save())
            except Exception as error:  # whatever it is, the caller must get an answer
                answer.set_exception(error)

        with self._wake:
            self._orders.append(order)
            self._wake.notify()
        return answer

    @property
    def dropped(self) -> dict[str, int]:
        """Return the number of images that were not used, by reason."""
        return dict(self._dropped + self._assembler.dropped)

    def summary(self) -> str:
        """Return what became of the images, and how long it took, as text."""
        dropped = self.dropped
        reasons = ', '.join(f'{reason} {count}' for reason, count in sorted(dropped.items()))
        waiting = self.received - self.integrated - sum(dropped.values())
        lines = [
            f'frames: {self.received} received, {self.integrated} integrated, '
            f'{sum(dropped.values())} dropped{f" ({reasons})" if reasons else ""}, '
            f'{waiting} waiting, {len(self._reconstruction.keyframes)} keyframes']
        if self.integrated:
            lines.append('time: ' + ', '.join(
                f'{stage} {1000 * seconds / self.integrated:.1f} ms a frame'
                for stage, seconds in self._seconds.items()))
        return '\n'.join(lines)

    def _enqueue(self, feed: Callable[[], None]) -> None:
        with self._wake:
            if len(self._messages) - self._images >= MAX_MESSAGES:
                oldest = next(i for i, item in enumerate(self._messages) if not item[1])
                del self._messages[oldest]
            self._messages.append((feed, False))
            self._wake.notify()

    def _run(self) -> None:
        while (step := self._next()) is not None:
            try:
                step()
                self._publish()
            except Exception as error:  # the thread must outlive whatever one step does
                self._fail('the worker', error)
        if self._settings.snapshot_on_exit:
            try:
                self._log.info(f'snapshot: {describe(self._save())}')
            except Exception as error:
                self._log.error(f'no snapshot: {error}')
        self._reconstruction.close()

    def _next(self) -> Callable[[], None] | None:
        """Wait for the next thing to do; None: stop."""
        with self._wake:
            self._wake.wait_for(
                lambda: self._stop or self._orders or self._views or self._messages,
                timeout=0.0 if self.waiting_rays else 1.0 / self._settings.publish_rate)
            if self._stop:
                return None
            if self._orders:
                return self._orders.popleft()
            if self._views:
                view = self._views.popleft()
                return lambda: self._integrate(view)
            if self._messages:
                feed, image = self._messages.popleft()
                self._images -= image
                return lambda: self._feed(feed)
        return self._idle

    def _idle(self) -> None:
        if self.waiting_rays:
            self._account(self._reconstruction.finish(_IDLE_STEP))
        self._feed(lambda: None)  # images may have waited for their poses long enough

    def _feed(self, feed: Callable[[], None]) -> None:
        feed()
        self._views.extend(self._assembler.ready(time.monotonic_ns()))
        for reason, sentence in self._assembler.explanations.items():
            self._tell(reason, sentence)
        if self._dropped['queue_full']:
            self._tell(
                'queue_full', 'images come faster than they can be integrated, and the oldest are '
                'left out: raise ray_stride or lower the frame rate')

    def _integrate(self, view: View) -> None:
        try:
            update = self._reconstruction.add(view)
        except FrameError as error:
            self._dropped[error.reason] += 1
            self._tell(error.reason, str(error))
            return
        except Exception as error:  # costs this frame, not the others
            self._dropped['error'] += 1
            self._fail(f'the frame of {view.stamp_ns * 1e-9:.3f} s', error)
            return
        self.integrated += 1
        self._in_map += 1
        self._stamp_ns = view.stamp_ns
        self._account(update)

    def _account(self, update: Update) -> None:
        self.waiting_rays = update.waiting
        self._seconds.update(update.seconds)
        self._outputs.change(update.changed)
        for notice in update.notices:
            self._log.info(notice)

    def _publish(self) -> None:
        now = time.monotonic()
        if now < self._publish_at or not self._assembler.world_frame:
            return
        self._publish_at = now + 1.0 / self._settings.publish_rate
        self._outputs.publish(
            self._reconstruction, self._assembler.world_frame, self._stamp_ns, self._in_map)

    def _save(self) -> Written:
        self._account(self._reconstruction.finish())
        return save_snapshot(
            self._reconstruction, self._settings.snapshot_directory, self._settings.colour_map)

    def _reset(self) -> None:
        self._dropped['reset'] += len(self._views)
        self._views.clear()
        self._reconstruction.close()
        self._reconstruction = Reconstruction(self._settings)
        self._in_map = 0
        self.waiting_rays = 0
        if self._assembler.world_frame:
            self._outputs.clear(self._assembler.world_frame)

    def _tell(self, reason: str, sentence: str) -> None:
        if reason not in self._told:
            self._told.add(reason)
            self._log.warning(f'{sentence} [{reason}: said once, then counted]')

    def _fail(self, what: str, error: Exception) -> None:
        self._log.error(f'{what} failed: {type(error).__name__}: {error}')
        place = ''.join(traceback.format_tb(error.__traceback__))
        if place not in self._told:
            self._told.add(place)
            self._log.error(place)


def describe(written: Written) -> str:
    """Return where a snapshot is and what it holds."""
    stride = f', every {written.stride}th ray' if written.stride > 1 else ''
    return (
        f'{written.path}: {written.vertices} vertices, {written.edges} edges, '
        f'{written.faces} faces{stride}')
