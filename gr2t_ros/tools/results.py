# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a replay leaves: mesh, picture, cameras, report, a mesh for each view, the map."""
from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
from time import perf_counter

from ..core.colour import Colouring
from ..core.compiled import cache_notice
from ..core.next_views import where_next
from ..core.reconstruction import Reconstruction, Update
from ..core.warm_up import warm_up
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
    say(f'fusing {reconstruction.kept} keyframes, and writing {directory} ...')
    colouring = reconstruction.colouring()
    started = perf_counter()
    mesh = reconstruction.fused_mesh()
    run.seconds['mesh'] = [perf_counter() - started]
    written = ply.write_fused(directory / 'mesh.ply', mesh, colouring)
    results = {str(written.path): f'{written.vertices} vertices, {written.faces} faces'}
    if run.parts.directory:
        results[str(written.path)] += f'; of the {reconstruction.kept} keyframes still in memory'
        results[str(run.parts.directory)] = (
            f'the other {run.parts.keyframes} keyframes, finished, a file each: '
            f'{run.parts.vertices} vertices, {run.parts.edges} edges, {run.parts.faces} faces')
    if per_view:
        results[str(directory / 'views')] = _write_views(
            reconstruction, directory / 'views', colouring)
    poses = [item.view.T_world_camera for item in reconstruction.keyframes]
    cameras = directory / 'cameras.txt'
    trajectory.write(cameras, zip(
        [item.view.stamp_ns for item in reconstruction.keyframes], poses))
    results[str(cameras)] = f'poses of {len(poses)} keyframes'
    picture = directory / 'preview.png'
    preview(
        picture, mesh.vertices, mesh.faces, mesh.vertex_likelihood, mesh.vertex_sigma,
        colouring, title=title, poses=poses)
    results[str(picture)] = ''
    if with_map:
        saved = save_map(directory / MAP_NAME, reconstruction, run.settings.world_frame)
        results[str(saved.path)] = saved.content
    run.next_views = where_next(reconstruction, mesh).views
    run.finish_seconds += perf_counter() - begin
    content = report.report(
        run, {'vertices': written.vertices, 'faces': written.faces}, mesh.vertex_likelihood)
    report.write(directory / 'report.json', content)
    results[str(directory / 'report.json')] = ''
    return report.table(content, run, results)


def _write_views(reconstruction: Reconstruction, directory: Path, colouring: Colouring) -> str:
    """Write the mesh of each keyframe that is in memory; say what there is now."""
    vertices = edges = faces = 0
    with Progress(reconstruction.kept, 'meshes') as bar:
        for number, keyframe in enumerate(reconstruction.keyframes):
            if keyframe.released:
                continue
            written = ply.write_view(
                directory / f'view_{number:04d}.ply', number, reconstruction.mesh(number),
                colouring)
            vertices += written.vertices
            edges += written.edges
            faces += written.faces
            bar.reach(bar.done + 1)
    return (f'{reconstruction.kept} keyframes, a file each: {vertices} vertices, {edges} edges, '
            f'{faces} faces')
