# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One mesh out of all keyframes.

Every keyframe's maxima are a depth image with little noise. On a grid about them, each voxel
averages its distances to the keyframes' surfaces, weighted by how sure the maxima are and how much
they face their camera; the mesh is where the average is zero.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

from numba import njit
import numpy as np
from numpy.typing import NDArray

from ..settings import Settings
from .blocks import key_of, place_of, places_of, with_keys
from .compiled import run_all
from .fused_grid import (
    add_view,
    BYTES_PER_BLOCK,
    Grid,
    new_grid,
    reached,
    Views,
    views_of,
    without_empty,
)
from .fused_surface import surface
from .fused_view import Bandwidth, FusedView, spread
from .islands import without_islands
from .new_density import voxel_size_for
from .ray_march import Density, Rays
from .seen_through import blocks_seen_through
from .view import View
from .voxel_density import VoxelDensity

Doubles = NDArray[np.float64]
Region = tuple[int, int, int]
Seen = tuple[Views, Bandwidth, Bandwidth, float]

REGION = 8  # blocks; side of a region
MIN_COMPONENT = 50  # triangles
_BLOCKS, _MANY = 128, 4096  # a task


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """
    A triangle mesh of several views' surface.

    :param vertices: (n, 3) float64, world, metres
    :param vertex_likelihood: (n,) float32, 1 / (px^2 m)
    :param vertex_sigma: (n,) float32, standard deviation across the surface, metres
    :param vertex_confidence: (n,) float32, 0 to 1
    :param vertex_views: (n,) int32, how many keyframes support the vertex
    :param faces: (m, 3) int32, indices of vertices, anticlockwise seen from outside
    """

    vertices: Doubles
    vertex_likelihood: NDArray[np.float32]
    vertex_sigma: NDArray[np.float32]
    vertex_confidence: NDArray[np.float32]
    vertex_views: NDArray[np.int32]
    faces: NDArray[np.int32]


_NONE = np.zeros(0, np.float32)
_EMPTY = SurfaceMesh(
    np.zeros((0, 3)), _NONE, _NONE, _NONE, np.zeros(0, np.int32), np.zeros((0, 3), np.int32))


