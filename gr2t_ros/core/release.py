# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Memory's bound: what is far from the camera is handed out, finished, and forgotten.

A keyframe that leaves is marched to the end, meshed, and given to the caller's sink; its number
stays, without rays. Then go the lattice's blocks that no other keyframe's rays need, so that all
that stays is as it would be without a bound.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
import os
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from ..errors import FrameError, Gr2tError
from ..settings import Settings
from . import fused_grid
from .blocks import BYTES_PER_BLOCK, VOXELS
from .colour import Colouring
from .ray_march import march, Rays, stale
from .view import View
from .voxel_density import VoxelDensity

if TYPE_CHECKING:
    from .reconstruction import Keyframe, Reconstruction
    from .view_mesh import ViewMesh

Sink = Callable[[int, 'ViewMesh', Colouring], None]

_SLOTS = 4 * (8 + 4)  # bytes of the hash for a block, at least
BYTES_PER_RAY = 28
# what a block and a ray come to: with the fused map that is made in the end, or for a snapshot;
# with the copy for that, see frozen.py, too, of rays also what changes while it is written
_BLOCK = BYTES_PER_BLOCK + _SLOTS + fused_grid.BYTES_PER_BLOCK
_BLOCK_COPIED = _BLOCK + BYTES_PER_BLOCK - 4 * VOXELS
_RAY = BYTES_PER_RAY + 10
_RAY_COPIED = _RAY + 30
_AT_WORK = 8  # keyframes, the newest, that are never released
_RECENT = 50  # changes: blocks that a view touched since then stay
_PAUSE = 5.0  # s before a sink that failed is tried again


class MemoryBound:
    """
    Holds an engine's memory to settings.max_memory_mb, where it has a sink.

    A sink takes a keyframe's number, its mesh and how the map is coloured now; it raises Gr2tError
    where it cannot keep them.
    """

    def __init__(self) -> None:
        self._failure = ''
        self._again = 0.0  # by the monotonic clock
        self._news: list[int] = []

    def news(self) -> tuple[int, ...]:
        """Return the keyframes that were released since this was asked last."""
        news, self._news = tuple(self._news), []
        return news

    def make_room(self, engine: Reconstruction, view: View, keyframe: bool) -> None:
        """
        Release keyframes, the farthest from a view first, until the view may come.

        :param keyframe: whether it is to be one: where max_keyframes is reached, one that is too
            far away to see what the view sees leaves
        :raises FrameError: if there is nothing to release, or the sink fails; nothing is lost then
        """
        if engine.sink is None:
            return
        limit = limit_of(engine.settings)
        if isinstance(engine.density, VoxelDensity):
            engine.density.most_blocks = limit // _BLOCK
        while used_by(engine) > limit:
            number, _ = _farthest(engine, view)
            if number is None:
                _forget_blocks(engine)
                if used_by(engine) <= limit:
                    break
                raise FrameError('memory', (
                    f'the map\'s {used_by(engine) / 1e6:.0f} MB are all near the camera, and '
                    f'max_memory_mb allows {limit / 1e6:.0f}: raise it, voxel_size or ray_stride'))
            self._release(engine, number)
        if keyframe and engine.kept >= engine.settings.max_keyframes:
            number, away = _farthest(engine, view)
            if number is not None and away > 2 * engine.settings.depth_max:
                self._release(engine, number)

    def _release(self, engine: Reconstruction, number: int) -> None:
        if engine.sink is not None and monotonic() >= self._again:
            try:
                _finish(engine, number)
                engine.sink(number, engine.mesh(number), engine.colouring())
                self._failure = ''
            except Gr2tError as error:
                self._failure = str(error)
                self._again = monotonic() + _PAUSE
        if self._failure:
            raise FrameError('memory', (
                'the memory that max_memory_mb allows is full, and what is far away cannot be '
                f'written out: {self._failure}'))
        _empty(engine.keyframes[number])
        self._news.append(number)
        engine.fused.keep(engine.density, [
            keyframe.view for keyframe in engine.keyframes if not keyframe.released], engine.pool)
        _forget_blocks(engine)


def limit_of(settings: Settings) -> int:
    """Return how many bytes a map may take: where max_memory_mb is 0, half of the machine's."""
    if settings.max_memory_mb:
        return settings.max_memory_mb * 10 ** 6
    return os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') // 2


def used_by(engine: Reconstruction) -> int:
    """Return a map's bytes, with what is kept free for making meshes of it."""
    if not engine.keyframes:
        return 0
    block, ray = (_BLOCK_COPIED, _RAY_COPIED) if engine.copied else (_BLOCK, _RAY)
    used = engine.fused.nbytes
    for keyframe in engine.keyframes:
        used += keyframe.view.depth.nbytes + ray * len(keyframe.rays.pixels)
        used += keyframe.blocks.nbytes if keyframe.blocks is not None else 0
    if isinstance(engine.density, VoxelDensity):
        return used + block * engine.density.blocks.size
    return used + sum(np.asarray(array).nbytes for array in engine.density.state.views)


def _farthest(engine: Reconstruction, view: View) -> tuple[int | None, float]:
    """Return the keyframe farthest from a view that may be released, and how far it is (m)."""
    farthest, most = None, -1.0
    here = view.T_world_camera[:3, 3]
    for number, keyframe in enumerate(engine.keyframes[:-_AT_WORK]):
        if not keyframe.released:
            away = float(np.linalg.norm(keyframe.view.T_world_camera[:3, 3] - here))
            if away > most:
                farthest, most = number, away
    return farthest, most


def _finish(engine: Reconstruction, number: int) -> None:
    """March those of a keyframe's rays that wait."""
    engine.density.refresh(engine.pool)
    rays = engine.keyframes[number].own_rays()
    chosen = stale(engine.density, rays, slice(0, len(rays.pixels)), engine.pool)
    march(engine.density, rays, chosen, engine.pool)


def _empty(keyframe: Keyframe) -> None:
    """Forget all but the pose."""
    keyframe.released = True
    keyframe.view = replace(keyframe.view, depth=np.zeros((0, 0), np.float32))
    keyframe.rays = replace(keyframe.rays, **{
        item.name: getattr(keyframe.rays, item.name)[:0].copy() for item in fields(Rays)
        if item.init and item.name not in ('table', 'T_world_camera')})
    if keyframe.blocks is not None:
        keyframe.blocks = keyframe.blocks[:0].copy()


def _forget_blocks(engine: Reconstruction) -> None:
    density = engine.density
    if not isinstance(density, VoxelDensity):
        return
    watched = np.zeros(density.blocks.size, np.bool_)
    for keyframe in engine.keyframes:
        if keyframe.blocks is not None:
            watched[keyframe.blocks] = True
    renumbered = density.forget(watched, density.change - _RECENT, engine.pool)
    for keyframe in engine.keyframes:
        if keyframe.blocks is not None and len(keyframe.blocks):
            keyframe.blocks = renumbered[keyframe.blocks]
