# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots and maps: written and read by a thread of its own, while frames go on."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
import time
from typing import Any, Protocol, TypeVar

from ..core.frozen import ASKING
from ..core.reconstruction import Reconstruction
from ..core.state import ADDING
from ..errors import Gr2tError, InputError
from ..io.files import Folder
from ..io.map_file import ENDING, MapFile, save_map
from ..io.snapshots import save_snapshot, Snapshot
from ..settings import Settings
from .timings import Timings

Result = TypeVar('Result')


@dataclass(frozen=True)
class Copy:
    """
    A map as it was at a moment.

    :param number: of the map: another after each reset
    :param elsewhere: what of it is in other files, as a sentence
    """

    reconstruction: Reconstruction
    world_frame: str
    number: int
    elsewhere: str


class Map(Protocol):
    """What there is to save, as the worker has it."""

    def copy(self, fields: Sequence[str]) -> Copy:
        """Return a copy of the map, with these fields of its lattice."""

    def check_frame(self, world_frame: str) -> None:
        """Refuse a map in another world frame."""

    def put(self, reconstruction: Reconstruction, world_frame: str) -> None:
        """Go on with another map."""

    @property
    def stopping(self) -> bool:
        """Return whether all that is being written is to be given up."""


class Saver:
    """
    Writes snapshots and maps, one after the other: each has a copy of the map in memory.

    folder: where they go.

    :param settings: of which the folder holds for good
    :param this_map: asked from the thread that writes
    :param empty: makes a reconstruction without views
    :param log: takes what the periodic files say
    """

    def __init__(
        self, settings: Settings, this_map: Map, empty: Callable[[], Reconstruction], log: Any,
        timings: Timings,
    ) -> None:
        self.problem = ''  # of the last periodic file
        self._settings = settings
        self.folder = Folder(settings.snapshot_directory)
        self._map = this_map
        self._empty = empty
        self._log = log
        self._timings = timings
        self._writer = ThreadPoolExecutor(1, thread_name_prefix='saver')
        self._file: tuple[int, Path] | None = None  # of which map the last was written, and where
        self._snapshots = _Periodic('snapshot', self.snapshot)
        self._maps = _Periodic('map', self.save_map)

    def update(self, settings: Settings) -> None:
        """Take parameters that changed."""
        self._settings = settings

    def snapshot(self) -> Future[Snapshot]:
        """Save the meshes of the map as it is after the step at hand, all its rays marched."""
        return self._submit(lambda: self._snapshot(self._map.copy(ASKING)))

    def save_map(self) -> Future[str]:
        """Save the map as it is after the step at hand, in the file of its last time."""
        return self._submit(lambda: self._save_map(self._map.copy(ADDING)))

    def load_map(self) -> Future[str]:
        """Go on with the map in the file map_file, or the newest."""
        return self._submit(self._load_map)

    def now_and_then(self, number: int, views: int) -> None:
        """Begin what is due, if there is something new in the map with this number."""
        self._snapshots.begin(self._settings.snapshot_period, (number, views), self._report)
        self._maps.begin(self._settings.map_period, (number, views), self._report)

    def last(self, last: Copy) -> None:
        """Save what settings ask for when the node ends; nobody changes the map any more."""
        self._writer.shutdown()
        for name, wanted, save in (
                ('snapshot', self._settings.snapshot_on_exit, self._snapshot),
                ('map', self._settings.map_period and last.reconstruction.views, self._save_map)):
            if not wanted:
                continue
            try:
                self._log.info(f'{name}: {save(last, lambda: False)}')
            except Exception as error:
                self._log.error(f'no {name}: {error}')

    def _submit(self, task: Callable[[], Result]) -> Future[Result]:
        try:
            return self._writer.submit(task)
        except RuntimeError:
            ended: Future[Result] = Future()
            ended.set_exception(Gr2tError('the node was told to stop'))
            return ended

    def _stopping(self) -> bool:
        return self._map.stopping

    def _snapshot(
        self, copy: Copy, interrupted: Callable[[], bool] | None = None
    ) -> Snapshot:
        with self._timings.measure('snapshot'):
            snapshot = save_snapshot(
                copy.reconstruction, self.folder, interrupted or self._stopping)
        return replace(snapshot, elsewhere=copy.elsewhere)

    def _save_map(self, copy: Copy, interrupted: Callable[[], bool] | None = None) -> str:
        if not copy.reconstruction.views:
            raise InputError('there is nothing to save yet: no frame has been integrated')

        def save(path: Path) -> str:
            return str(save_map(
                path, copy.reconstruction, copy.world_frame,
                interrupted=interrupted or self._stopping))

        with self._timings.measure('save map'):
            if self._file and self._file[0] == copy.number:
                self.folder.made()
                return save(self._file[1])
            with self.folder.new_file(time.strftime('map_%Y%m%d_%H%M%S'), ENDING) as path:
                saved = save(path)
            self._file = copy.number, path
            return saved

    def _load_map(self) -> str:
        path = self._chosen()
        reconstruction = self._empty()
        try:
            with self._timings.measure('load map'), MapFile(path) as file:
                self._map.check_frame(file.world_frame)
                file.load(reconstruction)
            views, keyframes = reconstruction.views, len(reconstruction.keyframes)
            self._map.put(reconstruction, file.world_frame)
        except BaseException:
            reconstruction.close()
            raise
        return f'{path}: {views} views, {keyframes} keyframes'

    def _chosen(self) -> Path:
        """Return the path of the map to be loaded."""
        if self._settings.map_file:
            return self.folder.inside(self._settings.map_file)
        paths = [path for path in self.folder.path.glob(f'[!.]*{ENDING}') if path.is_file()]
        if not paths:
            raise InputError(f'there is no map in {self.folder.path}')
        return self.folder.inside(max(paths, key=lambda path: path.stat().st_mtime_ns).name)

    def _report(self, name: str, answer: Future[Any]) -> None:
        error = answer.exception()
        if error and self._map.stopping:
            return  # it was given up, as it should
        self.problem = f'no periodic {name}: {error}' if error else ''
        if error:
            self._log.error(self.problem)
        else:
            self._log.info(f'periodic {name}: {answer.result()}')


@dataclass
class _Periodic:
    """Files that are written so often; the next period begins when one is written."""

    name: str
    save: Callable[[], Future[Any]]
    saved: tuple[int, int] = (0, 0)  # the number of the map and its views, in the last one
    due_since: float = -1.0

    def begin(
        self, period: float, there: tuple[int, int],
        report: Callable[[str, Future[Any]], None],
    ) -> None:
        """Save what is there, if it is time and there is something new."""
        now = time.monotonic()
        if self.due_since < 0:
            self.due_since = now
        if not period or now < self.due_since + period or not there[1] or there == self.saved:
            return
        self.due_since, self.saved = float('inf'), there

        def done(answer: Future[Any]) -> None:
            # slow disks get fewer, not a queue
            self.due_since = time.monotonic()
            report(self.name, answer)

        self.save().add_done_callback(done)
