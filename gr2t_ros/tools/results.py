# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a replay leaves: mesh.ply, preview.png, report.json, a mesh for each view, the map."""
from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
from time import perf_counter

import numpy as np

from ..core.compiled import cache_notice
from ..core.next_views import where_next
from ..core.reconstruction import Reconstruction, Update, warm_up
from ..core.view_mesh import ViewMesh
from ..errors import InputError
from ..io import ply, trajectory
from ..io.map_file import MapFile, save_map
from ..settings import Settings
from . import report
from .progress import Progress, say
from .render import preview

MAP_NAME = 'map.gr2t'


def prepare_kernels(settings: Settings) -> float:
    """
    Compile the kernels, or load them, and say so.

    :return: seconds it took
    """
    say('preparing the kernels (the first run compiles them: about a minute) ...')
    if notice := cache_notice():
        say(notice)
    return warm_up(settings)


def output_folder(directory: Path) -> Path:
    """
    Return the folder, made and fit to be written to, before hours are spent on its content.

    :raises InputError: if it cannot be made or is read-only
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if os.access(directory, os.W_OK):
            return directory
        reason = 'it is read-only'
    except OSError as error:
        reason = error.strerror or str(error)
    raise InputError(f'cannot write to the folder {directory}: {reason}; name another with -o')


def opened_map(path: Path) -> MapFile:
    """
    Open a saved map.

    :param path: the file, or the folder of a replay that wrote one
    :raises InputError: see MapFile
    """
    return MapFile(path / MAP_NAME if path.is_dir() else path)


def load(file: MapFile, reconstruction: Reconstruction) -> None:
    """
    Load a map, and say what it holds.

    :param reconstruction: empty
    :raises InputError: see MapFile.load
    """
    file.load(reconstruction)
    count = len(reconstruction.keyframes)
    say(f'{file.path}: {file.views} views, {count} keyframes, in the frame {file.world_frame}')
    if gone := count - reconstruction.kept:
        say(f'{gone} of these keyframes had left memory: their meshes are where that run put them')


def march_waiting(reconstruction: Reconstruction) -> Iterator[Update]:
    """March the rays that wait, a second at a time; yield what was done."""
    update = reconstruction.finish(budget=0.0)
    total = update.waiting
    with Progress(total, 'rays that wait') as bar:
        while update.waiting:
            update = reconstruction.finish(budget=1.0)
            yield update
            bar.reach(total - update.waiting)


def write_results(
    reconstruction: Reconstruction, run: report.Run, directory: Path, title: str, *,
    per_view: bool, with_map: bool,
) -> str:
    """
    Write all results of a run.

    :param run: what was counted so far; the times of writing are added
    :param title: below the picture
    :param per_view: whether each keyframe's mesh becomes a file too
    :param with_map: whether the map becomes one, from which it can go on
    :return: a table of what was written, and of the run
    :raises Gr2tError: if a file cannot be written
    """
    begin = perf_counter()
    say(f'writing {directory} ...')
    meshes = _Meshes(reconstruction, run, directory / 'views' if per_view else None)
    written = ply.write_views(
        directory / 'mesh.ply', meshes.all, meshes.colouring,
        expected_vertices=meshes.expected)
    counts = {'vertices': written.vertices, 'edges': written.edges, 'faces': written.faces}
    results = {str(written.path): ', '.join(f'{n} {name}' for name, n in counts.items())}
    if written.stride > 1:
        results[str(written.path)] += (
            f'; decimated by {written.stride} in rows and columns, to at most {ply.MAX_FACES} '
            'faces')
    if run.parts.directory:
        results[str(written.path)] += f'; the {reconstruction.kept} keyframes still in memory'
        results[str(run.parts.directory)] = (
            f'the other {run.parts.keyframes} keyframes, finished, a file each: '
            f'{run.parts.vertices} vertices, {run.parts.edges} edges, {run.parts.faces} faces')
    if per_view:
        meshes.write_other_views()
        results[str(directory / 'views')] = f'{reconstruction.kept} keyframes'
    cameras = directory / 'cameras.txt'
    trajectory.write(cameras, (
        (item.view.stamp_ns, item.view.T_world_camera) for item in reconstruction.keyframes))
    results[str(cameras)] = f'poses of {len(reconstruction.keyframes)} keyframes'
    mesh = ply.read(written.path).mesh
    picture = directory / 'preview.png'
    preview(
        picture, mesh.vertices, mesh.faces, mesh.vertex_likelihood, mesh.vertex_sigma,
        meshes.colouring, title=title,
        poses=[item.view.T_world_camera for item in reconstruction.keyframes])
    results[str(picture)] = ''
    if with_map:
        saved = save_map(directory / MAP_NAME, reconstruction, run.settings.world_frame)
        results[str(saved.path)] = saved.content
    run.next_views = where_next(reconstruction).views
    run.finish_seconds += perf_counter() - begin
    content = report.report(run, counts, mesh.vertex_likelihood)
    report.write(directory / 'report.json', content)
    results[str(directory / 'report.json')] = ''
    return report.table(content, run, results)


class _Meshes:
    """The keyframes' meshes, timed; each goes to a file of its own when it is first made."""

    def __init__(
        self, reconstruction: Reconstruction, run: report.Run, views: Path | None
    ) -> None:
        self.colouring = reconstruction.colouring()
        self.expected = sum(
            int(np.count_nonzero(item.rays.converged)) for item in reconstruction.keyframes)
        self._reconstruction = reconstruction
        self._run = run
        self._views = views
        self._written: set[int] = set()

    def all(self, stride: int) -> Iterator[tuple[int, ViewMesh]]:
        """Yield them in order, as ply.write_views wants it."""
        seconds = self._run.seconds['mesh'] = []
        count = len(self._reconstruction.keyframes)
        with Progress(count, 'meshes') as bar:
            for number in range(count):
                begin = perf_counter()
                mesh = self._reconstruction.mesh(number, stride)
                seconds.append(perf_counter() - begin)
                if stride == 1:
                    self._write_view(number, mesh)
                bar.reach(number + 1)
                yield number, mesh

    def write_other_views(self) -> None:
        """Write the files of those that were made decimated only."""
        for number in range(len(self._reconstruction.keyframes)):
            if number not in self._written:
                self._write_view(number, self._reconstruction.mesh(number))

    def _write_view(self, number: int, mesh: ViewMesh) -> None:
        def strided(stride: int) -> list[tuple[int, ViewMesh]]:
            return [(number, mesh if stride == 1 else self._reconstruction.mesh(number, stride))]
        if self._views is not None and not self._reconstruction.keyframes[number].released:
            ply.write_views(
                self._views / f'view_{number:04d}.ply', strided, self.colouring)
            self._written.add(number)
