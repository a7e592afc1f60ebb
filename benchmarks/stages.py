# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What one frame costs: integrate, march, march again, mesh; beside Open3D's TSDF."""
from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from common import BUNNY, Clock, frames, KITCHEN_30HZ, KITCHEN_SWEEP, table
import numpy as np
import tsdf

from gr2t_ros.core.ray_march import march, Rays, rays_of, stale
from gr2t_ros.core.view import View
from gr2t_ros.core.view_mesh import view_mesh
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.settings import Settings

DEPTH_MAX = 3.5  # metres
SETTINGS = Settings(depth_max=DEPTH_MAX)
VOXELS = {
    KITCHEN_30HZ: (0.005, 0.01, 0.02), KITCHEN_SWEEP: (0.005, 0.01, 0.02), BUNNY: (0.001, 0.002)}
_PARTS = (
    'integrate', 'prefilter', 'start', 'rays', 'march', 'start 2', 'rays 2', 'march 2', 'again',
    'mesh', 'Open3D integrate', 'Open3D ray cast', 'Open3D mesh')
_MESH_EVERY = 5  # frames
_REPEATS = 5


def density_of(voxel_size: float) -> VoxelDensity:
    """Return an empty density whose h3 is the voxel size at all depths."""
    return VoxelDensity(SETTINGS.pixel_bandwidth, voxel_size, 0.0, voxel_size, DEPTH_MAX)


def measure_stages(data: Path, threads: int, count: int) -> list[dict[str, Any]]:
    """
    Print and return what a frame costs, by data set and voxel size.

    :param count: frames
    """
    warm_up(SETTINGS)
    rows = []
    for name, voxels in VOXELS.items():
        views = frames(data, name, count, SETTINGS)
        if not views:
            continue
        found: list[dict[str, Any]] = [
            {'data': name, 'voxel mm': 1e3 * voxel_size, 'threads': threads}
            | _stages(views, voxel_size, threads) for voxel_size in voxels]
        title = f'{name}, {len(views)} frames, threads: {threads}'
        table(
            f'{title}. Milliseconds a frame, x: of Open3D\'s for the same frame (medians)',
            [{'voxel mm': row['voxel mm']} | row['shown'] for row in found])
        table(
            f'{title}. Milliseconds of the parts',
            [{'voxel mm': row['voxel mm']} | row['ms'] for row in found])
        rows += found
    return rows


def _stages(views: Sequence[View], voxel_size: float, threads: int) -> dict[str, Any]:
    """Run our stages and Open3D's frame by frame, in turns: a busy machine slows both alike."""
    density = density_of(voxel_size)
    peer = tsdf.Tsdf(voxel_size, DEPTH_MAX) if tsdf.installed() else None
    if tsdf.installed():  # what only a first call costs
        _theirs(tsdf.Tsdf(voxel_size, DEPTH_MAX), views[0], True)
    before: Rays | None = None
    wall: list[dict[str, float]] = []
    cpu: list[dict[str, float]] = []
    others: list[dict[str, float]] = []
    with ThreadPoolExecutor(threads) as pool:
        for number, view in enumerate(views):
            with_mesh = number % _MESH_EVERY == _MESH_EVERY - 1
            clock = Clock()
            before, share = _ours(clock, density, view, before, with_mesh, pool)
            other = {'cores': clock.cores} | ({} if share is None else {'of rays': share})
            times = [clock.seconds, clock.cpu]
            if peer:
                theirs = _theirs(peer, view, with_mesh)
                other['Open3D cores'] = theirs.cores
                times = [clock.seconds | theirs.seconds, clock.cpu | theirs.cpu]
            for rows, values in zip((wall, cpu), times):
                rows.append(_with_sums(values))
            others.append(other)
    return {
        'shown': {
            'integrate': _median(wall, 'integrate', scale=1e3),
            'x': _median(wall, 'integrate', 'Open3D integrate'),
            'march': _median(wall, 'march', scale=1e3),
            'x ': _median(wall, 'march', 'Open3D ray cast'),
            'stride 2': _median(wall, 'march 2', scale=1e3),
            'x  ': _median(wall, 'march 2', 'Open3D ray cast'),
            'again': _median(wall, 'again', scale=1e3), 'of rays': _median(others, 'of rays'),
            'view mesh': _median(wall, 'mesh', scale=1e3),
            'x   ': _median(wall, 'mesh', 'Open3D mesh'),
            'cores': _median(others, 'cores'), 'Open3D cores': _median(others, 'Open3D cores')},
        'ms': {name: _median(wall, name, scale=1e3) for name in _PARTS},
        'CPU ms': {name: _median(cpu, name, scale=1e3) for name in _PARTS}}


