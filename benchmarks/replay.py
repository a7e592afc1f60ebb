# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A whole recording through the reconstruction: speed, its course over time, memory."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any

from common import found, frames, recorded, table
import numpy as np
from stages import DEPTH_MAX, VOXELS

from gr2t_ros.core.blocks import BYTES_PER_BLOCK
from gr2t_ros.core.ray_march import Rays
from gr2t_ros.core.reconstruction import Reconstruction, Update
from gr2t_ros.core.view import View
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.settings import Settings
from gr2t_ros.tools.report import peak_memory_mb

SETTINGS = Settings(voxel_size=0.01)
_STAGES = ('read', 'integrate', 'march', 'again')


def measure_replay(data: Path, name: str, every: bool, count: int | None) -> dict[str, Any]:
    """
    Replay a recording at 1 cm, other parameters at their defaults, and print how it went.

    :param every: whether every frame owns a mesh, so that all pixels of all frames are marched
    :param count: frames; None: all
    """
    path = found(data, name)
    if path is None:
        return {}
    settings = SETTINGS.updated({'keyframe_translation': 0.0}) if every else SETTINGS
    warm_up(settings)
    at_start = peak_memory_mb()
    with closing(Reconstruction(settings)) as reconstruction:
        seconds, updates, loop = _loop(reconstruction, islice(recorded(path, settings), count))
        began = perf_counter()
        last = reconstruction.finish()
        finish = perf_counter() - began
        peak = peak_memory_mb()
        blocks = _blocks(reconstruction)
        keyframes = reconstruction.keyframes
        rays = sum(len(keyframe.rays.pixels) for keyframe in keyframes)
        bytes_of_rays = sum(_bytes_of_rays(keyframe.rays) for keyframe in keyframes)
    frame_ms = 1e3 * np.sum([seconds[stage] for stage in _STAGES], axis=0)
    quarter = len(frame_ms) // 4
    row: dict[str, Any] = {
        'data': name + (', all keyframes' if every else ''), 'frames': len(frame_ms),
        'keyframes': len(keyframes), 'frames/s': len(frame_ms) / loop,
        'p50 ms': float(np.median(frame_ms)), 'p95 ms': float(np.percentile(frame_ms, 95)),
        **{f'{stage} %': 100 * float(np.sum(seconds[stage])) / loop for stage in _STAGES},
        'finish s': finish,
        'last/2nd quarter': float(
            np.median(frame_ms[-quarter:]) / np.median(frame_ms[quarter:2 * quarter]))}
    table(f'{row["data"]}, voxel 1 cm, all cores', [row])
    memory = {
        'peak MB': peak, 'before MB': at_start, 'blocks': blocks, 'bytes a block': BYTES_PER_BLOCK,
        'blocks MB': 1e-6 * blocks * BYTES_PER_BLOCK, 'rays': rays,
        'bytes a ray': bytes_of_rays / max(rays, 1), 'rays MB': 1e-6 * bytes_of_rays,
        'marched': sum(update.marched for update in [*updates, last]),
        'marched again': sum(update.remarched for update in [*updates, last])}
    table('its memory and rays', [memory])
    return row | memory | {'frame ms': [round(float(ms), 2) for ms in frame_ms]}


def _loop(
    reconstruction: Reconstruction, stream: Iterator[View]
) -> tuple[dict[str, list[float]], list[Update], float]:
    """Return the seconds of each stage and frame, the updates, and the wall time of all."""
    seconds: dict[str, list[float]] = {stage: [] for stage in _STAGES}
    updates: list[Update] = []
    began = perf_counter()
    while True:
        started = perf_counter()
        view = next(stream, None)
        if view is None:
            return seconds, updates, perf_counter() - began
        seconds['read'].append(perf_counter() - started)
        update = reconstruction.add(view)
        updates.append(update)
        seconds['integrate'].append(update.seconds['integrate'])
        # a frame's new and old rays cost the same each
        new = update.marched / max(update.marched + update.remarched, 1)
        seconds['march'].append(new * update.seconds['march'])
        seconds['again'].append((1 - new) * update.seconds['march'])


def measure_blocks(data: Path) -> list[dict[str, Any]]:
    """Print and return how many blocks a square metre of surface takes, with h3 = voxel size."""
    rows = []
    for name, voxels in VOXELS.items():
        # one view at a time, for the areas of several overlap
        views = frames(data, name, 10, Settings(depth_max=DEPTH_MAX))[::3]
        for voxel_size in voxels if views else ():
            settings = Settings(
                depth_bandwidth=voxel_size, depth_bandwidth_quadratic=0.0, voxel_size=voxel_size,
                depth_max=DEPTH_MAX)
            shares = []
            for view in views:
                with closing(Reconstruction(settings)) as reconstruction:
                    reconstruction.add(view)
                    shares.append(_blocks(reconstruction) / _area(reconstruction.mesh(0)))
            per_area = float(np.median(shares))
            rows.append({
                'data': name, 'voxel mm': 1e3 * voxel_size, 'blocks/m2': per_area,
                'MB/m2': 1e-6 * per_area * BYTES_PER_BLOCK})
    table('blocks of a square metre of one view\'s mesh', rows)
    return rows


def _blocks(reconstruction: Reconstruction) -> int:
    """Return the number of blocks; the first stands for none."""
    assert isinstance(reconstruction.density, VoxelDensity)
    return reconstruction.density.blocks.size - 1


def _bytes_of_rays(rays: Rays) -> int:
    """Return the memory of all that is kept for each ray."""
    own = (getattr(rays, item.name) for item in fields(rays))
    return sum(array.nbytes for array in own if array.shape == rays.pixels.shape)


def _area(mesh: ViewMesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, n]] for n in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
