# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One thread that takes the messages in their order and builds the map from them."""
from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
import threading
import time
import traceback
from typing import Any, Protocol, TypeVar

from ..core import poses
from ..core.frozen import room_for
from ..core.reconstruction import Reconstruction, Update
from ..core.release import limit_of, used_by
from ..core.view import View
from ..errors import FrameError, Gr2tError, InputError
from ..io.parts import new_directory, Parts
from ..settings import Settings
from .intake import Intake
from .saver import Copy, Saver
from .timings import Timings

Result = TypeVar('Result')

_IDLE_STEP = 0.1  # s of marching before another look at the queue
_AGAIN = 3  # failures in a row that are no accident
_SAME_CLOCK = 3600.0  # s; stamps farther from now are those of a recording


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
    ) -> bool:
        """Send what changed to whoever listens; tell whether something was sent."""

    def clear(self, frame_id: str) -> None:
        """Take back all that was sent."""

    def update(self, settings: Settings) -> None:
        """Take parameters that may change."""


class Worker:
    """
    The map and the thread that builds it.

    The services' methods may be called from any thread, and only enqueue.

    intake: where the messages go. saver: what writes the map.

    :param settings: parameters
    :param outputs: called from the worker's thread, publish_rate times a second
    :param log: likewise
    :param rectified: see Intake
    :param timings: learns how long things take
    :param now_ns: the time by the clock of the images' stamps
    """

    def __init__(
        self, settings: Settings, outputs: Outputs, log: Log, *, rectified: Mapping[str, bool],
        timings: Timings | None = None, now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._settings = settings
        self._outputs = outputs
        self._log = log
        self.timings = timings or Timings()
        self.intake = Intake(
            settings, rectified, self._notify, self.timings, self._time_jumped)
        self._now_ns = now_ns
        self.busy = 0.0  # s
        self._in_a_row: Counter[str] = Counter()  # failures of one kind after the other
        self._failure = ''
        self._unseen: list[int] = []  # stamps of views that were not published yet
        self._reconstruction = self._empty()
        self._number = 1  # of the map
        self._in_map = 0  # its views
        self.waiting_rays = 0
        self._views: deque[View] = deque()
        self._stamp_ns = 0  # of the newest view in the map
        self._publish_at = 0.0

        self._wake = threading.Condition()
        self._orders: deque[Callable[[], None]] = deque()
        self._stop = False
        self._thread = threading.Thread(target=self._run, name='worker')
        self.saver = Saver(settings, self, self._empty, log, self.timings)
        self._told: set[str] = set()  # places of failures

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """
        End after the step at hand, with a last snapshot or map where settings ask for one.

        What is being written is given up, so that it leaves no file.
        """
        with self._wake:
            self._stop = True
            self._wake.notify()
        self._thread.join()

    @property
    def views(self) -> int:
        """Return the number of views in the map."""
        return self._in_map

    @property
    def keyframes(self) -> int:
        """Return the number of keyframes."""
        return len(self._reconstruction.keyframes)

    @property
    def blocks(self) -> int:
        """Return the number of the lattice's blocks."""
        return self._reconstruction.blocks

    @property
    def failing(self) -> str:
        """Return what fails again and again, as a sentence; '' where nothing does."""
        kinds = [kind for kind, count in self._in_a_row.items() if count >= _AGAIN]
        return f'{" and ".join(kinds)} fail again and again: {self._failure}' if kinds else ''

    @property
    def parts(self) -> Parts:
        """Return what left memory."""
        sink = self._reconstruction.sink
        assert isinstance(sink, Parts)
        return sink

    @property
    def memory(self) -> tuple[int, int]:
        """Return the bytes of the map, and how many it may have; see max_memory_mb."""
        return used_by(self._reconstruction), limit_of(self._settings)

    @property
    def alive(self) -> bool:
        """Return whether it runs."""
        return self._thread.is_alive()

    def reset(self) -> None:
        """Forget the map, and the images that wait."""
        self.intake.drop_images('reset')
        with self._wake:
            self._orders.appendleft(self._reset)
            self._wake.notify()

    def update(self, settings: Settings) -> None:
        """Take parameters that changed, after the step at hand; all that is shown follows."""
        def order() -> None:
            self._settings = self._reconstruction.settings = settings
            self.intake.update(settings)
            self._outputs.update(settings)
            self.saver.update(settings)
            self._outputs.change(range(len(self._reconstruction.keyframes)))
            self._publish_at = 0.0
            reach = self._reconstruction.depth_max
            if settings.depth_max > reach:
                self._log.warning(
                    f'depth_max {settings.depth_max:g} m: the map was begun with {reach:g} m; '
                    'what is deeper counts after ~/reset')

        with self._wake:
            self._orders.append(order)
            self._wake.notify()

    @property
    def stopping(self) -> bool:
        """Return whether it was told to stop."""
        return self._stop

    def copy(self, fields: Sequence[str]) -> Copy:
        """
        Return the map as it is after the step at hand; frames go on then.

        :param fields: see Reconstruction.frozen
        :raises Gr2tError: if it was told to stop
        """
        now = self._reconstruction  # the worker may begin another at any moment
        room = room_for(now.density, fields) if now.views else {}

        def freeze() -> Copy:
            with self.timings.measure('copy of the map'):
                return self._this(self._reconstruction.frozen(room, fields))

        return self._in_turn(freeze)

    def _this(self, reconstruction: Reconstruction) -> Copy:
        return Copy(
            reconstruction, self.intake.world.frame, self._number, str(self.parts))

    def check_frame(self, world_frame: str) -> None:
        """
        Refuse a map that is not in the world frame of the images.

        :raises InputError: naming both
        """
        ours = self.intake.world.frame
        if ours and world_frame != ours:
            raise InputError(
                f'the map is in the world frame {world_frame!r}, but this node builds in '
                f'{ours!r}: set world_frame to that of the map, or load another')

    def put(self, reconstruction: Reconstruction, world_frame: str) -> None:
        """
        Go on with another map after the step at hand.

        :raises Gr2tError: if it was told to stop, or images came in another world frame meanwhile
        """
        def replace() -> None:
            self.check_frame(world_frame)
            self._replace(reconstruction)
            reconstruction.settings = self._settings
            self.intake.world.frame = world_frame
            self._stamp_ns = reconstruction.stamp_ns
            self._in_map = reconstruction.views
            self.waiting_rays = sum(len(item.rays.pixels) for item in reconstruction.keyframes)
            self._outputs.change(range(len(reconstruction.keyframes)))
            self._publish_at = 0.0

        self._in_turn(replace)

    def _in_turn(self, task: Callable[[], Result]) -> Result:
        """Run a task in the worker's thread after the step at hand; return what it does."""
        done: Future[Result] = Future()

        def order() -> None:
            try:
                done.set_result(task())
            except Exception as error:  # whatever it is, who waits must get an answer
                done.set_exception(error)

        with self._wake:
            if self._stop:
                raise Gr2tError('the node was told to stop')
            self._orders.append(order)
            self._wake.notify()
        return done.result()

    def summary(self) -> str:
        """Return what became of the images, and how long it took, as text."""
        lines = []
        for name, camera in self.intake.cameras.items():
            dropped = camera.dropped
            reasons = ', '.join(f'{reason} {count}' for reason, count in sorted(dropped.items()))
            lines.append(
                f'frames{f" of {name}" if name else ""}: {camera.received} received, '
                f'{camera.integrated} integrated, {dropped.total()} dropped'
                f'{f" ({reasons})" if reasons else ""}, {camera.waiting} waiting')
        lines[-1] += f', {len(self._reconstruction.keyframes)} keyframes'
        if self.parts.keyframes:
            lines.append(str(self.parts))
        return '\n'.join([*lines, self.timings.table()])

    def _notify(self) -> None:
        with self._wake:
            self._wake.notify()

    def _run(self) -> None:
        while (step := self._next()) is not None:
            began = time.perf_counter()
            for kind, what in (
                    ('step', step), ('publishing', self._publish),
                    ('saving', lambda: self.saver.now_and_then(self._number, self._in_map))):
                try:
                    what()
                    self._in_a_row[kind] = 0
                except Exception as error:  # the thread must outlive whatever one step does
                    self._fail(kind, f'the worker\'s {kind}', error)
            for sentence in self.intake.news():
                self._log.warning(sentence)
            self.busy += time.perf_counter() - began
        self.saver.last(self._this(self._reconstruction))
        self._reconstruction.close()

    def _next(self) -> Callable[[], None] | None:
        """Wait for the next thing to do; None: stop."""
        with self._wake:
            self._wake.wait_for(
                lambda: self._stop or self._orders or self._views or self.intake.queued,
                timeout=0.0 if self.waiting_rays else 1.0 / self._settings.publish_rate)
            if self._orders:
                return self._orders.popleft()
            if self._stop:
                return None
            if self._views:
                view = self._views.popleft()
                return lambda: self._integrate(view)
            if self.intake.queued:
                return self._take
        return self._idle

    def _idle(self) -> None:
        if self.waiting_rays:
            update = self._reconstruction.finish(_IDLE_STEP)
            self.timings.add('march when idle', update.seconds['march'])
            self._account(update)
        self._take()

    def _take(self) -> None:
        self._views.extend(self.intake.take())

    def _time_jumped(self, stamp_ns: int) -> None:
        emptied = self._settings.reset_on_time_jump
        self._log.warning(
            f'the clock went back to {poses.seconds(stamp_ns)}: what waited and the poses of '
            'before are forgotten; the map ' + (
                'is emptied' if emptied else 'stays (reset_on_time_jump:=true empties it)'))
        if emptied:
            self._reset()

    def _integrate(self, view: View) -> None:
        try:
            update = self._reconstruction.add(view, self.intake.load)
        except FrameError as error:
            self.intake.drop(view, error.reason, str(error))
            self._account(self._reconstruction.finish(0.0))  # some may have been released
            return
        except Exception as error:  # costs this frame, not the others
            self.intake.drop(view, 'error', 'a frame failed: the log says where')
            self._fail('frames', f'the frame of {poses.seconds(view.stamp_ns)}', error)
            return
        self._in_a_row['frames'] = 0
        self.intake.cameras[view.camera_name].integrated += 1
        self._in_map += 1
        if self._in_map == 1:
            self._log.info(
                f'the map begins, in the frame {self.intake.world.frame}: RViz\'s fixed frame '
                'must be it, or be connected with it')
        self._stamp_ns = view.stamp_ns
        self._unseen.append(view.stamp_ns)
        for stage, seconds in update.seconds.items():
            self.timings.add(stage, seconds)
        self._account(update)

    def _account(self, update: Update) -> None:
        self.waiting_rays = update.waiting
        self._outputs.change((*update.changed, *update.released))
        if update.released and self.parts.keyframes == len(update.released):
            self._log.warning(
                'memory is full (max_memory_mb): the keyframes farthest from the camera leave the '
                f'display; finished, each becomes a PLY file in {self.parts.directory}')
        for notice in update.notices:
            self._log.info(notice)

    def _publish(self) -> None:
        now = time.monotonic()
        if now < self._publish_at or not self.intake.world.frame:
            return
        self._publish_at = now + 1.0 / self._settings.publish_rate
        if self._outputs.publish(
                self._reconstruction, self.intake.world.frame, self._stamp_ns, self._in_map):
            for stamp_ns in self._unseen:
                latency = 1e-9 * (self._now_ns() - stamp_ns)
                if abs(latency) < _SAME_CLOCK:
                    self.timings.add('stamp to publish', latency)
        self._unseen.clear()

    def _reset(self) -> None:
        for view in self._views:
            self.intake.drop(view, 'reset')
        self._views.clear()
        self._replace(self._empty())

    def _empty(self) -> Reconstruction:
        return Reconstruction(
            self._settings, Parts(lambda: new_directory(self.saver.folder.made())), copied=True)

    def _replace(self, reconstruction: Reconstruction) -> None:
        self._reconstruction.close()
        self._reconstruction = reconstruction
        self._in_map = self.waiting_rays = 0
        self._number += 1
        if self.intake.world.frame:
            self._outputs.clear(self.intake.world.frame)

    def _fail(self, kind: str, what: str, error: Exception) -> None:
        self._in_a_row[kind] += 1
        self._failure = f'{type(error).__name__}: {error}'
        self._log.error(f'{what} failed: {type(error).__name__}: {error}')
        place = ''.join(traceback.format_tb(error.__traceback__))
        if place not in self._told:
            self._told.add(place)
            self._log.error(place)