class FusedMap:
    """
    The fused map of a reconstruction, empty at first.

    The same keyframes give the same map, bit for bit, whichever way it came about.
    """

    def __init__(self) -> None:
        self._voxel = 0.0  # metres, as the first update has it
        self._min_confidence = 0.0
        self._images: dict[View, FusedView] = {}
        self._grid = new_grid()
        self._change = 0
        self._changed: list[NDArray[np.int64]] = []  # regions, (n, 3), that were not returned yet

    @property
    def nbytes(self) -> int:
        """Return the memory it takes."""
        return BYTES_PER_BLOCK * (self._grid.size - 1) + sum(
            image.nbytes for image in self._images.values())

    @property
    def regions(self) -> list[Region]:
        """Return the regions that may have a mesh."""
        return _unique(_regions_of(self._grid.key[1:self._grid.size]))

    def update(
        self, density: Density | None, keyframes: Sequence[tuple[View, Rays]],
        settings: Settings, pool: Executor | None,
    ) -> list[Region]:
        """
        Take in what was marched since the last time.

        :param keyframes: all of them, in a fixed order; those without rays do not count
        :return: the regions whose mesh may have changed, each once
        """
        keyframes = [(view, rays) for view, rays in keyframes if len(rays.pixels)]
        if density is None:
            return []
        self.keep(density, [view for view, _ in keyframes], pool)
        if self._voxel == 0 and keyframes:
            self._voxel = (
                density.voxel_size if isinstance(density, VoxelDensity)
                else voxel_size_for(settings, keyframes[0][0])[0])
        if settings.min_confidence != self._min_confidence:
            self._min_confidence = settings.min_confidence
            for image in self._images.values():
                image.forget()
        self._images = {
            view: self._images.get(view) or FusedView(view.camera, settings.ray_stride)
            for view, _ in keyframes}
        fresh = [item for item in keyframes if self._images[item[0]].rounds != item[1].rounds]
        for view, rays in fresh:
            touched = self._images[view].update(
                density, rays, self._min_confidence, self._voxel, pool)
            self._take_in(density, view, touched, pool)
        changed, self._changed = self._changed, []
        return _unique(np.concatenate([np.zeros((0, 3), np.int64), *changed]))

    def keep(
        self, density: Density, views: Sequence[View], pool: Executor | None
    ) -> None:
        """Forget all keyframes but some, and the blocks that are empty then."""
        gone = set(self._images) - set(views)
        for view in gone:
            image = self._images.pop(view)  # the kernels know where it is, and do not keep it
            seen = self._seen(density, {view: image})
            blocks = np.arange(1, self._grid.size, dtype=np.int32)
            keys = reached(new_grid(1), self._grid.key[blocks], *seen, 0)
            self._sum(seen, self._blocks_of(keys), -1, pool)
            self._judge_anew(seen[0], density.bandwidth, pool)
        if gone:
            self._grid = without_empty(self._grid)

    def _take_in(
        self, density: Density, view: View, keys: NDArray[np.int64], pool: Executor | None
    ) -> None:
        """Replace what a keyframe said before in the blocks with some keys by what it says now."""
        image = self._images[view]
        now = self._seen(density, {view: image})
        blocks = self._blocks_of(reached(self._grid, keys, *now, 0))
        if image.former is not None:
            self._sum(self._seen(density, {view: image.former}), blocks, -1, pool)
            image.former = None
        self._sum(now, blocks, 1, pool)
        changed = now[0]._replace(
            address=np.array([[0, image.changed.ctypes.data]]),
            depth=np.array([[-np.inf, np.inf]]))  # as they were, too
        self._judge_anew(changed, density.bandwidth, pool)

    def _judge_anew(self, views: Views, bandwidth: Bandwidth, pool: Executor | None) -> None:
        """Note the regions with something that a keyframe, the only one of views, sees through."""
        sigma = spread(bandwidth, self._voxel)
        blocks = np.arange(1, self._grid.size, dtype=np.int32)
        through = np.concatenate([np.zeros(0, np.bool_), *run_all(pool, blocks_seen_through, [
            (self._grid, blocks[i:i + _MANY], views, sigma, self._voxel)
            for i in range(0, len(blocks), _MANY)])])
        self._changed.append(np.unique(
            _regions_of(_before(self._grid, blocks[through])), axis=0))

    def _blocks_of(self, keys: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the blocks with some keys, made where there are none; note that they change."""
        self._change += 1
        self._grid, blocks = with_keys(self._grid, keys, self._change, new=new_grid)
        self._changed.append(np.unique(_regions_of(_before(self._grid, blocks)), axis=0))
        return blocks

    def _sum(
        self, seen: Seen, blocks: NDArray[np.int32], sign: int, pool: Executor | None
    ) -> None:
        """Add what one keyframe says to the blocks, or subtract it."""
        run_all(pool, add_view, [
            (self._grid, blocks[i:i + _BLOCKS], *seen, 0, sign)
            for i in range(0, len(blocks), _BLOCKS)])

    def mesh(
        self, density: Density | None, pool: Executor | None,
        min_component: int = MIN_COMPONENT, region: Region | None = None,
    ) -> SurfaceMesh:
        """
        Return the mesh of all regions, joined, or of one.

        :param min_component: triangles; parts that have fewer are left out, but for those that
            may go on in another region
        """
        blocks = np.arange(1, self._grid.size, dtype=np.int32)
        if density is None or len(blocks) == 0:
            return _EMPTY
        if region is not None:
            blocks = blocks[(_regions_of(self._grid.key[blocks]) == region).all(axis=1)]
        found = without_islands(
            surface(self._grid, blocks, *self._seen(density, self._images), pool),
            min_component)
        return SurfaceMesh(
            found.vertices, density.likelihood(found.vertices, pool).astype(np.float32),
            found.sigma, found.confidence, found.views, found.faces)

    def _seen(self, density: Density, images: Mapping[View, FusedView]) -> Seen:
        """Return what the kernels need of keyframes."""
        return (
            views_of(images), density.bandwidth, spread(density.bandwidth, self._voxel),
            self._voxel)


def _regions_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the regions (n, 3) of blocks with some keys."""
    return places_of(keys) // REGION


def _unique(regions: NDArray[np.int64]) -> list[Region]:
    return [(x, y, z) for x, y, z in np.unique(regions, axis=0).tolist()]


@njit(cache=True, nogil=True)
def _before(grid: Grid, blocks: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the keys of some blocks and those whose cells reach into them, with repetitions."""
    out = np.zeros(8 * len(blocks), np.int64)
    for n in range(len(blocks)):
        x, y, z = place_of(grid.key[blocks[n]])
        for m in range(8):
            out[8 * n + m] = key_of(x - (m & 1), y - (m >> 1 & 1), z - (m >> 2))
    return out
