# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks share: frames, fresh processes, tables."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
import multiprocessing
import os
from pathlib import Path
import platform
from time import perf_counter, process_time
from typing import Any, TypeVar

import trimesh

from gr2t_ros.core.view import View
from gr2t_ros.io import topics
from gr2t_ros.io.bags import Bag
from gr2t_ros.io.frames import FrameAssembler
from gr2t_ros.io.views import views
from gr2t_ros.settings import Settings
from gr2t_ros.tools.noise import Noise
from gr2t_ros.tools.simulate import simulated_views

Result = TypeVar('Result')

BUNNY = 'bunny'
_BUNNY_DISTANCE = 0.35  # metres
KITCHEN_30HZ, KITCHEN_SWEEP = 'kitchen_30hz', 'kitchen_sweep'
_FILES = {
    BUNNY: 'meshes/bunny_metric_watertight.ply', KITCHEN_30HZ: 'bags/kitchen_30hz',
    KITCHEN_SWEEP: 'bags/kitchen_sweep'}
_MAX_WAITING = 100  # images whose pose comes later in the bag


def say_absent(data: Path) -> None:
    """Print which data sets will be skipped."""
    for name, file in _FILES.items():
        if not (data / file).exists():
            print(f'{name}: skipped, there is no {data / file}')


def found(data: Path, name: str) -> Path | None:
    """Return the file or folder of a data set, or None where it is absent."""
    path = data / _FILES[name]
    return path if path.exists() else None


def recorded(bag: Path, settings: Settings) -> Iterator[View]:
    """Yield a recording's frames, topics guessed."""
    with Bag([bag]) as opened:
        sources = topics.choose(opened)
        settings = settings.updated({
            'pose_source': sources.poses.source, 'world_frame': sources.poses.world_frame})
        assembler = FrameAssembler(
            settings, rectified=sources.depth.rectified, max_waiting=_MAX_WAITING)
        yield from views(opened, sources, assembler)


def frames(data: Path, name: str, count: int, settings: Settings) -> list[View]:
    """Return the first frames of a data set; none where it is absent."""
    path = found(data, name)
    if path is None:
        return []
    if name == BUNNY:
        return bunny_views(trimesh.load_mesh(path), None)[:count]
    return list(islice(recorded(path, settings), count))


def bunny_views(
    mesh: trimesh.Trimesh, noise: Noise | None, encoding: str = '32FC1'
) -> list[View]:
    """Return the 12 simulated views of the bunny."""
    return simulated_views(mesh, 12, _BUNNY_DISTANCE, encoding=encoding, noise=noise)


class Clock:
    """
    Times of named pieces of work.

    :param seconds: name -> wall time; cpu: name -> CPU time of all threads
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu: dict[str, float] = {}

    def __call__(self, name: str, task: Callable[..., Result], *arguments: Any) -> Result:
        """Run a task and add its time to a name."""
        cpu, wall = process_time(), perf_counter()
        result = task(*arguments)
        wall, cpu = perf_counter() - wall, process_time() - cpu
        self.seconds[name] = self.seconds.get(name, 0.0) + wall
        self.cpu[name] = self.cpu.get(name, 0.0) + cpu
        return result

    @property
    def cores(self) -> float:
        """Return how many cores the work kept busy."""
        return sum(self.cpu.values()) / sum(self.seconds.values())


def in_fresh_process(
    threads: int, task: Callable[..., Result], *arguments: object
) -> Result:
    """Run a task in a process of its own that may use so many cores and no more."""
    with ProcessPoolExecutor(
            1, multiprocessing.get_context('spawn'), _confine, (threads,)) as pool:
        return pool.submit(task, *arguments).result()


def _confine(threads: int) -> None:
    # Open3D has no option for it: its thread pool is as large as the number of cores it may use
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    model = platform.processor() or platform.machine()
    info = Path('/proc/cpuinfo')
    if info.exists():
        for line in info.read_text(encoding='utf-8').splitlines():
            if line.startswith('model name'):
                model = line.partition(':')[2].strip()
                break
    return {
        'processor': model, 'cores': os.cpu_count(), 'python': platform.python_version(),
        'load': os.getloadavg()[0]}


def table(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows of the same keys under a title."""
    if not rows:
        return
    print(f'\n{title}', flush=True)
    cells = [list(rows[0]), *([_text(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    for line in cells:
        print('  '.join(
            f'{cell:{"<" if n == 0 else ">"}{widths[n]}}' for n, cell in enumerate(line)),
            flush=True)


def _text(value: Any) -> str:
    if value is None:
        return '-'
    if not isinstance(value, float):
        return str(value)
    return f'{value:.{0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 3}f}'