def _with_sums(times: dict[str, float]) -> dict[str, float]:
    """Return the parts of a frame with what a march of all pixels, or a quarter, takes."""
    return times | {
        'march' + every: times['prefilter'] + times['start' + every] + times['rays' + every]
        for every in ('', ' 2')}


def _median(
    rows: Sequence[dict[str, float]], name: str, over: str = '', *, scale: float = 1.0
) -> float | None:
    """Return the median of a value, or of its quotient by another, where it was measured."""
    values = [
        scale * row[name] / (row[over] if over else 1.0) for row in rows
        if name in row and (not over or over in row)]
    return float(np.median(values)) if values else None


def _ours(
    clock: Clock, density: VoxelDensity, view: View, before: Rays | None, with_mesh: bool,
    pool: ThreadPoolExecutor,
) -> tuple[Rays, float | None]:
    """Return the view's rays, and the share of the last view's that had to march again."""
    clock('integrate', density.add, view, pool)
    clock('prefilter', density.refresh, pool)
    for name, stride in ((' 2', 2), ('', 1)):
        rays = clock('start' + name, rays_of, density, view, stride, SETTINGS.start, pool)
        clock('rays' + name, march, density, rays, np.arange(len(rays.pixels)), pool)
    share = None
    if before is not None:
        changed = clock('again', stale, density, before, slice(None), pool)
        clock('again', march, density, before, changed, pool)
        share = len(changed) / max(len(before.pixels), 1)
    if with_mesh:
        clock(
            'mesh', view_mesh, density, rays, view.camera.width, 1, SETTINGS.min_confidence,
            SETTINGS.min_edge_likelihood, pool)
    return rays, share


def _theirs(peer: tsdf.Tsdf, view: View, with_mesh: bool) -> Clock:
    clock = Clock()
    frame = tsdf.Frame(view)
    clock('Open3D integrate', peer.integrate, frame)
    clock('Open3D ray cast', peer.ray_cast, frame)
    if with_mesh:
        clock('Open3D mesh', peer.mesh)
    return clock


def measure_pieces(data: Path) -> list[dict[str, Any]]:
    """Print and return what a voxel, a block and a ray cost on one thread."""
    warm_up(SETTINGS)
    rows = []
    for name, voxels in VOXELS.items():
        for view in frames(data, name, 1, SETTINGS):
            rows += [
                {'data': name, 'voxel mm': 1e3 * voxel_size} | _pieces(view, voxel_size)
                for voxel_size in voxels]
    table(
        'One frame in an empty map, one thread: nanoseconds of CPU time each, best of some runs',
        rows)
    return rows


def _pieces(view: View, voxel_size: float) -> dict[str, Any]:
    clocks = []
    for _ in range(_REPEATS):
        density = density_of(voxel_size)
        clock = Clock()
        clock('first', density.add, view)
        voxels = np.count_nonzero(density.blocks.value)
        density.refresh()
        touched = np.count_nonzero(density.blocks.touched)
        clock('again', density.add, view)
        clock('block', density.refresh)
        rays = clock('start', rays_of, density, view, 1, SETTINGS.start)
        clock('ray', march, density, rays, np.arange(len(rays.pixels)))
        rays.marched[:] = density.change - 1
        clock('ask', stale, density, rays, slice(None))
        clocks.append(clock.cpu)
    best = {name: 1e9 * min(times[name] for times in clocks) for name in clocks[0]}
    count = max(len(rays.pixels), 1)
    evaluations = float(rays.iterations.mean())
    return {
        'blocks': int(touched), 'voxels': int(voxels), 'rays': count,
        'voxel, new': best['first'] / voxels, 'voxel': best['again'] / voxels,
        'block prefiltered': best['block'] / touched, 'start': best['start'] / count,
        'ray': best['ray'] / count, 'evaluations': evaluations,
        'evaluation': best['ray'] / count / evaluations, 'asked': best['ask'] / count}


def measure_threads(data: Path, count: int) -> list[dict[str, Any]]:
    """Print and return how much faster two threads are than one, in turns."""
    warm_up(SETTINGS)
    rows = []
    for name, voxels in VOXELS.items():
        views = frames(data, name, count, SETTINGS)
        for voxel_size in voxels if views else ():
            clocks: list[list[dict[str, float]]] = []
            with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(2) as two:
                pools = [(pool, density_of(voxel_size)) for pool in (one, two)]
                for view in views:
                    clocks.append([])
                    for pool, density in pools:
                        clock = Clock()
                        _ours(clock, density, view, None, False, pool)
                        clocks[-1].append(_with_sums(clock.seconds))
            rows.append({'data': name, 'voxel mm': 1e3 * voxel_size} | {
                part: float(np.median([one[part] / two[part] for one, two in clocks]))
                for part in ('integrate', 'prefilter', 'start', 'rays', 'march')})
    table('Times as fast with two threads as with one (medians over frames)', rows)
    return rows
